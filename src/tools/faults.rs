//! Faults of a simulated line, from a script. The same script and seed give the same faults.
//!
//! In: a TOML file of `[[fault]]` tables. Out: what becomes of each frame. Times are in seconds of
//! the sensor since it started; which bytes and bits are hit follows from the seed.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::random::Stream;
use crate::wording;

/// The file format, for `--help`.
pub(crate) const FORMAT: &str = r#"The faults of --faults FILE, a TOML file; times in the sensor's seconds from the start:

  [[fault]]
  at_s = 12.0            # from the first frame at or after this
  kind = "unplug"        # the pty and its link go, and come back after `for_s`
  for_s = 1.5

  kind = "silence"       # frames stay unsent for `for_s`; the port stays open
  kind = "noise"         # `bytes` random bytes before each of `frames` frames
  kind = "drop-bytes"    # `bytes` of each of `frames` frames are not sent
  kind = "flip"          # `bits` of each of `frames` frames are inverted

`for_s` is needed where it applies; `bytes`, `bits` and `frames` are 1 unless given, and `bytes`
and `bits` at most 1000000."#;

/// Bytes or bits struck at a frame: a minute and a half of a line at 115,200 baud, far beyond what
/// a frame has.
const MOST_STRUCK: usize = 1_000_000;

/// Why a script cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Path of the script.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// No TOML, or a key or value that cannot be used.
    #[error("{path}: {problem}")]
    Malformed {
        /// Path of the script.
        path: PathBuf,
        /// What is wrong with it.
        problem: Problem,
    },
}

/// What is wrong with a script.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// No TOML, or not these tables: in the parser's words.
    #[error("{0}")]
    Syntax(String),
    /// A value that cannot be used.
    #[error("fault {number}: {value}")]
    Value {
        /// Number of the fault, from 1.
        number: usize,
        /// Which value, and why not.
        value: Unfit,
    },
}

/// A value that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Unfit {
    /// The moment is before the first frame, or not a number.
    #[error("at_s: found {0}, expected seconds from 0")]
    Moment(f64),
    /// The key belongs to other kinds of faults.
    #[error("{0}: this kind of fault does not have it")]
    Misplaced(&'static str),
    /// More bytes or bits than the limit.
    #[error("{key}: found {found}, expected at most {MOST_STRUCK}")]
    TooMany {
        /// The key.
        key: &'static str,
        /// The value as given.
        found: usize,
    },
    /// The time is not a number of seconds above 0.
    #[error("for_s: found {0}, expected seconds above 0")]
    Span(f64),
    /// A fault that needs a time and has none.
    #[error("for_s: this kind of fault needs it, in seconds")]
    NoSpan,
}

impl Error {
    /// Whether the file cannot be read.
    pub fn is_unreadable(&self) -> bool {
        matches!(self, Error::Unreadable { .. })
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Script {
    #[serde(default, rename = "fault")]
    faults: Vec<Table>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    at_s: f64,
    kind: Kind,
    for_s: Option<f64>,
    bytes: Option<usize>,
    bits: Option<usize>,
    frames: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    Unplug,
    Silence,
    Noise,
    DropBytes,
    Flip,
}

/// What happens to the line for a time, or to frames.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    Unplug {
        from_s: f64,
        to_s: f64,
    },
    Silence {
        from_s: f64,
        to_s: f64,
    },
    Noise {
        from_s: f64,
        bytes: usize,
        frames: u64,
    },
    DropBytes {
        from_s: f64,
        bytes: usize,
        frames: u64,
    },
    Flip {
        from_s: f64,
        bits: usize,
        frames: u64,
    },
}

/// What to do with a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Line {
    /// Send it as it is now.
    Up,
    /// Do not send it.
    Silent,
    /// Do not send it: the port is gone.
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
        Self {
            faults: Vec::new(),
            stream: Stream::new(0, "faults"),
        }
    }

    /// Reads a script.
    ///
    /// # Errors
    ///
    /// If it cannot be read, or has a key or value that cannot be used.
    pub(crate) fn load(path: &Path, seed: u64) -> Result<Self, Error> {
        let text = std::fs::read_to_string(path).map_err(|source| Error::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, seed).map_err(|problem| Error::Malformed {
            path: path.to_owned(),
            problem,
        })
    }

    fn parse(text: &str, seed: u64) -> Result<Self, Problem> {
        let script: Script = toml::from_str(text)
            .map_err(|error| Problem::Syntax(wording::of_toml(text, &error)))?;
        let faults = script
            .faults
            .iter()
            .enumerate()
            .map(|(index, table)| {
                table.fault().map_err(|value| Problem::Value {
                    number: index + 1,
                    value,
                })
            })
            .collect::<Result<_, _>>()?;
        Ok(Self {
            faults,
            stream: Stream::new(seed, "faults"),
        })
    }

    /// Damages the frame due at `time_s` as the script says, and says whether it is to be sent.
    /// Frames are asked for in order.
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
                    // If all bytes were dropped, there is none to invert.
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

impl Table {
    fn fault(&self) -> Result<Fault, Unfit> {
        if !(self.at_s.is_finite() && self.at_s >= 0.0) {
            return Err(Unfit::Moment(self.at_s));
        }
        let of_time = matches!(self.kind, Kind::Unplug | Kind::Silence);
        let misplaced = [
            ("for_s", self.for_s.is_some() && !of_time),
            ("frames", self.frames.is_some() && of_time),
            ("bits", self.bits.is_some() && self.kind != Kind::Flip),
            (
                "bytes",
                self.bytes.is_some() && !matches!(self.kind, Kind::Noise | Kind::DropBytes),
            ),
        ];
        if let Some((key, _)) = misplaced.iter().find(|(_, misplaced)| *misplaced) {
            return Err(Unfit::Misplaced(key));
        }
        for (key, number) in [("bytes", self.bytes), ("bits", self.bits)] {
            if let Some(found) = number.filter(|&number| number > MOST_STRUCK) {
                return Err(Unfit::TooMany { key, found });
            }
        }
        let from_s = self.at_s;
        let (bytes, bits) = (self.bytes.unwrap_or(1), self.bits.unwrap_or(1));
        let frames = self.frames.unwrap_or(1);
        let to_s = || match self.for_s {
            Some(for_s) if for_s.is_finite() && for_s > 0.0 => Ok(from_s + for_s),
            Some(for_s) => Err(Unfit::Span(for_s)),
            None => Err(Unfit::NoSpan),
        };
        Ok(match self.kind {
            Kind::Unplug => Fault::Unplug {
                from_s,
                to_s: to_s()?,
            },
            Kind::Silence => Fault::Silence {
                from_s,
                to_s: to_s()?,
            },
            Kind::Noise => Fault::Noise {
                from_s,
                bytes,
                frames,
            },
            Kind::DropBytes => Fault::DropBytes {
                from_s,
                bytes,
                frames,
            },
            Kind::Flip => Fault::Flip {
                from_s,
                bits,
                frames,
            },
        })
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
        let mut faults = Faults::parse(script, 1).unwrap();
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
        let mut faults = Faults::parse(script, 1).unwrap();
        let mut frame = vec![0_u8; 100];
        assert_eq!(faults.strike(1.0, &mut frame), Line::Up);
        assert!(frame.is_empty());
    }

    #[test]
    fn a_script_that_cannot_be_played_says_why() {
        for (script, expected) in [
            ("[[fault]]\nat_s = 1.0\nkind = \"melt\"", "line 3"),
            ("[[fault]]\nat_s = 1.0\nkind = \"flip\"\nbit = 3", "bit"),
            ("[[fault]]\nat_s = 1.0\nkind = \"unplug\"", "for_s"),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"flip\"\nfor_s = 1.0",
                "for_s",
            ),
            ("[[fault]]\nat_s = -1.0\nkind = \"flip\"", "at_s"),
            ("[[fault]]\nkind = \"flip\"", "at_s"),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"noise\"\nbytes = 99999999999",
                "bytes: found 99999999999, expected at most 1000000",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"flip\"\nbits = 1000001",
                "bits: found 1000001",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"flip\"\nbits = -1",
                "expected a whole number from 0",
            ),
            (
                "[[fault]]\nat_s = \"soon\"\nkind = \"flip\"",
                "expected a number",
            ),
        ] {
            let problem = Faults::parse(script, 1).unwrap_err().to_string();
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
