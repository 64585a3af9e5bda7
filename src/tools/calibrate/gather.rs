//! The presses of a recording, each with the positions of the arm.

use std::io::{BufReader, ErrorKind, Read};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use crate::tools::exit::Failure;
use crate::tools::unplayable;
use hardnessd_core::event::{Event, Note, Phase, PressState};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Playback, Reader};
use hardnessd_core::sensor::{Description, Sensor};
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
}

/// A press that waits for its last positions.
struct Ended {
    number: u64,
    /// The first and the last frame.
    frames: [u64; 2],
    end: Duration,
    described: Option<Arc<Description>>,
    saturated: bool,
}

/// A frame of the sensor.
struct Taken {
    number: u64,
    mono: Duration,
    newtons: Vec<f32>,
    force_n: f64,
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
    let read = || -> anyhow::Result<_> {
        let (kind, file) = FileKind::read(file)?;
        match kind {
            FileKind::Recording => {
                of_recording(BufReader::new(file), sensor.name(), hrn, with_track)
            }
            FileKind::Raw => Ok(of_bytes(file, sensor, hrn)?),
        }
    };
    read().map_err(unplayable(path))
}

fn of_recording(
    file: impl Read,
    sensor: &str,
    hrn: Arc<Hrn>,
    with_track: bool,
) -> anyhow::Result<Vec<Press>> {
    let (mut playback, none) = (Playback::new(hrn), Track::default());
    let mut gathered = Gathered {
        with_track,
        ..Gathered::default()
    };
    for found in Reader::new(file) {
        let found = found?;
        if found.sensor != sensor {
            continue;
        }
        let at = found.at;
        let track = playback.track(sensor).unwrap_or(&none);
        if let Entry::State(state) = &found.entry {
            gathered.describe(&state.sensor.description);
        }
        gathered.settle(at.mono, track);
        gathered.take(playback.feed(found)?, at);
    }
    for note in playback.left_out() {
        hardnessd_core::stderr_line!("warning: {note}");
    }
    Ok(gathered.end(playback.track(sensor).unwrap_or(&none)))
}

fn of_bytes(mut file: impl Read, sensor: &Sensor, hrn: Arc<Hrn>) -> std::io::Result<Vec<Press>> {
    // The frames of raw bytes get their times from the frame rate, counted from here.
    let start = Stamp {
        mono: Duration::ZERO,
        wall: Timestamp::UNIX_EPOCH,
    };
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::FrameRate);
    let (mut gathered, none) = (Gathered::default(), Track::default());
    gathered.describe(sensor.description());
    let mut chunk = vec![0; CHUNK_BYTES];
    loop {
        let read = match file.read(&mut chunk) {
            Ok(0) => break,
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            read => read?,
        };
        let bytes = Input::Bytes((&chunk[..read]).into());
        let events = pipeline.take(bytes, start);
        gathered.take(events.unwrap_or_default(), start);
        gathered.settle(Duration::MAX, &none);
    }
    gathered.take(pipeline.end_of_recording(None), start);
    Ok(gathered.end(&none))
}

/// The number of bytes whose frames are held at a time.
const CHUNK_BYTES: usize = 1 << 16;

/// The presses and the state of reading so far.
#[derive(Default)]
struct Gathered {
    presses: Vec<Press>,
    /// Whether a press takes a copy of the arm's positions.
    with_track: bool,
    described: Option<Arc<Description>>,
    /// The frames of the press under way and of those in `ended`, and the newest frame.
    frames: Vec<Taken>,
    /// The number of the first frame of the press under way.
    began: Option<u64>,
    /// The presses that wait for their last positions.
    ended: Vec<Ended>,
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
                Event::Frame(frame) => {
                    let Some(force_n) = frame.force_n else {
                        continue;
                    };
                    if self.began.is_none() && self.ended.is_empty() {
                        self.frames.clear();
                    }
                    self.frames.push(Taken {
                        number: frame.frame,
                        mono: at.mono_of(frame.time),
                        newtons: frame.newtons,
                        force_n,
                    });
                }
                Event::Press(press) => match press.state {
                    PressState::Begin => self.began = Some(press.frame),
                    PressState::End => {
                        let first = self.began.take().unwrap_or(press.frame);
                        self.ended.push(Ended {
                            number: press.press,
                            frames: [first, press.frame],
                            end: at.mono_of(press.time),
                            described: self.described.clone(),
                            saturated: false,
                        });
                    }
                    PressState::Aborted => self.began = None,
                },
                // The final verdict comes together with the end of its press.
                Event::Hardness(verdict) if verdict.phase == Phase::Final => {
                    let mut ended = self.ended.iter_mut();
                    if let Some(press) = ended.find(|press| press.number == verdict.press) {
                        press.saturated = verdict.notes.contains(&Note::Saturated);
                    }
                }
                _ => {}
            }
        }
    }

    /// Takes the presses whose positions have come by `now`. `track` has them.
    fn settle(&mut self, now: Duration, track: &Track) {
        let is_due = |press: &Ended| now >= press.end.saturating_add(AFTER);
        while self.ended.first().is_some_and(is_due) {
            let Ended {
                frames: [first, last],
                described,
                saturated,
                ..
            } = self.ended.remove(0);
            let mut press = Press {
                track: match self.with_track {
                    true => track.clone(),
                    false => Track::default(),
                },
                described,
                saturated,
                ..Press::default()
            };
            let own = self.frames.iter();
            for frame in own.filter(|frame| (first..=last).contains(&frame.number)) {
                press.moments.push(frame.mono);
                press.forces_n.push(frame.force_n);
                press.frames.push(frame.newtons.clone());
            }
            self.presses.push(press);
        }
    }

    fn end(mut self, track: &Track) -> Vec<Press> {
        self.settle(Duration::MAX, track);
        self.presses
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
