//! The configuration that a command uses when the command line names none.

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

use super::exit::{Fail, Failure, NO_INPUT};
use hardnessd_core::stderr_line;

/// The argument `--config`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Configuration {
    /// Configuration [default: ./hardnessd.toml, else /etc/hardnessd.toml]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
}

/// The argument `--model`.
#[derive(Debug, Clone, ClapArgs)]
pub struct ModelFile {
    /// Model that judges, in place of the configuration's or the built-in one
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
}

impl ModelFile {
    /// The path of the model, if the command line names one.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be opened.
    pub fn path(&self) -> Result<Option<PathBuf>, Failure> {
        let Some(path) = &self.model else {
            return Ok(None);
        };
        let what = format!("--model {}: cannot read", path.display());
        super::open_file(path).of(what, NO_INPUT)?;
        Ok(Some(path.clone()))
    }
}

/// The paths at which a configuration is looked for, in this order.
pub(super) const PLACES: [&str; 2] = ["./hardnessd.toml", "/etc/hardnessd.toml"];

impl Configuration {
    /// The named file, or else the first default path that exists. In the second case, stderr names
    /// it.
    ///
    /// # Errors
    ///
    /// Fails if the command line names no configuration and no default path exists.
    pub fn path(&self) -> Result<PathBuf, Failure> {
        if let Some(config) = &self.config {
            return Ok(config.clone());
        }
        // If a file exists but cannot be read, that is an error, not a reason to try the next path.
        let there = |path: &&str| Path::new(path).symlink_metadata().is_ok();
        let Some(found) = PLACES.into_iter().find(there) else {
            let [first, second] = PLACES;
            return Err(Failure::new(
                NO_INPUT,
                format!(
                    "no configuration: there is neither {first} nor {second}: name one with --config"
                ),
            ));
        };
        stderr_line!("hardnessd: configuration {found}");
        Ok(PathBuf::from(found))
    }
}
