//! `hardnessd replay`: a recording through the same pipeline, events on stdout.
//!
//! Times come from the recording, so the output depends on nothing else: neither on the speed nor
//! on how the bytes are cut.

use std::fs::File;
use std::future::Future;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args as ClapArgs;
use tokio::time::Instant;

use super::simulate::positive;
use crate::daemon::config::{self, Config, Sensor, Setup};
use crate::daemon::now;
use crate::event::{Event, Kind};
use crate::pipeline::{Clock, Pipeline};

/// Arguments of `replay`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording: .bin, raw bytes back to back
    file: PathBuf,
    /// Configuration whose first sensor it was [default: a JX255N by default settings]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
    /// Play so many times as fast as the sensor did [default: as fast as it goes]
    #[arg(long, value_name = "X", value_parser = positive)]
    speed: Option<f64>,
}

/// Why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The configuration or its model.
    #[error(transparent)]
    Config(#[from] config::Error),
    /// The recording cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Of the recording.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A format of a later version.
    #[error("{path}: found a recording that is not .bin, expected .bin: not in this version")]
    Format {
        /// Of the recording.
        path: PathBuf,
    },
    /// Reading broke off.
    #[error("{path}: {source}")]
    Broken {
        /// Of the recording.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Stdout fails.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

/// Bytes read at once when nothing paces them.
const CHUNK_BYTES: usize = 64 * 1024;

/// Plays to the end, until `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// [`Error`], if the recording or the configuration cannot be used.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Error> {
    tokio::select! {
        // The recording first: one that needs no pacing is over before a signal is looked for.
        biased;
        played = play(args) => played,
        () = shutdown => Ok(()),
    }
}

async fn play(args: Args) -> Result<(), Error> {
    let Args {
        file: path,
        config,
        speed,
    } = args;
    if path
        .extension()
        .is_some_and(|extension| extension == "mcap")
    {
        return Err(Error::Format { path });
    }
    let setup = match config {
        Some(config) => Setup::load(&config)?,
        None => {
            let config = Config::new(vec![Sensor::new(path.clone())]);
            Setup::of(config, Path::new("defaults"))?
        }
    };
    let settings = setup
        .pipelines()
        .next()
        .expect("a configuration has at least one sensor");
    let mut recording = File::open(&path).map_err(|source| Error::Unreadable {
        path: path.clone(),
        source,
    })?;
    let frame_bytes = settings.layout.max_frame_bytes();
    let pace = speed.map(|speed| {
        Duration::from_secs_f64(1.0 / (settings.frame_rate_hz * speed * frame_bytes as f64))
    });
    let mut chunk = vec![
        0;
        if pace.is_some() {
            frame_bytes
        } else {
            CHUNK_BYTES
        }
    ];
    let mut pipeline = Pipeline::new(settings, Clock::FrameRate);
    let mut seq = 0;
    let start = Instant::now();
    let mut bytes: u32 = 0;
    loop {
        let read = match recording.read(&mut chunk) {
            Ok(read) => read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(source) => return Err(Error::Broken { path, source }),
        };
        if read == 0 {
            print(pipeline.end_of_recording(None), &mut seq)?;
            return Ok(());
        }
        if let Some(a_byte) = pace {
            bytes = bytes.saturating_add(u32::try_from(read).unwrap_or(u32::MAX));
            tokio::time::sleep_until(start + a_byte * bytes).await;
        }
        // The clock is the recording's: the moment given here is not looked at.
        if !print(pipeline.push(&chunk[..read], now()), &mut seq)? {
            return Ok(());
        }
    }
}

/// Prints what a subscriber would get; `false`: nobody reads.
fn print(events: Vec<Event>, seq: &mut u64) -> Result<bool, Error> {
    let mut lines = String::new();
    for mut event in events {
        if event.kind() != Kind::Frame {
            *seq += 1;
            event.number(*seq);
            lines.push_str(&event.to_line());
        }
    }
    super::print(lines.as_bytes()).map_err(Error::Print)
}
