//! Presses: one contact each, from touch to release.
//!
//! In: tared [`Frame`]s with their numbers and arrival times. Out: [`Change`]s. The tracker reads
//! no clock: the times of the frames decide how long a press lasts.

mod held;
mod phases;
mod settings;
mod settling;
mod thin;

use std::cmp::Ordering;
use std::sync::Arc;
use std::time::Duration;

use self::held::HeldFrames;
pub use self::phases::Phases;
pub use self::settings::{Settings, Thresholds};
use self::settling::{Load, Settling};
pub use self::thin::thinned;
use crate::frame::{Frame, Stamp};

/// The number of a frame in a press, and when its last byte came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameAt {
    /// The number of the frame, per sensor.
    pub frame: u64,
    /// When the frame's last byte came.
    pub stamp: Stamp,
}

/// Marks of a frame. They are decided by the settings at the frame's arrival, because the settings
/// may have changed when the press is judged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Marks {
    /// Whether the contact touches the border of the array.
    pub at_edge: bool,
    /// Whether a live taxel reads full scale.
    pub saturated: bool,
}

/// A frame of a press, in contact. The best frame has the maximal contact area. Of equal areas the
/// greater force wins, then the earlier frame.
#[derive(Debug, Clone, PartialEq)]
pub struct ContactFrame {
    /// The frame's number and arrival.
    pub moment: FrameAt,
    /// The frame as [`Frame::felt`] gives it.
    pub frame: Arc<Frame>,
    /// The frame's marks.
    pub marks: Marks,
    /// The contact area of the frame.
    pub contact_area_taxels: u32,
    /// The force of the contact.
    pub force_n: f64,
}

/// The end of a press that gets a verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The press was released.
    Release,
    /// The press was held for `max_seconds`.
    Timeout,
}

/// The reason why a press gets no verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Abort {
    /// The press had fewer than `min_frames` frames in contact.
    Short,
    /// The device was lost.
    Lost,
    /// The daemon stops.
    Shutdown,
    /// The recording ended.
    EndOfRecording,
}

impl Abort {
    /// The reason as it is published.
    pub fn reason(self) -> &'static str {
        match self {
            Abort::Short => "short",
            Abort::Lost => "lost",
            Abort::Shutdown => "shutdown",
            Abort::EndOfRecording => "end of recording",
        }
    }
}

/// A change of a press.
///
/// # Example
///
/// A touch of one frame begins a press that gets no verdict.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::frame::{Frame, Stamp};
/// use hardnessd_core::press::{Abort, Change, Marks, FrameAt, PressTracker, Thresholds};
///
/// let mut tracker = PressTracker::new(Thresholds::default());
/// let mut touched = Frame::default();
/// touched.newtons[400..409].fill(0.5);
/// let mut changes = Vec::new();
/// for (number, frame) in (0..).zip([touched, Frame::default(), Frame::default()]) {
///     let stamp = Stamp {
///         mono: Duration::from_millis(200 * number),
///         wall: jiff::Timestamp::UNIX_EPOCH,
///     };
///     let at = FrameAt { frame: number, stamp };
///     changes.extend(tracker.push(&frame, Marks::default(), at));
/// }
/// assert!(matches!(changes[0], Change::Begin { press: 1, .. }));
/// assert!(matches!(changes[1], Change::Aborted { frames: 1, reason: Abort::Short, .. }));
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// A press began with this frame.
    Begin {
        /// The press's number.
        press: u64,
        /// The frame.
        at: FrameAt,
    },
    /// The contact has settled.
    Settled {
        /// The press so far.
        press: Box<SoFar>,
    },
    /// The press ended and is to be judged.
    End {
        /// The whole press.
        press: Box<SoFar>,
        /// The last frame in contact.
        last: FrameAt,
        /// The number of frames in contact.
        frames: u64,
        /// Whether the press was released or timed out.
        end: End,
    },
    /// The press ended without a verdict.
    Aborted {
        /// The press's number.
        press: u64,
        /// The last frame in contact.
        last: FrameAt,
        /// The number of frames in contact.
        frames: u64,
        /// The reason why there is no verdict.
        reason: Abort,
    },
}

/// The frames in contact of a press up to now.
#[derive(Debug, Clone, PartialEq)]
pub struct SoFar {
    press: u64,
    peak: ContactFrame,
    course: HeldFrames,
}

impl SoFar {
    /// The press's number.
    pub fn press(&self) -> u64 {
        self.press
    }

    /// The best frame.
    pub fn peak(&self) -> &ContactFrame {
        &self.peak
    }

    /// The frames up to `until`, and the place of the best frame among them. They are evenly spread
    /// over the press, some hundred at most. A short press has all its frames.
    pub fn until(&self, until: Duration) -> (Vec<&ContactFrame>, usize) {
        self.course.until(until, &self.peak)
    }
}

/// Follows one sensor's presses.
///
/// # Example
///
/// Three frames of a touch and two of a release are one press.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::frame::{Frame, Stamp};
/// use hardnessd_core::press::{Change, Marks, FrameAt, PressTracker, Thresholds};
///
/// let mut tracker = PressTracker::new(Thresholds::default());
/// let free = Frame::default();
/// let mut touched = free.clone();
/// touched.newtons[400..409].fill(0.5);
/// let mut changes = Vec::new();
/// for (number, frame) in (0..).zip([&touched, &touched, &touched, &free, &free]) {
///     let stamp = Stamp {
///         mono: Duration::from_millis(200 * number),
///         wall: jiff::Timestamp::UNIX_EPOCH,
///     };
///     let at = FrameAt { frame: number, stamp };
///     changes.extend(tracker.push(frame, Marks::default(), at));
/// }
/// assert!(matches!(changes[0], Change::Begin { press: 1, .. }));
/// assert!(matches!(changes[1], Change::Settled { .. }));
/// assert!(matches!(changes[2], Change::End { frames: 3, .. }));
/// ```
#[derive(Debug)]
pub struct PressTracker {
    thresholds: Thresholds,
    state: State,
    presses: u64,
}

#[derive(Debug)]
enum State {
    Idle,
    Pressed(Box<Pressed>),
    /// The press timed out. The count is that of frames without contact since then.
    AwaitingRelease {
        released_frames: u32,
    },
}

#[derive(Debug)]
struct Pressed {
    so_far: SoFar,
    began: Duration,
    last: FrameAt,
    frames: u64,
    released_frames: u32,
    /// `None` once the early verdict has come.
    settling: Option<Settling>,
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

    /// The number of presses so far.
    pub fn presses(&self) -> u64 {
        self.presses
    }

    /// Continues after this number of presses.
    pub fn resume(&mut self, presses: u64) {
        self.presses = presses;
    }

    /// Whether a press is under way.
    pub fn is_pressed(&self) -> bool {
        self.pressed().is_some()
    }

    /// Whether there is no press under way, and no press that timed out and is not yet released.
    pub fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle)
    }

    /// The start time of the press under way.
    pub fn began(&self) -> Option<Duration> {
        self.pressed().map(|pressed| pressed.began)
    }

    /// The press under way, and the number of its frames in contact.
    pub fn so_far(&self) -> Option<(&SoFar, u64)> {
        let pressed = self.pressed()?;
        Some((&pressed.so_far, pressed.frames))
    }

    fn pressed(&self) -> Option<&Pressed> {
        match &self.state {
            State::Pressed(pressed) => Some(pressed),
            State::Idle | State::AwaitingRelease { .. } => None,
        }
    }

    /// Takes the next frame in. Returns its changes, in order.
    pub fn push(&mut self, frame: &Frame, marks: Marks, at: FrameAt) -> Vec<Change> {
        let threshold_n = self.thresholds.contact_threshold_n;
        let area = frame.contact_area_taxels(threshold_n);
        let touched = area >= self.thresholds.end_area_taxels;
        let mut changes = Vec::new();
        if self.is_idle() && area < self.thresholds.begin_area_taxels {
            return changes;
        }
        let felt = frame.felt(threshold_n);
        let force_n = felt.force_n();
        let contact = || ContactFrame {
            moment: at,
            frame: Arc::new(felt),
            marks,
            contact_area_taxels: area,
            force_n,
        };
        match &mut self.state {
            State::Idle => {
                self.presses += 1;
                let press = self.presses;
                let peak = contact();
                changes.push(Change::Begin { press, at });
                let mut course = HeldFrames::default();
                course.push(peak.clone());
                self.state = State::Pressed(Box::new(Pressed {
                    so_far: SoFar {
                        press,
                        peak,
                        course,
                    },
                    began: at.stamp.mono,
                    last: at,
                    frames: 1,
                    released_frames: 0,
                    settling: Some(Settling::default()),
                }));
            }
            State::Pressed(pressed) if touched => pressed.touch(contact()),
            State::Pressed(pressed) => pressed.released_frames += 1,
            State::AwaitingRelease { released_frames } => {
                *released_frames = if touched { 0 } else { *released_frames + 1 };
                if *released_frames >= self.thresholds.end_frames {
                    self.state = State::Idle;
                }
                return changes;
            }
        }
        let load = Load {
            at: at.stamp.mono,
            contact_area_taxels: area,
            force_n,
        };
        self.conclude(load, &mut changes);
        changes
    }

    /// Ends a press under way without a verdict.
    pub fn abort(&mut self, reason: Abort) -> Option<Change> {
        let aborted = self.pressed()?.aborted(reason);
        self.state = State::Idle;
        Some(aborted)
    }

    /// Adds the changes of a frame with this load to the press: settled, released or timed out.
    fn conclude(&mut self, load: Load, changes: &mut Vec<Change>) {
        let State::Pressed(pressed) = &mut self.state else {
            return;
        };
        if let Some(settling) = &mut pressed.settling
            && settling.push(load, &self.thresholds)
        {
            pressed.settling = None;
            changes.push(Change::Settled {
                press: Box::new(pressed.so_far.clone()),
            });
        }
        let held = load.at.saturating_sub(pressed.began).as_secs_f64();
        let end = if pressed.released_frames >= self.thresholds.end_frames {
            End::Release
        } else if held >= self.thresholds.max_seconds {
            End::Timeout
        } else {
            return;
        };
        let next = match end {
            End::Release => State::Idle,
            End::Timeout => State::AwaitingRelease {
                released_frames: pressed.released_frames,
            },
        };
        if let State::Pressed(pressed) = std::mem::replace(&mut self.state, next) {
            changes.push(pressed.finish(end, self.thresholds.min_frames));
        }
    }
}

/// The largest share by which two equal forces may differ. Each taxel is an f32 and is rounded
/// twice:
/// when the baseline is subtracted, and when counts become newtons.
const ROUNDING: f64 = 2.0 * f32::EPSILON as f64;

impl Pressed {
    fn touch(&mut self, touched: ContactFrame) {
        self.last = touched.moment;
        self.frames += 1;
        self.released_frames = 0;
        let so_far = &mut self.so_far;
        if is_greater(&touched, &so_far.peak) {
            so_far.peak = touched.clone();
        }
        so_far.course.push(touched);
    }

    fn aborted(&self, reason: Abort) -> Change {
        Change::Aborted {
            press: self.so_far.press,
            last: self.last,
            frames: self.frames,
            reason,
        }
    }

    fn finish(self, end: End, min_frames: u64) -> Change {
        if self.frames < min_frames {
            return self.aborted(Abort::Short);
        }
        Change::End {
            press: Box::new(self.so_far),
            last: self.last,
            frames: self.frames,
            end,
        }
    }
}

/// Whether `one` is better than `other`, which came before it.
fn is_greater(one: &ContactFrame, other: &ContactFrame) -> bool {
    match one.contact_area_taxels.cmp(&other.contact_area_taxels) {
        Ordering::Less => false,
        Ordering::Equal => one.force_n > other.force_n * (1.0 + ROUNDING),
        Ordering::Greater => true,
    }
}

#[cfg(test)]
mod tests;
