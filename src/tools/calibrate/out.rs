//! The file for the gains.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use super::Error;

/// The name of the file, beside the configuration, if the command line names none.
const DEFAULT: &str = "gains.npy";

/// A file that is being made, at a temporary path until it is whole.
pub(super) struct Out {
    path: PathBuf,
    part: PathBuf,
    /// Whether an empty file at `path` keeps the place.
    is_claimed: bool,
}

impl Out {
    /// Makes the temporary file, which shows that the file can be made. A file that the command
    /// line names will be replaced. Without a name, the file lies beside `config`, and replaces
    /// nothing.
    pub(super) fn begin(named: Option<PathBuf>, config: &Path) -> Result<Self, Error> {
        let is_claimed = named.is_none();
        let path = named.unwrap_or_else(|| config.with_file_name(DEFAULT));
        if is_claimed {
            claim(&path)?;
        }
        let mut part = path.clone().into_os_string();
        part.push(format!(".{}.part", std::process::id()));
        let out = Self {
            path,
            part: part.into(),
            is_claimed,
        };
        out.tried(File::create_new(&out.part).map(drop))?;
        Ok(out)
    }

    /// The path of the whole file.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn finish(mut self, bytes: &[u8]) -> Result<(), Error> {
        self.tried(fs::write(&self.part, bytes))?;
        self.tried(fs::rename(&self.part, &self.path))?;
        self.is_claimed = false;
        Ok(())
    }

    fn tried(&self, result: io::Result<()>) -> Result<(), Error> {
        result.map_err(|source| Error::Out {
            path: self.path.clone(),
            source,
        })
    }
}

impl Drop for Out {
    fn drop(&mut self) {
        // After a success, the temporary file is gone already.
        let _ = fs::remove_file(&self.part);
        if self.is_claimed {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Makes an empty file, so that two commands at a time cannot write to the same path.
fn claim(path: &Path) -> Result<(), Error> {
    let path = path.to_owned();
    match File::create_new(&path) {
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Err(Error::Taken { path }),
        Err(source) => Err(Error::Out { path, source }),
    }
}
