//! The daemon: sensors at one end, subscribers at the other, the core between.
//!
//! In: a checked [`Setup`], a future that ends when the daemon shall, and requests to read the
//! configuration again. Out: events on the sockets. One thread runs it all, one task a sensor, one
//! for the hub, one a connection; nothing is shared between them but lines ready to be sent.
//! It starts without its hardware and waits for it inside.

mod accept;
mod client;
pub mod config;
mod http;
mod hub;
pub mod log;
pub mod publish;
pub mod record;
#[cfg(any(feature = "ros2", feature = "zenoh"))]
mod relay;
mod request;
#[cfg(feature = "ros2")]
pub mod ros2;
mod sensor;
pub(crate) mod serial;
pub mod socket;
mod systemd;
pub mod tcp;
#[cfg(feature = "zenoh")]
pub mod zenoh;

use std::fs::File;
use std::future::Future;
use std::io::Read;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use self::config::{Config, Publish, Setup};
use self::log::Log;
use self::publish::Publishers;
use self::record::{EventRecorder, Recorder, SensorRecorder, Target};
use self::sensor::{Command, Sensor, Sensors};
use self::serial::Link;
use crate::event::{Hello, ModelCard, PROTOCOL, SensorCard, Status};
use crate::frame::Stamp;
use crate::pipeline::{Clock, Pipeline};
use crate::recording::{About, Labels};

/// How long subscribers may take to fetch their last lines: the daemon must be gone within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);

/// Questions waiting for a sensor; more askers than that wait themselves.
const QUESTIONS: usize = 16;

/// Why the daemon cannot start, or has stopped by itself.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A way out cannot be had.
    #[error(transparent)]
    Publish(#[from] publish::Error),
    /// No random numbers, without which a run cannot be told from another.
    #[error("/dev/urandom: {0}")]
    Random(#[source] std::io::Error),
    /// What was to be recorded is not there, or cannot be written.
    #[error(transparent)]
    Record(#[from] record::Error),
    /// Nobody to write the log to.
    #[error(transparent)]
    Log(#[from] log::Error),
    /// A fault of this program.
    #[error("{0} stopped by itself")]
    Stopped(&'static str),
}

/// How a running daemon is asked to read its configuration again.
pub struct Reload {
    /// One item a request.
    pub requests: mpsc::Receiver<()>,
    /// The file.
    pub path: PathBuf,
    /// The log, whose format may change.
    pub log: Log,
}

/// A daemon whose sockets are bound: whoever connects from now on is served once it runs.
pub struct Daemon {
    setup: Setup,
    hello: Hello,
    publishers: Publishers,
    /// Where a recording goes, if there is one.
    target: Option<Target>,
}

/// The moment, on both clocks.
pub(crate) fn now() -> Stamp {
    let mono = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Stamp {
        mono: Duration::try_from(mono).expect("CLOCK_MONOTONIC counts from 0 at boot"),
        wall: jiff::Timestamp::now(),
    }
}

/// Whether a daemon can write where `config` says, as far as looking tells: what another process
/// holds, or a network refuses, only a try finds out.
///
/// # Errors
///
/// If a socket, the log or a recording cannot be where it shall.
pub fn check(config: &Config) -> Result<(), Error> {
    log::check(config.log)?;
    publish::check(&config.publish.unix)?;
    if let Some(settings) = &config.record {
        record::check(settings)?;
    }
    Ok(())
}

impl Daemon {
    /// Binds the sockets. Needs a runtime to be there.
    ///
    /// # Errors
    ///
    /// If a socket cannot be had: its path or address is in use, is no socket, or the system
    /// refuses.
    pub fn bind(setup: Setup) -> Result<Self, Error> {
        let hello = hello(&setup, run_token().map_err(Error::Random)?);
        let publishers = Publishers::bind(&setup.config)?;
        Ok(Self {
            target: setup.config.record.clone().map(Target::Directory),
            setup,
            hello,
            publishers,
        })
    }

    /// A daemon without sockets that records into `file`, which is at `path` and empty. It ends by
    /// itself when a sensor is not there to begin with, or all are gone.
    ///
    /// # Errors
    ///
    /// If there are no random numbers.
    pub fn recording(
        mut setup: Setup,
        path: PathBuf,
        file: File,
        labels: Labels,
    ) -> Result<Self, Error> {
        setup.config.http = None;
        setup.config.publish = Publish::none();
        setup.config.record = None;
        Ok(Self {
            target: Some(Target::File { path, file, labels }),
            ..Self::bind(setup)?
        })
    }

    /// Where the live page is, if there is one.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.publishers.http_address()
    }

    /// Serves until `shutdown` comes, then finishes the event in hand: presses are aborted,
    /// subscribers get their last lines.
    ///
    /// # Errors
    ///
    /// If a part stops by itself, which is a fault of this program.
    pub async fn run(
        self,
        shutdown: impl Future<Output = ()>,
        mut reload: Option<Reload>,
    ) -> Result<(), Error> {
        let Self {
            mut setup,
            hello,
            publishers,
            target,
        } = self;
        let run = hello.run.clone();
        let mut recorder = target
            .map(|target| Recorder::start(target, about(&setup, &hello)))
            .transpose()?;
        let events = recorder
            .as_ref()
            .map_or(EventRecorder::default(), Recorder::of_hub);
        let hub = hub::start(hello, events);

        let mut tasks = JoinSet::new();
        let mut commands = Vec::new();
        for (index, sensor) in setup.config.sensors.iter().enumerate() {
            let (sender, inbox) = mpsc::channel(QUESTIONS);
            let pipeline = Pipeline::new(setup.pipeline(sensor), Clock::Arrival);
            let link = Link::new(&sensor.port, sensor.baud);
            let recorder = recorder
                .as_ref()
                .map_or(SensorRecorder::default(), |recorder| {
                    recorder.of_sensor(index, setup.recorded(sensor))
                });
            tasks.spawn(sensor::serve(pipeline, link, recorder, hub.clone(), inbox));
            commands.push(Sensor {
                name: sensor.name.clone(),
                commands: sender,
            });
        }
        let sensors = Sensors(commands);

        let (stop, stopped) = watch::channel(());
        publishers.announce();
        let mut publishers = publishers.serve(&hub, &sensors, &stopped);
        announce(&setup, &run);
        systemd::ready();

        let mut heartbeat = tokio::time::interval(systemd::heartbeat());
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut loading: Option<JoinHandle<Result<Setup, config::Error>>> = None;
        let mut shutdown = std::pin::pin!(shutdown);
        let outcome = loop {
            tokio::select! {
                () = &mut shutdown => break Ok(()),
                Some(_) = tasks.join_next() => break Err(Error::Stopped("a sensor")),
                Some(_) = publishers.join_next() => break Err(Error::Stopped("a listener")),
                () = record_ended(&mut recorder) => break Ok(()),
                _ = heartbeat.tick() => {
                    if let Some(statuses) = alive(&hub, &sensors).await {
                        systemd::alive(&statuses);
                    }
                }
                path = requested(&mut reload), if loading.is_none() => {
                    systemd::reloading();
                    // On a thread of its own: a model takes long to load beside a frame.
                    loading = Some(tokio::task::spawn_blocking(move || Setup::load(&path)));
                }
                loaded = finished(&mut loading) => {
                    loading = None;
                    match change(&setup, loaded, reload.as_ref().map(|reload| &reload.log)) {
                        Ok(changed) => {
                            setup = changed;
                            hub.describe(self::hello(&setup, run.clone())).await;
                            for (sensor, settings) in sensors.0.iter().zip(&setup.config.sensors) {
                                let criteria = Box::new(setup.criteria(settings));
                                // A sensor that has ended is noticed above.
                                let _ = sensor.commands.send(Command::Reload(criteria)).await;
                            }
                            info!(model = short(&setup), "reloaded");
                        }
                        Err(reason) => error!(%reason, "reload refused, all stays as it was"),
                    }
                    systemd::ready();
                }
            }
        };

        systemd::stopping();
        info!("stopping");
        for sensor in &sensors.0 {
            // One that has ended needs no telling.
            let _ = sensor.commands.send(Command::Finish).await;
        }
        while tasks.join_next().await.is_some() {}
        hub.close().await;
        drop(stop);
        let farewell = async { while publishers.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
            warn!("a subscriber did not fetch its last lines");
        }
        let recorded = match recorder {
            // A file that was asked for by itself is worth waiting for.
            Some(recorder) if setup.config.record.is_none() => recorder.finish().await,
            Some(recorder) => tokio::time::timeout(FAREWELL, recorder.finish())
                .await
                .unwrap_or_else(|_| {
                    warn!("the disk did not take the end of the recording");
                    Ok(())
                }),
            None => Ok(()),
        };
        outcome.and(recorded.map_err(Error::Record))
    }
}

/// Waits until there is no more to record; for ever, if nothing is.
async fn record_ended(recorder: &mut Option<Recorder>) {
    match recorder {
        Some(recorder) => recorder.stopped().await,
        None => std::future::pending().await,
    }
}

/// Whether the pipelines turn: every sensor's task and the hub answer. What feeds the watchdog.
async fn alive(hub: &hub::Handle, sensors: &Sensors) -> Option<Vec<Status>> {
    let statuses = sensors.statuses().await;
    let all = statuses.len() == sensors.0.len();
    (all && hub.finals().await.is_ok()).then_some(statuses)
}

/// Why a reload was refused.
#[derive(Debug, thiserror::Error)]
enum Refusal {
    #[error(transparent)]
    Config(#[from] config::Error),
    #[error("{key}: found another value, expected the one it started with: restart to change it")]
    Fixed { key: String },
    #[error(transparent)]
    Log(#[from] log::Error),
    #[error("reading it failed: {0}")]
    Task(#[from] tokio::task::JoinError),
}

/// The next request to reload; for ever none, if none can come.
async fn requested(reload: &mut Option<Reload>) -> PathBuf {
    if let Some(reload) = reload
        && reload.requests.recv().await.is_some()
    {
        return reload.path.clone();
    }
    std::future::pending().await
}

type Loaded = Result<Result<Setup, config::Error>, tokio::task::JoinError>;

async fn finished(loading: &mut Option<JoinHandle<Result<Setup, config::Error>>>) -> Loaded {
    match loading {
        Some(loading) => loading.await,
        None => std::future::pending().await,
    }
}

/// All or nothing: the new setup if every part of it can be had without a restart.
fn change(setup: &Setup, loaded: Loaded, log: Option<&Log>) -> Result<Setup, Refusal> {
    let changed = loaded??;
    if let Some(key) = setup.config.fixed_difference(&changed.config) {
        return Err(Refusal::Fixed { key });
    }
    if let Some(log) = log
        && changed.config.log != setup.config.log
    {
        log.change(changed.config.log)?;
    }
    Ok(changed)
}

fn announce(setup: &Setup, run: &str) {
    info!(
        version = env!("CARGO_PKG_VERSION"),
        robot = setup.config.robot.as_str(),
        run,
        model = short(setup),
        validation = setup.hrn.card().validation.as_str(),
        "started"
    );
    for sensor in &setup.config.sensors {
        info!(sensor = sensor.name.as_str(), port = %sensor.port.display(), "sensor");
    }
}

/// The model as events name it.
fn short(setup: &Setup) -> &str {
    &setup.hrn.sha256()[..12]
}

fn about(setup: &Setup, hello: &Hello) -> About {
    let sensors = setup.config.sensors.iter();
    About {
        robot: hello.robot.clone(),
        run: hello.run.clone(),
        boot_id: hello.boot_id.clone(),
        reason: None,
        labels: Labels::new(),
        sensors: sensors.map(|sensor| setup.recorded(sensor)).collect(),
    }
}

fn hello(setup: &Setup, run: String) -> Hello {
    // Where /proc is hidden there is no boot id; the run token still tells starts apart.
    let boot_id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let card = setup.hrn.card();
    Hello {
        protocol: PROTOCOL,
        server: "hardnessd",
        version: env!("CARGO_PKG_VERSION"),
        robot: setup.config.robot.clone(),
        run,
        boot_id: boot_id.trim_end().to_owned(),
        seq: 0,
        sensors: setup
            .pipelines()
            .map(|settings| SensorCard {
                rows: settings.layout.array().rows,
                cols: settings.layout.array().cols,
                pitch_mm: settings.criteria.calibration.pitch_mm,
                name: settings.sensor,
            })
            .collect(),
        model: ModelCard {
            sha256: setup.hrn.sha256().to_owned(),
            validation: card.validation.clone(),
            levels: card.levels.clone(),
        },
    }
}

/// 64 random bits in hex: no two starts of all robots are likely to share one.
fn run_token() -> std::io::Result<String> {
    let mut bytes = [0; 8];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(format!("{:016x}", u64::from_be_bytes(bytes)))
}
