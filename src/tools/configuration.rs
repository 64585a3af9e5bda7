//! Which configuration a command uses when the command line names none.

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

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

/// Where to look for a configuration, in this order.
const PLACES: [&str; 2] = ["./hardnessd.toml", "/etc/hardnessd.toml"];

impl Configuration {
    /// The named file, else the first that exists. In the second case stderr says which.
    ///
    /// # Errors
    ///
    /// [`Missing`], if none was named and there is none.
    pub fn path(&self) -> Result<PathBuf, Missing> {
        if let Some(config) = &self.config {
            return Ok(config.clone());
        }
        // A file that exists but cannot be read is an error, not a reason to try the next.
        let there = |path: &&str| Path::new(path).symlink_metadata().is_ok();
        let found = PLACES.into_iter().find(there).ok_or(Missing)?;
        eprintln!("hardnessd: configuration {found}");
        Ok(PathBuf::from(found))
    }
}
