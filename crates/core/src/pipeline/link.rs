//! The link of a sensor: its state, its measured rate, and the silences that change it.

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Clock, Pipeline};
use crate::event::{Event, LinkState, Status};
use crate::frame::{Frame, Stamp};
use crate::sensor::Sensor;
use crate::tare::{Aim, Touch, TouchKind};

/// After a silence of this many periods, the pending bytes are settled: a frame that only waited for
/// the header of the next one is then whole.
const PAUSE_PERIODS: f64 = 0.5;

/// After the last frame of a live sensor, bytes that are not read keep it from being stale for this time.
const SKIPPING: Duration = Duration::from_secs(10);

/// The number of frames over which the frame rate is measured.
pub(super) const RATE_FRAMES: usize = 32;

/// The link of a sensor: its port, and when bytes and frames came over it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Link {
    port: Port,
    /// Whether the port was lost, and no frame has come since.
    pub(super) was_lost: bool,
    /// The arrival times of the latest frames.
    recent: VecDeque<Duration>,
    /// When the last bytes came that are not settled, or when the port was opened.
    pub(super) last_bytes: Option<Duration>,
    pub(super) last_frame: Option<Stamp>,
    /// State and reason of the last published status, and the kind of a touch.
    published: (LinkState, Option<String>, Option<TouchKind>),
}

/// The state of the port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Port {
    /// The port is not open. The reason is that of the last try, or of the loss.
    Closed { reason: Option<String> },
    /// The port has been open since then, and no frame has come yet.
    Opened { since: Duration },
    /// The last frame came at this time, or the last bytes that were skipped.
    Live { since: Duration },
    /// The port is open, and no frame came for this time.
    Silent { during: Duration },
}

impl Link {
    /// The link of a port that was never opened.
    pub(super) fn new() -> Self {
        Self {
            port: Port::Closed { reason: None },
            was_lost: false,
            recent: VecDeque::with_capacity(RATE_FRAMES),
            last_bytes: None,
            last_frame: None,
            published: (LinkState::Connecting, None, None),
        }
    }

    /// The link of the same sensor whose port was not opened since. What was published still is.
    pub(super) fn anew(&self) -> Self {
        let (state, reason, _) = self.published.clone();
        Self {
            published: (state, reason, None),
            ..Self::new()
        }
    }

    pub(super) fn is_live(&self) -> bool {
        matches!(self.port, Port::Live { .. })
    }

    /// The port is open.
    pub(super) fn opened(&mut self, since: Duration) {
        // A silence from now on is a pause before the first frame.
        self.last_bytes = Some(since);
        if matches!(self.port, Port::Closed { .. }) {
            self.port = Port::Opened { since };
        }
    }

    /// The port could not be opened.
    pub(super) fn unavailable(&mut self, reason: String) {
        if let Port::Closed { reason: known } = &mut self.port {
            *known = Some(reason);
        }
    }

    /// A frame came, and was taken. Returns when the one before it came.
    pub(super) fn frame(&mut self, stamp: Stamp) -> Option<Stamp> {
        self.came(stamp);
        self.last_frame.replace(stamp)
    }

    /// A frame came. If it is dropped, it counts too for the state and the measured rate.
    pub(super) fn came(&mut self, stamp: Stamp) {
        // A rate measured across a silence would be meaningless.
        if self.is_silent() {
            self.recent.clear();
        }
        if self.recent.len() >= RATE_FRAMES {
            self.recent.pop_front();
        }
        self.recent.push_back(stamp.mono);
        self.port = Port::Live { since: stamp.mono };
        self.was_lost = false;
    }

    /// Bytes came that nobody reads. They may be frames, if the last ones were.
    pub(super) fn skipped(&mut self, at: Duration) {
        let last = self.recent.back();
        if let Port::Live { since } = &mut self.port
            && last.is_some_and(|&last| at.saturating_sub(last) < SKIPPING)
        {
            *since = at;
        }
    }

    /// Whether the port is open, and silent.
    pub(super) fn is_silent(&self) -> bool {
        matches!(self.port, Port::Silent { .. })
    }

    /// No frame came for this time.
    pub(super) fn silent(&mut self, during: Duration) {
        self.port = Port::Silent { during };
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

    /// Since when a silence lasts, and how long it may.
    fn silence(&self, sensor: &Sensor) -> Option<(Duration, Duration)> {
        match self.port {
            Port::Opened { since } => Some((since, sensor.late_after())),
            Port::Live { since } => Some((since, sensor.stale_after())),
            Port::Closed { .. } | Port::Silent { .. } => None,
        }
    }

    /// The rate of the latest frames. `None` before two frames.
    fn measured_hz(&self) -> Option<f64> {
        let span = self.recent.back()?.checked_sub(*self.recent.front()?)?;
        let periods = self.recent.len() - 1;
        (!span.is_zero()).then(|| periods as f64 / span.as_secs_f64())
    }
}

/// The most taxels that are named.
const NAMED: usize = 4;

/// The taxels of a frame in contact, in words.
pub(super) fn in_contact(frame: &Frame, threshold_n: f32) -> String {
    let cells = frame.newtons.iter().enumerate();
    let touched = cells.filter(|&(_, &newtons)| newtons >= threshold_n);
    let places: Vec<String> = touched
        .map(|(place, _)| frame.array.position(place))
        .map(|(row, col)| format!("[{row}, {col}]"))
        .collect();
    let named = places[..places.len().min(NAMED)].join(", ");
    let more = match places.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!(
        "taxels {named}{more}: if nothing touches them, take a tare, or put them into dead_taxels"
    )
}

impl Pipeline {
    /// When [`Self::take`] next needs a tick, on CLOCK_MONOTONIC.
    pub fn deadline(&self) -> Option<Duration> {
        let stale = self.stale_deadline().map(|(deadline, _)| deadline);
        self.pause_deadline().into_iter().chain(stale).min()
    }

    /// The current state of the link and its counters.
    pub fn status(&self, at: Stamp) -> Status {
        let (state, reason) = (self.link_state(), self.reason());
        let detail = match self.touch() {
            Some(touch) => Some(touch.to_string()),
            None => self.unreleased().map(str::to_owned),
        };
        Status {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: at.wall,
            state,
            reason,
            frames: self.frames,
            frames_damaged: self.frames_damaged,
            frames_dropped: self.pace.dropped,
            bytes_skipped: self.decoder.skipped(),
            frame_rate_hz: self.measured_rate_hz(),
            detail: detail.filter(|_| state == LinkState::Live),
        }
    }

    /// The state of the link. A port that was lost is lost until a frame comes, whatever happens to it.
    pub(super) fn link_state(&self) -> LinkState {
        match self.link.port {
            Port::Live { .. } => LinkState::Live,
            _ if self.link.was_lost => LinkState::Lost,
            Port::Closed { .. } | Port::Opened { .. } => LinkState::Connecting,
            Port::Silent { .. } => LinkState::Stale,
        }
    }

    /// The reason of the state.
    fn reason(&self) -> Option<String> {
        match &self.link.port {
            Port::Closed { reason } => reason.clone(),
            Port::Opened { .. } => {
                let was_lost = self.link.was_lost;
                was_lost.then(|| "open, no frame yet".to_owned())
            }
            Port::Live { .. } => {
                let tare = self.touch().map(|_| "tare: contact".to_owned());
                let unreleased = || {
                    let seconds = self.sensor.description().press.max_seconds;
                    let reason = || format!("not released for {seconds} s");
                    self.unreleased().map(|_| reason())
                };
                let too_fast = || self.pace.reason(self.sensor.frame_rate_hz());
                tare.or_else(unreleased).or_else(too_fast)
            }
            Port::Silent { during } => {
                let ms = (during.as_nanos() as f64 / 1e5).round() / 10.0;
                let bytes = self.decoder.problem();
                let bytes = bytes.map(|problem| format!(", but bytes come: {problem}"));
                Some(format!("no frame for {ms} ms{}", bytes.unwrap_or_default()))
            }
        }
    }

    /// The taxels that keep a press that timed out from its release.
    fn unreleased(&self) -> Option<&str> {
        let is_waiting = !self.tracker.is_idle() && !self.tracker.is_pressed();
        self.unreleased.as_deref().filter(|_| is_waiting)
    }

    /// What keeps the sensor from its first tare.
    fn touch(&self) -> Option<Touch> {
        match self.tare.aim()? {
            Aim::First { touch } => touch,
            Aim::Request => None,
        }
    }

    /// A status, if the state or its reason have changed since the last one. So is one if a tare meets
    /// what rests on the sensor after what varied. The numbers of a touch differ with every try, and
    /// what rests varies when it is taken away.
    pub(super) fn status_if_changed(&mut self, at: Stamp) -> Option<Event> {
        let (state, reason) = (self.link_state(), self.reason());
        let kind = self.touch().map(|touch| touch.kind);
        let (known_state, known_reason, known_kind) = &self.link.published;
        if (*known_state, known_reason) == (state, &reason) && kind <= *known_kind {
            return None;
        }
        self.link.published = (state, reason, kind);
        Some(Event::Status(self.status(at)))
    }

    fn measured_rate_hz(&self) -> Option<f64> {
        let measured = self.link.measured_hz()?;
        Some(match self.clock {
            Clock::FrameRate => self.sensor.frame_rate_hz(),
            Clock::Arrival => measured,
        })
    }

    /// When a silence settles the pending bytes, or is the pause before a frame.
    pub(super) fn pause_deadline(&self) -> Option<Duration> {
        let last_bytes = self
            .link
            .last_bytes
            .filter(|_| !self.decoder.pending().is_empty() || self.decoder.awaits_pause())?;
        Some(last_bytes.saturating_add(self.sensor.period().mul_f64(PAUSE_PERIODS)))
    }

    /// When a silence makes the link stale, and how long it is then.
    pub(super) fn stale_deadline(&self) -> Option<(Duration, Duration)> {
        if self.clock == Clock::FrameRate {
            return None;
        }
        let (since, during) = self.link.silence(&self.sensor)?;
        Some((since.saturating_add(during), during))
    }
}
