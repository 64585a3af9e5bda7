//! The file that is being written, and the free space on its disk.

use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::daemon::config;
use hardnessd_core::frame::Stamp;
use hardnessd_core::part;
use hardnessd_core::recording::{self, About, Entry, Writer};

/// The bytes of a megabyte in the decimal sense, as in the sizes of disks.
pub(super) const MB: u64 = 1_000_000;

/// A file that is being written.
pub(super) struct Open {
    pub(super) path: PathBuf,
    pub(super) file: Arc<File>,
    pub(super) writer: Writer<BufWriter<Arc<File>>>,
    pub(super) since: Instant,
}

impl Open {
    pub(super) fn new(path: PathBuf, file: File, about: &About) -> Result<Self, recording::Error> {
        let file = Arc::new(file);
        let writer = Writer::new(BufWriter::new(file.clone()), about)?;
        Ok(Self {
            path,
            file,
            writer,
            since: Instant::now(),
        })
    }

    /// Makes a new file in `directory` that holds these entries, each after the index of its sensor. Its name has
    /// `what` and the time. If this fails, no file is left, because the disk may be full.
    pub(super) fn filled<'a>(
        directory: &Path,
        what: &str,
        about: &About,
        entries: impl Iterator<Item = (usize, &'a (Stamp, Entry))>,
    ) -> Result<Self, recording::Error> {
        let now = jiff::Timestamp::now().strftime("%Y%m%dT%H%M%S%.3fZ");
        let path = directory.join(format!("{what}-{now}.mcap"));
        let file = File::create_new(&path).map_err(|error| named(&path, &error))?;
        let fill = || {
            let mut open = Self::new(path.clone(), file, about)?;
            for (sensor, (at, entry)) in entries {
                open.writer.entry(sensor, *at, entry)?;
            }
            open.writer.flush()?;
            Ok(open)
        };
        fill().inspect_err(|_| {
            // A file that cannot be removed stays.
            let _ = fs::remove_file(&path);
        })
    }

    /// Whether the next file is due: this one is full or old, or somebody has deleted or moved it.
    pub(super) fn is_over(&self, settings: &config::Record) -> bool {
        let bytes = self.file.metadata().map_or(0, |file| file.len());
        bytes >= settings.rotate_mb * MB
            || self.since.elapsed() >= Duration::from_secs(settings.rotate_s)
            || part::is_at(&self.path, &self.file).is_ok_and(|is_there| !is_there)
    }

    pub(super) fn finish(self) -> Result<(), recording::Error> {
        self.writer.finish()?;
        Ok(())
    }
}

/// Makes `directory` if it is missing. Fails if fewer than `floor` bytes are free on its disk.
pub(super) fn has_room(directory: &Path, floor: u64) -> io::Result<()> {
    fs::create_dir_all(directory).map_err(|error| named(directory, &error))?;
    let disk = rustix::fs::statvfs(directory).map_err(|error| named(directory, &error.into()))?;
    let free = disk.f_bavail.saturating_mul(disk.f_frsize);
    if free < floor {
        let message = format!(
            "{}: found {} MB free, expected at least {} (record.keep_free_mb)",
            directory.display(),
            free / MB,
            floor / MB
        );
        return Err(io::Error::new(ErrorKind::StorageFull, message));
    }
    Ok(())
}

fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}
