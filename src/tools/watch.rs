//! `hardnessd watch`: the sensors of a running daemon, on a terminal.
//!
//! It is a subscriber like any other. It asks for the totals once a second, and connects again when
//! the daemon goes away. `view` keeps what is known, and `draw` draws it. This file connects both
//! with the socket, the keys and the clock.

mod draw;
mod look;
mod screen;
#[cfg(test)]
mod tests;
mod view;

use std::future::Future;
use std::io::{self, IsTerminal};
use std::pin::Pin;
use std::time::Duration;

use clap::Args as ClapArgs;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use self::draw::draw;
use self::look::Look;
use self::screen::{Screen, keys};
use self::view::{Clock, Loss, Order, QUESTION, View};
use super::connect::{Address, Connection, Source};
use super::control;
use super::exit::{Fail, Failure};
use crate::daemon::now;
use hardnessd_core::exit::{IO, USAGE};
use hardnessd_core::stderr_line;
use hardnessd_core::wording::escaped;

/// Arguments of `watch`.
#[derive(Debug, Clone, ClapArgs)]
#[command(
    after_help = "Keys: q or Ctrl-C quits; Tab, arrows or 1 to 9 choose a sensor; Ctrl-L draws \
                        again; p asks what you press (`firm`, `2`, `cup` or `cup firm`), tells it to the daemon as \
                        the context `object` and `level`, and counts right and wrong verdicts. DAEMON SILENT: no answer for 3 s. NO DAEMON: nobody answers, or the \
                        protocol is another one; `watch` connects again. A map that is not live is \
                        grey. Without colours where NO_COLOR is set or TERM has none."
)]
pub struct Args {
    #[command(flatten)]
    source: Source,
}

/// Time between two pictures: as fast as eyes can follow.
const PICTURE: Duration = Duration::from_millis(100);

/// Time between two tries to connect.
const PAUSE: Duration = Duration::from_millis(500);

/// Shows the sensors until a key or `shutdown` ends it, or the terminal goes away.
///
/// # Errors
///
/// Fails if there is no terminal or the terminal fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    if !(io::stdin().is_terminal() && io::stdout().is_terminal()) {
        let needs = "`watch` needs a terminal on stdin and stdout: use `hardnessd tail` instead";
        return Err(Failure::new(USAGE, needs));
    }
    let look = look();
    let mut view = View::new();
    let mut daemon = Daemon::new(args.source.clone());
    if args.source.given().is_none()
        && let Ok(connection) = args.source.connect().await
    {
        let address = connection.address().to_string();
        stderr_line!("hardnessd: watching {}", escaped(&address));
    }
    let mut screen = Screen::open().of("terminal", IO)?;
    let mut keys = keys().of("terminal", IO)?;
    let mut pictures = tokio::time::interval(PICTURE);
    pictures.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut questions = tokio::time::interval(QUESTION);
    questions.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut shutdown = std::pin::pin!(shutdown);
    // The address of the last connection.
    let mut daemon_at = None;
    let (told, mut outcomes) = mpsc::channel(4);
    loop {
        tokio::select! {
            // Many lines from the daemon must not delay a key or a picture.
            biased;
            () = &mut shutdown => return Ok(()),
            () = screen.gone() => return Ok(()),
            key = keys.recv() => match key.map_or(Some(Order::Quit), |key| view.press(key)) {
                Some(Order::Quit) => return Ok(()),
                Some(Order::Redraw) => screen.forget().of("terminal", IO)?,
                Some(Order::Context(context)) => {
                    tokio::spawn(tell(daemon_at.clone(), context, told.clone()));
                }
                None => {}
            },
            Some(outcome) = outcomes.recv() => view.said = Some(outcome),
            _ = pictures.tick() => {
                let drawn = screen.draw(|frame| draw(frame, &view, now().mono, look));
                drawn.of("terminal", IO)?;
            }
            _ = questions.tick() => daemon.send(r#"{"get":"status"}"#),
            received = daemon.next() => match received {
                Ok(FromDaemon::Connection(address)) => {
                    let clock = Clock::of(&address);
                    view.wait(address.to_string(), clock, now().mono);
                    daemon_at = Some(address);
                }
                Ok(FromDaemon::Line(line)) => {
                    if let Some(request) = view.take_line(&line, now()) {
                        daemon.send(&request);
                    }
                }
                Err(loss) => view.lose(loss),
            },
        }
    }
}

/// Sets a context at the control socket beside the daemon's other one, and sends the outcome in words.
async fn tell(daemon_at: Option<Address>, context: Value, told: mpsc::Sender<String>) {
    let outcome = match daemon_at {
        Some(Address::Unix(path)) => {
            let socket = path.with_file_name("control.sock");
            let request = json!({"context": context, "id": 1});
            match control::ask(Some(socket), &request).await {
                Ok(_) => "the daemon repeats it in every verdict from now on".to_owned(),
                Err(error) => format!("counted here only: {}", error.line()),
            }
        }
        _ => "counted here only: over TCP nothing can be set, use `hardnessd context`".to_owned(),
    };
    // If `watch` has ended, nobody reads it.
    let _ = told.send(outcome).await;
}

fn look() -> Look {
    let variable = |name| std::env::var(name).unwrap_or_default();
    Look::new(&variable("TERM"), &variable("NO_COLOR"))
}

/// A connection to the daemon, or a line from it.
enum FromDaemon {
    /// The daemon accepted the connection at this address.
    Connection(Address),
    Line(String),
}

/// The connection to the daemon. When it breaks, it is made again.
struct Daemon {
    source: Source,
    connection: Option<Connection>,
    /// The next try to connect.
    connecting: Pin<Box<dyn Future<Output = Result<Connection, Failure>>>>,
}

impl Daemon {
    fn new(source: Source) -> Self {
        Self {
            connecting: Box::pin(connect(source.clone(), Duration::ZERO)),
            connection: None,
            source,
        }
    }

    /// The next connection or line, or the reason why there is no daemon. Cancelling the call loses
    /// nothing.
    async fn next(&mut self) -> Result<FromDaemon, Loss> {
        if let Some(connection) = &mut self.connection {
            let line = connection.next().await;
            return line.map(FromDaemon::Line).map_err(|error| {
                self.connection = None;
                Loss::Broken(error.line())
            });
        }
        let made = self.connecting.as_mut().await;
        self.connecting = Box::pin(connect(self.source.clone(), PAUSE));
        let connection = made.map_err(|error| Loss::Unreachable(error.line()))?;
        let address = connection.address().clone();
        self.connection = Some(connection);
        Ok(FromDaemon::Connection(address))
    }

    /// Sends a request, if there is a daemon.
    fn send(&mut self, request: &str) {
        if let Some(connection) = &mut self.connection {
            connection.try_send(request);
        }
    }
}

async fn connect(source: Source, pause: Duration) -> Result<Connection, Failure> {
    tokio::time::sleep(pause).await;
    source.connect().await
}

impl Clock {
    /// The clock of a daemon at this address.
    fn of(address: &Address) -> Self {
        match address {
            Address::Unix(_) => Self::Ours,
            Address::Tcp(_) => Self::Theirs,
        }
    }
}
