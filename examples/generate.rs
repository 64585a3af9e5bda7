//! Writes the man pages and completions of `hardnessd`, for a package:
//!
//! ```sh
//! cargo run --example generate -- DIR
//! ```
//!
//! Both are generated from the definition of the command line, so there is only one definition.

use std::fs;
use std::io;
use std::path::PathBuf;

use clap::{CommandFactory, Parser};
use clap_complete::Shell;

/// Write `hardnessd.1`, a page for each command, and completions for bash, zsh and fish
#[derive(Debug, Parser)]
struct Args {
    /// Directory to write to; made if it is missing
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

fn main() -> io::Result<()> {
    let out = Args::parse().out;
    let mut command = hardnessd::tools::args::Args::command();
    fs::create_dir_all(&out)?;
    clap_mangen::generate_to(command.clone(), &out)?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut command, "hardnessd", &out)?;
    }
    Ok(())
}
