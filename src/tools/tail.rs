//! `hardnessd tail`: events of a running daemon on stdout, for eyes and for scripts.
//!
//! What is printed, and counted by `--count`, are events of the types asked for, the current
//! statuses that a connection begins with among them. A `gap` is printed where it happened and not
//! counted. `hello` is not printed.

mod readable;

use std::future::Future;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args as ClapArgs;
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;

use super::simulate::positive;
use crate::daemon::config::Unix;
use crate::event::{Kind, PROTOCOL};

/// Arguments of `tail`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Socket of the daemon [default: where `run` puts it by default]
    #[arg(long, value_name = "P")]
    socket: Option<PathBuf>,
    /// Print the JSON lines as they are
    #[arg(long)]
    json: bool,
    /// End after so many events [default: never]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Give up after so many seconds, with exit code 1 [default: never]
    #[arg(long, value_name = "S", value_parser = positive)]
    timeout: Option<f64>,
    /// Types of events: hardness, press, status, frame
    #[arg(
        long,
        value_name = "T,...",
        value_delimiter = ',',
        value_parser = kind,
        default_value = "hardness,press,status"
    )]
    types: Vec<Kind>,
}

/// Why it ended before it was done.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The time is over.
    #[error("found {found} events within {seconds} s, expected {}", expected(*.count))]
    Timeout {
        /// Events printed.
        found: u64,
        /// As given.
        seconds: f64,
        /// As given.
        count: Option<u64>,
    },
    /// Nobody listens.
    #[error("{path}: no daemon answers: {source}")]
    NoDaemon {
        /// Of the socket.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Somebody listens, and is no daemon.
    #[error("{path}: found no hello within {} s, expected a daemon's", HELLO.as_secs())]
    Mute {
        /// Of the socket.
        path: PathBuf,
    },
    /// Somebody speaks, and is no daemon of this protocol.
    #[error("{path}: found {found}, expected a hello of protocol {PROTOCOL}")]
    Foreign {
        /// Of the socket.
        path: PathBuf,
        /// What it says first.
        found: String,
    },
    /// The daemon has no room.
    #[error("{path}: the daemon says: {message}")]
    Refused {
        /// Of the socket.
        path: PathBuf,
        /// As it came.
        message: String,
    },
    /// The daemon has ended.
    #[error("{path}: the daemon closed the connection")]
    Closed {
        /// Of the socket.
        path: PathBuf,
    },
    /// Stdout fails.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

/// How long a daemon may take to say hello: a hundred times the 50 ms that one takes at most,
/// for one that a service manager has to start first.
const HELLO: Duration = Duration::from_secs(5);

fn expected(count: Option<u64>) -> String {
    count.map_or("to go on".to_owned(), |count| count.to_string())
}

fn kind(name: &str) -> Result<Kind, String> {
    Kind::named(name).ok_or_else(|| "expected hardness, press, status or frame".to_owned())
}

/// Prints until the count is reached, `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// [`Error`], if no daemon answers, it ends, or the time is over.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Error> {
    let mut found = 0;
    tokio::select! {
        printed = print(&args, &mut found) => return printed,
        () = shutdown => return Ok(()),
        () = over(args.timeout) => {}
    }
    Err(Error::Timeout {
        found,
        seconds: args.timeout.unwrap_or_default(),
        count: args.count,
    })
}

async fn over(timeout_s: Option<f64>) {
    match timeout_s.map(Duration::try_from_secs_f64) {
        Some(Ok(timeout)) => tokio::time::sleep(timeout).await,
        // Longer than there is time.
        Some(Err(_)) | None => std::future::pending().await,
    }
}

async fn print(args: &Args, found: &mut u64) -> Result<(), Error> {
    let path = args
        .socket
        .clone()
        .unwrap_or_else(|| Unix::default().path());
    let no_daemon = |source| Error::NoDaemon {
        path: path.clone(),
        source,
    };
    let mut daemon = UnixStream::connect(&path).await.map_err(no_daemon)?;
    let request = json!({"subscribe": args.types}).to_string() + "\n";
    daemon
        .write_all(request.as_bytes())
        .await
        .map_err(no_daemon)?;
    let mut lines = Lines {
        path: path.clone(),
        input: BufReader::new(daemon),
        line: String::new(),
    };
    match tokio::time::timeout(HELLO, lines.next()).await {
        Ok(hello) => meet(&hello?, path)?,
        Err(_) => return Err(Error::Mute { path }),
    }
    loop {
        let event = lines.next().await?;
        let kind = event["type"].as_str().unwrap_or_default();
        // What was queued before the subscription took effect is not meant.
        let counts = Kind::named(kind).is_some_and(|kind| args.types.contains(&kind));
        if !counts && kind != "gap" {
            continue;
        }
        let text = if args.json {
            lines.line.clone()
        } else {
            readable::line(&event) + "\n"
        };
        let printed = super::print_apart(text.into_bytes()).await;
        if !printed.map_err(Error::Print)? {
            return Ok(());
        }
        *found += u64::from(counts);
        if args.count == Some(*found) {
            return Ok(());
        }
    }
}

/// Goes on only if this is what a daemon says first.
fn meet(hello: &Value, path: PathBuf) -> Result<(), Error> {
    let kind = hello["type"].as_str().unwrap_or_default();
    let found = match (kind, &hello["protocol"]) {
        ("hello", protocol) if *protocol == PROTOCOL => return Ok(()),
        ("hello", protocol) => format!("protocol {protocol}"),
        ("error", _) => {
            let message = hello["message"].as_str().unwrap_or_default().to_owned();
            return Err(Error::Refused { path, message });
        }
        (kind, _) => format!("{kind:?}"),
    };
    Err(Error::Foreign { path, found })
}

/// What the daemon says.
struct Lines {
    path: PathBuf,
    input: BufReader<UnixStream>,
    /// The last one, as it came.
    line: String,
}

impl Lines {
    async fn next(&mut self) -> Result<Value, Error> {
        let broken = |path: &PathBuf, source| Error::NoDaemon {
            path: path.clone(),
            source,
        };
        self.line.clear();
        match self.input.read_line(&mut self.line).await {
            Ok(0) => {
                let path = self.path.clone();
                return Err(Error::Closed { path });
            }
            Ok(_) => {}
            Err(source) => return Err(broken(&self.path, source)),
        }
        serde_json::from_str(&self.line).map_err(|_| {
            let source = io::Error::new(io::ErrorKind::InvalidData, "found no JSON");
            broken(&self.path, source)
        })
    }
}
