//! Errors that end the program with an exit code of their own.

use std::fmt::Display;
use std::io;
use std::path::Path;

use hardnessd_core::exit::NO_INPUT;

/// An error with an exit code of [`hardnessd_core::exit`].
#[derive(Debug, thiserror::Error)]
#[error("{text}")]
pub struct Coded {
    /// The exit code of a program that ends with this error.
    pub code: u8,
    text: String,
}

/// An error of this text, with an exit code.
pub fn coded(code: u8, text: impl Display) -> anyhow::Error {
    let text = text.to_string();
    Coded { code, text }.into()
}

/// The error of a file named on the command line that cannot be read.
pub fn unreadable(path: &Path, error: &io::Error) -> anyhow::Error {
    coded(NO_INPUT, format_args!("{}: {error}", path.display()))
}
