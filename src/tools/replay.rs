//! `hardnessd replay`: sends a recording through the daemon's pipeline, and prints the events on
//! stdout.
//!
//! All times come from the recording, so the output depends neither on the speed nor on how the
//! bytes are cut.

pub mod motion;

use std::collections::VecDeque;
use std::io::{self, BufReader, IsTerminal, Read};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use clap::Args as ClapArgs;

use super::configuration::ModelFile;
use super::exit::Failure;
use super::readable::Printer;
use super::simulate::positive;
use super::unplayable;
use crate::daemon::config::{Config, Setup};
use crate::daemon::now;
use crate::thread::spawn_thread;
use hardnessd_core::event::{Event, Kind};
use hardnessd_core::exit::{FAILED, USAGE};
use hardnessd_core::judge::Unjudged;
use hardnessd_core::motion::Point;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::recording::{FileKind, Playback, Reader};
use hardnessd_core::sensor;
use hardnessd_core::stderr_line;

/// Arguments of `replay`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording of `record`, or raw bytes back to back
    file: PathBuf,
    /// Configuration: its model judges; raw bytes are those of its first sensor [default: the model
    /// built in, a JX255N by default settings]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
    /// Play X times as fast as the sensor did [default: as fast as possible]
    #[arg(long, value_name = "X", value_parser = positive)]
    speed: Option<f64>,
    /// Positions of the arm for raw bytes: CSV with the columns time_s, counted from the first whole
    /// frame, and approach_mm [default: none]
    #[arg(long, value_name = "M.csv")]
    motion: Option<PathBuf>,
    #[command(flatten)]
    model: ModelFile,
    /// Print events as JSON lines on a terminal too
    #[arg(long)]
    json: bool,
}

/// The number of bytes that are read at once if neither a speed nor positions pace them.
const CHUNK_BYTES: usize = 64 * 1024;

/// Plays to the end, or until nobody reads stdout. Dropping the future stops the replay.
///
/// # Errors
///
/// Returns a [`Failure`] if the recording or the configuration cannot be used.
pub async fn run(args: Args) -> Result<(), Failure> {
    // Dropping this future drops `_stop`, which stops the thread.
    let (_stop, stopped) = mpsc::channel();
    // The replay runs on a thread of its own, so that a signal waits neither for a recording that
    // is a pipe nor for the reader of stdout.
    let played = spawn_thread("replay", move || play(&args, &stopped))?;
    played.await.expect("a replay does not panic")
}

/// Plays to the end, or until the other end of `stopped` is dropped.
fn play(args: &Args, stopped: &Receiver<()>) -> Result<(), Failure> {
    let model = args.model.path()?;
    let setup = match &args.config {
        Some(config) => Setup::load(config, model.as_deref())?,
        None => {
            let config = Config::new(vec![sensor::Settings::new(args.file.clone())]);
            Setup::of(config.with_model(model.as_deref()), Path::new("defaults"))?
        }
    };
    let path = &args.file;
    let recording = super::open(path)?;
    let levels = &setup.hrn.card().levels;
    let labels = levels.iter().map(|level| level.label.clone()).collect();
    let printer = Printer::new(args.json || !io::stdout().is_terminal(), labels);
    let pace = Pace {
        speed: args.speed,
        start: None,
        stopped,
        printer: &printer,
    };
    let (kind, recording) = FileKind::read(recording).map_err(unplayable(path))?;
    match kind {
        FileKind::Recording if args.motion.is_some() => Err(own_motion(path)),
        FileKind::Recording => play_recording(path, BufReader::new(recording), &setup, pace),
        FileKind::Raw => {
            let motion = args.motion.as_deref().map(motion::load).transpose()?;
            play_bytes(path, recording, motion, &setup.checked(path)?, pace)
        }
    }
}

/// The timing of a replay.
struct Pace<'a> {
    speed: Option<f64>,
    /// When the first entry was played.
    start: Option<Instant>,
    stopped: &'a Receiver<()>,
    printer: &'a Printer,
}

impl Pace<'_> {
    /// Waits until the entry is due that came `since` after the first one. Returns `false` if the
    /// replay was stopped.
    fn wait(&mut self, since: Duration) -> bool {
        let start = *self.start.get_or_insert_with(Instant::now);
        let left = self.speed.map_or(Duration::ZERO, |speed| {
            let due = Duration::try_from_secs_f64(since.as_secs_f64() / speed);
            // A moment that is too far away to count never comes.
            let due = due.unwrap_or(Duration::MAX);
            due.saturating_sub(start.elapsed())
        });
        self.stopped.recv_timeout(left) != Err(RecvTimeoutError::Disconnected)
    }
}

/// Plays a recording. If it is cut off or damaged, its events end like those of bytes that end
/// there, and the error follows them.
fn play_recording(path: &Path, file: impl Read, setup: &Setup, pace: Pace) -> Result<(), Failure> {
    let mut playback = Playback::new(setup.hrn.clone());
    for (sensor, hrn) in setup.identified() {
        playback.identify(sensor, hrn.clone());
    }
    let (mut seq, printer) = (0, pace.printer);
    let played = play_entries(path, file, pace, &mut playback, &mut seq);
    if let Ok(false) = played {
        return Ok(());
    }
    for note in playback.left_out() {
        stderr_line!("warning: {}: {note}", path.display());
    }
    if let Some(model) = playback.other_model() {
        stderr_line!(
            "warning: {}: recorded with model {}, played with another",
            path.display(),
            model.get(..12).unwrap_or(model)
        );
    }
    let end = playback.end();
    warn(playback.unjudged());
    print(end, &mut seq, printer)?;
    played.map(drop)
}

/// Plays the entries of a recording at their moments. Returns `false` if nobody reads stdout or the
/// replay was stopped.
fn play_entries(
    path: &Path,
    file: impl Read,
    mut pace: Pace,
    playback: &mut Playback,
    seq: &mut u64,
) -> Result<bool, Failure> {
    // The moment of the first entry.
    let mut first: Option<Duration> = None;
    for found in Reader::new(file) {
        let found = found.map_err(unplayable(path))?;
        let first = *first.get_or_insert(found.at.mono);
        if !pace.wait(found.at.mono.saturating_sub(first)) {
            return Ok(false);
        }
        let events = playback.feed(found).map_err(unplayable(path))?;
        warn(playback.unjudged());
        if !print(events, seq, pace.printer)? {
            return Ok(false);
        }
    }
    if playback.sensors() == 0 {
        // A clip of a recording may lie inside one press.
        let problem = match playback.left_out().is_empty() {
            true => "found no state of a sensor, expected a recording of hardnessd",
            false => "found no sensor at rest, expected a recording with a moment between presses",
        };
        return Err(unplayable(path)(anyhow::Error::msg(problem)));
    }
    Ok(true)
}

/// Positions are given to the pipeline this long before the frame of their moment.
const AHEAD: Duration = Duration::from_secs(2);

/// Plays raw bytes, with the arm's positions.
fn play_bytes(
    path: &Path,
    file: impl Read,
    motion: Option<Vec<Point>>,
    setup: &Setup,
    mut pace: Pace,
) -> Result<(), Failure> {
    let sensor = setup.sensors.first();
    let sensor = sensor.expect("a configuration has at least one sensor");
    let hrn = setup.hrn_of(sensor.name()).clone();
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::FrameRate);
    let (mut seq, printer) = (0, pace.printer);
    let is_paced = pace.speed.is_some();
    let each = |events, since| Ok(pace.wait(since) && print(events, &mut seq, printer)?);
    let Some(end) = feed(path, file, motion, is_paced, &mut pipeline, each)? else {
        return Ok(());
    };
    let none = no_frame(path, &end);
    print(end, &mut seq, printer)?;
    none.map_or(Ok(()), Err)
}

/// Sends raw bytes through a pipeline, with the arm's positions. `each` takes the events of a part
/// and the time of its last frame after the first one, and says whether to go on. Returns the events
/// of the end, or `None` if `each` ended it.
pub(super) fn feed(
    path: &Path,
    mut file: impl Read,
    motion: Option<Vec<Point>>,
    is_paced: bool,
    pipeline: &mut Pipeline,
    mut each: impl FnMut(Vec<Event>, Duration) -> Result<bool, Failure>,
) -> Result<Option<Vec<Event>>, Failure> {
    let frame_rate_hz = pipeline.sensor().frame_rate_hz();
    // No two frames end within this many bytes, so each frame comes at its own moment, between its
    // positions.
    let chunk_bytes = if is_paced || motion.is_some() {
        pipeline.sensor().layout().min_frame_bytes()
    } else {
        CHUNK_BYTES
    };
    let mut motion = VecDeque::from(motion.unwrap_or_default());
    let mut chunk = vec![0; chunk_bytes];
    loop {
        let read = match file.read(&mut chunk) {
            Ok(read) => read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return Err(unplayable(path)(error)),
        };
        if read == 0 {
            let end = pipeline.end_of_recording(None);
            warn(pipeline.unjudged());
            return Ok(Some(end));
        }
        let (frames, _) = pipeline.frame_counts();
        let until_ns = time_of(frames, frame_rate_hz)
            .saturating_add(AHEAD)
            .as_nanos();
        let count = motion
            .iter()
            .position(|point| i128::from(point.at_ns) > until_ns as i128);
        let points: Vec<Point> = motion.drain(..count.unwrap_or(motion.len())).collect();
        // An error means that the time of a point went back. The approach of its press is then
        // unknown. The pipeline takes its times from the recording and does not use this one.
        let _ = pipeline.take(Input::Motion(points), now());
        let bytes = Input::Bytes((&chunk[..read]).into());
        let events = pipeline.take(bytes, now()).unwrap_or_default();
        warn(pipeline.unjudged());
        let (frames, _) = pipeline.frame_counts();
        let since = time_of(frames.saturating_sub(1), frame_rate_hz);
        if !each(events, since)? {
            return Ok(None);
        }
    }
}

/// The failure of positions beside a recording.
pub(super) fn own_motion(path: &Path) -> Failure {
    let path = path.display();
    let problem =
        format!("--motion: found {path}, a recording with times of its own, expected raw bytes");
    Failure::new(USAGE, problem)
}

/// The failure of raw bytes that had no whole frame, from the events of their end.
pub(super) fn no_frame(path: &Path, end: &[Event]) -> Option<Failure> {
    let path = path.display();
    end.iter().find_map(|event| match event {
        Event::Status(status) if status.frames == 0 => {
            let (bytes, damaged) = (status.bytes_skipped, status.frames_damaged);
            let problem = format!(
                "{path}: no whole frame in {bytes} bytes ({damaged} damaged): the layout is not that of \
                 [sensor.frame]: `hardnessd sniff {path}` looks for another"
            );
            Some(Failure::new(FAILED, problem))
        }
        _ => None,
    })
}

/// The time of whole frame `number` after the first one, in bytes without times.
fn time_of(number: u64, frame_rate_hz: f64) -> Duration {
    Duration::try_from_secs_f64(number as f64 / frame_rate_hz).unwrap_or(Duration::MAX)
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
        let phase = hardnessd_core::event::name(&phase);
        stderr_line!("warning: sensor {sensor:?}: no {phase} verdict on press {press}: {error}");
    }
}

/// Prints the events that a subscriber would receive, without frames. Returns `false` if nobody
/// reads stdout.
fn print(events: Vec<Event>, seq: &mut u64, printer: &Printer) -> Result<bool, Failure> {
    let mut lines = String::new();
    for mut event in events {
        if event.kind() != Kind::Frame {
            *seq += 1;
            event.number(*seq);
            let line = event.to_line();
            let json = line.trim_end();
            lines += &printer.line(json.to_owned(), || {
                serde_json::from_str(json).expect("an event is JSON")
            });
        }
    }
    super::print(lines.as_bytes())
}
