//! `hardnessd generate`: man pages and completions, for whoever makes a package.
//!
//! Both come from the definition of the command line itself, so that there is no second one. Hidden
//! from the help: who runs the daemon finds the files installed.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use clap::{Args as ClapArgs, Command};
use clap_complete::Shell;

/// Arguments of `generate`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Directory to write to; made if it is missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A file cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {source}")]
pub struct Error {
    path: PathBuf,
    source: io::Error,
}

/// Writes `hardnessd.1`, a page for each command, and completions for bash, zsh and fish.
///
/// # Errors
///
/// [`Error`], if a file cannot be written.
pub fn run(args: Args, command: Command) -> Result<(), Error> {
    let out = args.out;
    write(&out, command).map_err(|source| Error { path: out, source })
}

fn write(out: &Path, mut command: Command) -> io::Result<()> {
    fs::create_dir_all(out)?;
    clap_mangen::generate_to(command.clone(), out)?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut command, "hardnessd", out)?;
    }
    Ok(())
}
