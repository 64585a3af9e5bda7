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
use hardnessd_simulator::{FULL_SCALE_COUNTS, NEWTONS_PER_COUNT};

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
    ///
    /// The taxels are struck first, then the bytes and the cable, each in the order of the script.
    pub(crate) fn encode(
        &mut self,
        time_s: f64,
        mut raw: RawFrame,
        layout: &Layout,
        bytes: &mut Vec<u8>,
    ) -> Line {
        for fault in &mut self.faults {
            strike_taxels(fault, time_s, &mut raw);
        }
        bytes.clear();
        layout.encode(&middle(&raw, layout.array()), bytes);
        let mut line = Line::Up;
        for fault in &mut self.faults {
            strike_bytes(fault, time_s, &mut self.stream, bytes);
            let kind = fault.kind;
            match kind {
                Kind::Unplug {} if fault.strikes(time_s) => line = Line::Unplugged,
                Kind::Silence {} if line == Line::Up && fault.strikes(time_s) => {
                    line = Line::Silent;
                }
                _ => {}
            }
        }
        line
    }
}

/// Changes what taxels of a frame read, if the fault is of taxels.
fn strike_taxels(fault: &mut Fault, time_s: f64, raw: &mut RawFrame) {
    let (stuck, newtons) = match fault.kind {
        Kind::Stuck { counts } => (Some(counts), 0.0),
        Kind::Drift { newtons_per_hour } => {
            let hours = (time_s - fault.at_s).min(fault.for_s) / 3600.0;
            (None, newtons_per_hour * hours)
        }
        _ => return,
    };
    if !fault.strikes(time_s) {
        return;
    }
    let Fault { rows, cols, .. } = *fault;
    let more = newtons / f64::from(NEWTONS_PER_COUNT);
    let most = f64::from(FULL_SCALE_COUNTS);
    for row in rows[0]..=rows[1] {
        let places = raw.array.place(row, cols[0])..=raw.array.place(row, cols[1]);
        for count in &mut raw.counts[places] {
            let changed = (f64::from(*count) + more).round().clamp(0.0, most) as f32;
            *count = stuck.map_or(changed, f32::from);
        }
    }
}

/// Damages the bytes of a frame, if the fault is of bytes.
fn strike_bytes(fault: &mut Fault, time_s: f64, stream: &mut Stream, frame: &mut Vec<u8>) {
    let kind = fault.kind;
    match kind {
        Kind::Noise { bytes, .. } if fault.strikes(time_s) => {
            let noise = (0..bytes).map(|_| (stream.next_u64() >> 56) as u8);
            let noise: Vec<u8> = noise.collect();
            frame.splice(0..0, noise);
        }
        Kind::DropBytes { bytes, .. } if fault.strikes(time_s) => {
            for _ in 0..bytes.min(frame.len()) {
                frame.remove(stream.below(frame.len()));
            }
        }
        Kind::Flip { bits, .. } if fault.strikes(time_s) => {
            // If all bytes were dropped, there is no bit to invert.
            let bits = if frame.is_empty() { 0 } else { bits };
            for _ in 0..bits {
                let bit = stream.below(frame.len() * 8);
                frame[bit / 8] ^= 1 << (bit % 8);
            }
        }
        _ => {}
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
    use hardnessd_core::wire::{Decoder, Settings};

    /// A script at work on frames whose taxels all read `rest`.
    struct Played {
        faults: Faults,
        layout: Layout,
        rest: f32,
    }

    impl Played {
        fn new(script: &str, rest: f32) -> Self {
            Self {
                faults: Faults::of(script::parse(script).unwrap(), 1),
                layout: Layout::new(&Settings::default()).unwrap(),
                rest,
            }
        }

        fn whole(&self) -> Vec<u8> {
            let mut whole = Vec::new();
            let mut raw = RawFrame::default();
            raw.counts.fill(self.rest);
            self.layout.encode(&raw, &mut whole);
            whole
        }

        fn at(&mut self, time_s: f64) -> (Line, Vec<u8>) {
            let mut raw = RawFrame::default();
            raw.counts.fill(self.rest);
            let mut bytes = vec![1, 2, 3];
            let line = self.faults.encode(time_s, raw, &self.layout, &mut bytes);
            (line, bytes)
        }

        /// The frame of whole bytes at a time.
        fn frame(&mut self, time_s: f64) -> RawFrame {
            let (line, bytes) = self.at(time_s);
            assert_eq!(line, Line::Up);
            let mut decoder = Decoder::new(self.layout.clone());
            decoder.push(&bytes);
            decoder.next_frame().unwrap().unwrap().frame
        }
    }

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
        let mut played = Played::new(script, 0.0);
        let whole = played.whole();
        let mut struck = |time_s| {
            let (line, bytes) = played.at(time_s);
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

    #[test]
    fn each_kind_does_to_its_taxels_what_it_says() {
        let script = r#"
            [[fault]]
            at_s = 1.0
            kind = "stuck"
            rows = [2, 2]
            cols = [3, 4]
            for_s = 0.5
            [[fault]]
            at_s = 2.0
            kind = "stuck"
            counts = 0
            rows = [27, 27]
            for_s = 0.5
            [[fault]]
            at_s = 10.0
            kind = "drift"
            newtons_per_hour = 0.5
            for_s = 3600.0
            [[fault]]
            at_s = 5000.0
            kind = "drift"
            rows = [0, 0]
            newtons_per_hour = -100.0
        "#;
        let mut played = Played::new(script, 7.0);
        // The taxels that read another number than at rest, and that number.
        let mut other = |time_s| {
            let raw = played.frame(time_s);
            let places = (0..784).filter(|&place| raw.counts[place] != 7.0);
            let places: Vec<usize> = places.collect();
            (
                places.len(),
                places.first().map(|&place| (place, raw.counts[place])),
            )
        };
        assert_eq!(other(0.9), (0, None));
        assert_eq!(other(1.0), (2, Some((2 * 28 + 3, 255.0))));
        assert_eq!(other(1.5), (0, None));
        assert_eq!(other(2.0), (28, Some((27 * 28, 0.0))));
        assert_eq!(other(2.5), (0, None));
        // A count is 0.04 N, which 0.5 N an hour reach in 288 s.
        assert_eq!(other(10.0 + 140.0), (0, None));
        assert_eq!(other(10.0 + 150.0), (784, Some((0, 8.0))));
        assert_eq!(other(10.0 + 3500.0), (784, Some((0, 19.0))));
        // After its hour it stays.
        assert_eq!(other(4999.0), (784, Some((0, 20.0))));
        // No taxel reads less than nothing.
        assert_eq!(other(9000.0), (784, Some((0, 0.0))));
        assert_eq!(played.frame(9000.0).counts[28], 20.0);
    }
}
