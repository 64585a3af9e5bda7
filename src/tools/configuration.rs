//! The configuration that a command uses when the command line names none.

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use hardnessd_core::exit::{Coded, NO_INPUT};

/// The argument `--config`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Configuration {
    /// Configuration [default: ./hardnessd.toml, else /etc/hardnessd.toml]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
}

/// No configuration was named, and none was found.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no configuration: there is neither {} nor {}: name one with --config",
    PLACES[0],
    PLACES[1]
)]
pub struct Missing;

impl Coded for Missing {
    fn exit_code(&self) -> u8 {
        NO_INPUT
    }
}

/// The argument `--model`.
#[derive(Debug, Clone, ClapArgs)]
pub struct ModelFile {
    /// Model that judges, in place of the configuration's or the built-in one
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
}

/// The file of `--model` cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("--model {0}")]
pub struct NoModel(#[source] super::CannotRead);

impl Coded for NoModel {
    fn exit_code(&self) -> u8 {
        NO_INPUT
    }
}

impl ModelFile {
    /// The path of the model, if the command line names one.
    ///
    /// # Errors
    ///
    /// Returns [`NoModel`] if the file cannot be opened.
    pub fn path(&self) -> Result<Option<PathBuf>, NoModel> {
        let Some(path) = &self.model else {
            return Ok(None);
        };
        super::open(path).map_err(NoModel)?;
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
    /// Returns [`Missing`] if the command line names no configuration and no default path exists.
    pub fn path(&self) -> Result<PathBuf, Missing> {
        if let Some(config) = &self.config {
            return Ok(config.clone());
        }
        // If a file exists but cannot be read, that is an error, not a reason to try the next path.
        let there = |path: &&str| Path::new(path).symlink_metadata().is_ok();
        let found = PLACES.into_iter().find(there).ok_or(Missing)?;
        hardnessd_core::stderr_line!("hardnessd: configuration {found}");
        Ok(PathBuf::from(found))
    }
}
