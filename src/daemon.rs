//! The daemon, which connects sensors to subscribers and runs the core between them.
//!
//! In: a checked [`Setup`], a future that ends when the daemon must end, and requests to read the
//! configuration again. Out: events on the sockets. The sensors' thread runs one task for each
//! sensor, one for the hub, and one for each connection that writes its lines. The clients' thread
//! reads requests and runs HTTP. The tasks share nothing but lines that are ready to be sent. The
//! daemon starts without its sensors and waits for them.

pub(crate) mod accept;
pub(crate) mod baud;
mod client;
mod clients;
pub mod config;
#[cfg(feature = "foxglove")]
pub mod foxglove;
mod http;
mod hub;
pub(crate) mod lines;
pub mod log;
pub mod port;
pub mod publish;
pub mod realtime;
pub mod record;
mod own;
#[cfg_attr(
    not(any(feature = "foxglove", feature = "ros2", feature = "zenoh")),
    allow(dead_code, reason = "no library in this build has a thread of its own")
)]
mod relay;
mod reload;
mod request;
#[cfg(feature = "ros2")]
pub mod ros2;
mod running;
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
use std::sync::Arc;
use std::time::Duration;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tracing::{debug, info, warn};

use self::baud::Load;
use self::clients::Clients;
use self::config::{Publish, Setup};
use self::hub::Hub;
use self::own::Store;
use self::publish::Publishers;
use self::record::{Progress, Recorder, Target};
pub use self::reload::Reload;
use self::running::Running;
use self::sensor::{SensorCore, SensorHandle};
use self::serial::{Source, Sources};
use crate::thread::NoThread;
use hardnessd_core::event::{Hello, ModelCard, PROTOCOL, SensorCard};
use hardnessd_core::exit::{CONFIG, Coded, FAILED, IO, UNAVAILABLE};
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{About, Labels, RecordedSensor};
use hardnessd_core::sensor::Sensor;

/// The most commands that wait for a sensor. When the queue is full, the tasks that send wait.
const QUESTIONS: usize = 16;

/// The reason the daemon cannot start, or has stopped by itself.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The configuration names what the daemon cannot use.
    #[error("{0}")]
    Config(String),
    /// The system or a library refused. A later try may succeed.
    #[error("{0}")]
    Io(String),
    /// A sensor to record is missing at the start.
    #[error("sensor {sensor:?}: cannot record: {reason}")]
    Unavailable {
        /// The sensor's name.
        sensor: String,
        /// The reason its port cannot be opened.
        reason: String,
    },
    /// All sensors to record are lost. What they sent is recorded.
    #[error("sensor {sensor:?} lost: {reason}; the recording ends there")]
    Lost {
        /// The name of the sensor that was lost last.
        sensor: String,
        /// The reason its port was lost.
        reason: String,
    },
    /// A task ended by itself, which is a fault of this program.
    #[error("{0} stopped by itself")]
    Stopped(&'static str),
}

impl Error {
    /// The error that the system has no thread for `what`.
    fn no_thread(what: &str) -> impl FnOnce(std::io::Error) -> Self {
        move |error| Self::Io(format!("cannot start a thread for {what}: {error}"))
    }
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Config(_) => CONFIG,
            Error::Io(_) => IO,
            Error::Unavailable { .. } | Error::Lost { .. } => UNAVAILABLE,
            Error::Stopped(_) => FAILED,
        }
    }
}

/// The sockets of a daemon that records into one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sockets {
    /// No sockets, because one person uses the daemon as a tool.
    None,
    /// The sockets of `[publish.unix]`, on which a robot reports the positions of its arm.
    Configured,
}

/// A daemon whose sockets are bound. Connections wait until the daemon runs.
pub struct Daemon {
    setup: Setup,
    hello: Hello,
    hub: Hub,
    clients: Clients,
    publishers: Publishers,
    /// The target of the recording, if there is one.
    target: Option<Target>,
}

/// The current time of CLOCK_MONOTONIC and of the wall clock. If another process interrupts this one
/// between the two readings, the clocks are read again.
pub(crate) fn now() -> Stamp {
    let mono = || {
        let mono = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        Duration::try_from(mono).expect("CLOCK_MONOTONIC counts from 0 at boot")
    };
    let mut before = mono();
    for _ in 0..MOST_READINGS {
        let wall = jiff::Timestamp::now();
        let after = mono();
        if after.saturating_sub(before) <= READING {
            return Stamp { mono: before, wall };
        }
        before = after;
    }
    Stamp {
        mono: before,
        wall: jiff::Timestamp::now(),
    }
}

/// Reading both clocks takes no longer than this, unless another process interrupts it.
const READING: Duration = Duration::from_micros(100);
/// How often the clocks are read again.
const MOST_READINGS: usize = 3;

impl Daemon {
    /// Binds the sockets. Must be called inside a tokio runtime.
    ///
    /// # Errors
    ///
    /// Fails if the system gives no random numbers, or if a socket cannot be bound: its path or
    /// address is in use, the path holds another file, or the system refuses.
    pub fn bind(setup: Setup) -> Result<Self, Error> {
        let run = run_token().map_err(|error| Error::Io(format!("/dev/urandom: {error}")))?;
        let hello = hello(&setup, run);
        let hub = Hub::new(hello.clone());
        let clients = Clients::start().map_err(Error::no_thread("the clients"))?;
        let publishers = Publishers::bind(&setup.config, &hub, &clients)?;
        Ok(Self {
            clients,
            target: setup.config.record.clone().map(Target::Directory),
            setup,
            hello,
            hub,
            publishers,
        })
    }

    /// A daemon with `sockets` that records into `file`, an empty file at `path`, and reports in
    /// `progress` what the file holds. The daemon ends by itself if a sensor is missing at the
    /// start, or when all sensors are lost.
    ///
    /// # Errors
    ///
    /// Fails if the system gives no random numbers, or a socket cannot be bound.
    pub fn recording(
        mut setup: Setup,
        path: PathBuf,
        file: File,
        labels: Labels,
        progress: watch::Sender<Progress>,
        sockets: Sockets,
    ) -> Result<Self, Error> {
        setup.config.http = None;
        setup.config.publish = match sockets {
            Sockets::None => Publish::none(),
            Sockets::Configured => Publish {
                unix: setup.config.publish.unix,
                ..Publish::none()
            },
        };
        setup.config.record = None;
        Ok(Self {
            target: Some(Target::File {
                path,
                file,
                labels,
                progress,
            }),
            ..Self::bind(setup)?
        })
    }

    /// The address of the live page, if there is one.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.publishers.http_address()
    }

    /// Serves until `shutdown` is ready. Then presses are aborted, and subscribers get their last
    /// lines.
    ///
    /// # Errors
    ///
    /// Fails if a task ends by itself, which is a fault of this program, or if the recording fails.
    pub async fn run(
        self,
        shutdown: impl Future<Output = ()>,
        mut reload: Option<Reload>,
    ) -> Result<(), Error> {
        let mut running = self.start()?;
        // `serve` only borrows `reload`, because `reload` owns the log, which `finish` still uses.
        let ended = running.serve(shutdown, &mut reload).await;
        let recorded = running.finish().await;
        ended.and(recorded)
    }

    /// Starts a task for each sensor and each listener, and notifies systemd that the daemon is
    /// ready.
    fn start(self) -> Result<Running, Error> {
        let Self {
            setup,
            hello,
            hub,
            clients,
            publishers,
            target,
        } = self;
        raise_descriptors();
        realtime::lock_memory();
        let run = hello.run.clone();
        let recorder = target
            .map(|target| Recorder::start(target, about(&setup, &hello)))
            .transpose()?;
        if let Some(recorder) = &recorder {
            hub.log().record(recorder.of_hub());
        }
        let store = Store::of_environment();
        let store = store.map_err(|NoThread(error)| Error::no_thread("own presses")(error))?;
        let mut tasks = JoinSet::new();
        let mut sources = Sources::default();
        let started = setup.sensors.iter().enumerate().map(|(index, sensor)| {
            let recorder = recorder.as_ref().map(|recorder| recorder.of_sensor(index));
            let (commands, inbox) = mpsc::channel(QUESTIONS);
            let core = SensorCore {
                pipeline: pipeline_of(&setup, sensor, &store),
                recorder: recorder.unwrap_or_default(),
                unjudged: 0,
                commands: inbox,
            };
            let source = sources.take(&setup.sensors, index);
            start_sensor(core, source, (&hub, &store), &mut tasks);
            SensorHandle {
                name: sensor.name().to_owned(),
                commands,
            }
        });
        let sensors: Arc<[SensorHandle]> = started.collect();
        let (listening, stop) = watch::channel(());
        publishers.announce();
        let publishers = publishers.serve(&sensors, &stop, &clients);
        announce(&setup, &run);
        systemd::ready();
        Ok(Running {
            setup,
            run,
            hub,
            sensors,
            tasks,
            publishers,
            clients,
            store,
            recorder,
            listening,
        })
    }
}

/// Raises the soft limit of file descriptors to the hard limit, because every subscriber takes one.
/// Nothing in this process fails on descriptors above 1,023.
fn raise_descriptors() {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: maximum,
        maximum,
    };
    if current != maximum
        && let Err(error) = setrlimit(Resource::Nofile, raised)
    {
        debug!(%error, "the limit of file descriptors stays as it is");
    }
}

/// The pipeline of a sensor, with its own presses of earlier runs.
fn pipeline_of(setup: &Setup, sensor: &Sensor, store: &Store) -> Pipeline {
    let hrn = setup.hrn_of(sensor.name()).clone();
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::Arrival);
    store.load(&mut pipeline);
    pipeline
}

/// Starts the task of a sensor.
fn start_sensor(
    core: SensorCore,
    source: Source,
    (hub, store): (&Hub, &Store),
    tasks: &mut JoinSet<SensorCore>,
) {
    // Whoever connects before the task runs gets a status too.
    hub.log()
        .report(sensor::state(&core.pipeline, core.unjudged));
    tasks.spawn(sensor::serve(core, source, hub.clone(), store.clone()));
}

fn announce(setup: &Setup, run: &str) {
    info!(
        version = env!("CARGO_PKG_VERSION"),
        robot = setup.config.robot.as_str(),
        run,
        model = short(setup),
        validation = setup.hrn.card().validation.as_str(),
        scheduling = realtime::scheduling(),
        "started"
    );
    (0..setup.sensors.len()).for_each(|index| announce_sensor(setup, index));
}

fn announce_sensor(setup: &Setup, index: usize) {
    let (sensor, checked) = (&setup.config.sensors[index], &setup.sensors[index]);
    let name = sensor.name.as_str();
    info!(sensor = name, port = %sensor.port, "sensor");
    if let Some(excess) = Load::of(sensor, checked.layout()).excess {
        warn!(sensor = name, %excess, "the line cannot carry frame_rate_hz");
    }
    if setup.ignores_references_of(name) {
        warn!(
            sensor = name,
            "references are not used: they make verdicts on each other worse"
        );
    }
}

/// The model's name in events.
fn short(setup: &Setup) -> &str {
    &setup.hrn.sha256()[..12]
}

fn about(setup: &Setup, hello: &Hello) -> About {
    let sensors = setup.sensors.iter();
    let mut labels = Labels::new();
    if setup
        .config
        .sensors
        .iter()
        .any(|one| port::is_simulated(&one.port))
    {
        labels.insert("simulated".to_owned(), "true".to_owned());
    }
    About {
        robot: hello.robot.clone(),
        run: hello.run.clone(),
        boot_id: hello.boot_id.clone(),
        reason: None,
        labels,
        sensors: sensors
            .map(|sensor| RecordedSensor::new(sensor, setup.hrn_of(sensor.name())))
            .collect(),
    }
}

fn hello(setup: &Setup, run: String) -> Hello {
    // Where /proc is hidden, there is no boot ID. The run token still distinguishes starts.
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
            .sensors
            .iter()
            .map(|sensor| SensorCard {
                name: sensor.name().to_owned(),
                rows: sensor.layout().array().rows,
                cols: sensor.layout().array().cols,
                pitch_mm: sensor.calibration().pitch_mm,
            })
            .collect(),
        model: ModelCard {
            sha256: setup.hrn.sha256().to_owned(),
            validation: card.validation.clone(),
            levels: card.levels.clone(),
            name: setup.model_name(),
            needs: setup.model_needs().to_owned(),
            without_effect: setup.without_effect(),
        },
    }
}

/// 64 random bits in hex, so that two starts, even of different robots, are unlikely to share a
/// token.
fn run_token() -> std::io::Result<String> {
    let mut bytes = [0; 8];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(hex::encode(bytes))
}
