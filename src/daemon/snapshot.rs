//! The state of the hub and of all sensors at one moment, shared by everyone who asks at that time.
//!
//! However many clients ask, one snapshot is taken at a time, and those who wait share it. So the
//! sensors' thread answers a few questions of its own clients' thread, and not each client's.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::Mutex;
use tokio::time::Instant;

use super::hub::{self, Closed, Line, Survey};
use super::sensor::{Sensors, Vitals};

/// A snapshot is shared for this long.
const SHARED: Duration = Duration::from_millis(100);

/// The state at one moment.
#[derive(Debug)]
pub(crate) struct Snapshot {
    pub(crate) survey: Survey,
    /// The state of every sensor. A sensor whose task has ended is left out.
    pub(crate) vitals: Vec<Vitals>,
    /// Whether every sensor answered.
    pub(crate) is_whole: bool,
    /// The status of every sensor, as a line.
    pub(crate) statuses: Vec<Line>,
    /// The text of `/metrics`, once somebody has asked for it. `None`: there was no room for it.
    pub(crate) metrics: OnceLock<Option<Bytes>>,
    /// The text of `/api/status`, likewise.
    pub(crate) status: OnceLock<Option<Bytes>>,
    begun: Instant,
}

/// Takes snapshots. Clones share them.
#[derive(Debug, Clone)]
pub(crate) struct Snapshots {
    hub: hub::Handle,
    sensors: Sensors,
    latest: Arc<Mutex<Option<Arc<Snapshot>>>>,
}

impl Snapshots {
    pub(crate) fn new(hub: hub::Handle, sensors: Sensors) -> Self {
        Self {
            hub,
            sensors,
            latest: Arc::default(),
        }
    }

    /// A snapshot that was begun after the call.
    pub(crate) async fn current(&self) -> Result<Arc<Snapshot>, Closed> {
        self.since(Instant::now()).await
    }

    /// A snapshot that is at most [`SHARED`] old.
    pub(crate) async fn recent(&self) -> Result<Arc<Snapshot>, Closed> {
        let now = Instant::now();
        self.since(now.checked_sub(SHARED).unwrap_or(now)).await
    }

    async fn since(&self, oldest: Instant) -> Result<Arc<Snapshot>, Closed> {
        let mut latest = self.latest.lock().await;
        if let Some(latest) = &*latest
            && latest.begun > oldest
        {
            return Ok(Arc::clone(latest));
        }
        let begun = Instant::now();
        let survey = self.hub.survey().await?;
        let (vitals, is_whole) = self.sensors.vitals().await;
        let line = |vitals: &Vitals| Line::from(vitals.status.clone()).to_hold();
        let statuses = vitals.iter().map(line);
        let snapshot = Arc::new(Snapshot {
            statuses: statuses.collect(),
            survey,
            vitals,
            is_whole,
            metrics: OnceLock::new(),
            status: OnceLock::new(),
            begun,
        });
        *latest = Some(Arc::clone(&snapshot));
        Ok(snapshot)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::mpsc;

    use super::*;
    use crate::daemon::hub::tests::hello;
    use crate::daemon::record::EventRecorder;
    use crate::daemon::sensor::SensorHandle;

    #[tokio::test(start_paused = true)]
    async fn those_who_wait_together_share_a_snapshot_and_texts_are_shared_for_a_moment() {
        let hub = hub::start(hello(), EventRecorder::default());
        let (commands, mut inbox) = mpsc::channel(16);
        let name = "a".to_owned();
        let (_, sensors) = Sensors::new(vec![SensorHandle { name, commands }]);
        let snapshots = Snapshots::new(hub, sensors);
        let asked = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&asked);
        tokio::spawn(async move {
            while let Some(_unanswered) = inbox.recv().await {
                counted.fetch_add(1, Ordering::Relaxed);
                // Everybody else asks meanwhile.
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        });
        let all: Vec<_> = (0..100)
            .map(|_| {
                let snapshots = snapshots.clone();
                tokio::spawn(async move { snapshots.current().await.map(drop) })
            })
            .collect();
        for one in all {
            one.await.unwrap().unwrap();
        }
        // The first asked alone. The others asked before its snapshot was begun, or share the next.
        assert!(asked.load(Ordering::Relaxed) <= 2);

        let before = asked.load(Ordering::Relaxed);
        for (wait, new) in [(SHARED / 2, 0), (SHARED / 4, 0), (SHARED / 2, 1)] {
            tokio::time::advance(wait).await;
            snapshots.recent().await.unwrap();
            assert_eq!(asked.load(Ordering::Relaxed), before + new, "{wait:?}");
        }
        snapshots.current().await.unwrap();
        assert_eq!(asked.load(Ordering::Relaxed), before + 2);
    }
}
