//! The link of a sensor: its state, its measured rate, and the silences that change it.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Clock, Pipeline};
use crate::event::{Event, LinkState, Status};
use crate::frame::Stamp;
use crate::sensor::{LATE_PERIODS, Sensor};
use crate::tare::Aim;

/// After a silence of this many periods, the pending bytes are settled: a frame that only waited for
/// the header of the next one is then whole.
const PAUSE_PERIODS: f64 = 0.5;

/// After so many silences of about the same length, the sensor is known to send more slowly than expected.
const STEADY_SILENCES: usize = 3;
/// The longest of them is no longer than this many times the shortest.
const STEADY_FACTOR: f64 = 1.5;
/// They are at least this many periods long.
const SLOW_FACTOR: f64 = 1.5;

/// A longer silence is no period of any sensor.
const LONGEST_PERIOD: Duration = Duration::from_secs(3600);

/// The number of frames over which the frame rate is measured.
pub(super) const RATE_FRAMES: usize = 32;

/// The link of a sensor: its port, and when bytes and frames came over it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Link {
    port: Port,
    /// Whether the port was lost, and no frame has come since.
    was_lost: bool,
    /// The arrival times of the latest frames.
    recent: VecDeque<Duration>,
    /// The latest silences that were longer than the sensor's stale time, one after the other. Frames
    /// ended them.
    silences: VecDeque<Duration>,
    /// When the last bytes came that are not settled.
    pub(super) last_bytes: Option<Duration>,
    pub(super) last_frame: Option<Stamp>,
    /// State and reason of the last published status.
    published: (LinkState, Option<String>),
}

/// The state of the port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Port {
    /// The port is not open. The reason is that of the last try, or of the loss.
    Closed { reason: Option<String> },
    /// The port has been open since then, and no frame has come yet. Before that, so many bytes had
    /// come.
    Opened { since: Duration, received: u64 },
    /// The last frame came at this time.
    Live { since: Duration },
    /// The port is open, and no first frame came in time. Before it was opened, so many bytes had
    /// come.
    Silent { received: u64 },
    /// The port is open, and silent after its last frame.
    Stale,
}

impl Link {
    /// The link of a port that was never opened.
    pub(super) fn new() -> Self {
        Self {
            port: Port::Closed { reason: None },
            was_lost: false,
            recent: VecDeque::with_capacity(RATE_FRAMES),
            silences: VecDeque::with_capacity(STEADY_SILENCES),
            last_bytes: None,
            last_frame: None,
            published: (LinkState::Connecting, None),
        }
    }

    /// Whether a link can have this state. A recording may hold anything.
    pub(super) fn is_possible(&self) -> bool {
        let are_silences = |silence: &Duration| *silence <= LONGEST_PERIOD;
        self.recent.len() <= RATE_FRAMES
            && self.silences.len() <= STEADY_SILENCES
            && self.silences.iter().all(are_silences)
    }

    pub(super) fn was_lost(&self) -> bool {
        self.was_lost
    }

    pub(super) fn is_live(&self) -> bool {
        matches!(self.port, Port::Live { .. })
    }

    /// The port is open. So many bytes have come before.
    pub(super) fn opened(&mut self, since: Duration, received: u64) {
        self.last_bytes = None;
        if matches!(self.port, Port::Closed { .. }) {
            self.port = Port::Opened { since, received };
        }
    }

    /// The port could not be opened.
    pub(super) fn unavailable(&mut self, reason: String) {
        if let Port::Closed { reason: known } = &mut self.port {
            *known = Some(reason);
        }
    }

    /// A frame came. Returns when the one before it came.
    pub(super) fn frame(&mut self, stamp: Stamp, sensor: &Sensor) -> Option<Stamp> {
        if let (Port::Live { .. } | Port::Stale, Some(last)) = (&self.port, self.last_frame) {
            self.silence(stamp.mono.saturating_sub(last.mono), sensor);
        }
        // A rate measured across a silence would be meaningless.
        if matches!(self.port, Port::Silent { .. } | Port::Stale) {
            self.recent.clear();
        }
        if self.recent.len() == RATE_FRAMES {
            self.recent.pop_front();
        }
        self.recent.push_back(stamp.mono);
        self.port = Port::Live { since: stamp.mono };
        self.was_lost = false;
        self.last_frame.replace(stamp)
    }

    /// A silence of a live sensor has ended with a frame.
    fn silence(&mut self, silence: Duration, sensor: &Sensor) {
        if silence <= sensor.stale_after() {
            // The sensor sends as often as expected.
            self.silences.clear();
        } else if silence <= LONGEST_PERIOD
            && (silence <= self.stale_after(sensor) || self.slow_period(sensor).is_none())
        {
            if self.silences.len() == STEADY_SILENCES {
                self.silences.pop_front();
            }
            self.silences.push_back(silence);
        }
    }

    /// The period of a sensor that steadily sends more slowly than expected. The latest silences are
    /// then about equal.
    pub(super) fn slow_period(&self, sensor: &Sensor) -> Option<Duration> {
        let longest = *self.silences.iter().max()?;
        let shortest = *self.silences.iter().min()?;
        let is_steady = self.silences.len() == STEADY_SILENCES
            && longest <= shortest.mul_f64(STEADY_FACTOR)
            && shortest >= sensor.period().mul_f64(SLOW_FACTOR);
        let sum: Duration = self.silences.iter().sum();
        is_steady.then(|| sum / STEADY_SILENCES as u32)
    }

    /// How long the sensor may be silent before it is stale. One that steadily sends more slowly than
    /// expected is late only by its own period: it would be stale and live with every frame.
    pub(super) fn stale_after(&self, sensor: &Sensor) -> Duration {
        let own = self.slow_period(sensor).unwrap_or_default();
        sensor.stale_after().max(own.mul_f64(LATE_PERIODS))
    }

    /// The silence has lasted until [`Self::stale_deadline`].
    pub(super) fn silent(&mut self) {
        self.port = match self.port {
            Port::Opened { received, .. } => Port::Silent { received },
            _ => Port::Stale,
        };
    }

    /// The device is gone.
    pub(super) fn lost(&mut self, reason: String) {
        self.recent.clear();
        self.ended(reason);
    }

    /// No more bytes will come. The measured rate stays.
    pub(super) fn ended(&mut self, reason: String) {
        self.port = Port::Closed {
            reason: Some(reason),
        };
        self.was_lost = true;
    }

    /// When a silence makes the link stale.
    fn stale_deadline(&self, sensor: &Sensor) -> Option<Duration> {
        match self.port {
            Port::Opened { since, .. } => Some(since.saturating_add(sensor.late_after())),
            Port::Live { since } => Some(since.saturating_add(self.stale_after(sensor))),
            _ => None,
        }
    }

    /// The span of the latest frames and their number. `None` before two frames.
    fn measured(&self) -> Option<(Duration, usize)> {
        let span = self.recent.back()?.checked_sub(*self.recent.front()?)?;
        (self.recent.len() >= 2).then_some((span, self.recent.len()))
    }
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
        // A port that was lost is lost until a frame comes, whatever happens to it.
        let or_lost = |state| match self.seen.link.was_lost {
            true => LinkState::Lost,
            false => state,
        };
        match &self.seen.link.port {
            Port::Closed { reason } => (or_lost(LinkState::Connecting), reason.clone()),
            Port::Opened { .. } => {
                let was_lost = self.seen.link.was_lost;
                let again = was_lost.then(|| "open, no frame yet".to_owned());
                (or_lost(LinkState::Connecting), again)
            }
            Port::Live { .. } => (LinkState::Live, tare()),
            Port::Silent { received } => {
                let mut reason = no_frame_for(self.sensor.late_after());
                if self.decoder.received() > *received
                    && let Some(reason) = &mut reason
                {
                    reason.push_str(", but bytes come: is the baud rate or the layout wrong?");
                }
                (or_lost(LinkState::Stale), reason)
            }
            Port::Stale => (
                LinkState::Stale,
                no_frame_for(self.seen.link.stale_after(&self.sensor)),
            ),
        }
    }

    /// A status, if the state or its reason have changed since the last one.
    pub(super) fn status_if_changed(&mut self, at: Stamp) -> Vec<Event> {
        let state = self.state();
        if self.seen.link.published == state {
            return Vec::new();
        }
        self.seen.link.published = state;
        vec![Event::Status(self.status(at))]
    }

    /// The rate of a sensor that steadily sends more slowly than its description says, in frames/s.
    pub fn slow_rate_hz(&self) -> Option<f64> {
        let period = self.seen.link.slow_period(&self.sensor)?;
        Some(1.0 / period.as_secs_f64())
    }

    fn measured_rate_hz(&self) -> Option<f64> {
        let (span, frames) = self.seen.link.measured()?;
        let span = span.as_secs_f64();
        match self.clock {
            Clock::FrameRate => Some(self.sensor.description().frame_rate_hz),
            Clock::Arrival => (span > 0.0).then(|| (frames - 1) as f64 / span),
        }
    }

    /// When a silence settles the pending bytes.
    pub(super) fn pause_deadline(&self) -> Option<Duration> {
        let last_bytes = self
            .seen
            .link
            .last_bytes
            .filter(|_| self.decoder.pending() > 0)?;
        Some(last_bytes.saturating_add(self.sensor.period().mul_f64(PAUSE_PERIODS)))
    }

    /// When a silence makes the link stale.
    pub(super) fn stale_deadline(&self) -> Option<Duration> {
        if self.clock == Clock::FrameRate {
            return None;
        }
        self.seen.link.stale_deadline(&self.sensor)
    }
}
