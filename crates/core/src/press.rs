//! Presses: one contact each, from touch to release.
//!
//! In: tared [`Frame`]s with their numbers and arrival times. Out: [`Change`]s. The tracker reads
//! no clock: the times of the frames decide how long a press lasts.

mod phases;
mod settings;
mod settling;
mod so_far;

use std::sync::Arc;

pub use self::phases::{Phases, thinned};
pub use self::settings::{Settings, Thresholds};
use self::settling::Settling;
pub use self::so_far::SoFar;
use crate::frame::{Array, Frame, Stamp};

/// The number of a frame in a press, and when its last byte came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameAt {
    /// The number of the frame, per sensor.
    pub frame: u64,
    /// When the frame's last byte came.
    pub stamp: Stamp,
}

/// A frame as presses get it. The best frame of a press has the maximal contact area. Of equal areas the
/// greater force wins, then the earlier frame.
#[derive(Debug, Clone, PartialEq)]
pub struct ContactFrame {
    /// The frame's number and arrival.
    pub moment: FrameAt,
    /// The frame as [`Frame::felt`] gives it.
    pub frame: Arc<Frame>,
    /// Whether the contact touches the border of the array.
    pub at_edge: bool,
    /// Whether a live taxel reads full scale.
    pub saturated: bool,
    /// The contact area of the frame.
    pub contact_area_taxels: u32,
    /// The force of the contact.
    pub force_n: f64,
}

impl ContactFrame {
    /// A frame whose taxels are in contact at or above `threshold_n`, and do not read full scale.
    pub fn new(frame: &Frame, threshold_n: f32, moment: FrameAt) -> Self {
        let felt = frame.felt(threshold_n);
        let Array { rows, cols } = frame.array;
        let is_edge = |place: usize| {
            let (row, col) = frame.array.position(place);
            row == 0 || col == 0 || row + 1 == rows || col + 1 == cols
        };
        let mut taxels = frame.newtons.iter().enumerate();
        Self {
            moment,
            force_n: felt.force_n(),
            at_edge: taxels.any(|(place, &n)| n >= threshold_n && is_edge(place)),
            saturated: false,
            contact_area_taxels: frame.contact_area_taxels(threshold_n),
            frame: Arc::new(felt),
        }
    }
}

/// How a press ended. Only one that was released or timed out gets a verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The press was released.
    Release,
    /// The press was held for `max_seconds`.
    Timeout,
    /// The press had fewer than `min_frames` frames in contact.
    Short,
    /// The device was lost.
    Lost,
    /// The daemon stops.
    Shutdown,
    /// The recording ended.
    EndOfRecording,
}

impl End {
    /// Whether the press gets a verdict.
    pub fn is_judged(self) -> bool {
        matches!(self, End::Release | End::Timeout)
    }

    /// The reason as it is published.
    pub fn reason(self) -> Option<&'static str> {
        match self {
            End::Release => None,
            End::Timeout => Some("timeout"),
            End::Short => Some("short"),
            End::Lost => Some("lost"),
            End::Shutdown => Some("shutdown"),
            End::EndOfRecording => Some("end of recording"),
        }
    }
}

/// A change of a press.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// A press began with this frame.
    Begin {
        /// The press's number.
        press: u64,
        /// The frame.
        at: FrameAt,
    },
    /// The press ended.
    End {
        /// The whole press.
        press: Box<SoFar>,
        /// How it ended.
        end: End,
    },
}

/// Follows one sensor's presses.
///
/// # Example
///
/// Three frames of a touch and two of a release are one press. A touch of one frame is too short for a
/// verdict.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::frame::{Frame, Stamp};
/// use hardnessd_core::press::{Change, ContactFrame, End, FrameAt, PressTracker, Thresholds};
///
/// let mut tracker = PressTracker::new(Thresholds::default());
/// let free = Frame::default();
/// let mut touched = free.clone();
/// touched.newtons[400..409].fill(0.5);
/// let mut changes = Vec::new();
/// let frames = [&touched, &touched, &touched, &free, &free, &touched, &free, &free];
/// for (number, frame) in (0..).zip(frames) {
///     let stamp = Stamp {
///         mono: Duration::from_millis(200 * number),
///         wall: jiff::Timestamp::UNIX_EPOCH,
///     };
///     let at = FrameAt { frame: number, stamp };
///     changes.extend(tracker.push(ContactFrame::new(frame, 0.07, at)));
/// }
/// assert!(matches!(changes[0], Change::Begin { press: 1, .. }));
/// assert!(matches!(&changes[1], Change::End { press, end: End::Release } if press.frames == 3));
/// assert!(matches!(changes[3], Change::End { end: End::Short, .. }));
/// ```
#[derive(Debug)]
pub struct PressTracker {
    thresholds: Thresholds,
    state: State,
    /// The number of presses so far.
    pub(crate) presses: u64,
}

#[derive(Debug)]
enum State {
    Idle,
    /// The count is that of the last frames without contact.
    Pressed {
        press: Box<SoFar>,
        settling: Settling,
        released_frames: u32,
    },
    /// The press timed out. The count is that of frames without contact since then.
    AwaitingRelease {
        released_frames: u32,
    },
}

impl PressTracker {
    /// A tracker without a press.
    pub fn new(thresholds: Thresholds) -> Self {
        Self {
            thresholds,
            state: State::Idle,
            presses: 0,
        }
    }

    /// Whether a press is under way.
    pub fn is_pressed(&self) -> bool {
        self.so_far().is_some()
    }

    /// Whether there is no press under way, and no press that timed out and is not yet released.
    pub fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle)
    }

    /// The press under way.
    pub fn so_far(&self) -> Option<&SoFar> {
        match &self.state {
            State::Pressed { press, .. } => Some(press),
            State::Idle | State::AwaitingRelease { .. } => None,
        }
    }

    /// Takes the next frame in.
    pub fn push(&mut self, frame: ContactFrame) -> Option<Change> {
        let (at, area) = (frame.moment, frame.contact_area_taxels);
        let is_touched = area >= self.thresholds.end_area_taxels;
        match &mut self.state {
            State::Idle if area < self.thresholds.begin_area_taxels => None,
            State::Idle => {
                self.presses += 1;
                let mut settling = Settling::default();
                settling.push(&frame, &self.thresholds.settings);
                self.state = State::Pressed {
                    press: Box::new(SoFar::new(self.presses, frame)),
                    settling,
                    released_frames: 0,
                };
                let press = self.presses;
                Some(Change::Begin { press, at })
            }
            State::AwaitingRelease { released_frames } => {
                *released_frames = if is_touched { 0 } else { *released_frames + 1 };
                if *released_frames >= self.thresholds.settings.end_frames {
                    self.state = State::Idle;
                }
                None
            }
            State::Pressed {
                press,
                settling,
                released_frames,
            } => {
                if settling.push(&frame, &self.thresholds.settings) {
                    press.is_settled = true;
                }
                *released_frames = if is_touched { 0 } else { *released_frames + 1 };
                if is_touched {
                    press.push(frame);
                }
                let released_frames = *released_frames;
                let held = at.stamp.mono.saturating_sub(press.began).as_secs_f64();
                if released_frames >= self.thresholds.settings.end_frames {
                    self.end(End::Release, State::Idle)
                } else if held >= self.thresholds.settings.max_seconds {
                    self.end(End::Timeout, State::AwaitingRelease { released_frames })
                } else {
                    None
                }
            }
        }
    }

    /// Ends a press under way without a verdict.
    pub fn abort(&mut self, end: End) -> Option<Change> {
        self.so_far()?;
        self.end(end, State::Idle)
    }

    fn end(&mut self, end: End, next: State) -> Option<Change> {
        let State::Pressed { press, .. } = std::mem::replace(&mut self.state, next) else {
            return None;
        };
        let is_short = end.is_judged() && press.frames < self.thresholds.settings.min_frames;
        Some(Change::End {
            press,
            end: if is_short { End::Short } else { end },
        })
    }
}

#[cfg(test)]
mod tests;
