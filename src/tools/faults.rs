//! Faults of a simulated sensor and its line, from a script. The same script and seed give the same
//! faults.
//!
//! In: a TOML file of `[[fault]]` tables, and frames. Out: the bytes to send, and whether to send
//! them. Times are in seconds of the sensor since its start. The seed decides which bytes and bits
//! are hit.

mod script;

use std::path::Path;

pub(crate) use self::script::FORMAT;
use self::script::{Fault, Kind};
use super::exit::Failure;
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::Layout;
use hardnessd_simulator::random::Stream;

/// The state of the line at a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Line {
    /// Send the bytes.
    Up,
    /// Send nothing.
    Silent,
    /// Send nothing, and remove the port.
    Unplugged,
}

/// A script that is being played.
#[derive(Debug)]
pub(crate) struct Faults {
    faults: Vec<Fault>,
    stream: Stream,
}

impl Faults {
    /// No faults.
    pub(crate) fn none() -> Self {
        Self::of(Vec::new(), 0)
    }

    /// Reads a script.
    ///
    /// # Errors
    ///
    /// Fails if the script cannot be read, or has a key or value that cannot be used.
    pub(crate) fn load(path: &Path, seed: u64) -> Result<Self, Failure> {
        Ok(Self::of(script::load(path)?, seed))
    }

    fn of(faults: Vec<Fault>, seed: u64) -> Self {
        Self {
            faults,
            stream: Stream::new(seed, "faults"),
        }
    }

    /// Replaces `bytes` by those of the frame due at `time_s`, damaged as the script says, and
    /// returns how to send them. Call it for the frames in order.
    pub(crate) fn encode(
        &mut self,
        time_s: f64,
        raw: &RawFrame,
        layout: &Layout,
        bytes: &mut Vec<u8>,
    ) -> Line {
        bytes.clear();
        layout.encode(&middle(raw, layout.array()), bytes);
        let mut line = Line::Up;
        for fault in &mut self.faults {
            if !fault.strikes(time_s) {
                continue;
            }
            match fault.kind {
                Kind::Unplug {} => line = Line::Unplugged,
                Kind::Silence {} if line == Line::Unplugged => {}
                Kind::Silence {} => line = Line::Silent,
                Kind::Noise { bytes: count } => {
                    let noise = (0..count).map(|_| (self.stream.next_u64() >> 56) as u8);
                    bytes.splice(0..0, noise.collect::<Vec<u8>>());
                }
                Kind::DropBytes { bytes: count } => {
                    for _ in 0..count.min(bytes.len()) {
                        bytes.remove(self.stream.below(bytes.len()));
                    }
                }
                // If all bytes were dropped, there is no bit to invert.
                Kind::Flip { .. } if bytes.is_empty() => {}
                Kind::Flip { bits } => {
                    for _ in 0..bits {
                        let bit = self.stream.below(bytes.len() * 8);
                        bytes[bit / 8] ^= 1 << (bit % 8);
                    }
                }
            }
        }
        line
    }
}

/// The middle of a frame of the simulated array, as another array has it. Taxels that the simulated
/// one lacks read 0.
pub(super) fn middle(raw: &RawFrame, array: Array) -> RawFrame {
    let mut cut = RawFrame::zero(array);
    let place = |own: usize, side: usize, other: usize| {
        (own + other / 2)
            .checked_sub(side / 2)
            .filter(|&at| at < other)
    };
    for row in 0..array.rows {
        for col in 0..array.cols {
            let from_row = place(row, array.rows, raw.array.rows);
            let from_col = place(col, array.cols, raw.array.cols);
            if let (Some(from_row), Some(from_col)) = (from_row, from_col) {
                let count = raw.counts[raw.array.place(from_row, from_col)];
                cut.counts[array.place(row, col)] = count;
            }
        }
    }
    cut
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::wire::Settings;

    #[test]
    fn each_kind_does_to_the_line_what_it_says() {
        let script = r#"
            [[fault]]
            at_s = 1.0
            kind = "unplug"
            for_s = 0.5
            [[fault]]
            at_s = 2.0
            kind = "silence"
            for_s = 0.5
            [[fault]]
            at_s = 3.0
            kind = "noise"
            bytes = 7
            [[fault]]
            at_s = 4.0
            kind = "drop-bytes"
            bytes = 3
            frames = 2
            [[fault]]
            at_s = 5.0
            kind = "flip"
        "#;
        let mut faults = Faults::of(script::parse(script).unwrap(), 1);
        let layout = Layout::new(&Settings::default()).unwrap();
        let (raw, mut whole) = (RawFrame::default(), Vec::new());
        layout.encode(&raw, &mut whole);
        let mut struck = |time_s| {
            let mut bytes = vec![1, 2, 3];
            let line = faults.encode(time_s, &raw, &layout, &mut bytes);
            let flipped = bytes.iter().zip(&whole);
            let flipped: u32 = flipped.map(|(a, b)| (a ^ b).count_ones()).sum();
            (line, bytes.len(), flipped)
        };
        assert_eq!(struck(0.9), (Line::Up, 790, 0));
        assert_eq!(struck(1.0).0, Line::Unplugged);
        assert_eq!(struck(1.5), (Line::Up, 790, 0));
        assert_eq!(struck(2.2).0, Line::Silent);
        assert_eq!(struck(3.1).1, 797);
        assert_eq!(struck(3.2), (Line::Up, 790, 0));
        assert_eq!(struck(4.0).1, 787);
        assert_eq!(struck(4.2).1, 787);
        assert_eq!(struck(4.4), (Line::Up, 790, 0));
        assert_eq!(struck(5.0), (Line::Up, 790, 1));
        assert_eq!(struck(5.2), (Line::Up, 790, 0));
    }
}
