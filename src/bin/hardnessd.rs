//! The daemon's binary: arguments, log, runtime, signals, exit codes.

use std::future::Future;
use std::io;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use hardnessd::daemon::config::{Error as ConfigError, Setup};
use hardnessd::daemon::log::{Log, Settings as LogSettings};
use hardnessd::daemon::publish::Error as PublishError;
use hardnessd::daemon::record::Error as RecordError;
use hardnessd::daemon::socket::Error as SocketError;
use hardnessd::daemon::{Daemon, Error as DaemonError, Reload};
use hardnessd::tools::args::{Args, Command};
use hardnessd::tools::{
    self, check, demo, doctor, record, recover, replay, simulate, sniff, tail, watch,
};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc;

/// What an operator's script may rely on.
mod exit {
    pub(super) const FAILED: u8 = 1;
    pub(super) const USAGE: u8 = 2;
    pub(super) const NO_INPUT: u8 = 66;
    pub(super) const UNAVAILABLE: u8 = 69;
    pub(super) const IO: u8 = 74;
    pub(super) const CONFIG: u8 = 78;
}

/// How long what is being written may take to be whole.
const LAST_LINES: Duration = Duration::from_millis(200);

fn main() -> ExitCode {
    let runtime = match tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("hardnessd: no runtime: {error}");
            return ExitCode::from(exit::IO);
        }
    };
    // Before all else, be it the arguments: a signal that comes early must not kill.
    let signals = {
        let _inside = runtime.enter();
        Signals::catch()
    };
    let signals = match signals {
        Ok(signals) => signals,
        Err(error) => {
            eprintln!("hardnessd: no signals: {error}");
            return ExitCode::from(exit::IO);
        }
    };
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(error) => return tools::usage("hardnessd", &error),
    };
    let prints = !matches!(args.command, Command::Run { .. });
    let done = runtime.block_on(dispatch(args.command, signals));
    // A port may be stuck in its driver on a thread of its own, or nobody read stdout.
    runtime.shutdown_timeout(if prints { LAST_LINES } else { Duration::ZERO });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("hardnessd: {}", tools::line(error.as_ref()));
            ExitCode::from(exit_code(&error))
        }
    }
}

async fn dispatch(command: Command, signals: Signals) -> anyhow::Result<()> {
    match command {
        Command::Run { config } => run(config, signals).await,
        Command::Demo(args) => {
            // The events are what is shown: the log would say each again.
            let _log = Log::start(LogSettings::default(), "warn")?;
            Ok(demo::run(args, signals.end()).await?)
        }
        Command::Simulate(args) => Ok(simulate::run(args, signals.end()).await?),
        Command::Record(args) => {
            let mut end = pin!(signals.end());
            let Some(setup) = load(&args.config, end.as_mut()).await? else {
                return Ok(());
            };
            let _log = Log::start(setup.config.log, "info")?;
            Ok(record::run(args, setup, end).await?)
        }
        Command::Recover(args) => interruptible(signals, move || recover::run(&args)).await,
        Command::Replay(args) => Ok(replay::run(args, signals.end()).await?),
        Command::Tail(args) => Ok(tail::run(args, signals.end()).await?),
        Command::Watch(args) => Ok(watch::run(args, signals.end()).await?),
        Command::Check(args) => interruptible(signals, move || check::run(&args)).await,
        Command::Doctor(args) => interruptible(signals, move || doctor::run(&args)).await,
        Command::Sniff(args) => Ok(sniff::run(args, signals.end()).await?),
    }
}

/// Work that looks for no signal; one ends it, and that it is not done is said.
async fn interruptible<E: std::error::Error + Send + Sync + 'static>(
    signals: Signals,
    work: impl FnOnce() -> Result<(), E> + Send + 'static,
) -> anyhow::Result<()> {
    let done = until(signals.end(), work).await?;
    if done.is_none() {
        eprintln!("hardnessd: interrupted");
    }
    Ok(())
}

/// The configuration and its model; `None`: `end` came first.
async fn load(path: &Path, end: impl Future<Output = ()>) -> anyhow::Result<Option<Setup>> {
    let path = path.to_owned();
    until(end, move || Setup::load(&path)).await
}

/// What `work` gives, on a thread of its own: a file may be a pipe that says nothing. `None`: `end`
/// came first, and nobody waits for the thread.
async fn until<T: Send + 'static, E: std::error::Error + Send + Sync + 'static>(
    end: impl Future<Output = ()>,
    work: impl FnOnce() -> Result<T, E> + Send + 'static,
) -> anyhow::Result<Option<T>> {
    tokio::select! {
        done = tokio::task::spawn_blocking(work) => Ok(Some(done??)),
        () = end => Ok(None),
    }
}

async fn run(path: PathBuf, signals: Signals) -> anyhow::Result<()> {
    let (shutdown, mut hangup) = signals.apart();
    let mut shutdown = pin!(shutdown);
    let Some(setup) = load(&path, shutdown.as_mut()).await? else {
        return Ok(());
    };
    let log = Log::start(setup.config.log, "info")?;
    let daemon = Daemon::bind(setup)?;
    let (request, requests) = mpsc::channel(1);
    tokio::spawn(async move {
        while hangup.recv().await.is_some() {
            // A request that waits already will see this change too.
            let _ = request.try_send(());
        }
    });
    Ok(daemon
        .run(
            shutdown,
            Some(Reload {
                requests,
                path,
                log,
            }),
        )
        .await?)
}

/// The signals that this process takes.
struct Signals {
    interrupt: Signal,
    terminate: Signal,
    hangup: Signal,
    /// Whether whoever started it wants it to outlive the terminal, as nohup(1) does.
    outlives_terminal: bool,
}

impl Signals {
    /// From now on none of them kills.
    fn catch() -> io::Result<Self> {
        // Which it was is known only before one is caught.
        let outlives_terminal = ignores_hangup();
        // A file that must not grow is no reason to die of: the write fails, as on a full disk.
        drop(signal(SignalKind::from_raw(
            rustix::process::Signal::XFSZ.as_raw(),
        ))?);
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            hangup: signal(SignalKind::hangup())?,
            outlives_terminal,
        })
    }

    /// SIGINT, SIGTERM, or SIGHUP of a terminal that has gone.
    async fn end(self) {
        let outlives_terminal = self.outlives_terminal;
        let (shutdown, mut hangup) = self.apart();
        tokio::select! {
            () = shutdown => {}
            _ = hangup.recv(), if !outlives_terminal => {}
        }
    }

    /// SIGINT or SIGTERM, and SIGHUP for another use.
    fn apart(self) -> (impl Future<Output = ()>, Signal) {
        let Self {
            mut interrupt,
            mut terminate,
            hangup,
            ..
        } = self;
        let shutdown = async move {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
        };
        (shutdown, hangup)
    }
}

/// Whether SIGHUP is ignored, by proc_pid_status(5): `SigIgn` is a mask in hex, signal 1 its lowest
/// bit. Where /proc is hidden it is taken not to be.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}

fn exit_code(error: &anyhow::Error) -> u8 {
    let of_config = |error: &ConfigError| match error {
        ConfigError::Unreadable { .. } => exit::NO_INPUT,
        _ => exit::CONFIG,
    };
    let of_daemon = |error: &DaemonError| match error {
        // The configuration names a file that it must not.
        DaemonError::Publish(PublishError::Socket(
            SocketError::NoSocket { .. }
            | SocketError::NoDirectory { .. }
            | SocketError::TooLong { .. },
        )) => exit::CONFIG,
        DaemonError::Record(RecordError::Directory { .. }) | DaemonError::Log(_) => exit::CONFIG,
        DaemonError::Publish(PublishError::Unasked { .. } | PublishError::Passed(_)) => {
            exit::CONFIG
        }
        // In use or refused: another time it may work.
        DaemonError::Publish(_) | DaemonError::Random(_) => exit::IO,
        DaemonError::Record(RecordError::Unavailable { .. } | RecordError::Lost { .. }) => {
            exit::UNAVAILABLE
        }
        DaemonError::Record(_) => exit::IO,
        DaemonError::Stopped(_) => exit::FAILED,
    };
    if let Some(error) = error.downcast_ref::<ConfigError>() {
        return of_config(error);
    }
    if let Some(error) = error.downcast_ref::<DaemonError>() {
        return of_daemon(error);
    }
    if let Some(error) = error.downcast_ref::<check::Error>() {
        return match error {
            check::Error::Config(error) => of_config(error),
            check::Error::Daemon { source, .. } => of_daemon(source),
            check::Error::FrameRate { .. } => exit::CONFIG,
            check::Error::Print(_) => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<demo::Error>() {
        return match error {
            demo::Error::Config(error) => of_config(error),
            demo::Error::Daemon(error) => of_daemon(error),
            demo::Error::Layout(_) => exit::CONFIG,
            demo::Error::Io { .. } => exit::IO,
            demo::Error::Missed { .. } | demo::Error::Closed => exit::FAILED,
        };
    }
    if let Some(error) = error.downcast_ref::<simulate::Error>() {
        return match error {
            simulate::Error::Faults(error) if error.is_unreadable() => exit::NO_INPUT,
            simulate::Error::Faults(_) => exit::FAILED,
            simulate::Error::Layout(_) | simulate::Error::Baud { .. } => exit::USAGE,
            simulate::Error::Recording { .. } | simulate::Error::Pty { .. } => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<record::Error>() {
        return match error {
            record::Error::Level { .. } => exit::USAGE,
            record::Error::Create { .. } => exit::IO,
            record::Error::Daemon(error) => of_daemon(error),
        };
    }
    if let Some(error) = error.downcast_ref::<recover::Error>() {
        return match error {
            recover::Error::Unreadable { .. } => exit::NO_INPUT,
            recover::Error::Nothing { .. } | recover::Error::Foreign { .. } => exit::FAILED,
            recover::Error::Broken { .. } | recover::Error::Write { .. } => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<replay::Error>() {
        return match error {
            replay::Error::Config(error) => of_config(error),
            replay::Error::Unreadable { .. } => exit::NO_INPUT,
            replay::Error::Recording { .. }
            | replay::Error::Sensor { .. }
            | replay::Error::NoFrame { .. } => exit::FAILED,
            replay::Error::Broken { .. } | replay::Error::Print(_) => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<tail::Error>() {
        return match error {
            tail::Error::Timeout { .. } => exit::FAILED,
            tail::Error::NoDaemon { .. }
            | tail::Error::Mute { .. }
            | tail::Error::Foreign { .. }
            | tail::Error::Refused { .. }
            | tail::Error::Closed { .. } => exit::UNAVAILABLE,
            tail::Error::Print(_) => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<watch::Error>() {
        return match error {
            watch::Error::NoTerminal => exit::USAGE,
            watch::Error::Terminal(_) => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<doctor::Error>() {
        return match error {
            doctor::Error::Faults { .. } => exit::FAILED,
            doctor::Error::Print(_) => exit::IO,
        };
    }
    if let Some(error) = error.downcast_ref::<sniff::Error>() {
        return match error {
            sniff::Error::Unreadable { .. } => exit::NO_INPUT,
            sniff::Error::Recording { .. } => exit::FAILED,
            sniff::Error::Unavailable { .. } => exit::UNAVAILABLE,
            sniff::Error::Unexplained { .. } => exit::FAILED,
            sniff::Error::Print(_) => exit::IO,
        };
    }
    if error.is::<hardnessd::daemon::log::Error>() {
        return exit::CONFIG;
    }
    if error.is::<io::Error>() {
        return exit::IO;
    }
    exit::FAILED
}
