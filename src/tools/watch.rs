//! `hardnessd watch`: the sensors of a running daemon, on a terminal.
//!
//! It is a subscriber like any other. `follow` connects, asks for the totals once a second, and connects
//! again when the daemon goes away. `view` keeps what is known, and `draw` draws it. This file connects
//! them with the keys and the clock.

mod draw;
mod screen;
#[cfg(test)]
mod tests;
mod view;

use std::future::Future;
use std::io::{self, IsTerminal};
use std::time::Duration;

use clap::Args as ClapArgs;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use self::draw::{Look, draw};
use self::screen::{Screen, keys};
use self::view::{Order, View};
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

/// The request for the totals, and the time between two of them. Without a request, the daemon sends them
/// only when the state changes.
const QUESTION: &str = r#"{"get":"status"}"#;
const QUESTIONS: Duration = Duration::from_secs(1);

/// Time between two tries to connect.
const PAUSE: Duration = Duration::from_millis(500);

/// What comes from a daemon.
enum News {
    /// Its first line, and where it is.
    Hello(Address, Value),
    Event(Value),
    /// Why there is none.
    Absence(String),
}

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
    if args.source.given().is_none()
        && let Ok(connection) = args.source.connect().await
    {
        let address = connection.address().to_string();
        stderr_line!("hardnessd: watching {}", escaped(&address));
    }
    let variable = |name| std::env::var(name).unwrap_or_default();
    let look = Look::new(&variable("TERM"), &variable("NO_COLOR"));
    let mut view = View::new();
    let mut screen = Screen::open().of("terminal", IO)?;
    let mut keys = keys().of("terminal", IO)?;
    let mut pictures = tokio::time::interval(PICTURE);
    pictures.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let (sender, mut news) = mpsc::channel(16);
    tokio::spawn(follow(args.source, sender));
    let mut shutdown = std::pin::pin!(shutdown);
    // The address of the last daemon.
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
            Some(news) = news.recv() => match news {
                News::Hello(address, hello) => {
                    let is_remote = matches!(address, Address::Tcp(_));
                    view.meet(hello, is_remote, now().mono);
                    daemon_at = Some(address);
                }
                News::Event(event) => view.take(event, now()),
                News::Absence(reason) => view.lose(reason),
            },
        }
    }
}

/// Reads the lines of one daemon after the other, for as long as somebody takes them.
async fn follow(source: Source, news: mpsc::Sender<News>) {
    while !news.is_closed() {
        let absence = match source.connect().await {
            Ok(daemon) => read(daemon, &news).await,
            Err(failure) => failure,
        };
        // If `watch` has ended, nobody takes it.
        let _ = news.send(News::Absence(absence.line())).await;
        tokio::time::sleep(PAUSE).await;
    }
}

/// Reads the lines of a daemon until it is gone, and returns why. Asks for all events of this run that the
/// daemon still holds, and those that come.
async fn read(mut daemon: Connection, news: &mpsc::Sender<News>) -> Failure {
    let read = async {
        daemon.send(QUESTION).await?;
        let hello = daemon.meet().await?;
        let types = ["hardness", "press", "status", "frame"];
        let since = format!("{}:0", hello["run"].as_str().unwrap_or_default());
        let request = json!({"subscribe": types, "since": since});
        let address = daemon.address().clone();
        let _ = news.send(News::Hello(address, hello)).await;
        daemon.send(&request.to_string()).await?;
        let mut questions = tokio::time::interval(QUESTIONS);
        questions.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                line = daemon.next() => {
                    let event = serde_json::from_str(&line?).unwrap_or_default();
                    let _ = news.send(News::Event(event)).await;
                }
                _ = questions.tick() => daemon.send(QUESTION).await?,
            }
        }
    };
    let gone: Result<std::convert::Infallible, Failure> = read.await;
    let Err(failure) = gone;
    failure
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
