//! `hardnessd watch`: the sensors of a running daemon, on a terminal.
//!
//! A subscriber like any other, which asks for the totals once a second, and connects again when the
//! daemon goes away. What is known is kept in `view`, what it looks like in `draw`; here they
//! are brought together with the socket, the keys and the clock.

mod ansi;
mod draw;
mod look;
mod screen;
#[cfg(test)]
mod tests;
mod view;

use std::future::Future;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args as ClapArgs;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::time::{Instant, MissedTickBehavior};

use self::draw::draw;
use self::look::Look;
use self::screen::{Screen, keys};
use self::view::{Key, Loss, QUESTION, View};
use crate::daemon::config::Unix;
use crate::daemon::now;

/// Arguments of `watch`.
#[derive(Debug, Clone, ClapArgs)]
#[command(
    after_help = "Keys: q or Ctrl-C quits; Tab, arrows or 1 to 9 choose a sensor; Ctrl-L draws \
                        again. Without colours where NO_COLOR is set or TERM has none."
)]
pub struct Args {
    /// Socket of the daemon [default: where `run` puts it by default]
    #[arg(long, value_name = "P")]
    socket: Option<PathBuf>,
}

/// Why there is nothing to see.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Nobody would see it.
    #[error("found no terminal on stdin and stdout, expected one: `hardnessd tail` needs none")]
    NoTerminal,
    /// The terminal fails.
    #[error("terminal: {0}")]
    Terminal(#[source] io::Error),
}

/// Between two pictures: as often as a frame of the fastest array that eyes can follow.
const PICTURE: Duration = Duration::from_millis(100);

/// Between two tries to connect.
const PAUSE: Duration = Duration::from_millis(500);

/// Shows until a key or `shutdown` ends it, or the terminal goes away.
///
/// # Errors
///
/// [`Error`], if there is no terminal or it fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Error> {
    if !(io::stdin().is_terminal() && io::stdout().is_terminal()) {
        return Err(Error::NoTerminal);
    }
    let look = look();
    let mut view = View::new();
    let mut daemon = Daemon::new(args.socket.unwrap_or_else(|| Unix::default().path()));
    let mut screen = Screen::open().map_err(Error::Terminal)?;
    let mut keys = keys().map_err(Error::Terminal)?;
    let mut pictures = tokio::time::interval(PICTURE);
    pictures.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut questions = tokio::time::interval(QUESTION);
    questions.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut shutdown = std::pin::pin!(shutdown);
    loop {
        tokio::select! {
            // A daemon that says much must not keep a key or a picture waiting.
            biased;
            () = &mut shutdown => return Ok(()),
            key = keys.recv() => match key {
                None | Some(Key::Quit) => return Ok(()),
                Some(Key::Redraw) => screen.forget(),
                Some(key) => view.press(key),
            },
            _ = pictures.tick() => {
                screen.draw(|frame| draw(frame, &view, now().mono, look));
            }
            _ = questions.tick() => daemon.ask(),
            heard = daemon.next() => match heard {
                Ok(Heard::Connection) => view.wait(now().mono),
                Ok(Heard::Line(line)) => view.hear(&line, now()),
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
        &variable("NO_COLOR"),
        &locale.unwrap_or_default(),
    )
}

/// The connection to the daemon, made again whenever it breaks.
struct Daemon {
    path: PathBuf,
    connection: Option<(Lines<BufReader<OwnedReadHalf>>, OwnedWriteHalf)>,
    /// No try before.
    pause: Instant,
}

/// What comes of a daemon that is there.
enum Heard {
    /// It has taken the connection.
    Connection,
    Line(String),
}

impl Daemon {
    fn new(path: PathBuf) -> Self {
        Self {
            path,
            connection: None,
            pause: Instant::now(),
        }
    }

    /// The next line, or why there is no daemon. Nothing is lost if the wait is given up.
    async fn next(&mut self) -> Result<Heard, Loss> {
        let Some((lines, _)) = &mut self.connection else {
            tokio::time::sleep_until(self.pause).await;
            self.pause = Instant::now() + PAUSE;
            let connected = connect(&self.path).await.map_err(Loss::Unreachable)?;
            self.connection = Some(connected);
            return Ok(Heard::Connection);
        };
        if let Ok(Some(line)) = lines.next_line().await {
            return Ok(Heard::Line(line));
        }
        self.connection = None;
        self.pause = Instant::now() + PAUSE;
        Err(Loss::Closed)
    }

    /// Asks for the totals. A daemon that does not take the question is found out by its silence.
    fn ask(&mut self) {
        if let Some((_, output)) = &mut self.connection {
            let _ = output.try_write(b"{\"get\":\"status\"}\n");
        }
    }
}

async fn connect(path: &Path) -> Result<(Lines<BufReader<OwnedReadHalf>>, OwnedWriteHalf), String> {
    const REQUESTS: &[u8] = b"{\"subscribe\":[\"hardness\",\"press\",\"status\",\"frame\"]}\n\
        {\"get\":\"last\"}\n";
    let failed = |error: io::Error| format!("{}: {error}", path.display());
    let stream = UnixStream::connect(path).await.map_err(failed)?;
    let (input, mut output) = stream.into_split();
    output.write_all(REQUESTS).await.map_err(failed)?;
    Ok((BufReader::new(input).lines(), output))
}
