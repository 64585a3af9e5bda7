//! Which configuration a command takes, where the command line may leave it out.

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

/// The argument `--config`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Configuration {
    /// Configuration [default: ./hardnessd.toml, else /etc/hardnessd.toml]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
}

/// There is no configuration to be found.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no configuration: there is neither {} nor {}: name one with --config",
    PLACES[0],
    PLACES[1]
)]
pub struct Missing;

/// Where a configuration is looked for.
const PLACES: [&str; 2] = ["./hardnessd.toml", "/etc/hardnessd.toml"];

impl Configuration {
    /// The file that was named, else the first that there is; which one is then said on stderr.
    ///
    /// # Errors
    ///
    /// [`Missing`], if none was named and there is none.
    pub fn path(&self) -> Result<PathBuf, Missing> {
        if let Some(config) = &self.config {
            return Ok(config.clone());
        }
        // One that is there and cannot be read must not be passed over.
        let there = |path: &&str| Path::new(path).symlink_metadata().is_ok();
        let found = PLACES.into_iter().find(there).ok_or(Missing)?;
        eprintln!("hardnessd: configuration {found}");
        Ok(PathBuf::from(found))
    }
}
