//! Reads the file of a script: TOML in, faults or an error out.

use std::path::{Path, PathBuf};

use serde::Deserialize;

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

/// The most bytes or bits of a frame that a fault may strike. It is far more than a frame has: a
/// line at 115,200 baud needs a minute and a half for this many bytes.
const MOST_STRUCK: usize = 1_000_000;

/// The reason why a script cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Path of the script.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not TOML, or has a key or value that cannot be used.
    #[error("{path}: {problem}")]
    Malformed {
        /// Path of the script.
        path: PathBuf,
        /// The problem, with its place in the script.
        problem: Problem,
    },
}

/// A problem in a script.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// The text is not TOML, or its tables are not those of a script. The field is the parser's
    /// message in plain words.
    #[error("{0}")]
    Syntax(String),
    /// A value that cannot be used.
    #[error("fault {number}: {value}")]
    Value {
        /// Number of the fault, from 1.
        number: usize,
        /// The value, with the reason.
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
        /// The value in the script.
        found: usize,
    },
    /// The time is not a number of seconds above 0.
    #[error("for_s: found {0}, expected seconds above 0")]
    Span(f64),
    /// The fault needs a time and has none.
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

/// A fault of the line for a time, or a fault of a number of frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Fault {
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

/// Reads a script.
pub(super) fn load(path: &Path) -> Result<Vec<Fault>, Error> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    parse(&text).map_err(|problem| Error::Malformed {
        path: path.to_owned(),
        problem,
    })
}

pub(super) fn parse(text: &str) -> Result<Vec<Fault>, Problem> {
    let script: Script =
        toml::from_str(text).map_err(|error| Problem::Syntax(wording::of_toml(text, &error)))?;
    let faults = script.faults.iter().enumerate();
    faults
        .map(|(index, table)| {
            table.fault().map_err(|value| Problem::Value {
                number: index + 1,
                value,
            })
        })
        .collect()
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
            let problem = parse(script).unwrap_err().to_string();
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
