//! Recording: a separate thread writes what the sensors' tasks and the hub send to it.
//!
//! In: the sensors' inputs, and events, through a bounded queue. Out: files. Nothing waits for the
//! thread. A sensor's first entry is its state at rest, from which a replay can begin. When the queue
//! is full, entries are dropped and counted, up to the sensor's next rest. A disk that fails or is full
//! stops the recording, not the daemon. The recording continues when there is room again.

mod worker;

use std::fs::File;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};

use self::worker::Worker;
use super::sensor::Answer;
use super::{Error, config};
use crate::score::Score;
use crate::thread::spawn_thread;
use hardnessd_core::event::Event;
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Input, Pipeline};
use hardnessd_core::recording::{About, Entry, Labels, State};

/// The most bytes of memory that wait.
const QUEUED_BYTES: usize = 32 << 20;
/// How often a sensor's state is noted while it is at rest. It is also noted after each press, so a
/// clip of a recording and the part after a damaged chunk begin with the next press.
const STATE_EVERY: Duration = Duration::from_secs(5);
/// A state is also noted after this many bytes of entries, so that a flood of entries cannot make
/// the black box much larger than its bound.
const STATE_EVERY_BYTES: usize = 4 << 20;

/// The target of a recording.
#[derive(Debug)]
pub(crate) enum Target {
    /// One file, which the caller has made, and which is empty. `progress` gets what it holds so far, until
    /// the file is complete or cannot be written.
    File {
        path: PathBuf,
        file: File,
        labels: Labels,
        progress: watch::Sender<Progress>,
    },
    /// Files in the directory of the configuration.
    Directory(config::Record),
}

/// A recording that has no sensor to record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Gone {
    /// A sensor was missing at the start: its name, and why its port cannot be opened.
    Unavailable(String, String),
    /// All sensors are lost: the name of the last one, and why its port was lost.
    Lost(String, String),
}

/// The content of one file so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Progress {
    /// The number of whole frames of all sensors.
    pub frames: u64,
    /// The number of these frames that came after their sensor's zero was taken.
    pub tared: u64,
    /// The number of presses that were not aborted, so that they have a verdict.
    pub presses: u64,
    /// The number of presses that were under way when their sensor was lost.
    pub lost: u64,
    /// The number of sensors that are missing now.
    pub missing: usize,
    /// Why there was no sensor to record, once that was so.
    pub gone: Option<Gone>,
    /// The final verdicts beside the level of the label `level`.
    pub(crate) score: Score,
    /// The level of the last verdict. `None` if it was rejected.
    pub said: Option<u8>,
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
    /// A client requests the last minute of a sensor as a file.
    Blackbox {
        sensor: usize,
        reply: Answer,
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
            Self::Blackbox { .. } => 0,
        };
        size_of::<Self>() + beside
    }
}

/// More memory than a numbered event takes: a context has up to 1 KiB of text.
const EVENT_BYTES: usize = 4 << 10;

/// A job, and a permit for each byte of its memory. The room is free again when the permit is dropped.
type Queued = (Job, OwnedSemaphorePermit);

/// The queue to the thread.
#[derive(Debug, Clone)]
pub(crate) struct Jobs {
    sender: Sender<Queued>,
    /// A permit for each byte of memory that is left.
    room: Arc<Semaphore>,
    /// The number of jobs that had no room.
    dropped: Arc<AtomicU64>,
}

impl Jobs {
    fn new(sender: Sender<Queued>, bytes: usize) -> Self {
        Self {
            sender,
            room: Arc::new(Semaphore::new(bytes)),
            dropped: Arc::default(),
        }
    }

    /// Sends a job. Returns `false` if there was no room for it.
    fn send(&self, job: Job) -> bool {
        let bytes = u32::try_from(job.weight()).unwrap_or(u32::MAX);
        let Ok(taken) = self.room.clone().try_acquire_many_owned(bytes) else {
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return false;
        };
        // The recording may have ended, which is reported elsewhere.
        let _ = self.sender.send((job, taken));
        true
    }

    /// Records an event that is being published.
    pub(crate) fn event(&self, event: &Event) {
        self.send(Job::Event(Box::new(event.clone())));
    }
}

/// The daemon's handle to the thread.
#[derive(Debug)]
pub(crate) struct Recorder {
    /// What the hub passes events to.
    pub(crate) jobs: Jobs,
    labels: Labels,
    ended: oneshot::Receiver<Result<(), Error>>,
}

impl Recorder {
    /// Starts the thread.
    pub(crate) fn start(target: Target, mut about: About) -> Result<Self, Error> {
        if let Target::File { labels, .. } = &target {
            about.labels.extend(labels.clone());
        }
        let labels = about.labels.clone();
        let (sender, inbox) = channel();
        let jobs = Jobs::new(sender, QUEUED_BYTES);
        let worker = Worker::new(target, about, jobs.dropped.clone());
        let ended = spawn_thread("recorder", move || worker.run(&inbox))?;
        Ok(Self {
            jobs,
            labels,
            ended,
        })
    }

    /// The recorder for the task of the sensor with this `index`.
    pub(crate) fn of_sensor(&self, index: usize) -> SensorRecorder {
        SensorRecorder {
            jobs: self.jobs.clone(),
            index,
            labels: self.labels.clone(),
            noted: None,
            was_busy: false,
            bytes: 0,
        }
    }

    /// Waits until the file is complete. The caller must have dropped every [`SensorRecorder`] and
    /// what the hub has of it, because the thread ends when its queue has no sender left.
    pub(crate) async fn finish(self) -> Result<(), Error> {
        drop(self.jobs);
        // If the thread panicked, the panic has been reported.
        self.ended.await.unwrap_or(Ok(()))
    }
}

/// Records the inputs of one sensor.
#[derive(Debug)]
pub(crate) struct SensorRecorder {
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
}

impl SensorRecorder {
    /// Records `input`, which `pipeline` is about to take.
    pub(crate) fn note(&mut self, pipeline: &Pipeline, input: &Input, at: Stamp) {
        self.begin(pipeline, at);
        // Before the first state, entries are left out: a replay could not use them.
        if self.noted.is_some() {
            let entry = Entry::Input(input.clone());
            self.bytes += entry.weight();
            self.queue(at, entry);
        }
    }

    /// Records that `pipeline`, which is at rest, begins anew or has another model.
    pub(crate) fn begin_anew(&mut self, pipeline: &Pipeline, at: Stamp) {
        self.noted = None;
        self.begin(pipeline, at);
    }

    /// Requests the last minute as a file. The answer comes when the file is written.
    pub(crate) fn blackbox(&self, reply: Answer) {
        let sensor = self.index;
        // If there is no room for the job, `reply` is dropped with the job, which the caller sees.
        self.jobs.send(Job::Blackbox { sensor, reply });
    }

    /// Sends a state if one is due.
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
        (self.noted, self.was_busy, self.bytes) = (Some(at.mono), false, 0);
        self.queue(at, Entry::State(Box::new(state)));
    }

    fn queue(&mut self, at: Stamp, entry: Entry) {
        let sensor = self.index;
        if !self.jobs.send(Job::Entry { sensor, at, entry }) {
            self.noted = None;
        }
    }
}

#[cfg(test)]
mod tests;
