//! The course of a press: its frames in contact so far, in bounded memory.

use std::time::Duration;

use super::{ContactFrame, is_greater};

/// The largest number of frames that are held. When there are more, every second one is dropped,
/// and from then on only every second, fourth, ... frame is held.
const MOST_HELD: usize = 512;

/// The frames in contact so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct HeldFrames {
    /// Frames 0, `stride`, 2 `stride`, ... of the frames in contact.
    held: Vec<ContactFrame>,
    stride: u64,
    /// The last frame in contact.
    newest: Option<ContactFrame>,
    count: u64,
}

impl HeldFrames {
    pub(super) fn push(&mut self, frame: ContactFrame) {
        self.stride = self.stride.max(1);
        if self.count.is_multiple_of(self.stride) {
            if self.held.len() == MOST_HELD {
                self.stride *= 2;
                let mut keep = false;
                self.held.retain(|_| {
                    keep = !keep;
                    keep
                });
            }
            if self.count.is_multiple_of(self.stride) {
                self.held.push(frame.clone());
            }
        }
        self.newest = Some(frame);
        self.count += 1;
    }

    /// The frames up to `until`, by their times, and the place of the best frame among them. `peak`
    /// is the best frame of the whole press.
    pub(super) fn until<'a>(
        &'a self,
        until: Duration,
        peak: &'a ContactFrame,
    ) -> (Vec<&'a ContactFrame>, usize) {
        let all = self.held.iter().chain(&self.newest).chain([peak]);
        let mut frames: Vec<&ContactFrame> = all.filter(|f| f.moment.stamp.mono <= until).collect();
        frames.sort_by_key(|frame| frame.moment.frame);
        frames.dedup_by_key(|frame| frame.moment.frame);
        let peak = |frame: &&ContactFrame| frame.moment.frame == peak.moment.frame;
        let best = frames.iter().position(peak).unwrap_or_else(|| {
            (1..frames.len()).fold(0, |best, place| {
                if is_greater(frames[place], frames[best]) {
                    place
                } else {
                    best
                }
            })
        });
        (frames, best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Frame, Stamp};
    use crate::press::{FrameAt, Marks};

    fn frame(number: u64, area: u32) -> ContactFrame {
        let mut frame = Frame::default();
        frame.newtons[(number % 784) as usize] = 0.5 + number as f32;
        ContactFrame {
            moment: FrameAt {
                frame: number,
                stamp: Stamp {
                    mono: Duration::from_millis(10 * number),
                    wall: jiff::Timestamp::UNIX_EPOCH,
                },
            },
            force_n: frame.force_n(),
            frame: std::sync::Arc::new(frame),
            marks: Marks::default(),
            contact_area_taxels: area,
        }
    }

    #[test]
    fn first_best_and_last_are_held_and_the_rest_is_even() {
        for count in [1, 2, 511, 512, 513, 1024, 1025, 5000] {
            let best = count / 3;
            let area = |number| if number == best { 9 } else { 5 };
            let mut course = HeldFrames::default();
            (0..count).for_each(|number| course.push(frame(number, area(number))));
            let peak = frame(best, 9);
            let (frames, found) = course.until(Duration::MAX, &peak);
            let numbers: Vec<u64> = frames.iter().map(|frame| frame.moment.frame).collect();
            assert_eq!(numbers[found], best, "{count}");
            assert_eq!((numbers[0], numbers.last()), (0, Some(&(count - 1))));
            assert!(numbers.is_sorted_by(|one, next| one < next));
            assert!(numbers.len() >= 256.min(count as usize) && numbers.len() <= 514);
            let widest = numbers.windows(2).map(|pair| pair[1] - pair[0]).max();
            assert!(widest.unwrap_or(1) <= count.div_ceil(256), "{count}");
            if count <= 512 {
                assert_eq!(numbers.len() as u64, count);
            }
        }
    }

    #[test]
    fn the_best_frame_of_a_part_is_the_best_until_then() {
        let mut course = HeldFrames::default();
        let areas = [3, 5, 5, 4, 8, 8, 2];
        for (number, area) in (0..).zip(areas) {
            course.push(frame(number, area));
        }
        let peak = frame(5, 8);
        for (until_ms, best, length) in [(0, 0, 1), (15, 1, 2), (30, 2, 4), (40, 4, 5), (99, 5, 7)]
        {
            let (frames, found) = course.until(Duration::from_millis(until_ms), &peak);
            assert_eq!((frames[found].moment.frame, frames.len()), (best, length));
        }
    }
}
