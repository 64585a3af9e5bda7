//! Faults of a simulated line, from a script. The same script and seed give the same faults.
//!
//! In: a TOML file of `[[fault]]` tables, and frames. Out: frames with damage, and whether to send
//! each. Times are in seconds of the sensor since its start. The seed decides which bytes and bits
//! are hit.

mod script;

use std::path::Path;

use self::script::Fault;
pub(crate) use self::script::{Error, FORMAT};
use crate::random::Stream;

/// The state of the line at a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Line {
    /// Send the frame, with its damage.
    Up,
    /// Do not send the frame.
    Silent,
    /// Do not send the frame, and remove the port.
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
    pub(crate) fn load(path: &Path, seed: u64) -> Result<Self, Error> {
        Ok(Self::of(script::load(path)?, seed))
    }

    fn of(faults: Vec<Fault>, seed: u64) -> Self {
        Self {
            faults,
            stream: Stream::new(seed, "faults"),
        }
    }

    /// Damages the frame due at `time_s` as the script says, and returns whether to send it. Call
    /// it for the frames in order.
    pub(crate) fn strike(&mut self, time_s: f64, frame: &mut Vec<u8>) -> Line {
        let mut line = Line::Up;
        let stream = &mut self.stream;
        for fault in &mut self.faults {
            match fault {
                Fault::Unplug { from_s, to_s } if (*from_s..*to_s).contains(&time_s) => {
                    line = Line::Unplugged;
                }
                Fault::Silence { from_s, to_s }
                    if (*from_s..*to_s).contains(&time_s) && line == Line::Up =>
                {
                    line = Line::Silent;
                }
                Fault::Noise {
                    from_s,
                    bytes,
                    frames,
                } if time_s >= *from_s && *frames > 0 => {
                    *frames -= 1;
                    let noise = (0..*bytes).map(|_| (stream.next_u64() >> 56) as u8);
                    let noise: Vec<u8> = noise.collect();
                    frame.splice(0..0, noise);
                }
                Fault::DropBytes {
                    from_s,
                    bytes,
                    frames,
                } if time_s >= *from_s && *frames > 0 => {
                    *frames -= 1;
                    for _ in 0..(*bytes).min(frame.len()) {
                        frame.remove(stream.below(frame.len()));
                    }
                }
                Fault::Flip {
                    from_s,
                    bits,
                    frames,
                } if time_s >= *from_s && *frames > 0 => {
                    *frames -= 1;
                    // If all bytes were dropped, there is no bit to invert.
                    let bits = if frame.is_empty() { 0 } else { *bits };
                    for _ in 0..bits {
                        let bit = stream.below(frame.len() * 8);
                        frame[bit / 8] ^= 1 << (bit % 8);
                    }
                }
                _ => {}
            }
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let whole = vec![0_u8; 100];
        let mut struck = |time_s| {
            let mut frame = whole.clone();
            let line = faults.strike(time_s, &mut frame);
            let flipped: u32 = frame.iter().map(|byte| byte.count_ones()).sum();
            (line, frame.len(), flipped)
        };
        assert_eq!(struck(0.9), (Line::Up, 100, 0));
        assert_eq!(struck(1.0), (Line::Unplugged, 100, 0));
        assert_eq!(struck(1.5), (Line::Up, 100, 0));
        assert_eq!(struck(2.2), (Line::Silent, 100, 0));
        assert_eq!(struck(3.1).1, 107);
        assert_eq!(struck(3.2), (Line::Up, 100, 0));
        assert_eq!(struck(4.0), (Line::Up, 97, 0));
        assert_eq!(struck(4.2), (Line::Up, 97, 0));
        assert_eq!(struck(4.4), (Line::Up, 100, 0));
        assert_eq!(struck(5.0), (Line::Up, 100, 1));
        assert_eq!(struck(5.2), (Line::Up, 100, 0));
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
        let mut faults = Faults::of(script::parse(script).unwrap(), 1);
        let mut frame = vec![0_u8; 100];
        assert_eq!(faults.strike(1.0, &mut frame), Line::Up);
        assert!(frame.is_empty());
    }
}
