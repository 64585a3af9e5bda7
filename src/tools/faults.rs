//! Faults of a simulated sensor and its line, from a script. The same script and seed give the same
//! faults.
//!
//! In: a TOML file of `[[fault]]` tables, and frames. Out: the bytes to send, and whether to send
//! them. Times are in seconds of the sensor since its start. The seed decides which bytes and bits
//! are hit.

mod bytes;
mod cable;
mod script;
mod taxels;
mod times;

use std::path::Path;

use self::bytes::OfBytes;
use self::cable::Cable;
pub(crate) use self::cable::Line;
pub(crate) use self::script::{Error, FORMAT};
use self::taxels::OfTaxels;
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::Layout;
use hardnessd_simulator::random::Stream;

/// A script that is being played.
#[derive(Debug)]
pub(crate) struct Faults {
    taxels: Vec<OfTaxels>,
    bytes: Vec<OfBytes>,
    cable: Cable,
    stream: Stream,
}

impl Faults {
    /// No faults.
    pub(crate) fn none() -> Self {
        Self::of(script::Faults::default(), 0)
    }

    /// Reads a script.
    ///
    /// # Errors
    ///
    /// Fails if the script cannot be read, or has a key or value that cannot be used.
    pub(crate) fn load(path: &Path, seed: u64) -> Result<Self, Error> {
        Ok(Self::of(script::load(path)?, seed))
    }

    fn of(faults: script::Faults, seed: u64) -> Self {
        Self {
            taxels: faults.taxels,
            bytes: faults.bytes,
            cable: Cable::new(faults.cable),
            stream: Stream::new(seed, "faults"),
        }
    }

    /// Replaces `bytes` by those of the frame due at `time_s`, damaged as the script says, and
    /// returns how to send them. Call it for the frames in order.
    ///
    /// The taxels are struck first, then the bytes, then the cable; among these, faults strike in
    /// the order of the script.
    pub(crate) fn encode(
        &mut self,
        time_s: f64,
        mut raw: RawFrame,
        layout: &Layout,
        bytes: &mut Vec<u8>,
    ) -> Line {
        for fault in &self.taxels {
            fault.strike(time_s, &mut raw);
        }
        bytes.clear();
        layout.encode(&middle(&raw, layout.array()), bytes);
        for fault in &mut self.bytes {
            fault.strike(time_s, &mut self.stream, bytes);
        }
        self.cable.strike(time_s, bytes)
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
        rest: u16,
    }

    impl Played {
        fn new(script: &str, rest: u16) -> Self {
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
            [[fault]]
            at_s = 6.0
            kind = "repeat"
            frames = 2
        "#;
        let mut played = Played::new(script, 0);
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
        assert_eq!(struck(6.0), (Line::Up, 1580, 0));
        assert_eq!(struck(6.2), (Line::Up, 1580, 0));
        assert_eq!(struck(6.4), (Line::Up, 790, 0));
    }

    #[test]
    fn half_a_frame_comes_with_or_without_its_other_half_and_a_stall_loses_nothing() {
        let script = r#"
            [[fault]]
            at_s = 1.0
            kind = "half"
            for_s = 0.5
            [[fault]]
            at_s = 2.0
            kind = "half"
            for_s = 0.5
            other_half = true
            [[fault]]
            at_s = 3.0
            kind = "stall"
            for_s = 0.5
            [[fault]]
            at_s = 4.0
            kind = "stall"
            for_s = 0.5
            [[fault]]
            at_s = 4.2
            kind = "unplug"
            for_s = 0.1
        "#;
        let mut played = Played::new(script, 9);
        let whole = played.whole();
        let (head, tail) = whole.split_at(395);
        assert_eq!(played.at(1.0), (Line::Up, head.to_vec()));
        assert_eq!(played.at(1.2).0, Line::Silent);
        assert_eq!(played.at(1.5), (Line::Up, whole.clone()));
        assert_eq!(played.at(2.1), (Line::Up, head.to_vec()));
        assert_eq!(played.at(2.2).0, Line::Silent);
        assert_eq!(played.at(2.6), (Line::AtOnce, [tail, &whole].concat()));
        assert_eq!(played.at(2.8), (Line::Up, whole.clone()));
        assert_eq!(played.at(3.0).0, Line::Silent);
        assert_eq!(played.at(3.4).0, Line::Silent);
        assert_eq!(played.at(3.5), (Line::AtOnce, whole.repeat(3)));
        assert_eq!(played.at(3.6), (Line::Up, whole.clone()));
        // What was held back is lost with the cable.
        assert_eq!(played.at(4.0).0, Line::Silent);
        assert_eq!(played.at(4.2).0, Line::Unplugged);
        assert_eq!(played.at(4.4).0, Line::Silent);
        assert_eq!(played.at(4.5), (Line::AtOnce, whole.repeat(2)));
    }

    #[test]
    fn at_a_wrong_baud_rate_no_frame_is_read() {
        let script = "[[fault]]\nat_s = 1.0\nkind = \"wrong-baud\"\nratio = 0.5\nfor_s = 1.0\n";
        let mut played = Played::new(script, 9);
        let whole = played.whole();
        assert_eq!(played.at(0.5), (Line::Up, whole.clone()));
        let (line, bytes) = played.at(1.5);
        assert_eq!(line, Line::AtOnce);
        assert!(bytes.len() < whole.len(), "{}", bytes.len());
        let mut decoder = Decoder::new(played.layout.clone());
        decoder.push(&bytes);
        assert!(!matches!(decoder.next_frame(), Some(Ok(_))));
        assert_eq!(played.at(2.0), (Line::Up, whole));
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
            kind = "dead"
            rows = [27, 27]
            for_s = 0.5
            [[fault]]
            at_s = 3.0
            kind = "contact"
            cols = [5, 6]
            newtons = 0.4
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
        let mut played = Played::new(script, 7);
        // The taxels that read another number than at rest, and that number.
        let mut other = |time_s| {
            let raw = played.frame(time_s);
            let places = (0..784).filter(|&place| raw.counts[place] != 7);
            let places: Vec<usize> = places.collect();
            (
                places.len(),
                places.first().map(|&place| (place, raw.counts[place])),
            )
        };
        assert_eq!(other(0.9), (0, None));
        assert_eq!(other(1.0), (2, Some((2 * 28 + 3, 255))));
        assert_eq!(other(1.5), (0, None));
        assert_eq!(other(2.0), (28, Some((27 * 28, 0))));
        assert_eq!(other(2.5), (0, None));
        assert_eq!(other(3.4), (56, Some((5, 17))));
        assert_eq!(other(4.0), (0, None));
        // A count is 0.04 N, which 0.5 N an hour reach in 288 s.
        assert_eq!(other(10.0 + 140.0), (0, None));
        assert_eq!(other(10.0 + 150.0), (784, Some((0, 8))));
        assert_eq!(other(10.0 + 3500.0), (784, Some((0, 19))));
        // After its hour it stays.
        assert_eq!(other(4999.0), (784, Some((0, 20))));
        // No taxel reads less than nothing.
        assert_eq!(other(9000.0), (784, Some((0, 0))));
        assert_eq!(played.frame(9000.0).counts[28], 20);
    }

    #[test]
    fn a_frame_of_which_nothing_is_left_has_no_bits_to_flip() {
        let script = r#"
            [[fault]]
            at_s = 1.0
            kind = "drop-bytes"
            bytes = 1000
            [[fault]]
            at_s = 1.0
            kind = "flip"
            bits = 3
        "#;
        assert_eq!(Played::new(script, 0).at(1.0), (Line::Up, Vec::new()));
    }
}
