//! The presses of a recording, each with where the arm was.

use std::io::{BufReader, Read};
use std::sync::Arc;
use std::time::Duration;

use super::Error;
use crate::event::{Event, PressState};
use crate::frame::Stamp;
use crate::motion::Track;
use crate::recording::{Entry, Input, Playback, Reader};
use crate::verdict::Hrn;

/// One press.
#[derive(Debug, Default)]
pub(super) struct Press {
    /// Of its frames in contact.
    pub(super) moments: Vec<Duration>,
    /// Newtons on each taxel in them.
    pub(super) frames: Vec<Vec<f32>>,
    /// Total force in them.
    pub(super) forces_n: Vec<f64>,
    /// Where the arm was.
    pub(super) track: Track,
}

/// What was recorded of one sensor.
pub(super) struct Gathered {
    pub(super) presses: Vec<Press>,
}

/// A frame of the sensor.
struct Taken {
    number: u64,
    mono: Duration,
    newtons: Vec<f32>,
}

/// So long after a press its positions have come.
const AFTER: Duration = Duration::from_millis(800);

impl Gathered {
    /// Reads what was recorded of `sensor`.
    pub(super) fn read(file: impl Read, sensor: &str, hrn: Arc<Hrn>) -> Result<Self, Error> {
        let mut playback = Playback::new(hrn);
        let mut track = Track::default();
        let mut frames: Vec<Taken> = Vec::new();
        let mut began = None;
        // First and last frame of presses that wait for their last positions.
        let mut ended: Vec<(u64, u64, Duration)> = Vec::new();
        let mut presses = Vec::new();
        let press = |frames: &[Taken], first: u64, last: u64, track: &Track| {
            let mut press = Press {
                track: track.clone(),
                ..Press::default()
            };
            for frame in frames.iter().filter(|f| (first..=last).contains(&f.number)) {
                press.moments.push(frame.mono);
                let newtons = frame.newtons.iter().map(|&n| f64::from(n));
                press.forces_n.push(newtons.sum());
                press.frames.push(frame.newtons.clone());
            }
            press
        };
        for found in Reader::new(BufReader::new(file)) {
            let found = found?;
            if found.sensor != sensor {
                continue;
            }
            let at = found.at;
            if let Entry::Input(Input::Motion(points)) = &found.entry {
                // A step back makes the approach of its press unknown.
                let _ = track.push(points);
            }
            while let Some(&(first, last, end)) = ended.first()
                && at.mono >= end + AFTER
            {
                presses.push(press(&frames, first, last, &track));
                ended.remove(0);
            }
            for event in playback.feed(found)? {
                match event {
                    Event::Frame(frame) if frame.tared => frames.push(Taken {
                        number: frame.frame,
                        mono: moment(at, frame.time),
                        newtons: frame.newtons,
                    }),
                    Event::Press(press) if press.state == PressState::Begin => {
                        began = Some(press.frame);
                    }
                    Event::Press(press) if press.state == PressState::End => {
                        let first = began.take().unwrap_or(press.frame);
                        ended.push((first, press.frame, moment(at, press.time)));
                    }
                    _ => {}
                }
            }
        }
        for (first, last, _) in ended {
            presses.push(press(&frames, first, last, &track));
        }
        Ok(Self { presses })
    }
}

/// The moment of an event by the clock of the positions.
fn moment(at: Stamp, time: jiff::Timestamp) -> Duration {
    let ago = at.wall.as_nanosecond() - time.as_nanosecond();
    let mono = at.mono.as_nanos() as i128 - ago;
    Duration::from_nanos(u64::try_from(mono).unwrap_or(0))
}
