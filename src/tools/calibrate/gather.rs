//! The presses of a recording, each with the positions of the arm.

use std::io::Read;
use std::mem;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::tools::exit::{FAILED, Failure};
use crate::tools::played::Played;
use hardnessd_core::event::{Event, FrameEvent, Note, Phase, PressState};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::Pipeline;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::{self, Gains};
use hardnessd_core::verdict::Model;

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
    /// The settings that turned counts into newtons.
    pub(super) calibration: tare::Settings,
    /// Whether a taxel of the press's best frame read full scale.
    pub(super) saturated: bool,
    /// When it ended.
    pub(super) end: Duration,
}

impl Press {
    /// The newtons of its frames with gains of 1.
    pub(super) fn without_gains(&self) -> Vec<Vec<f32>> {
        let mut frames = self.frames.clone();
        if let Some(Gains::Taxels(rows)) = &self.calibration.gains {
            for frame in &mut frames {
                for (newtons, gain) in frame.iter_mut().zip(rows.iter().flatten()) {
                    *newtons /= gain;
                }
            }
        }
        frames
    }
}

/// The most memory of the presses of a file, in bytes.
const MOST_BYTES: usize = 1 << 30;
/// This long after a press, all its positions have come.
const AFTER: Duration = Duration::from_millis(800);

/// The presses of `sensor` in the file at `path`. A recording tells sensors apart by name. In a file of raw
/// bytes, all bytes are those of `sensor`.
pub(super) fn presses(
    file: impl Read,
    path: &Path,
    sensor: &Sensor,
    hrn: &Arc<Model>,
) -> Result<Vec<Press>, Failure> {
    let mut gathered = Gathered::default();
    Played::open(path, file, sensor, hrn, None)?.play(|played, mut events, at| {
        events.retain(|event| event.sensor() == sensor.name());
        if let Some(pipeline) = played.playback.pipeline(sensor.name()) {
            gathered.take(events, at, pipeline);
        }
        gathered.check_size(path).map(|()| true)
    })?;
    let taxels = sensor.layout().array().taxels();
    let mut frames = gathered.presses.iter().flat_map(|press| &press.frames);
    if let Some(other) = frames.find(|frame| frame.len() != taxels) {
        let (path, found) = (path.display(), other.len());
        let other = format!("{path}: found frames of {found} taxels, expected {taxels}");
        return Err(Failure::new(FAILED, other));
    }
    Ok(gathered.presses)
}

/// The presses and the state of reading so far.
#[derive(Default)]
struct Gathered {
    presses: Vec<Press>,
    /// The memory of their frames, and of those of the press under way.
    bytes: usize,
    /// The frames of the press under way, and the newest frame.
    frames: Vec<(FrameEvent, Duration)>,
    /// The number of the first frame of the press under way.
    began: Option<u64>,
}

impl Gathered {
    fn take(&mut self, events: Vec<Event>, at: Stamp, pipeline: &Pipeline) {
        for event in events {
            match event {
                Event::Frame(frame) if frame.force_n.is_some() => {
                    if self.began.is_none() {
                        self.forget();
                    }
                    let moment = at.mono_of(frame.time);
                    self.bytes += size_of_val(&frame.newtons[..]);
                    self.frames.push((frame, moment));
                }
                Event::Press(press) => match press.state {
                    PressState::Begin => self.began = Some(press.frame),
                    PressState::End => {
                        let calibration = pipeline.sensor().calibration().clone();
                        self.end(press.frame, at.mono_of(press.time), calibration);
                    }
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
        // Positions may come late, and another press may have ended meanwhile.
        let is_recent = |press: &&mut Press| at.mono < press.end.saturating_add(AFTER);
        for press in self.presses.iter_mut().rev().take_while(is_recent) {
            press.track = pipeline.track().clone();
        }
    }

    /// Makes a press of the frames up to the `last` one.
    fn end(&mut self, last: u64, end: Duration, calibration: tare::Settings) {
        let own = self.began.take().unwrap_or(last)..=last;
        let mut press = Press {
            calibration,
            end,
            ..Press::default()
        };
        for (frame, moment) in mem::take(&mut self.frames) {
            if own.contains(&frame.frame) {
                press.moments.push(moment);
                press.forces_n.push(frame.force_n.unwrap_or_default());
                press.frames.push(frame.newtons);
            } else {
                self.bytes -= size_of_val(&frame.newtons[..]);
            }
        }
        self.presses.push(press);
    }

    /// Forgets frames that are of no press.
    fn forget(&mut self) {
        for (frame, _) in self.frames.drain(..) {
            self.bytes -= size_of_val(&frame.newtons[..]);
        }
    }

    /// Refuses presses that fill the memory.
    fn check_size(&self, path: &Path) -> Result<(), Failure> {
        if self.bytes <= MOST_BYTES {
            return Ok(());
        }
        let (path, most) = (path.display(), MOST_BYTES >> 30);
        let many = format!("{path}: its presses take more than {most} GB of memory: record fewer");
        Err(Failure::new(FAILED, many))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::tests::support::{hrn, of_a_press};

    #[test]
    fn presses_that_fill_the_memory_are_refused_while_they_last() {
        let path = Path::new("x");
        let of = |bytes| Gathered {
            bytes,
            ..Gathered::default()
        };
        assert!(of(MOST_BYTES).check_size(path).is_ok());
        let error = of(MOST_BYTES + 1).check_size(path).unwrap_err().line();
        assert!(
            error.contains("x: its presses take more than 1 GB"),
            "{error}"
        );
        // Frames count as soon as they come, and for as long as they are kept.
        let (recording, sensor) = of_a_press(|_| {}, None, true);
        let hrn = hrn();
        let mut gathered = Gathered::default();
        let mut most = 0;
        Played::open(path, recording.as_slice(), &sensor, &hrn, None)
            .unwrap()
            .play(|played, events, at| {
                if let Some(pipeline) = played.playback.pipeline(sensor.name()) {
                    gathered.take(events, at, pipeline);
                }
                let under_way = gathered.frames.iter().map(|(frame, _)| &frame.newtons);
                let ended = gathered.presses.iter().flat_map(|press| &press.frames);
                let kept: usize = under_way
                    .chain(ended)
                    .map(|frame| size_of_val(&frame[..]))
                    .sum();
                assert_eq!(gathered.bytes, kept);
                most = most.max(gathered.frames.len());
                Ok(true)
            })
            .unwrap();
        assert!(most > 3 && !gathered.presses.is_empty(), "{most}");
    }
}
