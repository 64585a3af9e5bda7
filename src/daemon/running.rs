//! The running daemon: its main loop, reloads, and its end.

use std::pin::{Pin, pin};
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

use super::clients::Clients;
use super::config::Setup;
use super::record::Recorder;
use super::reload::{self, Readers, Refusal, Reload};
use super::sensor::{Command, Sensors};
use super::{Error, alive, hello, hub, short, systemd};

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
    /// The tasks of the sensors.
    pub(super) tasks: JoinSet<()>,
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
                () = record_ended(&mut self.recorder) => return Ok(()),
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
                loaded = finished(&mut loading) => {
                    loading = None;
                    let log = reload.as_ref().map(|reload| &reload.log);
                    match loaded.and_then(|changed| reload::change(&self.setup, changed, log)) {
                        Ok(changed) => self.adopt(changed).await,
                        Err(reason) => error!(%reason, "reload refused, all stays as it was"),
                    }
                    systemd::ready();
                }
            }
        }
    }

    /// Uses `changed` from now on.
    async fn adopt(&mut self, changed: Setup) {
        self.setup = changed;
        self.hub
            .describe(hello(&self.setup, self.run.clone()))
            .await;
        for (sensor, changed) in self.sensors.0.iter().zip(&self.setup.sensors) {
            let changed = Box::new(changed.clone());
            let command = Command::Reload(changed, self.setup.hrn.clone());
            // The main loop notices a sensor whose task has ended.
            let _ = sensor.commands.send(command).await;
        }
        info!(model = short(&self.setup), "reloaded");
    }

    /// Ends the daemon. Presses are aborted, and subscribers and the recording get their last
    /// lines.
    pub(super) async fn finish(mut self) -> Result<(), Error> {
        systemd::stopping();
        info!("stopping");
        for sensor in &self.sensors.0 {
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

/// Waits until there is no more to record. Without a recorder, this waits forever.
async fn record_ended(recorder: &mut Option<Recorder>) {
    match recorder {
        Some(recorder) => recorder.stopped().await,
        None => std::future::pending().await,
    }
}

/// Waits for the configuration that is being read. If none is being read, this waits forever.
async fn finished(loading: &mut Option<Loading>) -> Result<Setup, Refusal> {
    match loading {
        Some(loading) => loading.await,
        None => std::future::pending().await,
    }
}
