//! A file that is played: a recording through the pipelines of its sensors, or raw bytes through one.
//!
//! All times come from the file, so what is played depends neither on the speed nor on how the
//! bytes are cut.

use std::collections::VecDeque;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use super::exit::{FAILED, Failure, USAGE};
use super::replay::motion;
use super::unplayable;
use crate::daemon::config::Setup;
use hardnessd_core::event::{self, Event, Status};
use hardnessd_core::frame::Stamp;
use hardnessd_core::judge::Unjudged;
use hardnessd_core::motion::Point;
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, FileKind, Found, Playback, Reader};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::stderr_line;
use hardnessd_core::verdict::Model;

/// A file that is being played.
pub(super) struct Played<'a> {
    pub(super) playback: Playback,
    path: PathBuf,
    source: Source<'a>,
}

type File<'a> = BufReader<Box<dyn Read + 'a>>;

enum Source<'a> {
    Recording(Box<Reader<File<'a>>>),
    Raw {
        file: File<'a>,
        sensor: Box<Sensor>,
        /// The positions of the arm that are not played yet.
        motion: VecDeque<Point>,
    },
}

/// Positions are given to the pipeline this long before the frame of their moment.
const AHEAD: Duration = Duration::from_secs(2);

impl<'a> Played<'a> {
    /// Begins to play the file at `path`, judged by `hrn`. Raw bytes are those of `sensor`, whose arm moves as
    /// the file `motion` says. A recording has its own positions.
    pub(super) fn open(
        path: &Path,
        file: impl Read + 'a,
        sensor: &Sensor,
        hrn: &Arc<Model>,
        motion: Option<&Path>,
    ) -> Result<Self, Failure> {
        let (kind, file) = FileKind::read(file).map_err(unplayable(path))?;
        let file = BufReader::new(Box::new(file) as Box<dyn Read + 'a>);
        let (source, playback) = match kind {
            FileKind::Recording if motion.is_some() => {
                let found = format!("{}, a recording with times of its own", path.display());
                let problem = format!("--motion: found {found}, expected raw bytes");
                return Err(Failure::new(USAGE, problem));
            }
            FileKind::Recording => (
                Source::Recording(Box::new(Reader::new(file))),
                Playback::new(hrn.clone()),
            ),
            FileKind::Raw => {
                let motion = motion.map(motion::load).transpose()?;
                let source = Source::Raw {
                    file,
                    sensor: Box::new(sensor.clone()),
                    motion: motion.unwrap_or_default().into(),
                };
                (source, Playback::of_bytes(sensor.clone(), hrn.clone()))
            }
        };
        Ok(Self {
            playback,
            path: path.to_owned(),
            source,
        })
    }

    pub(super) fn is_raw(&self) -> bool {
        matches!(self.source, Source::Raw { .. })
    }

    /// Judges with the references of the configuration.
    pub(super) fn identify(&mut self, setup: &Setup) {
        for (name, hrn) in setup.identified() {
            match &self.source {
                Source::Recording(_) => self.playback.identify(name, hrn.clone()),
                Source::Raw { sensor, .. } if sensor.name() == name => {
                    self.playback = Playback::of_bytes((**sensor).clone(), hrn.clone());
                }
                Source::Raw { .. } => {}
            }
        }
    }

    /// Plays the next part: its events, and a moment on both clocks of the file. `None` at the end.
    fn next(&mut self) -> Result<Option<(Vec<Event>, Stamp)>, Failure> {
        let (parts, at) = match &mut self.source {
            Source::Recording(entries) => {
                let Some(found) = entries.next() else {
                    return Ok(None);
                };
                let found = found.map_err(unplayable(&self.path))?;
                let at = found.at;
                (vec![found], at)
            }
            Source::Raw {
                file,
                sensor,
                motion,
            } => {
                // No two frames end within this many bytes, so each frame comes at its own moment, between
                // its positions.
                let mut bytes = Vec::new();
                let part = sensor.layout().min_frame_bytes() as u64;
                let read = file.take(part).read_to_end(&mut bytes);
                if read.map_err(unplayable(&self.path))? == 0 {
                    return Ok(None);
                }
                let pipeline = self.playback.pipeline(sensor.name());
                let frames = pipeline.map_or(0, |pipeline| pipeline.frame_counts().0);
                let time = Duration::try_from_secs_f64(frames as f64 / sensor.frame_rate_hz());
                let mono = time.unwrap_or(Duration::MAX);
                let until = mono.saturating_add(AHEAD).as_nanos() as i128;
                let is_later = |point: &Point| i128::from(point.at_ns) > until;
                let count = motion.iter().position(is_later).unwrap_or(motion.len());
                let points = Input::Motion(motion.drain(..count).collect());
                let part = |input| Found {
                    sensor: sensor.name().to_owned(),
                    at: Stamp::EPOCH,
                    entry: Entry::Input(input),
                };
                let wall = Stamp::EPOCH
                    .wall
                    .checked_add(mono)
                    .unwrap_or(Stamp::EPOCH.wall);
                let parts = [points, Input::Bytes(bytes)].map(part);
                (parts.into(), Stamp { mono, wall })
            }
        };
        let mut events = Vec::new();
        for part in parts {
            events.extend(self.playback.feed(part).map_err(unplayable(&self.path))?);
        }
        warn(self.playback.unjudged());
        Ok(Some((events, at)))
    }

    /// The last events, at the end of the file or where it is damaged, and why the file was of no use.
    fn end(&mut self) -> (Vec<Event>, Option<Failure>) {
        let is_raw = self.is_raw();
        let (path, playback) = (self.path.display(), &mut self.playback);
        for note in playback.left_out() {
            stderr_line!("warning: {path}: {note}");
        }
        let events = playback.end();
        warn(playback.unjudged());
        let frames = events.iter().find_map(|event| match event {
            Event::Status(status) if is_raw => Some(status),
            _ => None,
        });
        let problem = match frames {
            Some(Status {
                frames: 0,
                bytes_skipped,
                frames_damaged,
                ..
            }) => format!(
                "no whole frame in {bytes_skipped} bytes ({frames_damaged} damaged): the layout is not that of \
                 [sensor.frame]: `hardnessd sniff {path}` looks for another"
            ),
            _ => match playback.nothing_played() {
                Some(problem) => problem.to_owned(),
                None => return (events, None),
            },
        };
        let failure = Failure::new(FAILED, format!("{path}: {problem}"));
        (events, Some(failure))
    }

    /// Plays to the end, or until `each` returns `false`, which takes the events of each part, and a moment.
    ///
    /// # Errors
    ///
    /// Fails as `each` does, or if the file cannot be played to its end, or is of no use. If a recording is cut off or
    /// damaged, its events end like those of bytes that end there.
    pub(super) fn play(
        &mut self,
        mut each: impl FnMut(&mut Self, Vec<Event>, Stamp) -> Result<bool, Failure>,
    ) -> Result<(), Failure> {
        let mut last = Stamp::EPOCH;
        let played = loop {
            match self.next() {
                Ok(Some((events, at))) => {
                    last = at;
                    if !each(self, events, at)? {
                        return Ok(());
                    }
                }
                Ok(None) => break Ok(()),
                Err(failure) => break Err(failure),
            }
        };
        let (events, failure) = self.end();
        each(self, events, last)?;
        played?;
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
