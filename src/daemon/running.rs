//! The running daemon: its main loop, reloads, and its end.

use std::pin::{Pin, pin};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use super::clients::Clients;
use super::config::Setup;
use super::record::{Recorder, Target};
use super::reload::{self, Readers, Refusal, Reload};
use super::sensor::{Command, SensorHandle, Sensors};
use super::{Error, about, alive, announce_sensor, hello, hub, short, start_sensor, systemd};
use crate::maybe;
use hardnessd_core::event::Hello;

/// How long subscribers may take to fetch their last lines. This is short, because the daemon must
/// end within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);

/// A running daemon.
pub(super) struct Running {
    pub(super) setup: Setup,
    /// The token of this run.
    pub(super) run: String,
    pub(super) hub: hub::Handle,
    pub(super) sensors: Sensors,
    /// Sends the sensors after a reload that adds or removes some.
    pub(super) changed_sensors: watch::Sender<Arc<[SensorHandle]>>,
    /// The tasks of the sensors. The result of a task is the name of its sensor.
    pub(super) tasks: JoinSet<String>,
    /// The tasks of the publishers.
    pub(super) publishers: JoinSet<()>,
    /// The thread of those tasks.
    pub(super) clients: Clients,
    pub(super) recorder: Option<Recorder>,
    /// Sends orders to the listeners.
    pub(super) orders: watch::Sender<()>,
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
        let readers = Readers::default();
        let mut loading: Option<Loading> = None;
        let mut shutdown = pin!(shutdown);
        loop {
            tokio::select! {
                () = &mut shutdown => return Ok(()),
                Some(_) = self.tasks.join_next() => return Err(Error::Stopped("a sensor")),
                Some(_) = self.publishers.join_next() => return Err(Error::Stopped("a listener")),
                () = maybe::wait(self.recorder.as_mut().map(Recorder::stopped)) => return Ok(()),
                _ = heartbeat.tick() => {
                    if let Some(statuses) = alive(&self.hub, &self.sensors).await {
                        systemd::alive(&statuses);
                    }
                }
                path = reload::requested(reload), if loading.is_none() => {
                    systemd::reloading();
                    // Order the listeners to check that they can still be reached.
                    let _ = self.orders.send(());
                    loading = Some(Box::pin(readers.read(path)));
                }
                loaded = maybe::wait(loading.as_mut()) => {
                    loading = None;
                    let log = reload.as_ref().map(|reload| &reload.log);
                    match loaded.and_then(|changed| reload::change(&self.setup, changed, log)) {
                        Ok(changed) => self.adopt(changed).await?,
                        Err(reason) => error!(%reason, "reload refused, all stays as it was"),
                    }
                    systemd::ready();
                }
            }
        }
    }

    /// Uses `changed` from now on.
    ///
    /// # Errors
    ///
    /// Fails if the task of a sensor has ended by itself.
    async fn adopt(&mut self, changed: Setup) -> Result<(), Error> {
        self.setup = changed;
        let running = self.sensors.current();
        let sensors = &self.setup.sensors;
        let (kept, removed): (Vec<&SensorHandle>, Vec<_>) = running
            .iter()
            .partition(|handle| sensors.iter().any(|sensor| sensor.name() == handle.name));
        let are_others = !removed.is_empty() || kept.len() < sensors.len();
        // The removed sensors end first, because an added one may have the port of one of them.
        self.remove(&removed).await?;
        let hello = hello(&self.setup, self.run.clone());
        if are_others {
            self.record_anew(&hello);
        }
        let recorder = self.recorder.as_ref().filter(|_| are_others);
        let events = recorder.map(Recorder::of_hub);
        self.hub.describe(hello, events).await;
        let mut sensors = Vec::with_capacity(self.setup.sensors.len());
        for (index, sensor) in self.setup.sensors.iter().enumerate() {
            let recorder = recorder.map(|recorder| recorder.of_sensor(index));
            let handle = kept.iter().find(|handle| handle.name == sensor.name());
            let Some(handle) = handle.copied() else {
                let (setup, tasks) = (&self.setup, &mut self.tasks);
                announce_sensor(&setup.config.sensors[index], sensor);
                let recorder = recorder.unwrap_or_default();
                sensors.push(start_sensor(setup, index, recorder, &self.hub, tasks));
                continue;
            };
            let hrn = self.setup.hrn_of(sensor.name()).clone();
            let command = Command::Reload(Box::new(sensor.clone()), hrn, recorder);
            // The main loop notices a sensor whose task has ended.
            let _ = handle.commands.send(command).await;
            sensors.push(handle.clone());
        }
        self.changed_sensors.send_replace(sensors.into());
        info!(model = short(&self.setup), "reloaded");
        Ok(())
    }

    /// Ends the tasks of sensors that the configuration no longer has.
    async fn remove(&mut self, removed: &[&SensorHandle]) -> Result<(), Error> {
        let is_removed = |name: &str| removed.iter().any(|sensor| sensor.name == name);
        let left = self.sensors.current();
        let left = left.iter().filter(|sensor| !is_removed(&sensor.name));
        self.changed_sensors.send_replace(left.cloned().collect());
        for sensor in removed {
            // The task may have ended by itself.
            let _ = sensor.commands.send(Command::Finish).await;
        }
        for _ in removed {
            match self.tasks.join_next().await {
                Some(Ok(name)) if is_removed(&name) => info!(sensor = name, "removed"),
                _ => return Err(Error::Stopped("a sensor")),
            }
        }
        Ok(())
    }

    /// Begins another recording, because a recording has the same sensors from its beginning to its end.
    fn record_anew(&mut self, hello: &Hello) {
        let Some(settings) = &self.setup.config.record else {
            return;
        };
        let target = Target::Directory(settings.clone());
        self.recorder = match Recorder::start(target, about(&self.setup, hello)) {
            Ok(recorder) => Some(recorder),
            Err(reason) => {
                error!(%reason, "the recording ends");
                None
            }
        };
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
        self.hub.close().await;
        drop(self.orders);
        let farewell = async { while self.publishers.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, farewell).await.is_err() {
            warn!("a subscriber did not fetch its last lines");
        }
        drop(self.clients);
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
