//! Simulated frames as the daemon's press tracker sees them.
//!
//! In: frames at a steady rate, with the sensor unloaded before the first. Out: the frames of the
//! single press among them.

use std::time::Duration;

use hardnessd_core::frame::{Frame, Stamp};
use hardnessd_core::press::{Change, ContactFrame, End, FrameAt, PressTracker, Thresholds};

/// Whether a press tracker of a JX255N begins a press with this frame.
pub(super) fn begins_press(frame: &Frame) -> bool {
    let usual = Thresholds::default();
    frame.contact_area_taxels(usual.contact_threshold_n) >= usual.begin_area_taxels
}

/// The single press among some frames, by the frames' indices.
pub(super) struct Seen {
    /// Frames in contact, from the one that began the press to its last.
    pub(super) contact: Vec<usize>,
    /// The frame that is judged.
    pub(super) best: usize,
}

/// The press that a press tracker sees in these frames, when frames without load follow. `None`
/// unless there is exactly one press and it ends with a release.
pub(super) fn one_press(frames: &[Frame], thresholds: &Thresholds, period_s: f64) -> Option<Seen> {
    let free = Frame::zero(frames.first()?.array);
    let rest = std::iter::repeat_n(&free, thresholds.settings.end_frames as usize);
    let mut tracker = PressTracker::new(thresholds.clone());
    let (mut contact, mut best) = (Vec::new(), None);
    for (number, frame) in (0_u32..).zip(frames.iter().chain(rest)) {
        let at = FrameAt {
            frame: number.into(),
            stamp: Stamp {
                mono: Duration::from_secs_f64(period_s * f64::from(number)),
                wall: jiff::Timestamp::UNIX_EPOCH,
            },
        };
        let felt = ContactFrame::new(frame, thresholds.contact_threshold_n, at);
        let area = felt.contact_area_taxels;
        match tracker.push(felt) {
            Some(Change::Begin { .. }) if best.is_some() => return None,
            None | Some(Change::Begin { .. }) => {}
            Some(Change::End {
                end: End::Release,
                press,
            }) => best = Some(press.peak.moment.frame as usize),
            Some(Change::End { .. }) => return None,
        }
        if tracker.is_pressed() && area >= thresholds.end_area_taxels {
            contact.push(number as usize);
        }
    }
    best.map(|best| Seen { contact, best })
}
