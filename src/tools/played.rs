//! A file that is played: a recording through the pipelines of its sensors, or raw bytes through one.
//!
//! All times come from the file, so what is played depends neither on the speed nor on how the
//! bytes are cut.

use std::collections::VecDeque;
use std::io::{BufReader, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use super::exit::Failure;
use super::replay::motion;
use super::unplayable;
use crate::daemon::config::Setup;
use crate::daemon::now;
use hardnessd_core::event::{self, Event};
use hardnessd_core::exit::{FAILED, USAGE};
use hardnessd_core::frame::Stamp;
use hardnessd_core::judge::Unjudged;
use hardnessd_core::motion::Point;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::recording::{FileKind, Labels, Playback, Reader};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::stderr_line;
use hardnessd_core::verdict::{Hrn, TimeSeries};

/// A file that is being played.
pub(super) struct Played<'a> {
    path: PathBuf,
    source: Source<'a>,
}

enum Source<'a> {
    Recording {
        entries: Reader<BufReader<Box<dyn Read + 'a>>>,
        playback: Playback,
        /// The moment of the first entry.
        first: Option<Duration>,
    },
    Raw {
        file: BufReader<Box<dyn Read + 'a>>,
        pipeline: Box<Pipeline>,
        /// The positions of the arm that the pipeline does not have yet.
        motion: VecDeque<Point>,
    },
}

/// What a part of a file gives.
pub(super) struct Step {
    pub(super) events: Vec<Event>,
    /// The time after the first part.
    pub(super) since: Duration,
    /// A moment on both clocks of the file.
    pub(super) at: Stamp,
}

/// Positions are given to the pipeline this long before the frame of their moment.
const AHEAD: Duration = Duration::from_secs(2);

/// Where the times of raw bytes begin, which come from the frame rate.
const START: Stamp = Stamp {
    mono: Duration::ZERO,
    wall: Timestamp::UNIX_EPOCH,
};

impl<'a> Played<'a> {
    /// Begins to play the file at `path`, judged by `hrn`. Raw bytes are those of `sensor`, whose arm moves as
    /// the file `motion` says. A recording has its own positions.
    pub(super) fn open(
        path: &Path,
        file: impl Read + 'a,
        sensor: &Sensor,
        hrn: &Arc<Hrn>,
        motion: Option<&Path>,
    ) -> Result<Self, Failure> {
        let (kind, file) = FileKind::read(file).map_err(unplayable(path))?;
        let file = BufReader::new(Box::new(file) as Box<dyn Read + 'a>);
        let source = match kind {
            FileKind::Recording if motion.is_some() => {
                let found = format!("{}, a recording with times of its own", path.display());
                let problem = format!("--motion: found {found}, expected raw bytes");
                return Err(Failure::new(USAGE, problem));
            }
            FileKind::Recording => Source::Recording {
                entries: Reader::new(file),
                playback: Playback::new(hrn.clone()),
                first: None,
            },
            FileKind::Raw => Source::Raw {
                file,
                pipeline: Box::new(Pipeline::new(sensor.clone(), hrn.clone(), Clock::FrameRate)),
                motion: motion
                    .map(motion::load)
                    .transpose()?
                    .unwrap_or_default()
                    .into(),
            },
        };
        Ok(Self {
            path: path.to_owned(),
            source,
        })
    }

    pub(super) fn is_raw(&self) -> bool {
        matches!(self.source, Source::Raw { .. })
    }

    /// Judges with the references of the configuration.
    pub(super) fn identify(&mut self, setup: &Setup) {
        match &mut self.source {
            Source::Recording { playback, .. } => {
                for (sensor, hrn) in setup.identified() {
                    playback.identify(sensor, hrn.clone());
                }
            }
            Source::Raw { pipeline, .. } => {
                let sensor = pipeline.sensor().clone();
                let hrn = setup.hrn_of(sensor.name()).clone();
                **pipeline = Pipeline::new(sensor, hrn, Clock::FrameRate);
            }
        }
    }

    /// Keeps the course of each press that ends, until [`Self::courses`] returns it.
    pub(super) fn keep_courses(&mut self) {
        match &mut self.source {
            Source::Recording { playback, .. } => playback.keep_courses(),
            Source::Raw { pipeline, .. } => pipeline.keep_courses(),
        }
    }

    /// The kept courses of a sensor that were not returned yet.
    pub(super) fn courses(&mut self, sensor: &str) -> Vec<TimeSeries> {
        match &mut self.source {
            Source::Recording { playback, .. } => playback.courses(sensor),
            Source::Raw { pipeline, .. } => pipeline.courses(),
        }
    }

    /// The labels of a recording, from the part played so far.
    pub(super) fn labels(&self) -> Labels {
        match &self.source {
            Source::Recording { playback, .. } => playback.labels(),
            Source::Raw { .. } => Labels::new(),
        }
    }

    /// The SHA-256 of the model that judged while a recording was made, if it is another one.
    pub(super) fn other_model(&self) -> Option<&str> {
        match &self.source {
            Source::Recording { playback, .. } => playback.other_model(),
            Source::Raw { .. } => None,
        }
    }

    /// The pipeline of a sensor.
    pub(super) fn pipeline(&self, sensor: &str) -> Option<&Pipeline> {
        match &self.source {
            Source::Recording { playback, .. } => playback.pipeline(sensor),
            Source::Raw { pipeline, .. } => Some(pipeline),
        }
    }

    /// Plays the next part. `None` at the end.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read or played further.
    pub(super) fn next(&mut self) -> Result<Option<Step>, Failure> {
        match &mut self.source {
            Source::Recording {
                entries,
                playback,
                first,
            } => {
                let Some(found) = entries.next() else {
                    return Ok(None);
                };
                let found = found.map_err(unplayable(&self.path))?;
                let at = found.at;
                let since = at.mono.saturating_sub(*first.get_or_insert(at.mono));
                let events = playback.feed(found).map_err(unplayable(&self.path))?;
                warn(playback.unjudged());
                Ok(Some(Step { events, since, at }))
            }
            Source::Raw {
                file,
                pipeline,
                motion,
            } => {
                let frame_rate_hz = pipeline.sensor().frame_rate_hz();
                let time_of = |frames: u64| {
                    let time = Duration::try_from_secs_f64(frames as f64 / frame_rate_hz);
                    time.unwrap_or(Duration::MAX)
                };
                // No two frames end within this many bytes, so each frame comes at its own moment, between
                // its positions.
                let mut bytes = vec![0; pipeline.sensor().layout().min_frame_bytes()];
                let read = loop {
                    match file.read(&mut bytes) {
                        Err(error) if error.kind() == ErrorKind::Interrupted => {}
                        read => break read.map_err(unplayable(&self.path))?,
                    }
                };
                if read == 0 {
                    return Ok(None);
                }
                bytes.truncate(read);
                let (frames, _) = pipeline.frame_counts();
                let until_ns = time_of(frames).saturating_add(AHEAD).as_nanos() as i128;
                let is_later = |point: &Point| i128::from(point.at_ns) > until_ns;
                let count = motion.iter().position(is_later).unwrap_or(motion.len());
                // An error means that the time of a point went back. The approach of its press is then
                // unknown. The pipeline takes its times from the frame rate and does not use this one.
                let _ = pipeline.take(Input::Motion(motion.drain(..count).collect()), now());
                let events = pipeline.take(Input::Bytes(bytes.into()), now());
                warn(pipeline.unjudged());
                let (frames, _) = pipeline.frame_counts();
                Ok(Some(Step {
                    events: events.unwrap_or_default(),
                    since: time_of(frames.saturating_sub(1)),
                    at: START,
                }))
            }
        }
    }

    /// The last events, at the end of the file or where it is damaged, and why the file was of no use.
    pub(super) fn end(&mut self) -> (Vec<Event>, Option<Failure>) {
        let path = self.path.display();
        match &mut self.source {
            Source::Recording { playback, .. } => {
                for note in playback.left_out() {
                    stderr_line!("warning: {path}: {note}");
                }
                let events = playback.end();
                warn(playback.unjudged());
                // A clip of a recording may lie inside one press.
                let problem = match playback.left_out().is_empty() {
                    true => "found no state of a sensor, expected a recording of hardnessd",
                    false => {
                        "found no sensor at rest, expected a recording with a moment between presses"
                    }
                };
                let failure = || unplayable(&self.path)(anyhow::Error::msg(problem));
                (events, (playback.sensors() == 0).then(failure))
            }
            Source::Raw { pipeline, .. } => {
                let events = pipeline.end_of_recording(None);
                warn(pipeline.unjudged());
                let failure = events.iter().find_map(|event| match event {
                    Event::Status(status) if status.frames == 0 => {
                        let (bytes, damaged) = (status.bytes_skipped, status.frames_damaged);
                        let problem = format!(
                            "{path}: no whole frame in {bytes} bytes ({damaged} damaged): the layout is not \
                             that of [sensor.frame]: `hardnessd sniff {path}` looks for another"
                        );
                        Some(Failure::new(FAILED, problem))
                    }
                    _ => None,
                });
                (events, failure)
            }
        }
    }

    /// Plays to the end. `each` takes the events of each part, and a moment.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be played to its end, or is of no use.
    pub(super) fn play(
        &mut self,
        mut each: impl FnMut(&mut Self, Vec<Event>, Stamp),
    ) -> Result<(), Failure> {
        let mut last = START;
        while let Some(Step { events, at, .. }) = self.next()? {
            last = at;
            each(self, events, at);
        }
        let (events, failure) = self.end();
        each(self, events, last);
        failure.map_or(Ok(()), Err)
    }
}

/// Says which verdicts are missing.
fn warn(unjudged: Vec<Unjudged>) {
    for Unjudged {
        sensor,
        press,
        phase,
        error,
    } in unjudged
    {
        let phase = event::name(&phase);
        stderr_line!("warning: sensor {sensor:?}: no {phase} verdict on press {press}: {error}");
    }
}
