//! The failure of a command: an error on one line, and its exit code.

pub use hardnessd_core::exit::{Coded, IO, USAGE};
use hardnessd_core::wording;

/// A signal that ended a command before it had finished.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("interrupted before it had finished")]
pub enum Stop {
    /// SIGHUP, which the system sends when the terminal has gone.
    Hangup = 1,
    /// SIGINT.
    Interrupt = 2,
    /// SIGTERM.
    Terminate = 15,
}

impl Coded for Stop {
    /// 128 and the signal's number, as in a shell.
    fn exit_code(&self) -> u8 {
        128 + *self as u8
    }
}

/// The error of any command.
#[derive(Debug)]
pub struct Failure(Box<dyn Coded + Send>);

impl<E: Coded + Send + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(Box::new(error))
    }
}

impl Failure {
    /// The error and its causes on one line.
    pub fn line(&self) -> String {
        wording::line(&*self.0)
    }

    /// The exit code.
    pub fn code(&self) -> u8 {
        self.0.exit_code()
    }
}
