//! A press up to now: its frames in contact, in bounded memory.

use std::cmp::Ordering;
use std::time::Duration;

use super::{ContactFrame, FrameAt};

/// The largest number of frames that are held, beside the best one. When there are more, every second one
/// is dropped, and from then on only every second, fourth, ... frame is held.
const MOST_HELD: usize = 512;

/// The frames in contact of a press up to now.
#[derive(Debug, Clone, PartialEq)]
pub struct SoFar {
    /// The press's number.
    pub press: u64,
    /// When its first frame came.
    pub began: Duration,
    /// The number of frames in contact.
    pub frames: u64,
    /// The best frame.
    pub peak: ContactFrame,
    /// Whether the contact has settled.
    pub is_settled: bool,
    /// Frames 0, `stride`, 2 `stride`, ... of the frames in contact, and the last one.
    held: Vec<ContactFrame>,
    stride: u64,
}

impl SoFar {
    /// The press that begins with this frame.
    pub(super) fn new(press: u64, first: ContactFrame) -> Self {
        Self {
            press,
            peak: first.clone(),
            began: first.moment.stamp.mono,
            is_settled: false,
            held: vec![first],
            stride: 1,
            frames: 1,
        }
    }

    pub(super) fn push(&mut self, frame: ContactFrame) {
        if is_greater(&frame, &self.peak) {
            self.peak = frame.clone();
        }
        if !(self.frames - 1).is_multiple_of(self.stride) {
            self.held.pop();
        }
        self.held.push(frame);
        self.frames += 1;
        if self.held.len() > MOST_HELD {
            self.stride *= 2;
            let mut keep = false;
            self.held.retain(|_| {
                keep = !keep;
                keep
            });
        }
    }

    /// Its last frame in contact.
    pub fn last(&self) -> FrameAt {
        self.held[self.held.len() - 1].moment
    }

    /// Its frames, evenly spread over the press, some hundred at most. A short press has all its frames.
    pub fn spread(&self) -> Vec<&ContactFrame> {
        let mut frames: Vec<&ContactFrame> = self.held.iter().chain([&self.peak]).collect();
        frames.sort_by_key(|frame| frame.moment.frame);
        frames.dedup_by_key(|frame| frame.moment.frame);
        frames
    }

    /// The place of the best frame among these first frames of the press.
    pub fn best_of(&self, frames: &[&ContactFrame]) -> usize {
        let is_peak = |frame: &&ContactFrame| frame.moment.frame == self.peak.moment.frame;
        let better = |best, place| match is_greater(frames[place], frames[best]) {
            true => place,
            false => best,
        };
        let known = frames.iter().position(is_peak);
        known.unwrap_or_else(|| (1..frames.len()).fold(0, better))
    }
}

/// The largest share by which two equal forces may differ. Each taxel is an f32 and is rounded twice:
/// when the baseline is subtracted, and when counts become newtons.
const ROUNDING: f64 = 2.0 * f32::EPSILON as f64;

/// Whether `one` is better than `other`, which came before it.
fn is_greater(one: &ContactFrame, other: &ContactFrame) -> bool {
    match one.contact_area_taxels.cmp(&other.contact_area_taxels) {
        Ordering::Less => false,
        Ordering::Equal => one.force_n > other.force_n * (1.0 + ROUNDING),
        Ordering::Greater => true,
    }
}
