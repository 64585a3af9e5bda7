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
use tokio::time::{Instant, MissedTickBehavior};

use self::draw::draw;
use self::look::Look;
use self::screen::{Screen, keys};
use self::view::{Clock, Key, Loss, QUESTION, View};
use super::connect::{self, Address, Connection, Source};
use crate::daemon::now;
use hardnessd_core::exit::{Coded, IO, USAGE};

/// Arguments of `watch`.
#[derive(Debug, Clone, ClapArgs)]
#[command(
    after_help = "Keys: q or Ctrl-C quits; Tab, arrows or 1 to 9 choose a sensor; Ctrl-L draws \
                        again. DAEMON SILENT: no answer for 3 s. NO DAEMON: nobody answers, or the \
                        protocol is another one; `watch` connects again. A map that is not live is \
                        grey. Without colours where NO_COLOR is set or TERM has none, and in ASCII \
                        unless LC_ALL, LC_CTYPE or LANG says UTF-8."
)]
pub struct Args {
    #[command(flatten)]
    source: Source,
}

/// An error of `watch`.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Stdin or stdout is not a terminal.
    #[error("`watch` needs a terminal on stdin and stdout: use `hardnessd tail` instead")]
    NoTerminal,
    /// The terminal cannot be read from or written to.
    #[error("terminal: {0}")]
    Terminal(#[source] io::Error),
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::NoTerminal => USAGE,
            Error::Terminal(_) => IO,
        }
    }
}

/// Time between two pictures: as fast as eyes can follow.
const PICTURE: Duration = Duration::from_millis(100);

/// Time between two tries to connect.
const PAUSE: Duration = Duration::from_millis(500);

/// Shows the sensors until a key or `shutdown` ends it, or the terminal goes away.
///
/// # Errors
///
/// Returns [`Error`] if there is no terminal or the terminal fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Error> {
    if !(io::stdin().is_terminal() && io::stdout().is_terminal()) {
        return Err(Error::NoTerminal);
    }
    let look = look();
    let mut view = View::new();
    let mut daemon = Daemon::new(args.source.clone());
    if args.source.given().is_none()
        && let Ok(connection) = args.source.connect().await
    {
        let address = connection.address().to_string();
        hardnessd_core::stderr_line!(
            "hardnessd: watching {}",
            hardnessd_core::wording::escaped(&address)
        );
    }
    let mut screen = Screen::open().map_err(Error::Terminal)?;
    let mut keys = keys().map_err(Error::Terminal)?;
    let mut pictures = tokio::time::interval(PICTURE);
    pictures.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut questions = tokio::time::interval(QUESTION);
    questions.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut shutdown = std::pin::pin!(shutdown);
    loop {
        tokio::select! {
            // Many lines from the daemon must not delay a key or a picture.
            biased;
            () = &mut shutdown => return Ok(()),
            () = screen.gone() => return Ok(()),
            key = keys.recv() => match key {
                None | Some(Key::Quit) => return Ok(()),
                Some(Key::Redraw) => screen.forget().map_err(Error::Terminal)?,
                Some(key) => view.press(key),
            },
            _ = pictures.tick() => {
                let drawn = screen.draw(|frame| draw(frame, &view, now().mono, look));
                drawn.map_err(Error::Terminal)?;
            }
            _ = questions.tick() => daemon.send(r#"{"get":"status"}"#),
            received = daemon.next() => match received {
                Ok(FromDaemon::Connection(address)) => {
                    let clock = Clock::of(&address);
                    view.wait(address.to_string(), clock, now().mono);
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

fn look() -> Look {
    let variable = |name| std::env::var(name).unwrap_or_default();
    let locale = ["LC_ALL", "LC_CTYPE", "LANG"].map(variable);
    let locale = locale.into_iter().find(|value| !value.is_empty());
    Look::new(
        &variable("TERM"),
        &variable("COLORTERM"),
        &variable("NO_COLOR"),
        &locale.unwrap_or_default(),
    )
}

/// The connection to the daemon. When it breaks, it is made again.
struct Daemon {
    source: Source,
    state: State,
}

enum State {
    /// There is no daemon. The next try is at this time.
    Waiting(Instant),
    Connecting(Connecting),
    Connected(Connection),
}

type Connecting = Pin<Box<dyn Future<Output = Result<Connection, connect::Error>> + Send>>;

/// A connection to the daemon, or a line from it.
enum FromDaemon {
    /// The daemon accepted the connection at this address.
    Connection(Address),
    Line(String),
}

impl Daemon {
    fn new(source: Source) -> Self {
        Self {
            source,
            state: State::Waiting(Instant::now()),
        }
    }

    /// The next connection or line, or the reason why there is no daemon. Cancelling the call loses
    /// nothing.
    async fn next(&mut self) -> Result<FromDaemon, Loss> {
        loop {
            match &mut self.state {
                State::Waiting(until) => {
                    tokio::time::sleep_until(*until).await;
                    let source = self.source.clone();
                    let connecting = async move { source.connect().await };
                    self.state = State::Connecting(Box::pin(connecting));
                }
                State::Connecting(connecting) => match connecting.await {
                    Ok(connection) => {
                        let address = connection.address().clone();
                        self.state = State::Connected(connection);
                        return Ok(FromDaemon::Connection(address));
                    }
                    Err(error) => {
                        self.pause();
                        return Err(Loss::Unreachable(error.to_string()));
                    }
                },
                State::Connected(connection) => match connection.next().await {
                    Ok(line) => return Ok(FromDaemon::Line(line)),
                    Err(error) => {
                        self.pause();
                        return Err(match error {
                            connect::Error::TooLong { .. } => Loss::Unreachable(error.to_string()),
                            _ => Loss::Closed,
                        });
                    }
                },
            }
        }
    }

    fn pause(&mut self) {
        self.state = State::Waiting(Instant::now() + PAUSE);
    }

    /// Sends a request.
    fn send(&self, request: &str) {
        if let State::Connected(connection) = &self.state {
            connection.try_send(request);
        }
    }
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
