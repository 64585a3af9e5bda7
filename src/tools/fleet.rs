//! `hardnessd fleet`: the sensors of every robot behind a zenoh router or peer, on stdout.
//!
//! In: what daemons put on zenoh. Out: a table, or JSON lines. A robot is there while its liveliness token is.
//! Nothing is sent to a robot but the question what is true now.

mod numbers;
mod robots;
mod session;
mod view;

use std::future::Future;
use std::io::{self, IsTerminal};
use std::time::Duration;

use clap::Args as ClapArgs;
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior};

use self::robots::{ASK, Fleet};
use self::session::{PATIENCE, Session, WAITING};
use super::Stdout;
use super::exit::Failure;
use super::simulate::positive;
use crate::daemon::config::Endpoint;
use crate::daemon::now;
use crate::maybe;
use hardnessd_core::exit::{Coded, IO, UNAVAILABLE};

/// Arguments of `fleet`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// A zenoh router or a daemon, tcp/HOST:PORT; of several, the first that answers
    #[arg(long, value_name = "ENDPOINT", required = true, value_parser = endpoint)]
    connect: Vec<Endpoint>,
    /// Print JSON lines: one for each sensor, once a second if something of it is new [default: a table]
    #[arg(long)]
    json: bool,
    /// End after S seconds. A table is then printed once, at the end [default: no limit]
    #[arg(long, value_name = "S", value_parser = positive)]
    seconds: Option<f64>,
}

/// Why it ended early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No router or daemon answers.
    #[error(
        "{}: no zenoh router or daemon answered within {} s",
        listed(.connect),
        PATIENCE.as_secs()
    )]
    Unavailable {
        /// As given.
        connect: Vec<Endpoint>,
    },
    /// The system gave no thread.
    #[error("no thread for zenoh: {0}")]
    Thread(#[source] io::Error),
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Unavailable { .. } => UNAVAILABLE,
            Error::Thread(_) => IO,
        }
    }
}

fn listed(endpoints: &[Endpoint]) -> String {
    let each: Vec<String> = endpoints.iter().cloned().map(String::from).collect();
    each.join(", ")
}

/// How often what is new is printed.
const TICK: Duration = Duration::from_secs(1);

fn endpoint(text: &str) -> Result<Endpoint, String> {
    Endpoint::try_from(text.to_owned()).map_err(|error| error.to_string())
}

/// Prints until `shutdown` comes, the time is over, or nobody reads stdout.
///
/// # Errors
///
/// A [`Failure`], if no router or peer answers, or stdout cannot be written to.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    let mut shutdown = std::pin::pin!(shutdown);
    let (sender, mut news) = mpsc::channel(WAITING);
    let opened = tokio::select! {
        opened = Session::open(&args.connect, sender) => opened.map_err(Error::Thread)?,
        () = &mut shutdown => return Ok(()),
    };
    let Some(session) = opened else {
        let connect = args.connect;
        return Err(Error::Unavailable { connect }.into());
    };
    let mut fleet = Fleet::default();
    let mut tick = tokio::time::interval_at(Instant::now() + TICK, TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let end = maybe::after(args.seconds);
    let mut asked = now().mono;
    let mut dropped = 0;
    // While a slow reader takes what is printed, news are still taken in.
    let mut printing = std::pin::pin!(None);
    let mut is_over = false;
    loop {
        tokio::select! {
            () = &mut shutdown => return Ok(()),
            printed = maybe::wait(printing.as_mut().as_pin_mut()) => {
                printing.set(None);
                let printed: Result<bool, Stdout> = printed;
                if !printed? || is_over {
                    return Ok(());
                }
                continue;
            }
            Some(news) = news.recv() => {
                fleet.learn(news);
                continue;
            }
            () = maybe::until(end), if printing.is_none() => is_over = true,
            _ = tick.tick() => {}
        }
        let now = now();
        fleet.settle(now);
        session.ask_for_lost_tokens();
        if now.mono - asked >= ASK {
            asked = now.mono;
            let there = fleet.robots().filter(|(_, robot)| robot.is_there);
            there.for_each(|(site, _)| session.ask(site));
        }
        if dropped != session.dropped() {
            dropped = session.dropped();
            hardnessd_core::stderr_line!(
                "hardnessd: {dropped} messages came too fast and were dropped"
            );
        }
        // The rest is printed when the reader has taken this.
        if printing.is_some() || !(args.json || is_over || end.is_none()) {
            continue;
        }
        let text = match args.json {
            true => view::lines(&mut fleet, now),
            false if end.is_none() && io::stdout().is_terminal() => {
                view::CLEAR.to_owned() + &view::table(&fleet, now)
            }
            false => view::table(&fleet, now),
        };
        printing.set(Some(super::print_apart(text.into_bytes())));
        // The text of a large fleet may take longer than a tick. News are taken in before the next one.
        tick.reset();
    }
}
