//! The failures of commands and their exit codes, which an operator's scripts may rely on.

#[cfg(feature = "zenoh")]
use super::fleet;
#[cfg(feature = "watch")]
use super::watch;
use super::{
    calibrate, check, configuration, demo, doctor, record, recover, replay, simulate, sniff, tail,
};
pub use hardnessd_core::exit::{CONFIG, FAILED, IO, NO_INPUT, UNAVAILABLE, USAGE};

use crate::daemon;
use crate::daemon::config::Error as ConfigError;
use crate::daemon::publish::Error as PublishError;
use crate::daemon::record::Error as RecordError;
use crate::daemon::socket::Error as SocketError;

/// A signal that ends a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// SIGHUP, which the system sends when the terminal has gone.
    Hangup = 1,
    /// SIGINT.
    Interrupt = 2,
    /// SIGTERM.
    Terminate = 15,
}

impl Stop {
    /// The exit code of a command that the signal ended early: 128 and the signal's number, as in a
    /// shell.
    fn code(self) -> u8 {
        128 + self as u8
    }
}

/// An error of a command of `hardnessd`.
#[derive(Debug, thiserror::Error)]
#[expect(
    missing_docs,
    reason = "each is the command's own, and says what it is"
)]
pub enum Failure {
    #[error("interrupted before it had finished")]
    Stopped(Stop),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Missing(#[from] configuration::Missing),
    #[error(transparent)]
    Log(#[from] daemon::log::Error),
    #[error(transparent)]
    Daemon(#[from] daemon::Error),
    #[error(transparent)]
    Demo(#[from] demo::Error),
    #[error(transparent)]
    Simulate(#[from] simulate::Error),
    #[error(transparent)]
    Record(#[from] record::Error),
    #[error(transparent)]
    Recover(#[from] recover::Error),
    #[error(transparent)]
    Replay(#[from] replay::Error),
    #[error(transparent)]
    Tail(#[from] tail::Error),
    #[cfg(feature = "watch")]
    #[error(transparent)]
    Watch(#[from] watch::Error),
    #[cfg(feature = "zenoh")]
    #[error(transparent)]
    Fleet(#[from] fleet::Error),
    #[error(transparent)]
    Check(#[from] check::Error),
    #[error(transparent)]
    Calibrate(#[from] calibrate::Error),
    #[error(transparent)]
    Doctor(#[from] doctor::Error),
    #[error(transparent)]
    Sniff(#[from] sniff::Error),
}

impl Failure {
    /// The exit code.
    pub fn code(&self) -> u8 {
        match self {
            Self::Stopped(stop) => stop.code(),
            Self::Config(error) => of_config(error),
            Self::Missing(_) => NO_INPUT,
            Self::Log(_) => CONFIG,
            Self::Daemon(error) => of_daemon(error),
            Self::Demo(error) => of_demo(error),
            Self::Simulate(error) => of_simulate(error),
            Self::Record(error) => of_record(error),
            Self::Recover(error) => of_recover(error),
            Self::Replay(error) => of_replay(error),
            Self::Tail(error) => of_tail(error),
            #[cfg(feature = "watch")]
            Self::Watch(watch::Error::NoTerminal) => USAGE,
            #[cfg(feature = "watch")]
            Self::Watch(watch::Error::Terminal(_)) => IO,
            #[cfg(feature = "zenoh")]
            Self::Fleet(fleet::Error::Unavailable { .. }) => UNAVAILABLE,
            #[cfg(feature = "zenoh")]
            Self::Fleet(fleet::Error::Thread(_) | fleet::Error::Print(_)) => IO,
            Self::Check(error) => of_check(error),
            Self::Calibrate(error) => of_calibrate(error),
            Self::Doctor(doctor::Error::Faults { .. }) => FAILED,
            Self::Doctor(doctor::Error::Print(_)) => IO,
            Self::Sniff(error) => of_sniff(error),
        }
    }
}

fn of_config(error: &ConfigError) -> u8 {
    match error {
        ConfigError::Unreadable { .. } => NO_INPUT,
        _ => CONFIG,
    }
}

fn of_daemon(error: &daemon::Error) -> u8 {
    match error {
        // The configuration names a path that the daemon cannot use.
        daemon::Error::Publish(PublishError::Socket(
            SocketError::NoSocket { .. }
            | SocketError::NoDirectory { .. }
            | SocketError::TooLong { .. },
        )) => CONFIG,
        daemon::Error::Record(RecordError::Directory { .. }) | daemon::Error::Log(_) => CONFIG,
        daemon::Error::Publish(PublishError::Unasked { .. } | PublishError::Passed(_)) => CONFIG,
        // The address is in use, or the system refused. A later try may succeed.
        daemon::Error::Publish(_) | daemon::Error::Random(_) => IO,
        daemon::Error::Record(RecordError::Unavailable { .. } | RecordError::Lost { .. }) => {
            UNAVAILABLE
        }
        daemon::Error::Record(_) => IO,
        daemon::Error::Stopped(_) => FAILED,
    }
}

fn of_demo(error: &demo::Error) -> u8 {
    match error {
        demo::Error::Config(error) => of_config(error),
        demo::Error::Daemon(error) => of_daemon(error),
        demo::Error::Missed { .. } | demo::Error::Closed => FAILED,
        demo::Error::Io { .. } => IO,
        demo::Error::Layout(_) => CONFIG,
    }
}

fn of_simulate(error: &simulate::Error) -> u8 {
    match error {
        simulate::Error::Faults(error) if error.is_unreadable() => NO_INPUT,
        simulate::Error::Faults(_) => FAILED,
        simulate::Error::Layout(_) | simulate::Error::Baud { .. } => USAGE,
        simulate::Error::Recording { .. } | simulate::Error::Pty { .. } => IO,
    }
}

fn of_record(error: &record::Error) -> u8 {
    match error {
        record::Error::Level { .. }
        | record::Error::Twice { .. }
        | record::Error::Asked { .. }
        | record::Error::NoTerminal => USAGE,
        record::Error::Session { .. } | record::Error::Create { .. } => IO,
        record::Error::Unavailable { .. } => UNAVAILABLE,
        record::Error::Daemon(error) => of_daemon(error),
    }
}

fn of_recover(error: &recover::Error) -> u8 {
    match error {
        recover::Error::Unreadable { .. } => NO_INPUT,
        recover::Error::Nothing { .. } | recover::Error::Foreign { .. } => FAILED,
        recover::Error::Broken { .. } | recover::Error::Write { .. } => IO,
    }
}

fn of_replay(error: &replay::Error) -> u8 {
    match error {
        replay::Error::Config(error) => of_config(error),
        replay::Error::Unreadable { .. } => NO_INPUT,
        replay::Error::Motion { source, .. } if source.is_unreadable() => NO_INPUT,
        replay::Error::Motion { .. }
        | replay::Error::Recording { .. }
        | replay::Error::Sensor { .. }
        | replay::Error::NoFrame { .. } => FAILED,
        replay::Error::OwnMotion { .. } => USAGE,
        replay::Error::Broken { .. } | replay::Error::Print(_) => IO,
    }
}

fn of_tail(error: &tail::Error) -> u8 {
    match error {
        tail::Error::Connect(_)
        | tail::Error::Mute { .. }
        | tail::Error::Foreign { .. }
        | tail::Error::Refused { .. } => UNAVAILABLE,
        tail::Error::Timeout { .. } => FAILED,
        tail::Error::Print(_) => IO,
    }
}

fn of_check(error: &check::Error) -> u8 {
    match error {
        check::Error::Config(error) => of_config(error),
        check::Error::Daemon { source, .. } => of_daemon(source),
        check::Error::Missing(_) => NO_INPUT,
        check::Error::FrameRate { .. } => CONFIG,
        check::Error::Print(_) => IO,
    }
}

fn of_calibrate(error: &calibrate::Error) -> u8 {
    match error {
        calibrate::Error::Daemon(error) => of_daemon(error),
        calibrate::Error::NoSensor { .. }
        | calibrate::Error::Unasked
        | calibrate::Error::NoFile => USAGE,
        calibrate::Error::Missing { .. } => NO_INPUT,
        calibrate::Error::Recording { source, .. } if source.is_io() => IO,
        calibrate::Error::Arm(_)
        | calibrate::Error::Force(_)
        | calibrate::Error::Taxels(_)
        | calibrate::Error::Count { .. }
        | calibrate::Error::Recording { .. } => FAILED,
        calibrate::Error::Temporary { .. }
        | calibrate::Error::Taken { .. }
        | calibrate::Error::Out { .. }
        | calibrate::Error::Print(_) => IO,
    }
}

fn of_sniff(error: &sniff::Error) -> u8 {
    match error {
        sniff::Error::Unreadable { .. } => NO_INPUT,
        sniff::Error::Recording { .. } | sniff::Error::Unexplained { .. } => FAILED,
        sniff::Error::Unavailable { .. } => UNAVAILABLE,
        sniff::Error::Print(_) | sniff::Error::Write { .. } => IO,
    }
}
