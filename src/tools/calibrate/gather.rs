//! The presses of a recording, each with the positions of the arm.

use std::io::{BufReader, Read};
use std::mem;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use crate::tools::exit::Failure;
use crate::tools::replay::feed;
use crate::tools::unplayable;
use hardnessd_core::event::{Event, FrameEvent, Note, Phase, PressState};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Playback, Reader};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::stderr_line;
use hardnessd_core::verdict::Hrn;

/// One press.
#[derive(Debug, Default)]
pub(super) struct Press {
    /// The moments of the frames in contact.
    pub(super) moments: Vec<Duration>,
    /// The newtons on each taxel, for each of these frames. Noise makes some negative.
    pub(super) frames: Vec<Vec<f32>>,
    /// The force of the contact in each of these frames, in newtons.
    pub(super) forces_n: Vec<f64>,
    /// The positions of the arm.
    pub(super) track: Track,
    /// The description of the sensor when the press ended. `None` if the file has none.
    pub(super) described: Option<Arc<Description>>,
    /// Whether a taxel of the press's best frame read full scale.
    pub(super) saturated: bool,
    /// When it ended.
    pub(super) end: Duration,
}

/// This long after a press, all its positions have come.
const AFTER: Duration = Duration::from_millis(800);

/// The presses of `sensor` in the file at `path`. A recording tells sensors apart by name. In a file of raw
/// bytes, all bytes are those of `sensor`. The presses have the positions of the arm `with_track`.
pub(super) fn presses(
    file: impl Read,
    path: &Path,
    sensor: &Sensor,
    hrn: Arc<Hrn>,
    with_track: bool,
) -> Result<Vec<Press>, Failure> {
    let (kind, file) = FileKind::read(file).map_err(unplayable(path))?;
    let mut gathered = Gathered {
        with_track,
        ..Gathered::default()
    };
    match kind {
        FileKind::Recording => {
            let taken = gathered.take_recording(BufReader::new(file), sensor.name(), hrn);
            taken.map_err(unplayable(path))?;
        }
        FileKind::Raw => {
            // The frames of raw bytes get their times from the frame rate, counted from here.
            let start = Stamp {
                mono: Duration::ZERO,
                wall: Timestamp::UNIX_EPOCH,
            };
            let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::FrameRate);
            gathered.describe(sensor.description());
            let each = |events, _| {
                gathered.take(events, start);
                Ok(true)
            };
            let end = feed(path, file, None, false, &mut pipeline, each)?;
            gathered.take(end.unwrap_or_default(), start);
        }
    }
    Ok(gathered.presses)
}

/// The presses and the state of reading so far.
#[derive(Default)]
struct Gathered {
    presses: Vec<Press>,
    /// Whether a press takes a copy of the arm's positions.
    with_track: bool,
    /// The number of presses that have their positions.
    settled: usize,
    described: Option<Arc<Description>>,
    /// The frames of the press under way, and the newest frame.
    frames: Vec<(FrameEvent, Duration)>,
    /// The number of the first frame of the press under way.
    began: Option<u64>,
}

impl Gathered {
    fn take_recording(
        &mut self,
        file: impl Read,
        sensor: &str,
        hrn: Arc<Hrn>,
    ) -> anyhow::Result<()> {
        let (mut playback, none) = (Playback::new(hrn), Track::default());
        for found in Reader::new(file) {
            let found = found?;
            if found.sensor != sensor {
                continue;
            }
            let at = found.at;
            if let Entry::State(state) = &found.entry {
                self.describe(&state.sensor.description);
            }
            self.settle(at.mono, playback.track(sensor).unwrap_or(&none));
            self.take(playback.feed(found)?, at);
        }
        for note in playback.left_out() {
            stderr_line!("warning: {note}");
        }
        self.settle(Duration::MAX, playback.track(sensor).unwrap_or(&none));
        Ok(())
    }

    fn describe(&mut self, description: &Description) {
        if self.described.as_deref() != Some(description) {
            self.described = Some(Arc::new(description.clone()));
        }
    }

    fn take(&mut self, events: Vec<Event>, at: Stamp) {
        for event in events {
            match event {
                Event::Frame(frame) if frame.force_n.is_some() => {
                    if self.began.is_none() {
                        self.frames.clear();
                    }
                    let moment = at.mono_of(frame.time);
                    self.frames.push((frame, moment));
                }
                Event::Press(press) => match press.state {
                    PressState::Begin => self.began = Some(press.frame),
                    PressState::End => self.end(press.frame, at.mono_of(press.time)),
                    PressState::Aborted => self.began = None,
                },
                // The final verdict follows the end of its press.
                Event::Hardness(verdict) if verdict.phase == Phase::Final => {
                    if let Some(press) = self.presses.last_mut() {
                        press.saturated = verdict.notes.contains(&Note::Saturated);
                    }
                }
                _ => {}
            }
        }
    }

    /// Makes a press of the frames up to the `last` one.
    fn end(&mut self, last: u64, end: Duration) {
        let own = self.began.take().unwrap_or(last)..=last;
        let mut press = Press {
            described: self.described.clone(),
            end,
            ..Press::default()
        };
        for (frame, moment) in mem::take(&mut self.frames) {
            if own.contains(&frame.frame) {
                press.moments.push(moment);
                press.forces_n.push(frame.force_n.unwrap_or_default());
                press.frames.push(frame.newtons);
            }
        }
        self.presses.push(press);
    }

    /// Gives the presses whose positions have come by `now` a copy of `track`, which has them.
    fn settle(&mut self, now: Duration, track: &Track) {
        while self.with_track
            && let Some(press) = self.presses.get_mut(self.settled)
            && now >= press.end.saturating_add(AFTER)
        {
            press.track = track.clone();
            self.settled += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::test_support::{hrn, of_a_press};

    #[test]
    fn a_press_has_the_positions_from_before_its_recording() {
        let (recording, sensor) = of_a_press(|_| {}, None, true);
        let presses = presses(recording.as_slice(), Path::new("x"), &sensor, hrn(), true).unwrap();
        let [press] = &presses[..] else {
            panic!("one press");
        };
        let found = press.track.approach(press.moments[0], &press.moments, 0.0);
        let way = found.unwrap().last().copied().flatten();
        assert!((way.unwrap() - 4.0).abs() < 1e-6, "{way:?}");
    }
}
