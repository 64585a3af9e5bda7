//! The running daemon: its main loop, reloads, and its end.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use super::clients::Clients;
use super::config::Setup;
use super::hub::Hub;
use super::own::Store;
use super::record::{Recorder, SensorRecorder, Target};
use super::reload::{self, Refusal, Reload};
use super::sensor::{Command, SensorCore, SensorHandle, Sensors};
use super::serial::Sources;
use super::{Error, about, announce_sensor, hello, now, pipeline_of, short, start_sensor, systemd};
use crate::maybe;

/// How long subscribers may take to fetch their last lines. This is short, because the daemon must
/// end within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);

/// A running daemon.
pub(super) struct Running {
    pub(super) setup: Setup,
    /// The token of this run.
    pub(super) run: String,
    pub(super) hub: Hub,
    pub(super) sensors: Sensors,
    /// Sends the sensors after a reload that adds or removes some.
    pub(super) changed_sensors: watch::Sender<Arc<[SensorHandle]>>,
    /// The tasks of the sensors.
    pub(super) tasks: JoinSet<SensorCore>,
    /// The tasks of the publishers.
    pub(super) publishers: JoinSet<()>,
    /// The thread of those tasks.
    pub(super) clients: Clients,
    pub(super) store: Store,
    pub(super) recorder: Option<Recorder>,
    /// The recorders before that one, which may still write.
    pub(super) former: Vec<Recorder>,
    /// The listeners stop when this is dropped.
    pub(super) listening: watch::Sender<()>,
}

/// A configuration that is being read.
type Loading = Pin<Box<dyn Future<Output = Result<Setup, Refusal>>>>;

impl Running {
    /// Serves until `shutdown` is ready, there is no more to record, or a task has ended by itself.
    pub(super) async fn serve(
        &mut self,
        shutdown: impl Future<Output = ()>,
        reload: &mut Option<Reload>,
    ) -> Result<(), Error> {
        let mut heartbeat = tokio::time::interval(systemd::heartbeat());
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut loading: Option<Loading> = None;
        let mut shutdown = pin!(shutdown);
        loop {
            tokio::select! {
                () = &mut shutdown => return Ok(()),
                Some(_) = self.tasks.join_next() => return Err(Error::Stopped("a sensor")),
                Some(_) = self.publishers.join_next() => return Err(Error::Stopped("a listener")),
                () = maybe::wait(self.recorder.as_mut().map(Recorder::stopped)) => return Ok(()),
                _ = heartbeat.tick() => {
                    // This is the sensors' thread, so it works.
                    systemd::alive(self.hub.live());
                }
                path = reload::requested(reload), if loading.is_none() => {
                    systemd::reloading();
                    loading = Some(Box::pin(reload::read(path)));
                }
                loaded = maybe::wait(loading.as_mut()) => {
                    loading = None;
                    let log = reload.as_ref().map(|reload| &reload.log);
                    let changed = loaded.and_then(|changed| {
                        let changed = reload::change(&self.setup, changed)?;
                        let recorder = self.record_anew(&changed)?;
                        reload::change_log(&self.setup, &changed, log);
                        Ok((changed, recorder))
                    });
                    match changed {
                        Ok((changed, recorder)) => self.adopt(changed, recorder).await?,
                        Err(reason) => error!(%reason, "reload refused, all stays as it was"),
                    }
                    systemd::ready();
                }
            }
        }
    }

    /// Uses `changed` from now on, and `recorder` if there is one. Nothing here can fail but a task that
    /// ended by itself.
    ///
    /// # Errors
    ///
    /// Fails if the task of a sensor has ended by itself.
    async fn adopt(&mut self, changed: Setup, recorder: Option<Recorder>) -> Result<(), Error> {
        let former = std::mem::replace(&mut self.setup, changed);
        let running = self.sensors.current();
        let runs_on = |handle: &&SensorHandle| self.setup.is_same(&former, &handle.name);
        let (kept, stopped): (Vec<&SensorHandle>, Vec<_>) = running.iter().partition(runs_on);
        // The others end first, because a sensor that starts may have the port of one of them.
        let mut stopped = self.stop(&stopped).await?;
        self.hub.describe(hello(&self.setup, self.run.clone()));
        if let Some(recorder) = &recorder {
            self.hub.record(recorder.of_hub());
        }
        let mut sensors = Vec::with_capacity(self.setup.sensors.len());
        let mut sources = Sources::default();
        for (index, sensor) in self.setup.sensors.iter().enumerate() {
            let next = recorder.as_ref().map(|recorder| recorder.of_sensor(index));
            if let Some(&handle) = kept.iter().find(|handle| handle.name == sensor.name()) {
                let hrn = self.setup.hrn_of(sensor.name()).clone();
                let model = Command::Model(Box::new(sensor.clone()), hrn);
                for command in [Some(model), next.map(Command::Recorder)]
                    .into_iter()
                    .flatten()
                {
                    // The main loop notices a sensor whose task has ended.
                    let _ = handle.commands.send(command).await;
                }
                sensors.push(handle.clone());
                continue;
            }
            announce_sensor(&self.setup, index);
            let (before, recorder, unjudged) = match stopped.remove(sensor.name()) {
                Some(core) => (Some(core.pipeline), core.recorder, core.unjudged),
                None => (None, SensorRecorder::default(), 0),
            };
            let mut core = SensorCore {
                pipeline: pipeline_of(&self.setup, index, before, &self.store),
                recorder,
                unjudged,
            };
            if let Some(next) = next {
                core.recorder.replace(next);
            }
            core.recorder.begin_anew(&core.pipeline, now());
            let (setup, tasks) = (&self.setup, &mut self.tasks);
            let beside = (&self.hub, &self.store);
            let source = sources.take(&setup.sensors, index);
            sensors.push(start_sensor(setup, index, (core, source), beside, tasks));
        }
        self.changed_sensors.send_replace(sensors.into());
        if let Some(recorder) = recorder {
            // The former recording ends when the sensors have let go of it.
            self.former.extend(self.recorder.replace(recorder));
        }
        info!(model = short(&self.setup), "reloaded");
        Ok(())
    }

    /// Ends the tasks of sensors that do not run on. Returns what is left of them, by name.
    async fn stop(
        &mut self,
        stopped: &[&SensorHandle],
    ) -> Result<BTreeMap<String, SensorCore>, Error> {
        let is_stopped = |name: &str| stopped.iter().any(|sensor| sensor.name == name);
        let left = self.sensors.current();
        let left = left.iter().filter(|sensor| !is_stopped(&sensor.name));
        self.changed_sensors.send_replace(left.cloned().collect());
        for sensor in stopped {
            // The task may have ended by itself.
            let _ = sensor.commands.send(Command::Finish).await;
        }
        let mut ended = BTreeMap::new();
        for _ in stopped {
            match self.tasks.join_next().await {
                Some(Ok(one)) if is_stopped(one.pipeline.sensor().name()) => {
                    let name = one.pipeline.sensor().name().to_owned();
                    info!(sensor = name, "stopped");
                    ended.insert(name, one);
                }
                _ => return Err(Error::Stopped("a sensor")),
            }
        }
        Ok(ended)
    }

    /// Begins another recording if `changed` has other sensors, because a recording has the same sensors
    /// from its beginning to its end.
    fn record_anew(&self, changed: &Setup) -> Result<Option<Recorder>, Refusal> {
        let names = |setup: &Setup| -> BTreeSet<String> {
            let sensors = setup.sensors.iter();
            sensors.map(|sensor| sensor.name().to_owned()).collect()
        };
        let Some(settings) = &changed.config.record else {
            return Ok(None);
        };
        if names(changed) == names(&self.setup) {
            return Ok(None);
        }
        let target = Target::Directory(settings.clone());
        let hello = hello(changed, self.run.clone());
        Ok(Some(Recorder::start(target, about(changed, &hello))?))
    }

    /// Ends the daemon. Presses are aborted, and subscribers and the recording get their last
    /// lines.
    pub(super) async fn finish(mut self) -> Result<(), Error> {
        systemd::stopping();
        info!("stopping");
        for sensor in self.sensors.current().iter() {
            // The task may have ended by itself.
            let _ = sensor.commands.send(Command::Finish).await;
        }
        while self.tasks.join_next().await.is_some() {}
        self.hub.close();
        drop(self.listening);
        let farewell = async { while self.publishers.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
            warn!("a subscriber did not fetch its last lines");
        }
        drop(self.clients);
        let former = async {
            for recorder in self.former {
                // A recording into a directory that fails has been logged.
                let _ = recorder.finish().await;
            }
        };
        if tokio::time::timeout(FAREWELL, former).await.is_err() {
            warn!("the disk did not take the end of a former recording");
        }
        let recorded = match self.recorder {
            // Wait as long as necessary for a recording into one file, because a user asked for it.
            Some(recorder) if self.setup.config.record.is_none() => recorder.finish().await,
            Some(recorder) => tokio::time::timeout(FAREWELL, recorder.finish())
                .await
                .unwrap_or_else(|_| {
                    warn!("the disk did not take the end of the recording");
                    Ok(())
                }),
            None => Ok(()),
        };
        recorded.map_err(Error::Record)
    }
}
