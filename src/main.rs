//! The daemon's binary: arguments, log, runtime, signals, exit codes.

use std::future::Future;
use std::io::{self, Write as _};
use std::panic;
use std::path::{Path, PathBuf};
use std::pin::{Pin, pin};
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use hardnessd::daemon::config::{self, Setup};
use hardnessd::daemon::log::{Log, Settings as LogSettings};
use hardnessd::daemon::{Daemon, Reload};
use hardnessd::thread;
use hardnessd::tools::args::{Args, Command};
use hardnessd::tools::exit::{self, Failure};
#[cfg(feature = "watch")]
use hardnessd::tools::watch;
use hardnessd::tools::{
    self, calibrate, check, control, demo, doctor, identify, record, recover, replay, simulate,
    sniff, tail,
};
use hardnessd_core::trial;
use rustix::process;
use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{Signal, SignalKind, signal};

/// How long a write that is under way may take to finish.
const LAST_LINES: Duration = Duration::from_millis(200);

fn main() -> ExitCode {
    if let Some(code) = trial::entry() {
        return code;
    }
    // Nothing here needs memory: where there is none, a backtrace would never end.
    panic::set_hook(Box::new(|panic| {
        let what = panic.payload_as_str().unwrap_or("a panic");
        let _ = match panic.location() {
            Some(place) => writeln!(io::stderr(), "hardnessd: {what} ({place})"),
            None => writeln!(io::stderr(), "hardnessd: {what}"),
        };
        std::process::abort();
    }));
    // Signals come before everything else, even the arguments: an early signal must not kill the
    // process.
    let (runtime, signals) = match with_signals() {
        Ok(started) => started,
        Err(error) => {
            hardnessd_core::stderr_line!("hardnessd: no runtime and signals: {error}");
            return ExitCode::from(exit::IO);
        }
    };
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(error) => return tools::usage(&error),
    };
    let prints = !matches!(args.command, Command::Run(_));
    let done = runtime.block_on(dispatch(args.command, signals));
    // A thread may still wait for a port's driver or for the reader of stdout.
    runtime.shutdown_background();
    if prints {
        thread::finish(LAST_LINES);
    }
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let line = error.line();
            thread::bounded(LAST_LINES, move || {
                hardnessd_core::stderr_line!("hardnessd: {line}");
            });
            ExitCode::from(error.code)
        }
    }
}

/// The runtime of the commands, and the signals, which it handles.
fn with_signals() -> io::Result<(Runtime, Signals)> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let inside = runtime.enter();
    let signals = Signals::catch()?;
    drop(inside);
    Ok((runtime, signals))
}

async fn dispatch(command: Command, signals: Signals) -> Result<(), Failure> {
    match command {
        Command::Run(args) => run(args.config.path()?, args.model.path()?, signals).await,
        Command::Demo(args) => {
            // The events are the output. The log would repeat each of them.
            let _log = Log::start(LogSettings::default(), "error")?;
            demo::run(args, signals.received()).await
        }
        Command::Simulate(args) if args.is_for_file() => {
            finish(signals, simulate::run(args, std::future::pending())).await
        }
        Command::Simulate(args) => simulate::run(args, signals.received()).await,
        Command::Record(args) => {
            let mut end = pin!(signals.received());
            let path = args.config.path()?;
            let setup = tokio::select! {
                setup = load(move || Setup::load(&path, None)) => setup?,
                () = &mut end => return Ok(()),
            };
            // Lines of the log would come between the questions of a session.
            let level = if args.is_session() { "warn" } else { "info" };
            let log = Log::start(setup.config.log, level)?;
            record::run(args, setup, &log, end).await
        }
        Command::Recover(args) => finish_blocking(signals, move || recover::run(&args)).await,
        Command::Replay(args) => finish_blocking(signals, move || replay::run(&args)).await,
        Command::Tail(args) => tail::run(args, signals.received()).await,
        #[cfg(feature = "watch")]
        Command::Watch(args) => watch::run(args, signals.received()).await,
        Command::Control(command) => finish_blocking(signals, || control::run(command)).await,
        Command::Check(args) => finish_blocking(signals, move || check::run(&args)).await,
        Command::Calibrate(args) => {
            let path = &args.config.path()?;
            let load = |path: &Path| Setup::load(path, None);
            let command = async |setup, end: End<'_>| calibrate::run(args, setup, path, end).await;
            attend(signals, path, load, command).await
        }
        Command::Identify(args) => {
            let path = &args.config.path()?;
            let command = async |setup, end: End<'_>| identify::run(args, setup, path, end).await;
            attend(signals, path, identify::load, command).await
        }
        Command::Doctor(args) => finish_blocking(signals, move || doctor::run(&args)).await,
        Command::Sniff(args) => finish(signals, sniff::run(args)).await,
    }
}

/// The signal at which a command is to end in order.
type End<'a> = Pin<&'a mut dyn Future<Output = process::Signal>>;

/// Runs a command that serves a sensor of the configuration at `path`, and prints what it found. A signal before its end is a failure.
async fn attend(
    signals: Signals,
    path: &Path,
    read: impl FnOnce(&Path) -> Result<Setup, config::Error> + Send + 'static,
    command: impl AsyncFnOnce(Setup, End<'_>) -> Result<String, Failure>,
) -> Result<(), Failure> {
    let mut end = pin!(signals.end());
    let path = path.to_owned();
    let setup = tokio::select! {
        setup = load(move || read(&path)) => setup?,
        signal = &mut end => return Err(Failure::interrupted(signal)),
    };
    let _log = Log::start(setup.config.log, "warn")?;
    let text = command(setup, end.as_mut()).await?;
    tokio::select! {
        printed = tools::print_apart(text) => printed.map(drop),
        signal = end => Err(Failure::interrupted(signal)),
    }
}

/// Waits until `work` ends. A signal before its end is a failure.
async fn finish(
    signals: Signals,
    work: impl Future<Output = Result<(), Failure>>,
) -> Result<(), Failure> {
    tokio::select! {
        done = work => done,
        signal = signals.end() => Err(Failure::interrupted(signal)),
    }
}

/// Like [`finish`], for work that blocks. The work runs on another thread.
async fn finish_blocking(
    signals: Signals,
    work: impl FnOnce() -> Result<(), Failure> + Send + 'static,
) -> Result<(), Failure> {
    finish(signals, async { thread::run("work", work).await? }).await
}

/// Loads a configuration and its model on a thread of its own, because a file may be a pipe that sends
/// nothing.
async fn load(
    read: impl FnOnce() -> Result<Setup, config::Error> + Send + 'static,
) -> Result<Setup, Failure> {
    Ok(thread::run("load", read).await??)
}

async fn run(path: PathBuf, model: Option<PathBuf>, signals: Signals) -> Result<(), Failure> {
    let Signals {
        mut interrupt,
        mut terminate,
        hangup,
        ..
    } = signals;
    let mut shutdown = pin!(async {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    });
    let named = (path.clone(), model.clone());
    let setup = tokio::select! {
        setup = load(move || Setup::load(&named.0, named.1.as_deref())) => setup?,
        () = &mut shutdown => return Ok(()),
    };
    let log = Log::start(setup.config.log, "info")?;
    let daemon = Daemon::start(setup)?;
    let reload = Reload::start(hangup, path, model, log);
    Ok(daemon.run(shutdown, Some(reload)).await?)
}

/// The signals that this process handles.
struct Signals {
    interrupt: Signal,
    terminate: Signal,
    hangup: Signal,
    /// Whether the process was started with SIGHUP ignored, as nohup(1) does.
    outlives_terminal: bool,
}

impl Signals {
    /// Catches the signals. From now on, none of them kills the process.
    fn catch() -> io::Result<Self> {
        // This can be seen only before the signal is caught.
        let outlives_terminal = ignores_hangup();
        // At the limit of a file's size, the write fails as on a full disk, and SIGXFSZ does not
        // end the process.
        drop(signal(SignalKind::from_raw(
            process::Signal::XFSZ.as_raw(),
        ))?);
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            hangup: signal(SignalKind::hangup())?,
            outlives_terminal,
        })
    }

    /// Waits for SIGINT, SIGTERM, or SIGHUP of a terminal that has gone.
    async fn end(mut self) -> process::Signal {
        tokio::select! {
            _ = self.interrupt.recv() => process::Signal::INT,
            _ = self.terminate.recv() => process::Signal::TERM,
            _ = self.hangup.recv(), if !self.outlives_terminal => process::Signal::HUP,
        }
    }

    /// Like [`Signals::end`], for a command that runs until a signal ends it.
    async fn received(self) {
        self.end().await;
    }
}

/// Whether SIGHUP is ignored. By proc_pid_status(5), `SigIgn` is a mask in hex, and signal 1 is its
/// lowest bit. If /proc is hidden, SIGHUP counts as not ignored.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}
