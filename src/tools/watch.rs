//! `hardnessd watch`: the sensors of a running daemon, on a terminal.
//!
//! It is a subscriber like any other. `follow` connects, asks for the totals once a second, and connects
//! again when the daemon goes away. `view` keeps what is known, and `draw` draws it. This file connects
//! them with the keys and the clock. Each has a thread of its own, so a terminal that accepts no bytes (Ctrl-S, a
//! slow ssh) does not delay the end at a signal. The keys wait for it.

mod draw;
mod pressing;
mod screen;
#[cfg(test)]
mod tests;
mod view;

use std::convert::Infallible;
use std::future::Future;
use std::io::{self, IsTerminal};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args as ClapArgs;
use ratatui_crossterm::crossterm::event::{self, Event, KeyEvent};
use ratatui_crossterm::crossterm::terminal;
use serde_json::{Value, json};
use tokio::time::timeout;

use self::draw::draw;
use self::screen::Screen;
use self::view::{Order, View};
use super::connect::{self, Address, Connection, Source};
use super::control;
use super::exit::{FAILED, Fail, Failure, IO, USAGE};
use crate::daemon::now;
use crate::thread::{spawn_thread, start};
use hardnessd_core::stderr_line;
use hardnessd_core::wording::escaped;

/// Arguments of `watch`.
#[derive(Debug, Clone, ClapArgs)]
#[command(
    after_help = "Keys: q or Ctrl-C quits; Tab, arrows or 1 to 9 choose a sensor; Ctrl-L draws \
                        again; p asks what you press (`firm`, `2`, `cup` or `cup firm`), tells it to the daemon as \
                        the context `object` and `level`, and counts right and wrong verdicts. DAEMON SILENT: no answer for 3 s. NO DAEMON: nobody answers, or the \
                        protocol is another one; `watch` connects again. A map that is not live is \
                        grey. Needs 256 colours, also where NO_COLOR is set."
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

/// Time between two pictures that are written as a whole: another program may write to the same terminal.
const WHOLE_PICTURES: Duration = Duration::from_secs(5);

/// Time between two tries to connect.
const PAUSE: Duration = Duration::from_millis(500);

/// How long the terminal may take for the last bytes.
const LAST_BYTES: Duration = Duration::from_millis(500);

/// What a picture shows, or what changes it.
enum Input {
    Key(KeyEvent),
    /// The first line of a daemon, and where it is.
    Hello(Address, Value),
    Event(Value),
    /// Why there is no daemon.
    Absence(String),
    /// The outcome of a command.
    Said(String),
    /// No more keys come.
    End,
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
    let is_over = Arc::new(AtomicBool::new(false));
    let seen = is_over.clone();
    let mut shown = spawn_thread("watch", move || show(args.source, &seen))?;
    tokio::select! {
        shown = &mut shown => shown.expect("pictures are drawn without a panic"),
        () = shutdown => {
            is_over.store(true, Ordering::Relaxed);
            let _ = timeout(LAST_BYTES, shown).await;
            let _ = terminal::disable_raw_mode();
            Ok(())
        }
    }
}

/// Draws pictures until `is_over`, the key for the end, or the end of the terminal.
fn show(source: Source, is_over: &AtomicBool) -> Result<(), Failure> {
    if source.given().is_none()
        && let Ok(connection) = source.connect()
    {
        let address = connection.address.to_string();
        stderr_line!("hardnessd: watching {}", escaped(&address));
    }
    let mut view = View::new();
    let mut screen = Screen::open().of("terminal", IO)?;
    let (sender, inputs) = sync_channel(16);
    let keys = sender.clone();
    start("keys", move || read_keys(&keys))?;
    let news = sender.clone();
    start("daemon", move || follow(&source, &news))?;
    // The address of the last daemon.
    let (mut daemon_at, mut run) = (None, String::new());
    let mut whole_at = Instant::now() + WHOLE_PICTURES;
    while !is_over.load(Ordering::Relaxed) {
        if Instant::now() >= whole_at {
            whole_at = Instant::now() + WHOLE_PICTURES;
            if screen.forget().is_err() {
                break;
            }
        }
        let drawn = screen.draw(|frame| draw(frame, &view, now().mono));
        if drawn.is_err() {
            // The terminal has gone.
            break;
        }
        let next = Instant::now() + PICTURE;
        while let left = next.saturating_duration_since(Instant::now())
            && !left.is_zero()
            && let Ok(input) = inputs.recv_timeout(left)
        {
            match input {
                Input::Key(key) => match view.press(key) {
                    Some(Order::Quit) => return Ok(()),
                    Some(Order::Redraw) => screen.forget().of("terminal", IO)?,
                    Some(Order::Merge(keys)) => {
                        let (daemon_at, told) = (daemon_at.clone(), sender.clone());
                        let run = run.clone();
                        start("command", move || tell(daemon_at, &run, &keys, &told))?;
                    }
                    None => {}
                },
                Input::Hello(address, hello) => {
                    let is_remote = matches!(address, Address::Tcp(_));
                    run = hello["run"].as_str().unwrap_or_default().to_owned();
                    view.meet(hello, is_remote, now().mono);
                    daemon_at = Some(address);
                }
                Input::Event(event) => view.take(event, now()),
                Input::Absence(reason) => view.absence = Some(reason),
                Input::Said(outcome) => view.said = Some(outcome),
                Input::End => return Ok(()),
            }
        }
    }
    Ok(())
}

/// Sends keys as they are pressed, until the input ends.
fn read_keys(keys: &SyncSender<Input>) {
    while let Ok(event) = event::read() {
        if let Event::Key(key) = event {
            send(keys, Input::Key(key));
        }
    }
    send(keys, Input::End);
}

/// Sends what is to be shown. If `watch` has ended, nobody takes it.
fn send(inputs: &SyncSender<Input>, input: Input) {
    let _ = inputs.send(input);
}

/// Reads the lines of one daemon after the other, for ever.
fn follow(source: &Source, news: &SyncSender<Input>) {
    loop {
        let Err(absence) = source.connect().and_then(|daemon| read(daemon, news));
        send(news, Input::Absence(absence.line()));
        thread::sleep(PAUSE);
    }
}

/// Reads the lines of a daemon until it is gone, and returns why. Asks for all events of this run that the
/// daemon still holds, and those that come.
fn read(mut daemon: Connection, news: &SyncSender<Input>) -> Result<Infallible, Failure> {
    daemon.send(QUESTION)?;
    let hello = daemon.meet()?;
    let types = ["hardness", "press", "status", "frame"];
    let since = format!("{}:0", hello["run"].as_str().unwrap_or_default());
    let request = json!({"subscribe": types, "since": since});
    send(news, Input::Hello(daemon.address.clone(), hello));
    daemon.send(&request.to_string())?;
    let mut asked = Instant::now();
    loop {
        if let Some(line) = daemon.next_within(QUESTIONS)? {
            let event = serde_json::from_str(&line).unwrap_or_default();
            send(news, Input::Event(event));
        }
        if asked.elapsed() >= QUESTIONS {
            daemon.send(QUESTION)?;
            asked = Instant::now();
        }
    }
}

/// Sets keys of a context at the control socket beside the daemon's other one, and sends the outcome in words.
fn tell(daemon_at: Option<Address>, run: &str, keys: &Value, told: &SyncSender<Input>) {
    let tell = |path: &Path| {
        let mut daemon = connect::control(Some(path.with_file_name("control.sock")))?;
        if daemon.meet()?["run"] != run {
            let other =
                "control.sock beside the socket is that of another daemon, use `hardnessd context`";
            return Err(Failure::new(FAILED, other));
        }
        control::ask(&mut daemon, json!({"merge": keys}))
    };
    let outcome = match daemon_at {
        Some(Address::Unix(path)) => match tell(&path) {
            Ok(_) => "the daemon repeats it in every verdict from now on".to_owned(),
            Err(error) => format!("counted here only: {}", error.line()),
        },
        _ => "counted here only: over TCP nothing can be set, use `hardnessd context`".to_owned(),
    };
    send(told, Input::Said(outcome));
}
