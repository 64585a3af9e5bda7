//! The failure of a command: an error on one line, and its exit code.

use std::fmt::{Debug, Display};

use rustix::process::Signal;

use crate::daemon;
use crate::thread::NoThread;
pub use hardnessd_core::exit::{FAILED, IO, NO_INPUT, UNAVAILABLE, USAGE};
use hardnessd_core::wording;

/// The error of a command, and the exit code of the program that ends with it.
#[derive(Debug)]
pub struct Failure {
    error: anyhow::Error,
    /// The exit code.
    pub code: u8,
}

impl Failure {
    /// A failure with a message of its own.
    pub fn new(code: u8, message: impl Display + Debug + Send + Sync + 'static) -> Self {
        let error = anyhow::Error::msg(message);
        Self { error, code }
    }

    /// A failure whose message begins with what failed, such as a path, and ends with the cause.
    pub(super) fn of(code: u8, what: impl Display, cause: impl Into<anyhow::Error>) -> Self {
        let error = cause.into().context(what.to_string());
        Self { error, code }
    }

    /// A signal ended a command before it had finished. The code is 128 and the signal's number, as
    /// in a shell.
    pub fn interrupted(signal: Signal) -> Self {
        let number = u8::try_from(signal.as_raw()).unwrap_or_default();
        Self::new(128 + number, "interrupted before it had finished")
    }

    /// The error and its causes on one line.
    pub fn line(&self) -> String {
        wording::line(&*self.error)
    }
}

impl From<daemon::Error> for Failure {
    fn from(error: daemon::Error) -> Self {
        let code = error.exit_code();
        let error = error.into();
        Self { error, code }
    }
}

impl From<NoThread> for Failure {
    fn from(error: NoThread) -> Self {
        daemon::Error::from(error).into()
    }
}

/// Gives an error its exit code.
pub(super) trait Fail<T> {
    /// Fails with this exit code.
    fn exit(self, code: u8) -> Result<T, Failure>;

    /// Like [`Failure::of`].
    fn of(self, what: impl Display, code: u8) -> Result<T, Failure>;
}

impl<T, E: Into<anyhow::Error>> Fail<T> for Result<T, E> {
    fn exit(self, code: u8) -> Result<T, Failure> {
        self.map_err(|error| Failure {
            error: error.into(),
            code,
        })
    }

    fn of(self, what: impl Display, code: u8) -> Result<T, Failure> {
        self.map_err(|error| Failure::of(code, what, error))
    }
}
