//! The running daemon: its main loop, reloads, and its end.
//!
//! At SIGHUP, a thread of its own reads the configuration and the model, and is abandoned after [`PATIENCE`]: a
//! pipe may have no writer and a file system may hang, and a thread that reads from them cannot be ended.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use tokio::signal::unix::Signal;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use super::config::Setup;
use super::log::Log;
use super::record::Recorder;
use super::sensor::{Command, SensorCore};
use super::{Daemon, Error, announce_sensor, hello, now, short, systemd};
use crate::maybe;
use crate::thread::spawn_thread;

/// How long subscribers may take to fetch their last lines. This is short, because the daemon must
/// end within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);

impl Daemon {
    /// Serves until `shutdown` is ready, or there is no more to record.
    pub(super) async fn serve(
        &mut self,
        shutdown: impl Future<Output = ()>,
        setups: &mut Option<mpsc::Receiver<Result<Setup, Refusal>>>,
        log: Option<&Log>,
    ) {
        let mut heartbeat = tokio::time::interval(systemd::heartbeat());
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut shutdown = pin!(shutdown);
        loop {
            tokio::select! {
                () = &mut shutdown => return,
                () = maybe::wait(self.recorder.as_mut().map(Recorder::stopped)) => return,
                _ = heartbeat.tick() => {
                    // This is the sensors' thread, so it works.
                    systemd::alive(self.hub.log().live());
                }
                Some(read) = maybe::wait(setups.as_mut().map(mpsc::Receiver::recv)) => {
                    match read.and_then(|changed| self.may_adopt(changed)) {
                        Ok(changed) => {
                            if let Some(log) = log {
                                log.change(changed.config.log);
                            }
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
            announce_sensor(&self.setup, &self.setup.config.sensors[index]);
            core.pipeline = core.pipeline.restarted(sensor.clone(), hrn);
            core.recorder.begin_anew(&core.pipeline, now());
            anew.push(core);
        }
        self.start_sensors(anew);
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
    pub(super) async fn finish(mut self) -> Result<(), Error> {
        systemd::stopping();
        info!("stopping");
        drop(self.stop((0..self.sensors.len()).collect()).await);
        self.hub.log().close();
        drop(self.listening);
        let farewell = async { while self.publishers.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
            warn!("a subscriber did not fetch its last lines");
        }
        drop(self.clients);
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

/// How long reading the files of a configuration may take. The built-in model takes well under a
/// second.
const PATIENCE: Duration = Duration::from_secs(10);

/// The requests to a running daemon to read its configuration again.
pub struct Reload {
    /// SIGHUP. A request while another one waits is the same one: what is read then has all changes.
    pub requests: Signal,
    /// The path of the configuration.
    pub path: PathBuf,
    /// The model that replaces the configuration's own, if there is one.
    pub model: Option<PathBuf>,
    /// The log, whose format may change.
    pub log: Log,
}

/// The reason a reload was refused, in words: nobody tells reasons apart.
pub(super) type Refusal = String;

impl Reload {
    /// Reads the configuration at each request, in a task of its own. Returns what was read, and the log.
    pub(super) fn start(self) -> (mpsc::Receiver<Result<Setup, Refusal>>, Log) {
        let Self {
            mut requests,
            path,
            model,
            log,
        } = self;
        let (sender, setups) = mpsc::channel(1);
        tokio::spawn(async move {
            while requests.recv().await.is_some() {
                systemd::reloading();
                // The daemon may have ended.
                let _ = sender.send(read(path.clone(), model.clone()).await).await;
            }
        });
        (setups, log)
    }
}

/// Reads the configuration at `path` and its model, or `model` in its place.
async fn read(path: PathBuf, model: Option<PathBuf>) -> Result<Setup, Refusal> {
    let shown = path.display().to_string();
    let reading = spawn_thread("reload", move || Setup::load(&path, model.as_deref()));
    let reading = reading.map_err(|error| format!("{shown}: {error}"))?;
    match tokio::time::timeout(PATIENCE, reading).await {
        Ok(loaded) => loaded
            .expect("a configuration is read without a panic")
            .map_err(|error| error.to_string()),
        Err(_) => Err(format!(
            "{shown}: reading it and its files did not end within {} s",
            PATIENCE.as_secs()
        )),
    }
}
