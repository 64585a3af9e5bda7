//! The link of a sensor: its state, its measured rate, and the silences that change it.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Clock, Pipeline};
use crate::event::{Event, LinkState, Status};
use crate::frame::Stamp;
use crate::tare::Aim;

/// After a silence of this many periods, the pending bytes are settled: a frame that only waited for
/// the header of the next one is then whole.
const PAUSE_PERIODS: f64 = 0.5;

/// The state of the port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) enum Link {
    /// The port was never opened. The reason is that of the last try.
    Closed { reason: Option<String> },
    /// The port has been open since then, and no frame has come yet.
    Opened { since: Duration },
    /// The last frame came at this time.
    Live { since: Duration },
    /// The port is open, and no first frame came in time.
    Silent,
    /// The port is open, and silent after its last frame.
    Stale,
    /// The port was open and is gone, or it is open again and no frame has come.
    Lost { reason: String },
}

impl Pipeline {
    /// When [`Self::tick`] is next due, on CLOCK_MONOTONIC.
    pub fn deadline(&self) -> Option<Duration> {
        match (self.pause_deadline(), self.stale_deadline()) {
            (Some(pause), Some(stale)) => Some(pause.min(stale)),
            (pause, stale) => pause.or(stale),
        }
    }

    /// The current state of the link and its counters.
    pub fn status(&self, at: Stamp) -> Status {
        let (state, reason) = self.state();
        Status {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: at.wall,
            state,
            reason,
            frames: self.seen.frames,
            frames_damaged: self.seen.frames_damaged,
            bytes_skipped: self.decoder.skipped(),
            frame_rate_hz: self.measured_rate_hz(),
        }
    }

    /// The state and its reason.
    pub(super) fn state(&self) -> (LinkState, Option<String>) {
        let tare = || {
            let met_contact = self.tare.aim() == Some(Aim::First { met_contact: true });
            met_contact.then(|| "tare: contact".to_owned())
        };
        let no_frame_for = |silence: Duration| {
            let ms = (silence.as_nanos() as f64 / 1e5).round() / 10.0;
            Some(format!("no frame for {ms} ms"))
        };
        match &self.seen.link {
            Link::Closed { reason } => (LinkState::Connecting, reason.clone()),
            Link::Opened { .. } => (LinkState::Connecting, None),
            Link::Live { .. } => (LinkState::Live, tare()),
            Link::Silent => {
                let mut reason = no_frame_for(self.sensor.late_after());
                if self.decoder.received() > 0
                    && let Some(reason) = &mut reason
                {
                    reason.push_str(", but bytes come: is the baud rate or the layout wrong?");
                }
                (LinkState::Stale, reason)
            }
            Link::Stale => (LinkState::Stale, no_frame_for(self.sensor.stale_after())),
            Link::Lost { reason } => (LinkState::Lost, Some(reason.clone())),
        }
    }

    /// A status, if the state or its reason have changed since the last one.
    pub(super) fn status_if_changed(&mut self, at: Stamp) -> Vec<Event> {
        let state = self.state();
        if self.seen.told == state {
            return Vec::new();
        }
        self.seen.told = state;
        vec![Event::Status(self.status(at))]
    }

    fn measured_rate_hz(&self) -> Option<f64> {
        let span = self
            .seen
            .recent
            .back()?
            .checked_sub(*self.seen.recent.front()?)?
            .as_secs_f64();
        match self.clock {
            _ if self.seen.recent.len() < 2 => None,
            Clock::FrameRate => Some(self.sensor.description().frame_rate_hz),
            Clock::Arrival => (span > 0.0).then(|| (self.seen.recent.len() - 1) as f64 / span),
        }
    }

    /// When a silence settles the pending bytes.
    pub(super) fn pause_deadline(&self) -> Option<Duration> {
        let last_bytes = self
            .seen
            .last_bytes
            .filter(|_| self.decoder.pending() > 0)?;
        Some(last_bytes.saturating_add(self.sensor.period().mul_f64(PAUSE_PERIODS)))
    }

    /// When a silence makes the link stale.
    pub(super) fn stale_deadline(&self) -> Option<Duration> {
        if self.clock == Clock::FrameRate {
            return None;
        }
        match self.seen.link {
            Link::Opened { since } => Some(since.saturating_add(self.sensor.late_after())),
            Link::Live { since } => Some(since.saturating_add(self.sensor.stale_after())),
            _ => None,
        }
    }
}
