//! The daemon, which connects sensors to subscribers and runs the core between them.
//!
//! In: a checked [`Setup`], a future that ends when the daemon must end, and requests to read the
//! configuration again. Out: events on the sockets. The sensors' thread runs one task for each
//! sensor, one for the hub, and one for each connection that writes its lines. The clients' thread
//! reads requests and runs HTTP. The tasks share nothing but lines that are ready to be sent. The
//! daemon starts without its sensors and waits for them.

pub(crate) mod accept;
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
#[cfg(feature = "zenoh")]
pub mod rmw_zenoh;
#[cfg(feature = "ros2")]
pub mod ros2;
mod sensor;
pub(crate) mod serial;
pub mod socket;
mod systemd;
pub mod tcp;
#[cfg(feature = "zenoh")]
pub mod zenoh;

use std::collections::BTreeMap;
use std::fs::File;
use std::future::Future;
use std::io::Read;
use std::net::SocketAddr;
use std::pin::pin;
use std::time::Duration;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{debug, error, info, warn};

use self::clients::Clients;
use self::config::{Publish, Setup};
use self::hub::Hub;
use self::own::{Store, Written};
use self::publish::Publishers;
use self::record::{Recorder, Target};
use self::reload::Refusal;
pub use self::reload::Reload;
use self::sensor::{Command, SensorCore, SensorHandle, Sensors};
use crate::maybe;
use crate::thread::NoThread;
use hardnessd_core::event::{Hello, ModelCard, PROTOCOL, SensorCard};
use hardnessd_core::exit::{CONFIG, IO};
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{About, Labels, RecordedSensor};
use hardnessd_core::sensor::Sensor;

/// How long subscribers may take to fetch their last lines. This is short, because the daemon must
/// end within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);
/// The most commands that wait for a sensor.
const QUESTIONS: usize = 64;

/// The reason the daemon cannot start, or has stopped by itself, in words. Only the exit code tells reasons apart.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Error {
    message: String,
    code: u8,
}

impl Error {
    /// The configuration names what the daemon cannot use.
    fn config(message: String) -> Self {
        let code = CONFIG;
        Self { message, code }
    }

    /// The system or a library refused. A later try may succeed.
    pub(crate) fn io(message: String) -> Self {
        Self { message, code: IO }
    }

    /// The exit code of a program that ends with it.
    pub fn exit_code(&self) -> u8 {
        self.code
    }
}

impl From<NoThread> for Error {
    fn from(error: NoThread) -> Self {
        Self::io(error.to_string())
    }
}

/// A daemon that has started: its sockets answer, and its ports are being opened.
pub struct Daemon {
    setup: Setup,
    hub: Hub,
    sensors: Sensors,
    /// The tasks of the sensors.
    tasks: JoinSet<SensorCore>,
    publishers: Publishers,
    /// The thread of the clients.
    clients: Clients,
    /// Where own presses are written, if anywhere.
    store: Option<Store>,
    /// When own presses are written.
    stored: Option<Written>,
    recorder: Option<Recorder>,
    /// The listeners stop when this is dropped.
    listening: watch::Sender<()>,
}

/// The current time of CLOCK_MONOTONIC and of the wall clock.
pub(crate) fn now() -> Stamp {
    let mono = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Stamp {
        mono: Duration::try_from(mono).expect("CLOCK_MONOTONIC counts from 0 at boot"),
        wall: jiff::Timestamp::now(),
    }
}

impl Daemon {
    /// Binds the sockets, and starts a task for each sensor and each listener. Call it inside a tokio
    /// runtime, whose thread becomes that of the sensors.
    ///
    /// # Errors
    ///
    /// Fails if the system gives no random numbers or no thread, or if a socket cannot be bound: its path or
    /// address is in use, the path holds another file, or the system refuses.
    pub fn start(setup: Setup) -> Result<Self, Error> {
        let target = setup.config.record.clone().map(Target::Directory);
        Self::start_with(setup, target)
    }

    /// A daemon that records into the file of `target`. Of all publishers it has `[publish.unix]` alone.
    ///
    /// # Errors
    ///
    /// Fails if the system gives no random numbers, or a socket cannot be bound.
    pub(crate) fn recording(mut setup: Setup, target: Target) -> Result<Self, Error> {
        setup.config.publish = Publish {
            unix: setup.config.publish.unix,
            ..Publish::default()
        };
        setup.config.http = None;
        setup.config.record = None;
        Self::start_with(setup, Some(target))
    }

    fn start_with(setup: Setup, target: Option<Target>) -> Result<Self, Error> {
        let run = run_token().map_err(|error| Error::io(format!("/dev/urandom: {error}")))?;
        let hello = hello(&setup, run);
        raise_descriptors();
        realtime::lock_memory();
        let hub = Hub::new(hello.clone());
        let clients = Clients::start().map_err(NoThread)?;
        let (store, stored) = Store::of_environment()?.unzip();
        let names = setup.sensors.iter().map(|sensor| sensor.name().to_owned());
        let handles = names.map(|name| {
            let (commands, inbox) = mpsc::channel(QUESTIONS);
            (SensorHandle { name, commands }, inbox)
        });
        let (handles, inboxes): (Vec<_>, Vec<_>) = handles.unzip();
        let sensors: Sensors = handles.into();
        let (listening, stop) = watch::channel(());
        let publishers = Publishers::start(&setup.config, &hub, &sensors, &clients.runtime, &stop)?;
        let recorder = target.map(|target| Recorder::start(target, about(&setup, &hello)));
        let recorder = recorder.transpose()?;
        if let Some(recorder) = &recorder {
            hub.log().record(recorder.jobs.clone());
        }
        let parts = setup.sensors.iter().zip(inboxes).enumerate();
        let core = |(index, (sensor, commands)): (usize, (&Sensor, _))| {
            let recorder = recorder.as_ref();
            let hrn = setup.hrn_of(sensor.name()).clone();
            let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::Arrival);
            if let Some(store) = &store {
                store.load(&mut pipeline);
            }
            SensorCore {
                pipeline,
                recorder: recorder.map(|recorder| recorder.of_sensor(index)),
                unjudged: 0,
                commands,
            }
        };
        let cores = parts.map(core).collect();
        let mut daemon = Self {
            setup,
            hub,
            sensors,
            tasks: JoinSet::new(),
            publishers,
            clients,
            store,
            stored,
            recorder,
            listening,
        };
        daemon.start_sensors(cores);
        daemon.announce(&hello.run);
        systemd::ready();
        Ok(daemon)
    }

    /// Starts a task for each of these sensors.
    fn start_sensors(&mut self, cores: Vec<SensorCore>) {
        let sensors: Vec<&Sensor> = cores.iter().map(|core| core.pipeline.sensor()).collect();
        let sources = serial::start(&sensors);
        for (core, source) in cores.into_iter().zip(sources) {
            // Whoever connects before the task runs gets a status too.
            self.hub.log().report(core.state());
            let serving = sensor::serve(core, source, self.hub.clone(), self.store.clone());
            self.tasks.spawn(serving);
        }
    }

    fn announce(&self, run: &str) {
        info!(
            version = env!("CARGO_PKG_VERSION"),
            robot = self.setup.config.robot.as_str(),
            run,
            model = short(&self.setup),
            validation = self.setup.hrn.card().validation.as_str(),
            "started"
        );
        for sensor in &self.setup.config.sensors {
            info!(sensor = sensor.name.as_str(), port = %sensor.port, "sensor");
        }
        warn_of(&self.setup);
    }

    /// The address of the live page, if there is one.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.publishers.http
    }

    /// Serves until `shutdown` is ready. Then presses are aborted, and subscribers get their last
    /// lines.
    ///
    /// # Errors
    ///
    /// Fails if the recording fails.
    pub async fn run(
        mut self,
        shutdown: impl Future<Output = ()>,
        mut reload: Option<Reload>,
    ) -> Result<(), Error> {
        self.serve(shutdown, reload.as_mut()).await;
        self.finish().await
    }

    /// Serves until `shutdown` is ready.
    async fn serve(&mut self, shutdown: impl Future<Output = ()>, mut reload: Option<&mut Reload>) {
        let mut heartbeat = tokio::time::interval(systemd::heartbeat());
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut shutdown = pin!(shutdown);
        loop {
            tokio::select! {
                () = &mut shutdown => return,
                _ = heartbeat.tick() => {
                    // This is the sensors' thread, so it works.
                    systemd::alive(self.hub.log().live());
                }
                Some((read, log)) = maybe::wait(reload.as_deref_mut().map(Reload::next)) => {
                    match read.and_then(|changed| self.may_adopt(changed)) {
                        Ok(changed) => {
                            log.change(changed.config.log);
                            self.adopt(changed).await;
                        }
                        Err(reason) => error!(%reason, "reload refused, all stays as it was"),
                    }
                    systemd::ready();
                }
            }
        }
    }

    /// Returns `changed` if all of it can change while the daemon runs.
    fn may_adopt(&self, changed: Setup) -> Result<Setup, Refusal> {
        match self.setup.config.fixed_difference(&changed.config) {
            Some(key) => Err(format!(
                "{key} has changed, which a running daemon cannot take over: restart it"
            )),
            None => Ok(changed),
        }
    }

    /// Uses `changed` from now on: sensors whose tables differ start anew, the others get the model.
    /// Nothing here can fail.
    async fn adopt(&mut self, changed: Setup) {
        let former = std::mem::replace(&mut self.setup, changed);
        // All end first, because a sensor that starts may have the port of another one.
        let stopped = (0..former.sensors.len()).filter(|&at| !self.setup.is_same(&former, at));
        let mut stopped = self.stop(stopped.collect()).await;
        self.hub.log().describe(hello(&self.setup, String::new()));
        let mut anew = Vec::new();
        for (index, sensor) in self.setup.sensors.iter().enumerate() {
            let hrn = self.setup.hrn_of(sensor.name()).clone();
            let Some(mut core) = stopped.remove(sensor.name()) else {
                let model = Command::Model(Box::new(sensor.clone()), hrn);
                let _ = self.sensors[index].commands.send(model).await;
                continue;
            };
            info!(sensor = sensor.name(), "stopped");
            let port = &self.setup.config.sensors[index].port;
            info!(sensor = sensor.name(), %port, "sensor");
            core.pipeline = core.pipeline.restarted(sensor.clone(), hrn);
            core.begin_recording_anew();
            anew.push(core);
        }
        self.start_sensors(anew);
        warn_of(&self.setup);
        info!(model = short(&self.setup), "reloaded");
    }

    /// Ends the tasks of these sensors. Returns what is left of them, by name.
    async fn stop(&mut self, stopped: Vec<usize>) -> BTreeMap<String, SensorCore> {
        let mut ended = BTreeMap::new();
        for &index in &stopped {
            let _ = self.sensors[index].commands.send(Command::Finish).await;
        }
        for _ in stopped {
            let core = self.tasks.join_next().await;
            let core = core
                .expect("a task for each")
                .expect("a panic ends the process");
            ended.insert(core.name().to_owned(), core);
        }
        ended
    }

    /// Ends the daemon. Presses are aborted, and subscribers and the recording get their last
    /// lines.
    async fn finish(mut self) -> Result<(), Error> {
        systemd::stopping();
        info!("stopping");
        drop(self.stop((0..self.sensors.len()).collect()).await);
        self.hub.log().close();
        drop(self.listening);
        let farewell = async { while self.publishers.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
            warn!("a subscriber did not fetch its last lines");
        }
        drop((self.clients, self.store));
        if let Some(stored) = self.stored
            && tokio::time::timeout(FAREWELL, stored).await.is_err()
        {
            warn!("the disk did not take the own presses");
        }
        match self.recorder {
            // Wait as long as necessary for a recording into one file, because a user asked for it.
            Some(recorder) if self.setup.config.record.is_none() => recorder.finish().await,
            Some(recorder) => tokio::time::timeout(FAREWELL, recorder.finish())
                .await
                .unwrap_or_else(|_| {
                    warn!("the disk did not take the end of the recording");
                    Ok(())
                }),
            None => Ok(()),
        }
    }
}

/// Raises the soft limit of file descriptors to the hard limit, because every subscriber takes one.
/// Nothing in this process fails on descriptors above 1,023.
fn raise_descriptors() {
    let limit = getrlimit(Resource::Nofile);
    let current = limit.maximum;
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current, ..limit }) {
        debug!(%error, "the limit of file descriptors stays as it is");
    }
}

fn warn_of(setup: &Setup) {
    for warning in setup.warnings() {
        warn!("{warning}");
    }
}

/// The model's name in events.
fn short(setup: &Setup) -> &str {
    &setup.hrn.sha256()[..12]
}

fn about(setup: &Setup, hello: &Hello) -> About {
    let sensors = setup.sensors.iter();
    let mut labels = Labels::new();
    let mut tables = setup.config.sensors.iter();
    if tables.any(|one| port::is_simulated(&one.port)) {
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
