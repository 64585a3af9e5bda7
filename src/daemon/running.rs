//! The running daemon: its main loop, reloads, and its end.

use std::collections::BTreeMap;
use std::pin::pin;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use super::config::Setup;
use super::log::Log;
use super::record::Recorder;
use super::reload::Refusal;
use super::sensor::{Command, SensorCore};
use super::{Daemon, Error, announce_sensor, hello, now, short, systemd};
use crate::maybe;

/// How long subscribers may take to fetch their last lines. This is short, because the daemon must
/// end within 1 s.
const FAREWELL: Duration = Duration::from_millis(300);

impl Daemon {
    /// Serves until `shutdown` is ready, there is no more to record, or a task has ended by itself.
    pub(super) async fn serve(
        &mut self,
        shutdown: impl Future<Output = ()>,
        setups: &mut Option<mpsc::Receiver<Result<Setup, Refusal>>>,
        log: Option<&Log>,
    ) -> Result<(), Error> {
        let mut heartbeat = tokio::time::interval(systemd::heartbeat());
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut shutdown = pin!(shutdown);
        loop {
            tokio::select! {
                () = &mut shutdown => return Ok(()),
                Some(_) = self.tasks.join_next() => return Err(Error::Stopped("a sensor")),
                Some(_) = self.publishers.tasks.join_next() => return Err(Error::Stopped("a listener")),
                () = maybe::wait(self.recorder.as_mut().map(Recorder::stopped)) => return Ok(()),
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
                            self.adopt(changed).await?;
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
    /// Nothing here can fail but a task that ended by itself.
    ///
    /// # Errors
    ///
    /// Fails if the task of a sensor has ended by itself.
    async fn adopt(&mut self, changed: Setup) -> Result<(), Error> {
        let former = std::mem::replace(&mut self.setup, changed);
        // All end first, because a sensor that starts may have the port of another one.
        let stopped = (0..former.sensors.len()).filter(|&at| !self.setup.is_same(&former, at));
        let mut stopped = self.stop(stopped.collect()).await?;
        self.hub
            .log()
            .describe(hello(&self.setup, self.run.clone()));
        let mut anew = Vec::new();
        for (index, sensor) in self.setup.sensors.iter().enumerate() {
            let hrn = self.setup.hrn_of(sensor.name()).clone();
            let Some(mut core) = stopped.remove(sensor.name()) else {
                let model = Command::Model(Box::new(sensor.clone()), hrn);
                // The main loop notices a sensor whose task has ended.
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
        Ok(())
    }

    /// Ends the tasks of these sensors. Returns what is left of them, by name.
    async fn stop(&mut self, stopped: Vec<usize>) -> Result<BTreeMap<String, SensorCore>, Error> {
        for &index in &stopped {
            // The task may have ended by itself.
            let _ = self.sensors[index].commands.send(Command::Finish).await;
        }
        let mut ended = BTreeMap::new();
        for _ in &stopped {
            let Some(Ok(core)) = self.tasks.join_next().await else {
                return Err(Error::Stopped("a sensor"));
            };
            ended.insert(core.name().to_owned(), core);
        }
        Ok(ended)
    }

    /// Ends the daemon. Presses are aborted, and subscribers and the recording get their last
    /// lines.
    pub(super) async fn finish(mut self) -> Result<(), Error> {
        systemd::stopping();
        info!("stopping");
        // A task that ended by itself is reported already.
        let _ = self.stop((0..self.sensors.len()).collect()).await;
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
