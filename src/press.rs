//! Presses: one contact each, from touch to release.
//!
//! In: tared [`Frame`]s with their number and the moment they came. Out: [`Change`]s, each
//! complete in itself. The tracker asks no clock: a press lasts as long as its frames say.

mod settings;

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use self::settings::{Settings, SettingsError};
use crate::frame::{Frame, Stamp};

/// A frame of a press: its number and when its last byte came.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Moment {
    /// Number of the frame, per sensor.
    pub frame: u64,
    /// When it came.
    pub stamp: Stamp,
}

/// The frame of maximal contact area so far; ties go to the greater force, then the earlier one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Peak {
    /// Which frame.
    pub moment: Moment,
    /// Its taxels.
    pub frame: Frame,
    /// Its contact area.
    pub contact_area_taxels: u32,
    /// Its total force.
    pub force_n: f64,
}

/// How a press came to its end with a verdict due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// Released.
    Release,
    /// Held for `max_seconds`.
    Timeout,
}

/// Why a press came to nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Abort {
    /// Fewer than `min_frames` in contact.
    Short,
    /// The device was lost.
    Lost,
    /// The daemon stops.
    Shutdown,
    /// The recording ended.
    EndOfRecording,
}

impl Abort {
    /// As published.
    pub fn reason(self) -> &'static str {
        match self {
            Abort::Short => "short",
            Abort::Lost => "lost",
            Abort::Shutdown => "shutdown",
            Abort::EndOfRecording => "end of recording",
        }
    }
}

/// What became of a press.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// It began with this frame.
    Begin {
        /// Its number.
        press: u64,
        /// The frame.
        at: Moment,
    },
    /// The contact has settled.
    Settled {
        /// Its number.
        press: u64,
        /// Best frame so far.
        peak: Box<Peak>,
    },
    /// It ended and is to be judged.
    End {
        /// Its number.
        press: u64,
        /// Its last frame in contact.
        last: Moment,
        /// Frames in contact.
        frames: u64,
        /// How.
        end: End,
        /// Its best frame.
        peak: Box<Peak>,
    },
    /// It came to nothing.
    Aborted {
        /// Its number.
        press: u64,
        /// Its last frame in contact.
        last: Moment,
        /// Frames in contact.
        frames: u64,
        /// Why.
        reason: Abort,
    },
}

/// Follows one sensor's presses.
#[derive(Debug)]
pub struct PressTracker {
    settings: Settings,
    state: State,
    presses: u64,
}

/// What a [`PressTracker`] has seen, without its settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    state: State,
    presses: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum State {
    Idle,
    Pressed(Box<Pressed>),
    /// Timed out; so many frames without contact so far.
    AwaitingRelease {
        released_frames: u32,
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Pressed {
    press: u64,
    began: Duration,
    last: Moment,
    frames: u64,
    released_frames: u32,
    peak: Peak,
    /// `None` once the early verdict has come.
    settling: Option<Settling>,
}

/// The latest frames that are all near the largest area and force so far.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Settling {
    near: VecDeque<Load>,
    most_area: u32,
    most_force_n: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Load {
    at: Duration,
    contact_area_taxels: u32,
    force_n: f64,
}

impl PressTracker {
    /// A tracker that has seen nothing. `settings` have passed [`Settings::check`].
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            state: State::Idle,
            presses: 0,
        }
    }

    /// Takes over changed settings; a press under way goes on under them.
    pub fn reload(&mut self, settings: Settings) {
        self.settings = settings;
    }

    /// What it has seen.
    pub fn memory(&self) -> Memory {
        Memory {
            state: self.state.clone(),
            presses: self.presses,
        }
    }

    /// Goes on where the one stood whose memory this is.
    pub fn recall(&mut self, memory: Memory) {
        Memory {
            state: self.state,
            presses: self.presses,
        } = memory;
    }

    /// Whether a press is under way.
    pub fn is_pressed(&self) -> bool {
        matches!(self.state, State::Pressed(_))
    }

    /// Takes the next frame in, and tells what it changed, in order.
    pub fn push(&mut self, frame: &Frame, at: Moment) -> Vec<Change> {
        let area = frame.contact_area_taxels(self.settings.contact_threshold_n);
        let touched = area >= self.settings.end_area_taxels;
        let mut changes = Vec::new();
        match &mut self.state {
            State::Idle if area < self.settings.begin_area_taxels => return changes,
            State::Idle => {
                self.presses += 1;
                let peak = Peak {
                    moment: at,
                    frame: *frame,
                    contact_area_taxels: area,
                    force_n: frame.force_n(),
                };
                changes.push(Change::Begin {
                    press: self.presses,
                    at,
                });
                self.state = State::Pressed(Box::new(Pressed {
                    press: self.presses,
                    began: at.stamp.mono,
                    last: at,
                    frames: 1,
                    released_frames: 0,
                    settling: Some(Settling::default()),
                    peak,
                }));
            }
            State::Pressed(pressed) if touched => pressed.touch(frame, at, area),
            State::Pressed(pressed) => pressed.released_frames += 1,
            State::AwaitingRelease { released_frames } => {
                *released_frames = if touched { 0 } else { *released_frames + 1 };
                if *released_frames >= self.settings.end_frames {
                    self.state = State::Idle;
                }
                return changes;
            }
        }
        self.conclude(frame, at, area, &mut changes);
        changes
    }

    /// Ends a press under way without a verdict.
    pub fn abort(&mut self, reason: Abort) -> Option<Change> {
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Pressed(pressed) => Some(Change::Aborted {
                press: pressed.press,
                last: pressed.last,
                frames: pressed.frames,
                reason,
            }),
            other => {
                self.state = other;
                None
            }
        }
    }

    /// What the press at hand amounts to after this frame: settled, released, timed out.
    fn conclude(&mut self, frame: &Frame, at: Moment, area: u32, changes: &mut Vec<Change>) {
        let State::Pressed(pressed) = &mut self.state else {
            return;
        };
        if let Some(settling) = &mut pressed.settling {
            let load = Load {
                at: at.stamp.mono,
                contact_area_taxels: area,
                force_n: frame.force_n(),
            };
            if settling.push(load, &self.settings) {
                pressed.settling = None;
                changes.push(Change::Settled {
                    press: pressed.press,
                    peak: Box::new(pressed.peak.clone()),
                });
            }
        }
        let held = at.stamp.mono.saturating_sub(pressed.began).as_secs_f64();
        let end = if pressed.released_frames >= self.settings.end_frames {
            End::Release
        } else if held >= self.settings.max_seconds {
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
            changes.push(pressed.finish(end, self.settings.min_frames));
        }
    }
}

impl Pressed {
    fn touch(&mut self, frame: &Frame, at: Moment, area: u32) {
        self.last = at;
        self.frames += 1;
        self.released_frames = 0;
        let force_n = frame.force_n();
        if (area, force_n) > (self.peak.contact_area_taxels, self.peak.force_n) {
            self.peak = Peak {
                moment: at,
                frame: *frame,
                contact_area_taxels: area,
                force_n,
            };
        }
    }

    fn finish(self, end: End, min_frames: u64) -> Change {
        let Pressed {
            press,
            last,
            frames,
            ..
        } = self;
        if frames < min_frames {
            return Change::Aborted {
                press,
                last,
                frames,
                reason: Abort::Short,
            };
        }
        Change::End {
            press,
            last,
            frames,
            end,
            peak: Box::new(self.peak),
        }
    }
}

impl Settling {
    /// Adds a frame; whether over at least `early_settle_s` and [`SETTLED_FRAMES`] frames area
    /// and force stayed near their largest so far, with enough force.
    fn push(&mut self, load: Load, settings: &Settings) -> bool {
        self.most_area = self.most_area.max(load.contact_area_taxels);
        self.most_force_n = self.most_force_n.max(load.force_n);
        self.near.push_back(load);
        let (most_area, most_force_n) = (self.most_area, self.most_force_n);
        let is_near = |load: &Load| {
            let area_gap = f64::from(most_area - load.contact_area_taxels);
            area_gap <= (SETTLED_SHARE * f64::from(most_area)).max(1.0)
                && most_force_n - load.force_n <= SETTLED_SHARE * most_force_n
        };
        // The largest values only grow: a frame once too far below them stays so.
        if let Some(last_far) = self.near.iter().rposition(|load| !is_near(load)) {
            self.near.drain(..=last_far);
        }
        let settle = Duration::from_secs_f64(settings.early_settle_s);
        let covers = |first: &Load| load.at.saturating_sub(first.at) >= settle;
        while self.near.len() > SETTLED_FRAMES && self.near.get(1).is_some_and(covers) {
            self.near.pop_front();
        }
        load.force_n >= settings.early_min_force_n
            && self.near.len() >= SETTLED_FRAMES
            && self.near.front().is_some_and(covers)
    }
}

/// Contract, section 4: an early verdict needs three settled frames ...
const SETTLED_FRAMES: usize = 3;
/// ... whose area and force are within 5 % of their largest so far.
const SETTLED_SHARE: f64 = 0.05;

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of `area` taxels sharing `force_n`.
    fn frame(area: usize, force_n: f32) -> Frame {
        let mut frame = Frame::default();
        for newtons in frame.newtons.iter_mut().take(area) {
            *newtons = force_n / area as f32;
        }
        frame
    }

    fn moment(frame: u64, rate_hz: u64) -> Moment {
        let mono = Duration::from_nanos(frame * 1_000_000_000 / rate_hz);
        let wall = jiff::Timestamp::UNIX_EPOCH + mono;
        Moment {
            frame,
            stamp: Stamp { mono, wall },
        }
    }

    /// One letter a change with its frame: b begin, s settled, e end, t timeout, x aborted.
    fn track(settings: &Settings, loads: &[(usize, f32)], rate_hz: u64) -> String {
        let mut tracker = PressTracker::new(settings.clone());
        let mut text = Vec::new();
        for (number, &(area, force_n)) in (0..).zip(loads) {
            for change in tracker.push(&frame(area, force_n), moment(number, rate_hz)) {
                text.push(match change {
                    Change::Begin { press, at } => format!("b{press}@{}", at.frame),
                    Change::Settled { peak, .. } => format!("s@{number}:{}", peak.moment.frame),
                    Change::End {
                        last,
                        frames,
                        end,
                        peak,
                        ..
                    } => format!(
                        "{}@{number}:last{} n{frames} peak{}",
                        if end == End::Release { 'e' } else { 't' },
                        last.frame,
                        peak.moment.frame
                    ),
                    Change::Aborted {
                        last,
                        frames,
                        reason,
                        ..
                    } => {
                        format!(
                            "x@{number}:last{} n{frames} {}",
                            last.frame,
                            reason.reason()
                        )
                    }
                });
            }
        }
        text.join(" ")
    }

    fn check(loads: &[(usize, f32)], expected: &str) {
        assert_eq!(track(&Settings::default(), loads, 5), expected);
    }

    #[test]
    fn a_press_runs_from_begin_area_to_release() {
        check(
            &[
                (0, 0.),
                (2, 9.),
                (3, 1.),
                (9, 5.),
                (5, 3.),
                (0, 0.),
                (0, 0.),
            ],
            "b1@2 e@6:last4 n3 peak3",
        );
    }

    #[test]
    fn one_empty_frame_does_not_end_a_press() {
        check(
            &[(3, 1.), (0, 0.), (4, 2.), (0, 0.), (0, 0.)],
            "b1@0 e@4:last2 n2 peak2",
        );
    }

    #[test]
    fn a_press_of_one_frame_is_short() {
        check(
            &[(3, 1.), (0, 0.), (0, 0.), (3, 1.)],
            "b1@0 x@2:last0 n1 short b2@3",
        );
    }

    #[test]
    fn ties_of_area_go_to_force_then_to_the_earlier_frame() {
        check(
            &[(5, 1.), (5, 3.), (5, 3.), (5, 2.), (0, 0.), (0, 0.)],
            "b1@0 e@5:last3 n4 peak1",
        );
    }

    #[test]
    fn a_held_press_times_out_once_and_waits_for_release() {
        let settings = Settings {
            max_seconds: 1.0,
            early_settle_s: 9.0,
            ..Settings::default()
        };
        let mut loads = vec![(5, 2.0); 8];
        loads.extend([(0, 0.0), (5, 2.0), (0, 0.0), (0, 0.0), (5, 2.0)]);
        assert_eq!(track(&settings, &loads, 5), "b1@0 t@5:last5 n6 peak0 b2@12");
    }

    #[test]
    fn settled_contact_is_reported_once_and_never_while_the_load_rises() {
        // At 5 frames/s three frames within 5 % span 0.4 s.
        check(
            &[(5, 2.), (9, 6.), (12, 10.), (12, 9.9), (12, 9.8), (12, 9.8)],
            "b1@0 s@4:2",
        );
        // 6 % a frame: every new frame leaves the one two before it behind.
        let rising: Vec<(usize, f32)> = (0..20).map(|i| (30, 4.0 * 1.06_f32.powi(i))).collect();
        check(&rising, "b1@0");
        // Too light.
        check(&[(5, 0.9); 5], "b1@0");
    }

    #[test]
    fn settling_needs_its_time_at_high_rates() {
        let settings = Settings::default();
        let text = track(&settings, &[(10, 5.0); 40], 100);
        assert_eq!(text, "b1@0 s@30:0");
    }

    #[test]
    fn an_aborted_press_leaves_the_tracker_idle() {
        let mut tracker = PressTracker::new(Settings::default());
        assert_eq!(tracker.abort(Abort::Lost), None);
        let _ = tracker.push(&frame(5, 2.0), moment(0, 5));
        assert!(matches!(
            tracker.abort(Abort::Lost),
            Some(Change::Aborted {
                press: 1,
                frames: 1,
                reason: Abort::Lost,
                ..
            })
        ));
        assert!(!tracker.is_pressed());
    }

    #[test]
    fn what_is_out_of_range_is_told_as_it_was_written() {
        let settings = Settings {
            contact_threshold_n: -0.07,
            ..Settings::default()
        };
        let told = settings.check().unwrap_err().to_string();
        assert!(
            told.starts_with("contact_threshold_n: found -0.07, expected"),
            "{told}"
        );
    }
}
