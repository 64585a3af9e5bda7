//! `hardnessd demo`: a simulated JX255N on a pty, the whole daemon on it, and a subscriber that
//! prints what it gets.
//!
//! Nothing is short-circuited: bytes go through the tty, events through the socket. What stands on
//! stdout is what a subscriber reads, `hello` first; the live page's address stands on stderr.

use std::fs::{self, DirBuilder};
use std::future::Future;
use std::io::{self, ErrorKind};
use std::net::SocketAddr;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args as ClapArgs;
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::net::UnixStream;
use tokio::sync::oneshot;
use tokio::time::Instant;

use super::faults::Faults;
use super::player::{Pace, Player};
use super::simulate::within;
use crate::daemon::config::{Config, Http, Sensor, Setup};
use crate::daemon::{self, Daemon};
use crate::simulator::SequenceSettings;
use crate::wire::{Layout, LayoutError};

/// Arguments of `demo`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// End after the final verdicts of so many presses [default: never]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    presses: Option<u32>,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Address of the live page
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    http: SocketAddr,
    /// Play so many times as fast, 0.01 to 100
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    speed: f64,
}

/// Why the demonstration failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The daemon's configuration or model.
    #[error(transparent)]
    Config(#[from] daemon::config::Error),
    /// The daemon.
    #[error(transparent)]
    Daemon(#[from] daemon::Error),
    /// The sensor's layout.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The pty, the socket or stdout.
    #[error("{what}: {source}")]
    Io {
        /// What was tried.
        what: &'static str,
        /// Why not.
        source: io::Error,
    },
    /// Presses went by without a verdict.
    #[error("found {found} final verdicts after {presses} presses, expected one each")]
    Missed {
        /// Verdicts.
        found: u32,
        /// Presses.
        presses: u32,
    },
    /// The daemon went away.
    #[error("the daemon closed the connection")]
    Closed,
}

/// How long the last verdict may take after the last byte.
const PATIENCE: Duration = Duration::from_secs(3);

/// Runs until the presses have their verdicts, `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// [`Error`], if a part cannot be had or a press gets no verdict.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Error> {
    let io = |what| move |source| Error::Io { what, source };
    let place = Place::new().map_err(io("directory for socket and port"))?;
    let port = place.0.join("port");
    let sensor = Sensor {
        name: "demo".to_owned(),
        ..Sensor::new(port.clone())
    };
    let layout = Layout::new(&sensor.frame)?;
    let pace = Pace::new(sensor.frame_rate_hz, sensor.baud, args.speed);
    let sequence = SequenceSettings {
        seed: args.seed,
        frame_rate_hz: sensor.frame_rate_hz,
        presses: args.presses,
        ..SequenceSettings::default()
    };
    let player = Player::new(Some(&port), layout, pace, Faults::none()).map_err(io("pty"))?;

    let socket = place.0.join("events.sock");
    let mut config = hastened(sensor, &socket, args.speed);
    config.http = Some(Http { listen: args.http });
    let daemon = Daemon::bind(Setup::of(config, Path::new("demo"))?)?;
    if let Some(address) = daemon.http_address() {
        eprintln!("live page: http://{address}/");
    }
    let subscriber = UnixStream::connect(&socket).await.map_err(io("socket"))?;
    let (stop, stopped) = oneshot::channel::<()>();
    let daemon = daemon.run(
        async {
            // Dropped is as good as sent.
            let _ = stopped.await;
        },
        None,
    );
    let printing = async {
        let printed = print(subscriber, args.presses, player, sequence, shutdown).await;
        let _ = stop.send(());
        printed
    };
    let (served, printed) = tokio::join!(daemon, printing);
    printed.and(served.map_err(Error::Daemon))
}

/// Beyond 100 the 2 ms between frames are more than a busy machine's timers can keep.
fn speed(text: &str) -> Result<f64, String> {
    within(text, 0.01, 100.0)
}

/// The defaults, with every time of a press shortened as the sensor is hastened.
fn hastened(sensor: Sensor, socket: &Path, speed: f64) -> Config {
    let frame_rate_hz = sensor.frame_rate_hz * speed;
    let mut config = Config::new(vec![Sensor {
        frame_rate_hz,
        ..sensor
    }]);
    config.press.early_settle_s /= speed;
    config.press.max_seconds /= speed;
    config.publish.unix = config.publish.unix.at(socket.to_owned());
    config
}

/// Prints what the subscriber gets while the sensor plays.
async fn print(
    subscriber: UnixStream,
    presses: Option<u32>,
    player: Player,
    sequence: SequenceSettings,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Error> {
    let io = |what| move |source| Error::Io { what, source };
    let mut lines = BufReader::new(subscriber);
    let mut line = Vec::new();
    let mut finals = 0;
    // Whether a slow reader has missed events, verdicts maybe among them.
    let mut missed = false;
    let mut played = std::pin::pin!(player.play(sequence));
    let mut shutdown = std::pin::pin!(shutdown);
    let mut last_byte: Option<Instant> = None;
    // The line on its way to stdout: the sensor and the daemon wait for no reader.
    let mut printing = std::pin::pin!(None);
    loop {
        let patience = last_byte.map(|at| at + PATIENCE);
        tokio::select! {
            // What there is to read counts before the patience with it.
            biased;
            () = &mut shutdown => return Ok(()),
            printed = wait(printing.as_mut().as_pin_mut()) => {
                printing.set(None);
                let printed: io::Result<bool> = printed;
                if !printed.map_err(io("stdout"))? || Some(finals) == presses {
                    return Ok(());
                }
            }
            read = lines.read_until(b'\n', &mut line), if printing.is_none() => {
                if read.map_err(io("socket"))? == 0 {
                    return Err(Error::Closed);
                }
                finals += u32::from(is_final(&line));
                missed |= is_gap(&line);
                printing.set(Some(super::print_apart(std::mem::take(&mut line))));
            }
            ended = &mut played, if last_byte.is_none() => {
                ended.map_err(io("pty"))?;
                last_byte = Some(Instant::now());
            }
            () = until(patience), if printing.is_none() => {
                if missed {
                    return Ok(());
                }
                return Err(Error::Missed { found: finals, presses: presses.unwrap_or(0) });
            }
        }
    }
}

/// The output of what there is to wait for.
async fn wait<T: Future>(one: Option<T>) -> T::Output {
    match one {
        Some(one) => one.await,
        None => std::future::pending().await,
    }
}

async fn until(moment: Option<Instant>) {
    match moment {
        Some(moment) => tokio::time::sleep_until(moment).await,
        None => std::future::pending().await,
    }
}

fn is_gap(line: &[u8]) -> bool {
    serde_json::from_slice::<serde_json::Value>(line).is_ok_and(|event| event["type"] == "gap")
}

fn is_final(line: &[u8]) -> bool {
    serde_json::from_slice::<serde_json::Value>(line)
        .is_ok_and(|event| event["type"] == "hardness" && event["phase"] == "final")
}

/// A directory of our own, gone with us.
struct Place(PathBuf);

impl Place {
    /// A new one: where a container is started again one that was killed there had the same number.
    fn new() -> io::Result<Self> {
        let mut path = std::env::temp_dir().join(format!("hardnessd-demo-{}", std::process::id()));
        loop {
            match DirBuilder::new().mode(0o700).create(&path) {
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                    path.as_mut_os_string().push("-");
                }
                made => return made.map(|()| Self(path)),
            }
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_killed_demonstration_has_left_is_not_in_the_way() {
        let left = Place::new().unwrap();
        let place = Place::new().unwrap();
        assert_ne!(left.0, place.0);
        assert!(left.0.is_dir() && place.0.is_dir());
    }
}
