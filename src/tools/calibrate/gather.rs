//! The presses of a recording, each with the positions of the arm.

use std::io::{BufReader, Read};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use crate::event::{Event, PressState};
use crate::frame::Stamp;
use crate::motion::Track;
use crate::pipeline::{Clock, Pipeline};
use crate::recording::{self, Entry, FileKind, Input, Playback, PlaybackError, Reader};
use crate::sensor::{Description, Sensor};
use crate::verdict::Hrn;

/// One press.
#[derive(Debug, Default)]
pub(super) struct Press {
    /// The moments of the frames in contact.
    pub(super) moments: Vec<Duration>,
    /// The newtons on each taxel, for each of these frames.
    pub(super) frames: Vec<Vec<f32>>,
    /// The total force of each of these frames, in newtons.
    pub(super) forces_n: Vec<f64>,
    /// The positions of the arm.
    pub(super) track: Track,
    /// The description of the sensor at that time. `None` if the file has none.
    pub(super) described: Option<Arc<Description>>,
}

/// A frame of the sensor.
struct Taken {
    number: u64,
    mono: Duration,
    newtons: Vec<f32>,
}

/// The reason why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum Unreadable {
    /// The recording is damaged, or of another program.
    #[error(transparent)]
    Recording(#[from] recording::Error),
    /// The recording describes an impossible sensor.
    #[error(transparent)]
    Playback(#[from] PlaybackError),
}

impl From<std::io::Error> for Unreadable {
    fn from(error: std::io::Error) -> Self {
        Self::Recording(error.into())
    }
}

/// This long after a press, all its positions have come.
const AFTER: Duration = Duration::from_millis(800);

/// The presses of `sensor` in a file. A recording tells sensors apart by name. In a file of raw
/// bytes, all bytes are those of `sensor`.
pub(super) fn presses(
    file: impl Read,
    sensor: &Sensor,
    hrn: Arc<Hrn>,
) -> Result<Vec<Press>, Unreadable> {
    let (kind, file) = FileKind::read(file)?;
    match kind {
        FileKind::Recording => of_recording(BufReader::new(file), sensor.name(), hrn),
        FileKind::Raw => Ok(of_bytes(file, sensor, hrn)?),
    }
}

fn of_recording(file: impl Read, sensor: &str, hrn: Arc<Hrn>) -> Result<Vec<Press>, Unreadable> {
    let mut playback = Playback::new(hrn);
    let mut gathered = Gathered::default();
    for found in Reader::new(file) {
        let found = found?;
        if found.sensor != sensor {
            continue;
        }
        let at = found.at;
        match &found.entry {
            Entry::Input(Input::Motion(points)) => {
                // An error means that the time of a point went back. The approach of its press is
                // then unknown.
                let _ = gathered.track.push(points);
            }
            Entry::Settings(sensor) => gathered.describe(&sensor.description),
            Entry::State(state) => gathered.describe(&state.sensor.description),
            Entry::Input(_) => {}
        }
        gathered.settle(at.mono);
        gathered.take(playback.feed(found)?, at);
    }
    Ok(gathered.end())
}

fn of_bytes(mut file: impl Read, sensor: &Sensor, hrn: Arc<Hrn>) -> std::io::Result<Vec<Press>> {
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    // The frames of raw bytes get their times from the frame rate, counted from here.
    let start = Stamp {
        mono: Duration::ZERO,
        wall: Timestamp::UNIX_EPOCH,
    };
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::FrameRate);
    let mut gathered = Gathered::default();
    gathered.describe(sensor.description());
    for chunk in bytes.chunks(CHUNK_BYTES) {
        gathered.take(pipeline.push(chunk, start), start);
        gathered.settle(Duration::MAX);
    }
    gathered.take(pipeline.end_of_recording(None), start);
    Ok(gathered.end())
}

/// The number of bytes whose frames are held at a time.
const CHUNK_BYTES: usize = 1 << 16;

/// The presses and the state of reading so far.
#[derive(Default)]
struct Gathered {
    presses: Vec<Press>,
    track: Track,
    described: Option<Arc<Description>>,
    /// The frames of the press under way and of those in `ended`, and the newest frame.
    frames: Vec<Taken>,
    /// The number of the first frame of the press under way.
    began: Option<u64>,
    /// The first and the last frame of each press that waits for its last positions, and when it
    /// ended.
    ended: Vec<(u64, u64, Duration)>,
}

impl Gathered {
    fn describe(&mut self, description: &Description) {
        if self.described.as_deref() != Some(description) {
            self.described = Some(Arc::new(description.clone()));
        }
    }

    fn take(&mut self, events: Vec<Event>, at: Stamp) {
        for event in events {
            match event {
                Event::Frame(frame) if frame.tared => {
                    if self.began.is_none() && self.ended.is_empty() {
                        self.frames.clear();
                    }
                    self.frames.push(Taken {
                        number: frame.frame,
                        mono: moment(at, frame.time),
                        newtons: frame.newtons,
                    });
                }
                Event::Press(press) => match press.state {
                    PressState::Begin => self.began = Some(press.frame),
                    PressState::End => {
                        let first = self.began.take().unwrap_or(press.frame);
                        let end = moment(at, press.time);
                        self.ended.push((first, press.frame, end));
                    }
                    PressState::Aborted => self.began = None,
                },
                _ => {}
            }
        }
    }

    /// Takes the presses whose positions have come by `now`.
    fn settle(&mut self, now: Duration) {
        while let Some(&(first, last, end)) = self.ended.first()
            && now >= end.saturating_add(AFTER)
        {
            self.ended.remove(0);
            let mut press = Press {
                track: self.track.clone(),
                described: self.described.clone(),
                ..Press::default()
            };
            let own = self.frames.iter();
            for frame in own.filter(|frame| (first..=last).contains(&frame.number)) {
                press.moments.push(frame.mono);
                let newtons = frame.newtons.iter().map(|&n| f64::from(n));
                press.forces_n.push(newtons.sum());
                press.frames.push(frame.newtons.clone());
            }
            self.presses.push(press);
        }
    }

    fn end(mut self) -> Vec<Press> {
        self.settle(Duration::MAX);
        self.presses
    }
}

/// The moment of an event by the clock of the positions.
fn moment(at: Stamp, time: Timestamp) -> Duration {
    let ago = at.wall.as_nanosecond() - time.as_nanosecond();
    let mono = at.mono.as_nanos() as i128 - ago;
    Duration::from_nanos(u64::try_from(mono).unwrap_or(0))
}
