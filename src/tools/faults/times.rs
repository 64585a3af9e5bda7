//! When a fault is: for a time, or for a number of frames.

/// A time, in seconds of the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Span {
    pub(super) from_s: f64,
    /// Infinite for a fault that does not end.
    pub(super) to_s: f64,
}

impl Span {
    pub(super) fn has(&self, time_s: f64) -> bool {
        (self.from_s..self.to_s).contains(&time_s)
    }
}

/// A number of frames, from the first one at or after a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Frames {
    pub(super) from_s: f64,
    pub(super) left: u64,
}

impl Frames {
    /// Whether the frame at `time_s` is one of them.
    pub(super) fn take(&mut self, time_s: f64) -> bool {
        let takes = time_s >= self.from_s && self.left > 0;
        self.left -= u64::from(takes);
        takes
    }
}
