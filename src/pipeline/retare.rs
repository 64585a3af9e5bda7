//! The tares of a pipeline: the first, and those asked for later.

use super::Pipeline;
use super::link::Link;
use crate::event::Tared;
use crate::frame::RawFrame;
use crate::tare::Progress;

/// Why a tare was not taken on request; the offsets stay as they were.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum RetareError {
    /// What is pressed now would be zeroed away.
    #[error("found a press, expected none")]
    Pressed,
    /// What rests on the sensor would be.
    #[error("found the sensor touched, expected it free")]
    Touched,
    /// No frames to average.
    #[error("found a sensor that is not live, expected frames")]
    NotLive,
    /// Its outcome has to come first.
    #[error("found a tare under way, expected none")]
    UnderWay,
    /// `tare_frames` is 0.
    #[error("found calibration.tare_frames = 0, expected 1 or more")]
    NoFrames,
}

impl Pipeline {
    /// Takes another tare from the next frames on; [`Self::retared`] tells what became of it. A
    /// press that timed out is over: a drift that looks like one is mended so.
    ///
    /// # Errors
    ///
    /// If one cannot be taken now: see [`RetareError`]. Nothing has changed then.
    pub fn retare(&mut self) -> Result<(), RetareError> {
        if self.tracker.is_pressed() {
            return Err(RetareError::Pressed);
        }
        if !matches!(self.seen.link, Link::Live { .. }) {
            return Err(RetareError::NotLive);
        }
        if self.tare.is_taking() {
            return Err(RetareError::UnderWay);
        }
        if !self.tare.retake() {
            return Err(RetareError::NoFrames);
        }
        self.seen.retaring = Some(self.tare.offsets());
        Ok(())
    }

    /// What became of a tare that was asked for, once.
    pub fn retared(&mut self) -> Option<Result<Tared, RetareError>> {
        self.retared.take()
    }

    /// Shows the tare a frame. A first tare is tried until it is taken; one that was asked for is
    /// given up when the sensor is touched, for a baseline stands.
    pub(super) fn observe(&mut self, raw: &RawFrame) {
        match self.tare.observe(raw) {
            Progress::Ready | Progress::Taking => {}
            Progress::Contact if self.seen.retaring.is_some() => {
                self.abandon_retare(RetareError::Touched);
            }
            Progress::Contact => self.seen.tare_met_contact = true,
            Progress::Taken => {
                self.seen.tare_met_contact = false;
                if let Some(old) = self.seen.retaring.take() {
                    self.retared = Some(Ok(Tared {
                        sensor: self.sensor.clone(),
                        old,
                        new: self.tare.offsets(),
                    }));
                }
            }
        }
    }

    /// Keeps the offsets; whoever asked for others is told why.
    pub(super) fn abandon_retare(&mut self, reason: RetareError) {
        if self.seen.retaring.take().is_some() {
            self.tare.give_up();
            self.retared = Some(Err(reason));
        }
    }
}
