//! Recording: a separate thread writes what the sensors' tasks and the hub send to it.
//!
//! In: the sensors' inputs, and events, through a bounded queue. Out: files. Nothing waits for the
//! thread. A sensor's first entry is its state at rest, from which a replay can begin. When the queue
//! is full, entries are dropped and counted, up to the sensor's next rest. A disk that fails or is full
//! stops the recording, not the daemon. The recording continues when there is room again.

mod file;
mod worker;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use rustix::fs::{Access, AtFlags, CWD};
use rustix::io::Errno;
use tokio::sync::{oneshot, watch};
use tracing::info;

use self::worker::Worker;
use super::{Error, config};
use hardnessd_core::event::{Event, Kind};
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Input, Pipeline};
use hardnessd_core::recording::{About, Entry, Labels, State};

/// The most entries and events that wait: about 4 s of a sensor at 100 frames/s.
const QUEUED: usize = 8192;
/// The most bytes of memory that wait.
const QUEUED_BYTES: usize = 32 << 20;
/// How often a sensor's state is noted while it is at rest. It is also noted after each press, so a
/// clip of a recording and the part after a damaged chunk begin with the next press.
const STATE_EVERY: Duration = Duration::from_secs(5);
/// A state is also noted after this many bytes of entries, so that a flood of entries cannot make
/// the black box much larger than its bound.
const STATE_EVERY_BYTES: usize = 4 << 20;
/// How often the damage is looked at.
const DAMAGE_EVERY: Duration = Duration::from_secs(10);
/// A sensor has a fault if at least [`DAMAGED_FRAMES`] frames, and more than [`DAMAGED_SHARE`] of
/// all its frames, were damaged since the last look.
const DAMAGED_FRAMES: u64 = 5;
const DAMAGED_SHARE: f64 = 0.1;

/// The target of a recording.
#[derive(Debug)]
pub(crate) enum Target {
    /// One file, which the caller has made. The recording ends when the file cannot be written or
    /// when there is no sensor left.
    File {
        path: PathBuf,
        file: File,
        labels: Labels,
        progress: watch::Sender<Progress>,
    },
    /// Files in the directory of the configuration.
    Directory(config::Record),
}

/// The content of one file so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Progress {
    /// The number of whole frames of all sensors.
    pub frames: u64,
    /// The number of these frames that came after their sensor's zero was taken.
    pub tared: u64,
    /// The number of presses that were not aborted, so that they have a verdict.
    pub presses: u64,
    /// The number of final verdicts, and how many of them have the level of the label `level`.
    pub verdicts: u64,
    /// See [`Self::verdicts`].
    pub right: u64,
    /// The level of the last verdict. `None` if it was rejected.
    pub said: Option<u8>,
}

/// So many black boxes of faults are kept, with so many megabytes. A sender that comes and goes would
/// fill the disk.
const MOST_BLACKBOXES: usize = 200;
const MOST_BLACKBOX_MB: u64 = 1000;

/// Checks that this process may write to the directory of the recordings, or make it. A daemon runs on
/// without it.
pub(crate) fn check(settings: &config::Record) -> Result<(), Error> {
    let directory = settings.dir();
    // Missing directories will be made, so check the nearest path that exists.
    let there = directory.ancestors().find(|place| place.exists());
    let there = there.unwrap_or(Path::new("."));
    let found = if there.is_dir() {
        let may = Access::WRITE_OK | Access::EXEC_OK;
        rustix::fs::accessat(CWD, there, may, AtFlags::EACCESS).map_err(std::io::Error::from)
    } else {
        Err(Errno::NOTDIR.into())
    };
    found.map_err(|error| {
        let there = there.display();
        Error::Io(format!(
            "record.dir: cannot write to {there}: {error}: set a directory that can be written to"
        ))
    })
}

/// A job for the thread.
#[derive(Debug)]
enum Job {
    Entry {
        sensor: usize,
        at: Stamp,
        entry: Entry,
    },
    Event(Box<Event>),
    /// Many frames of a sensor were damaged.
    Damage {
        sensor: usize,
    },
    /// A client requests the last minute of a sensor as a file.
    Blackbox {
        sensor: usize,
        reply: oneshot::Sender<Result<PathBuf, String>>,
    },
}

impl Job {
    /// The approximate memory of the job in bytes.
    fn weight(&self) -> usize {
        let beside = match self {
            Self::Entry { entry, .. } => entry.weight(),
            Self::Event(event) => match &**event {
                Event::Frame(frame) => size_of::<Event>() + size_of_val(&*frame.newtons),
                _ => EVENT_BYTES,
            },
            Self::Damage { .. } | Self::Blackbox { .. } => 0,
        };
        size_of::<Self>() + beside
    }
}

/// More memory than a numbered event takes: a context has up to 1 KiB of text.
const EVENT_BYTES: usize = 4 << 10;

/// The queue to the thread.
#[derive(Debug, Clone)]
struct Jobs {
    sender: SyncSender<Job>,
    load: Arc<Load>,
}

/// How full the queue is, and what had no room in it.
#[derive(Debug, Default)]
struct Load {
    /// The bytes of memory that wait.
    bytes: AtomicUsize,
    /// The number of jobs that were dropped.
    dropped: AtomicU64,
}

impl Jobs {
    /// Sends a job. Returns `false` if there was no room for it.
    fn send(&self, job: Job) -> bool {
        let bytes = job.weight();
        let queued = self.load.bytes.fetch_add(bytes, Ordering::Relaxed);
        let sent = match queued.saturating_add(bytes) <= QUEUED_BYTES {
            true => self.sender.try_send(job),
            false => Err(TrySendError::Full(job)),
        };
        if sent.is_err() {
            self.load.bytes.fetch_sub(bytes, Ordering::Relaxed);
        }
        match sent {
            Ok(()) => true,
            // The recording has ended, which is reported elsewhere.
            Err(TrySendError::Disconnected(_)) => true,
            Err(TrySendError::Full(_)) => {
                self.load.dropped.fetch_add(1, Ordering::Relaxed);
                false
            }
        }
    }
}

/// The daemon's handle to the thread.
#[derive(Debug)]
pub(crate) struct Recorder {
    jobs: Jobs,
    labels: Labels,
    frames: bool,
    /// Ready when there is no more to record.
    stop: oneshot::Receiver<()>,
    ended: oneshot::Receiver<Result<(), Error>>,
}

impl Recorder {
    /// Starts the thread.
    pub(crate) fn start(target: Target, mut about: About) -> Result<Self, Error> {
        let frames = match &target {
            Target::File { labels, .. } => {
                about.labels.extend(labels.clone());
                true
            }
            Target::Directory(settings) => settings.continuous,
        };
        let labels = about.labels.clone();
        let (sender, inbox) = sync_channel(QUEUED);
        let load = Arc::new(Load::default());
        let (stopping, stop) = oneshot::channel();
        let worker = Worker::new(target, about, load.clone(), stopping);
        let (end, ended) = oneshot::channel();
        std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || {
                // The daemon may no longer wait for the result.
                let _ = end.send(worker.run(&inbox));
            })
            .map_err(Error::no_thread("the recording"))?;
        Ok(Self {
            jobs: Jobs { sender, load },
            labels,
            frames,
            stop,
            ended,
        })
    }

    /// The recorder for the task of the sensor with this `index`.
    pub(crate) fn of_sensor(&self, index: usize) -> SensorRecorder {
        let active = Active {
            jobs: self.jobs.clone(),
            index,
            labels: self.labels.clone(),
            noted: None,
            was_busy: false,
            bytes: 0,
            left_out: 0,
            looked: None,
            counted: (0, 0),
        };
        SensorRecorder(Some(Box::new(active)))
    }

    /// The recorder for the hub.
    pub(crate) fn of_hub(&self) -> EventRecorder {
        EventRecorder(Some((self.jobs.clone(), self.frames)))
    }

    /// Waits until there is no more to record, or the thread has ended.
    pub(crate) async fn stopped(&mut self) {
        // An error means that the thread has ended.
        let _ = (&mut self.stop).await;
    }

    /// Waits until the file is complete. The caller must have dropped every [`SensorRecorder`] and
    /// [`EventRecorder`], because the thread ends when its queue has no sender left.
    pub(crate) async fn finish(self) -> Result<(), Error> {
        drop(self.jobs);
        // If the thread panicked, the panic has been reported.
        self.ended.await.unwrap_or(Ok(()))
    }
}

/// Records the inputs of one sensor. Without a recorder, it records nothing.
#[derive(Debug, Default)]
pub(crate) struct SensorRecorder(Option<Box<Active>>);

#[derive(Debug)]
struct Active {
    jobs: Jobs,
    index: usize,
    labels: Labels,
    /// The time of the last noted state. `None`: there is none yet, or entries after it were
    /// dropped.
    noted: Option<Duration>,
    /// Whether a press or a tare was under way since that state.
    was_busy: bool,
    /// The bytes of memory that the entries since that state take.
    bytes: usize,
    /// The number of entries that came before the sensor was at rest.
    left_out: u64,
    /// When the damage was looked at last.
    looked: Option<Duration>,
    /// The numbers of whole and of damaged frames up to then.
    counted: (u64, u64),
}

impl SensorRecorder {
    /// Records `input`, which `pipeline` is about to take.
    pub(crate) fn note(&mut self, pipeline: &Pipeline, input: &Input, at: Stamp) {
        if let Some(active) = &mut self.0 {
            active.follow(pipeline, at, Entry::Input(input.clone()));
        }
    }

    /// Records that `pipeline`, which is at rest, begins anew or has another model.
    pub(crate) fn begin_anew(&mut self, pipeline: &Pipeline, at: Stamp) {
        if let Some(active) = &mut self.0 {
            active.noted = None;
            active.begin(pipeline, at);
        }
    }

    /// Requests the last minute as a file. The answer comes when the file is written.
    pub(crate) fn blackbox(&self, reply: oneshot::Sender<Result<PathBuf, String>>) {
        // If there is no room for the job, `reply` is dropped with the job, which the caller sees.
        match &self.0 {
            Some(active) => {
                let sensor = active.index;
                active.jobs.send(Job::Blackbox { sensor, reply });
            }
            None => {
                let none = "nothing is kept: the configuration has no [record]";
                let _ = reply.send(Err(none.to_owned()));
            }
        }
    }
}

impl Active {
    /// Sends `entry`, after a state if one is due. Before the first state, entries are left out: a
    /// replay could not use them.
    fn follow(&mut self, pipeline: &Pipeline, at: Stamp, entry: Entry) {
        self.look_for_damage(pipeline, at);
        self.begin(pipeline, at);
        if self.noted.is_none() {
            self.left_out += 1;
            return;
        }
        self.bytes += entry.weight();
        self.queue(at, entry);
    }

    fn begin(&mut self, pipeline: &Pipeline, at: Stamp) {
        self.was_busy |= !pipeline.is_at_rest();
        let due = |noted| {
            let is_old = at.mono.saturating_sub(noted) >= STATE_EVERY;
            is_old || self.was_busy || self.bytes >= STATE_EVERY_BYTES
        };
        if !self.noted.is_none_or(due) {
            return;
        }
        let Some(state) = State::of(pipeline, &self.labels) else {
            return;
        };
        if self.left_out > 0 {
            let (sensor, entries) = (pipeline.sensor().name(), self.left_out);
            info!(
                sensor,
                entries, "recording begins at rest: what came before is left out"
            );
        }
        (self.noted, self.was_busy) = (Some(at.mono), false);
        (self.bytes, self.left_out) = (0, 0);
        self.queue(at, Entry::State(Box::new(state)));
    }

    fn look_for_damage(&mut self, pipeline: &Pipeline, at: Stamp) {
        let looked = *self.looked.get_or_insert(at.mono);
        if at.mono.saturating_sub(looked) < DAMAGE_EVERY {
            return;
        }
        let counts = pipeline.frame_counts();
        let (whole, damaged) = (counts.0 - self.counted.0, counts.1 - self.counted.1);
        let share = damaged as f64 / (whole + damaged).max(1) as f64;
        if damaged >= DAMAGED_FRAMES && share > DAMAGED_SHARE {
            let sensor = self.index;
            self.jobs.send(Job::Damage { sensor });
        }
        (self.looked, self.counted) = (Some(at.mono), counts);
    }

    fn queue(&mut self, at: Stamp, entry: Entry) {
        let sensor = self.index;
        if !self.jobs.send(Job::Entry { sensor, at, entry }) {
            self.noted = None;
        }
    }
}

/// Records events. Without a recorder, it does nothing.
#[derive(Debug, Default)]
pub(crate) struct EventRecorder(Option<(Jobs, bool)>);

impl EventRecorder {
    /// Records an event that is being published.
    pub(crate) fn event(&self, event: &Event) {
        if let Some((jobs, frames)) = &self.0
            && (*frames || event.kind() != Kind::Frame)
        {
            jobs.send(Job::Event(Box::new(event.clone())));
        }
    }
}

#[cfg(test)]
mod tests;
