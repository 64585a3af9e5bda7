//! The trainer: one subcommand a stage, from simulated presses to the file the daemon loads.

mod account;
mod arguments;
mod collect;
mod configuration;
mod fit;
mod models;
mod signals;
mod simulate;
mod train;

use std::error::Error;
use std::io::{self, Write as _};
use std::process::ExitCode;

use anyhow::Context as _;
use clap::Parser as _;
use clap::error::ErrorKind;
use hardnessd_core::trial;
use hardnessd_core::verdict::ModelError;
use hardnessd_core::{exit, wording};
use hrn_train::compare;
use hrn_train::exit::Coded;

use self::arguments::{Arguments, Command};

/// A training step frees and asks for the same large buffers over and over. The system's allocator
/// gives them back to the kernel each time, which took 40 % of a step.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    if let Some(code) = trial::entry() {
        return code;
    }
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => return usage(&error),
    };
    let how_to_continue = match arguments.command {
        Command::Train(_) => signals::again(Some("--resume")),
        Command::Compare(_) => signals::again(None),
        _ => None,
    };
    // Without this, the first work of the pool would panic where the system has no thread left.
    let pool = || rayon::ThreadPoolBuilder::new().build_global();
    let prepared = signals::end_at_signals(how_to_continue).context("signals");
    if let Err(error) = prepared.and_then(|()| pool().context("threads")) {
        hardnessd_core::stderr_line!("hrn-train: {}", wording::line(error.as_ref()));
        return ExitCode::from(exit::IO);
    }
    let done = match arguments.command {
        Command::Simulate(arguments) => simulate::simulate(&arguments),
        Command::Collect(arguments) => collect::collect(&arguments),
        // Training runs on a thread of the pool. From outside, every operation on several threads
        // would first have to wake one of them.
        Command::Train(arguments) => rayon::scope(|_| train::train(&arguments)),
        Command::Fit(arguments) => fit::fit(&arguments),
        Command::Compare(plan) => compare::compare(&plan),
        Command::Evaluate(arguments) => models::evaluate(&arguments),
        Command::Export { run, out } => models::export_run(&run, &out),
        Command::CheckModel { model, fps } => models::check_model(&model, fps),
        Command::Inspect { model } => account::of_model(&model),
    };
    match done.and_then(|account| Ok(print(&account)?)) {
        Ok(_) => ExitCode::SUCCESS,
        Err(error) => {
            hardnessd_core::stderr_line!("hrn-train: {}", wording::line(error.as_ref()));
            ExitCode::from(exit_code(&error))
        }
    }
}

/// The exit code of an error: its own, 78 bad model, 74 other I/O error, 1 any other error.
fn exit_code(error: &anyhow::Error) -> u8 {
    let mut chain = error.chain();
    if let Some(own) = chain.find_map(|error| error.downcast_ref::<Coded>()) {
        own.code
    } else if error.chain().any(<dyn Error>::is::<ModelError>) {
        exit::CONFIG
    } else if error.chain().any(<dyn Error>::is::<io::Error>) {
        exit::IO
    } else {
        exit::FAILED
    }
}

/// Prints clap's error on one line, or the help or the version if the command line asks for it. A
/// command line without a command gets the help too.
fn usage(error: &clap::Error) -> ExitCode {
    if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        // If stderr has gone, nobody reads the help.
        let _ = error.print();
        return ExitCode::from(exit::USAGE);
    }
    if error.use_stderr() {
        hardnessd_core::stderr_line!("hrn-train: {}", wording::of_usage(&error.to_string()));
        return ExitCode::from(exit::USAGE);
    }
    print(&error.to_string()).map_or(ExitCode::from(exit::IO), |()| ExitCode::SUCCESS)
}

/// Prints to stdout. If nobody reads any more, that is no error.
fn print(text: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let text = wording::lines(text);
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}
