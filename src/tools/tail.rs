//! `hardnessd tail`: prints events of a running daemon on stdout, for people and for scripts.
//!
//! It prints the events of the requested types, and `--count` counts them. They include the current
//! statuses that a connection begins with. A `gap` is printed where it happened, but not counted.
//! `hello` is not printed.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use clap::Args as ClapArgs;
use serde_json::{Value, json};

use super::answer;
use super::connect::Source;
use super::exit::{FAILED, Failure};
use super::readable::printed;
use crate::maybe;
use crate::thread::spawn_thread;
use hardnessd_core::event::Kind;
use hardnessd_core::stderr_line;
use hardnessd_core::wording::{escaped, named, positive};

/// What `--help` says below the options.
const MORE: &str = "\
    Times are UTC. The line of a verdict begins with the time of its publication; the frame that \
    it judges follows, with its own time. Exit code 69: no daemon answers within 5 s, it has too \
    many subscribers, or it has ended.";

/// Arguments of `tail`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    #[command(flatten)]
    source: Source,
    /// Print the JSON lines as they are
    #[arg(long)]
    json: bool,
    /// End after N events of these types, the first statuses included [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// End with exit code 1 if not done after S seconds in all [default: no limit]
    #[arg(long, value_name = "S", value_parser = positive)]
    timeout: Option<f64>,
    /// Types of events: hardness, press, status, frame
    #[arg(
        long,
        value_name = "T,...",
        value_delimiter = ',',
        value_parser = named::<Kind>,
        default_value = "hardness,press,status"
    )]
    types: Vec<Kind>,
}

/// Prints until the count is reached, `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// Returns a [`Failure`] if no daemon answers, the daemon ends, or the time limit has passed.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    let (timeout, count) = (args.timeout, args.count);
    let counted = Arc::new(AtomicU64::new(0));
    let found = counted.clone();
    let printed = spawn_thread("tail", move || print(&args, &counted))?;
    tokio::select! {
        printed = printed => return printed.expect("events are printed without a panic"),
        () = shutdown => return Ok(()),
        () = maybe::until(maybe::after(timeout)) => {}
    }
    let seconds = timeout.unwrap_or_default();
    let found = found.load(Ordering::Relaxed);
    let wanted = count.map_or(String::new(), |count| format!(" of {count}"));
    let problem = format!("timed out after {seconds} s ({found}{wanted} events)");
    Err(Failure::new(FAILED, problem))
}

fn print(args: &Args, counted: &AtomicU64) -> Result<(), Failure> {
    let mut daemon = args.source.connect()?;
    // A daemon that has no room for another client says so in place of its hello.
    let labels = answer::labels(&daemon.meet()?);
    daemon.send(&json!({"subscribe": args.types}).to_string())?;
    // This comes after the connection is made: if no daemon answers, the error must be the only
    // line.
    if args.source.given().is_none() {
        stderr_line!(
            "hardnessd: events of {}",
            escaped(&daemon.address.to_string())
        );
    }
    let mut found = 0;
    while args.count != Some(found) {
        let line = daemon.next()?;
        let event: Value = serde_json::from_str(&line).unwrap_or_default();
        let kind = event["type"].as_str().unwrap_or_default();
        // Events that were queued before the subscription took effect are left out.
        let counts = named::<Kind>(kind).is_ok_and(|kind| args.types.contains(&kind));
        if !counts && kind != "gap" {
            continue;
        }
        if !super::print(printed(&line, args.json, &labels).as_bytes())? {
            return Ok(());
        }
        found += u64::from(counts);
        counted.store(found, Ordering::Relaxed);
    }
    Ok(())
}
