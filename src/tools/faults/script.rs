//! The faults of a script, and the file that describes them.

use std::io::Read;
use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

use crate::tools::exit::Failure;
use crate::tools::{cannot_read, open};
use hardnessd_core::exit::FAILED;
use hardnessd_core::range::{self, OutOfRange};
use hardnessd_core::wording;

/// The file format, for `--help`.
pub(crate) const FORMAT: &str = r#"The faults of --faults FILE, a TOML file; times in the sensor's seconds from the start:

  [[fault]]
  at_s = 12.0            # from the first frame at or after this
  kind = "unplug"        # the pty and its link go, and come back
  for_s = 1.5            # how long; without it to the end

The cable:
  kind = "silence"       # frames stay unsent; the port stays open

Bytes, of the first frame unless `frames` says of how many:
  kind = "noise"         # `bytes` random bytes before each
  kind = "drop-bytes"    # `bytes` of each are not sent
  kind = "flip"          # `bits` of each are inverted

`bytes` and `bits` are 1 unless given, and at most 1000000."#;

/// The most bytes or bits of a frame that a fault may strike. It is far more than a frame has: a
/// line at 115,200 baud needs a minute and a half for this many bytes.
const MOST_STRUCK: usize = 1_000_000;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Script {
    #[serde(default, rename = "fault")]
    faults: Vec<Spanned<Fault>>,
}

/// A fault.
#[derive(Debug, Clone, Copy, Deserialize)]
pub(super) struct Fault {
    /// When it begins, in seconds of the sensor.
    pub(super) at_s: f64,
    /// How long it lasts.
    #[serde(default = "no_end")]
    pub(super) for_s: f64,
    /// The most frames that it strikes.
    frames: Option<usize>,
    #[serde(flatten)]
    pub(super) kind: Kind,
    /// The number of frames that it has struck.
    #[serde(skip)]
    struck: usize,
}

/// What happens. [`FORMAT`] says what each kind does. All have braces, because serde refuses an
/// unknown key only then.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub(super) enum Kind {
    Unplug {},
    Silence {},
    Noise {
        #[serde(default = "one")]
        bytes: usize,
    },
    DropBytes {
        #[serde(default = "one")]
        bytes: usize,
    },
    Flip {
        #[serde(default = "one")]
        bits: usize,
    },
}

fn no_end() -> f64 {
    f64::INFINITY
}

fn one() -> usize {
    1
}

impl Fault {
    /// Whether the fault is at work at a time. One of some frames counts this frame.
    pub(super) fn strikes(&mut self, time_s: f64) -> bool {
        let frames = match self.kind {
            Kind::Noise { .. } | Kind::DropBytes { .. } | Kind::Flip { .. } => {
                self.frames.unwrap_or(1)
            }
            _ => self.frames.unwrap_or(usize::MAX),
        };
        let is_now = (self.at_s..self.at_s + self.for_s).contains(&time_s);
        let strikes = is_now && self.struck < frames;
        self.struck += usize::from(strikes);
        strikes
    }

    fn check(&self) -> Result<(), OutOfRange> {
        let Self { at_s, for_s, .. } = *self;
        let from_0 = at_s.is_finite() && at_s >= 0.0;
        range::check("at_s", at_s, from_0, "seconds from 0")?;
        range::check("for_s", for_s, for_s > 0.0, "seconds above 0")?;
        let struck = |key, found| range::within(key, found, (0, MOST_STRUCK), "");
        match self.kind {
            Kind::Unplug {} | Kind::Silence {} => Ok(()),
            Kind::Noise { bytes } | Kind::DropBytes { bytes } => struck("bytes", bytes),
            Kind::Flip { bits } => struck("bits", bits),
        }
    }
}

/// The longest script: some ten thousand faults.
const MOST_BYTES: u64 = 1 << 20;

/// Reads a script.
///
/// # Errors
///
/// Fails if the script cannot be read, or has a key or value that cannot be used.
pub(super) fn load(path: &Path) -> Result<Vec<Fault>, Failure> {
    let mut text = String::new();
    let read = open(path)?.take(MOST_BYTES + 1).read_to_string(&mut text);
    read.map_err(cannot_read(path))?;
    if text.len() as u64 > MOST_BYTES {
        let problem = format!("{}: more than {MOST_BYTES} bytes", path.display());
        return Err(Failure::new(FAILED, problem));
    }
    parse(&text).map_err(|why| Failure::new(FAILED, format!("{}: {why}", path.display())))
}

/// The faults of a script, or what is wrong in which line.
pub(super) fn parse(text: &str) -> Result<Vec<Fault>, String> {
    let script: Script = toml::from_str(text).map_err(|error| wording::of_toml(text, &error))?;
    for fault in &script.faults {
        let line = text[..fault.span().start].matches('\n').count() + 1;
        let checked = fault.get_ref().check();
        checked.map_err(|error| format!("line {line}: {error}"))?;
    }
    Ok(script.faults.into_iter().map(Spanned::into_inner).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_script_that_cannot_be_played_says_why() {
        for (fault, expected) in [
            ("at_s = 1.0\nkind = \"melt\"", "unknown variant `melt`"),
            (
                "at_s = 1.0\nkind = \"flip\"\nbit = 3",
                "unknown field `bit`",
            ),
            (
                "at_s = 1.0\nkind = \"unplug\"\nbits = 3",
                "unknown field `bits`",
            ),
            (
                "at_s = -1.0\nkind = \"flip\"",
                "line 2: at_s: found -1.0, expected seconds from 0",
            ),
            ("kind = \"flip\"", "missing field `at_s`"),
            (
                "at_s = \"soon\"\nkind = \"flip\"",
                "invalid type: string \"soon\"",
            ),
            (
                "at_s = 1.0\nkind = \"flip\"\nbits = 1000001",
                "bits: found 1000001, expected 0 to 1000000",
            ),
            (
                "at_s = 1.0\nkind = \"silence\"\nfor_s = 0",
                "for_s: found 0.0, expected seconds above 0",
            ),
        ] {
            // Each error names a line of its fault.
            let problem = parse(&format!("\n[[fault]]\n{fault}")).unwrap_err();
            let line = problem
                .strip_prefix("line ")
                .and_then(|rest| rest[..1].parse().ok());
            assert!(line.is_some_and(|line: u32| line > 1), "{problem}");
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
