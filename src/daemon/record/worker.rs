//! The recorder's thread, which decides which file is open, when it ends, and what to do when the
//! disk fails.

use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::{Gone, Job, Progress, Queued, Target};
use crate::daemon::sensor::Done;
use crate::daemon::{Error, config, log};
use hardnessd_core::event::{Event, Phase, PressState};
use hardnessd_core::frame::Stamp;
use hardnessd_core::part;
use hardnessd_core::pipeline::Input;
use hardnessd_core::press::End;
use hardnessd_core::recording::{self, About, Entry, Ring, Writer};
use hardnessd_core::wording::escaped;

/// How often written entries are passed to the system. `kill -9` loses no more than this time.
const FLUSH_EVERY: Duration = Duration::from_millis(500);
/// At least this many bytes are in a chunk, unless [`FLUSH_EVERY`] ends it.
const CHUNK_BYTES: usize = 1 << 20;
/// How often dropped entries are reported.
const REPORT_EVERY: Duration = Duration::from_secs(60);
/// How long the recorder waits before it tries again after the disk failed or was full.
const RETRY_AFTER: Duration = Duration::from_secs(5);
/// Before a paused recording continues, 1 / [`ROOM_SHARE`] more than the floor must be free.
const ROOM_SHARE: u64 = 16;

/// The bytes of a megabyte in the decimal sense, as in the sizes of disks.
const MB: u64 = 1_000_000;

/// The state of the thread.
pub(super) struct Worker {
    target: Target,
    about: About,
    /// The number of entries that had no room in the queue and are not reported yet.
    dropped: Arc<AtomicU64>,
    /// When dropped entries are reported next.
    report_at: Instant,
    sensors: Vec<Watched>,
    open: Option<Open>,
    /// Until when the recording is paused, because the disk failed or is full.
    paused: Option<Instant>,
    progress: Progress,
}

/// The thread's state of one sensor.
#[derive(Default)]
struct Watched {
    ring: Ring,
    /// Whether the file has a state of the sensor, from which its entries can be played.
    is_begun: bool,
    /// Whether the sensor's port is open. `None`: this is not known yet.
    is_open: Option<bool>,
}

impl Worker {
    pub(super) fn new(target: Target, about: About, dropped: Arc<AtomicU64>) -> Self {
        Self {
            sensors: about.sensors.iter().map(|_| Watched::default()).collect(),
            target,
            about,
            dropped,
            report_at: Instant::now(),
            open: None,
            paused: None,
            progress: Progress::default(),
        }
    }

    /// Writes until the queue has no sender left. A failed write is an error only of a recording
    /// into one file, which ends there. In a directory, it is a line in the log.
    pub(super) fn run(mut self, jobs: &Receiver<Queued>) -> Result<(), Error> {
        if let Target::File { path, file, .. } = &self.target {
            let file = file.try_clone().map_err(recording::Error::from);
            let opened = file.and_then(|file| Open::new(path.clone(), file, &self.about));
            self.open = Some(opened.map_err(|error| cannot_write(path, &error))?);
        }
        let mut flush = Instant::now();
        // The bytes that were taken since the last look at the disk.
        let mut unchecked = 0;
        loop {
            let left = flush.saturating_duration_since(Instant::now());
            match jobs.recv_timeout(left) {
                Ok((job, room)) => {
                    unchecked += room.num_permits();
                    drop(room);
                    let done = self.take(job);
                    if let Target::File { progress, .. } = &self.target {
                        progress.send_replace(self.progress.clone());
                    }
                    self.settle(done)?;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return self.end(),
            }
            // Much may come in that time. So the free room is checked before each chunk.
            if Instant::now() >= flush || unchecked >= CHUNK_BYTES {
                unchecked = 0;
                let done = self.look_after();
                self.settle(done)?;
                flush = Instant::now() + FLUSH_EVERY;
            }
        }
    }

    /// Handles a failed write. It ends a recording into one file. In a directory, another file may work.
    fn settle(&mut self, done: Result<(), recording::Error>) -> Result<(), Error> {
        match (done, &self.target) {
            (Ok(()), _) => Ok(()),
            (Err(error), Target::File { path, .. }) => Err(cannot_write(path, &error)),
            (Err(error), Target::Directory(_)) => {
                self.open = None;
                self.pause(&error);
                Ok(())
            }
        }
    }

    /// Pauses the recording, and logs the reason once.
    fn pause(&mut self, reason: &recording::Error) {
        if self.paused.is_none() {
            warn!(%reason, "recording stopped; it is tried again");
        }
        self.paused = Some(Instant::now() + RETRY_AFTER);
    }

    fn end(mut self) -> Result<(), Error> {
        self.report_dropped();
        let Some(Open {
            path, file, writer, ..
        }) = self.open.take()
        else {
            return Ok(());
        };
        let mut finished = writer.finish().map(drop);
        if self.directory().is_none() {
            finished = finished.and_then(|()| Ok(file.sync_all()?));
            // If a sensor was missing at the start, the file is not kept, so do not report it.
            if !matches!(self.progress.gone, Some(Gone::Unavailable(..))) {
                info!(
                    path = %escaped(&path.display().to_string()),
                    frames = self.progress.frames,
                    presses = self.progress.presses,
                    "recorded"
                );
            }
        }
        self.settle(finished)
    }

    fn take(&mut self, job: Job) -> Result<(), recording::Error> {
        match job {
            Job::Entry { sensor, at, entry } => self.entry(sensor, at, entry),
            Job::Event(event) => self.event(&event),
            Job::Blackbox { sensor, reply } => {
                let written = self.blackbox(sensor).map(|path| Done {
                    blackbox: Some(path),
                    ..Done::default()
                });
                // The client may have gone.
                let _ = reply.send(written.map_err(|error| format!("blackbox: {error}")));
                Ok(())
            }
        }
    }

    fn entry(&mut self, sensor: usize, at: Stamp, entry: Entry) -> Result<(), recording::Error> {
        let watched = &mut self.sensors[sensor];
        let name = || self.about.sensors[sensor].name().to_owned();
        match &entry {
            Entry::State(_) => watched.is_begun = true,
            Entry::Input(Input::Opened) => watched.is_open = Some(true),
            Entry::Input(Input::Lost(reason)) => {
                watched.is_open = Some(false);
                let (sensor, reason) = (name(), reason.clone());
                if self.sensors.iter().all(|one| one.is_open == Some(false)) {
                    let gone = &mut self.progress.gone;
                    gone.get_or_insert(Gone::Lost(sensor, reason));
                }
            }
            Entry::Input(Input::Unavailable(reason)) if watched.is_open.is_none() => {
                watched.is_open = Some(false);
                let (sensor, reason) = (name(), reason.clone());
                let gone = &mut self.progress.gone;
                gone.get_or_insert(Gone::Unavailable(sensor, reason));
            }
            Entry::Input(_) => {}
        }
        let missing = self.sensors.iter().filter(|one| one.is_open == Some(false));
        self.progress.missing = missing.count();
        if let Entry::State(state) = &entry {
            self.about.sensors[sensor].clone_from(&state.sensor);
        }
        let written = match &mut self.open {
            Some(open) if self.sensors[sensor].is_begun => open.writer.entry(sensor, at, &entry),
            _ => Ok(()),
        };
        if self.directory().is_some() {
            // Also after a failed write, so that the next file can have the entry.
            self.sensors[sensor].ring.push(at, entry);
        }
        written
    }

    fn event(&mut self, event: &Event) -> Result<(), recording::Error> {
        match event {
            Event::Frame(frame) => {
                self.progress.frames += 1;
                self.progress.tared += u64::from(frame.tared);
            }
            Event::Press(press) if press.state == PressState::End => self.progress.presses += 1,
            Event::Press(press) if press.reason == End::Lost.reason() => self.progress.lost += 1,
            Event::Hardness(verdict) if verdict.phase == Phase::Final => {
                let truth = match &self.target {
                    Target::File { labels, .. } => labels.get("level").and_then(|l| l.parse().ok()),
                    Target::Directory(_) => None,
                };
                self.progress
                    .score
                    .take(verdict.level.map(u64::from), truth);
                self.progress.said = verdict.level;
            }
            _ => {}
        }
        match &mut self.open {
            Some(open) => open.writer.event(event),
            None => Ok(()),
        }
    }

    fn directory(&self) -> Option<&config::Record> {
        match &self.target {
            Target::File { .. } => None,
            Target::Directory(settings) => Some(settings),
        }
    }

    /// Writes the last minute of a sensor to a file of its own.
    fn blackbox(&self, sensor: usize) -> Result<PathBuf, String> {
        let Some(settings) = self.directory() else {
            let none = "`hardnessd record` keeps none: ask a daemon that has [record]";
            return Err(none.to_owned());
        };
        let ring = &self.sensors[sensor].ring;
        if ring.is_waiting() {
            let long =
                "the press under way takes more memory than is kept: ask again after its release";
            return Err(long.to_owned());
        }
        let name = self.about.sensors[sensor].name();
        let about = About {
            reason: Some("asked for".to_owned()),
            sensors: vec![self.about.sensors[sensor].clone()],
            ..self.about.clone()
        };
        let written = || -> Result<PathBuf, recording::Error> {
            let directory = settings.dir();
            has_room(&directory, settings.keep_free_mb * MB)?;
            let entries = ring.all().map(|entry| (0, entry));
            let open = Open::filled(&directory, &format!("blackbox-{name}"), &about, entries)?;
            let path = open.path.clone();
            // A full disk keeps no half file.
            open.finish()
                .inspect_err(|_| drop(fs::remove_file(&path)))?;
            // The client may run in another directory.
            Ok(std::path::absolute(&path).unwrap_or(path))
        };
        let path = written().map_err(|error| error.to_string())?;
        log::limited(
            name,
            || info!(sensor = name, path = %path.display(), "black box"),
        );
        Ok(path)
    }

    /// Says how many entries had no room, if there are any.
    fn report_dropped(&mut self) {
        let count = self.dropped.swap(0, Ordering::Relaxed);
        if count > 0 {
            warn!(count, "no room in the recorder's queue: entries dropped");
            self.report_at = Instant::now() + REPORT_EVERY;
        }
    }

    /// Does the work that is due every [`FLUSH_EVERY`].
    fn look_after(&mut self) -> Result<(), recording::Error> {
        if Instant::now() >= self.report_at {
            self.report_dropped();
        }
        if let Some(open) = &mut self.open {
            open.writer.flush()?;
        }
        if let Some(settings) = self.directory().cloned() {
            self.look_after_directory(&settings);
        }
        Ok(())
    }

    /// Ends the file if it is full or old, or if too little room is left, and begins the next file.
    fn look_after_directory(&mut self, settings: &config::Record) {
        let directory = settings.dir();
        let floor = settings.keep_free_mb * MB;
        let must_end =
            |open: &mut Open| open.is_over(settings) || has_room(&directory, floor).is_err();
        if let Some(Err(error)) = self.open.take_if(must_end).map(Open::finish) {
            return self.pause(&error);
        }
        if self.open.is_some() || self.paused.is_some_and(|until| Instant::now() < until) {
            return;
        }
        // After a pause, a little more room is required, so that the recording does not begin and
        // end again and again.
        let floor = match self.paused {
            Some(_) => floor + floor / ROOM_SHARE,
            None => floor,
        };
        let begun = has_room(&directory, floor)
            .map_err(recording::Error::from)
            .and_then(|()| self.next_file(&directory));
        match begun {
            Ok(open) => {
                info!(path = %open.path.display(), "recording");
                self.open = Some(open);
                self.paused = None;
            }
            Err(error) => self.pause(&error),
        }
    }

    /// Begins a file with every sensor's last state at rest and the entries since.
    fn next_file(&mut self, directory: &Path) -> Result<Open, recording::Error> {
        let sensors = self.sensors.iter().enumerate();
        let entries = sensors
            .flat_map(|(index, sensor)| sensor.ring.latest().map(move |entry| (index, entry)));
        let open = Open::filled(directory, "hardnessd", &self.about, entries)?;
        for (sensor, about) in self.sensors.iter_mut().zip(&self.about.sensors) {
            sensor.is_begun = sensor.ring.latest().next().is_some();
            if sensor.ring.is_waiting() {
                info!(
                    sensor = about.name(),
                    "recording begins at its next rest: its press is too long to repeat"
                );
            }
        }
        Ok(open)
    }
}

fn cannot_write(path: &Path, error: &recording::Error) -> Error {
    Error::io(format!("{}: {error}", path.display()))
}

/// A file that is being written.
struct Open {
    path: PathBuf,
    file: Arc<File>,
    writer: Writer<BufWriter<Arc<File>>>,
    since: Instant,
}

impl Open {
    fn new(path: PathBuf, file: File, about: &About) -> Result<Self, recording::Error> {
        let file = Arc::new(file);
        let writer = Writer::new(BufWriter::new(file.clone()), about)?;
        Ok(Self {
            path,
            file,
            writer,
            since: Instant::now(),
        })
    }

    /// Makes a new file in `directory` that holds these entries, each after the index of its sensor. Its name has
    /// `what` and the time. If this fails, no file is left, because the disk may be full.
    fn filled<'a>(
        directory: &Path,
        what: &str,
        about: &About,
        entries: impl Iterator<Item = (usize, &'a (Stamp, Entry))>,
    ) -> Result<Self, recording::Error> {
        let now = jiff::Timestamp::now().strftime("%Y%m%dT%H%M%S%.3fZ");
        let path = directory.join(format!("{what}-{now}.mcap"));
        let file = File::create_new(&path).map_err(|error| named(&path, &error))?;
        let fill = || {
            let mut open = Self::new(path.clone(), file, about)?;
            for (sensor, (at, entry)) in entries {
                open.writer.entry(sensor, *at, entry)?;
            }
            open.writer.flush()?;
            Ok(open)
        };
        fill().inspect_err(|_| {
            // A file that cannot be removed stays.
            let _ = fs::remove_file(&path);
        })
    }

    /// Whether the next file is due: this one is full or old, or somebody has deleted or moved it.
    fn is_over(&self, settings: &config::Record) -> bool {
        let bytes = self.file.metadata().map_or(0, |file| file.len());
        bytes >= settings.rotate_mb * MB
            || self.since.elapsed() >= Duration::from_secs(settings.rotate_s)
            || part::is_at(&self.path, &self.file).is_ok_and(|is_there| !is_there)
    }

    fn finish(self) -> Result<(), recording::Error> {
        self.writer.finish()?;
        Ok(())
    }
}

/// Makes `directory` if it is missing. Fails if fewer than `floor` bytes are free on its disk.
fn has_room(directory: &Path, floor: u64) -> io::Result<()> {
    fs::create_dir_all(directory).map_err(|error| named(directory, &error))?;
    let disk = rustix::fs::statvfs(directory).map_err(|error| named(directory, &error.into()))?;
    let free = disk.f_bavail.saturating_mul(disk.f_frsize);
    if free < floor {
        let message = format!(
            "{}: found {} MB free, expected at least {} (record.keep_free_mb)",
            directory.display(),
            free / MB,
            floor / MB
        );
        return Err(io::Error::new(ErrorKind::StorageFull, message));
    }
    Ok(())
}

fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}
