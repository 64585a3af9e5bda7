//! Reads the file of a script: TOML in, faults or an error out.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::bytes::{Damage, OfBytes};
use super::cable::{self, OfCable};
use super::taxels::{Change, OfTaxels, Region};
use super::times::{Frames, Span};
use hardnessd_core::exit::{Coded, FAILED, NO_INPUT};
use hardnessd_core::frame::Array;
use hardnessd_core::range::{self, OutOfRange};
use hardnessd_core::wording;
use hardnessd_simulator::FULL_SCALE_COUNTS;

/// The file format, for `--help`.
pub(crate) const FORMAT: &str = r#"The faults of --faults FILE, a TOML file; times in the sensor's seconds from the start:

  [[fault]]
  at_s = 12.0            # from the first frame at or after this
  kind = "unplug"        # the pty and its link go, and come back after `for_s`
  for_s = 1.5

The cable:
  kind = "silence"       # frames stay unsent for `for_s`; the port stays open
  kind = "half"          # the same, but half of the first frame is sent. With `other_half = true`
                         # its other half comes at the end
  kind = "stall"         # frames are held back for `for_s`, then come all at once
  kind = "wrong-baud"    # bytes as a reader at `ratio` times the sensor's baud rate reads them

Bytes of frames:
  kind = "noise"         # `bytes` random bytes before each of `frames` frames
  kind = "drop-bytes"    # `bytes` of each of `frames` frames are not sent
  kind = "flip"          # `bits` of each of `frames` frames are inverted
  kind = "repeat"        # each of `frames` frames comes twice

Taxels, those in `rows = [first, last]` and `cols = [first, last]`, counted from 0:
  kind = "stuck"         # they read `counts`
  kind = "dead"          # they read 0
  kind = "contact"       # each reads `newtons` more
  kind = "drift"         # each reads `newtons_per_hour` more every hour. After `for_s` it stays so

unplug, silence, half and stall need `for_s`, which is at most 60 for a stall. The other faults of
the cable and of taxels last to the end without it. `bytes`, `bits` and `frames` are 1 unless given,
and `bytes` and `bits` at most 1000000. `ratio` is 0.01 to 100, `counts` 255 unless given. stuck,
dead and contact need `rows` or `cols`; one that is not given means all. A drift may be negative,
but no taxel reads below 0 or above 255."#;

/// The most bytes or bits of a frame that a fault may strike. It is far more than a frame has: a
/// line at 115,200 baud needs a minute and a half for this many bytes.
const MOST_STRUCK: usize = 1_000_000;

/// The longest stall, in seconds. It bounds the memory for the frames that are held back.
const LONGEST_STALL_S: f64 = 60.0;

/// The least and the greatest ratio of a wrong baud rate.
const RATIOS: (f64, f64) = (0.01, 100.0);

/// The most newtons, and newtons an hour, that a taxel can read more: far more than its full scale.
const MOST_NEWTONS: f64 = 1e6;

/// The reason why a script cannot be played.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Error {
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
pub(crate) enum Problem {
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
pub(crate) enum Unfit {
    /// A value is out of its range.
    #[error(transparent)]
    Range(#[from] OutOfRange),
    /// The key belongs to other kinds of faults.
    #[error("{0}: this kind of fault does not have it")]
    Misplaced(&'static str),
    /// The fault needs a key and does not have it.
    #[error("{key}: this kind of fault needs it, {form}")]
    Needed {
        /// The key.
        key: &'static str,
        /// The unit or the form of the value.
        form: &'static str,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Unreadable { .. } => NO_INPUT,
            Error::Malformed { .. } => FAILED,
        }
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
    other_half: Option<bool>,
    ratio: Option<f64>,
    rows: Option<Vec<usize>>,
    cols: Option<Vec<usize>>,
    counts: Option<u16>,
    newtons: Option<f64>,
    newtons_per_hour: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    Unplug,
    Silence,
    Half,
    Stall,
    WrongBaud,
    Noise,
    DropBytes,
    Flip,
    Repeat,
    Stuck,
    Dead,
    Contact,
    Drift,
}

impl Kind {
    /// The keys that a fault of this kind may have, beside `at_s` and `kind`.
    fn keys(self) -> &'static [&'static str] {
        match self {
            Kind::Unplug | Kind::Silence | Kind::Stall => &["for_s"],
            Kind::Half => &["for_s", "other_half"],
            Kind::WrongBaud => &["for_s", "ratio"],
            Kind::Noise | Kind::DropBytes => &["bytes", "frames"],
            Kind::Flip => &["bits", "frames"],
            Kind::Repeat => &["frames"],
            Kind::Stuck => &["for_s", "rows", "cols", "counts"],
            Kind::Dead => &["for_s", "rows", "cols"],
            Kind::Contact => &["for_s", "rows", "cols", "newtons"],
            Kind::Drift => &["for_s", "rows", "cols", "newtons_per_hour"],
        }
    }
}

/// The faults of a script, in its order.
#[derive(Debug, Default)]
pub(super) struct Faults {
    pub(super) taxels: Vec<OfTaxels>,
    pub(super) bytes: Vec<OfBytes>,
    pub(super) cable: Vec<OfCable>,
}

/// Reads a script.
pub(super) fn load(path: &Path) -> Result<Faults, Error> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    parse(&text).map_err(|problem| Error::Malformed {
        path: path.to_owned(),
        problem,
    })
}

pub(super) fn parse(text: &str) -> Result<Faults, Problem> {
    let script: Script =
        toml::from_str(text).map_err(|error| Problem::Syntax(wording::of_toml(text, &error)))?;
    let mut faults = Faults::default();
    for (index, table) in script.faults.iter().enumerate() {
        let number = index + 1;
        let added = table.add_to(&mut faults);
        added.map_err(|value| Problem::Value { number, value })?;
    }
    Ok(faults)
}

impl Table {
    /// Adds the fault to the others.
    fn add_to(&self, faults: &mut Faults) -> Result<(), Unfit> {
        let fits = self.at_s.is_finite() && self.at_s >= 0.0;
        let at_s = format_args!("{}", self.at_s);
        range::check("at_s", at_s, fits, "seconds from 0")?;
        if let Some(key) = self.misplaced() {
            return Err(Unfit::Misplaced(key));
        }
        match self.kind {
            Kind::Unplug => faults.cable.push(self.of_cable(cable::Kind::Unplug)?),
            Kind::Silence => faults.cable.push(self.of_cable(cable::Kind::Silence)?),
            Kind::Half => {
                let kind = cable::Kind::Half {
                    other_half: self.other_half.unwrap_or(false),
                    has_begun: false,
                };
                faults.cable.push(self.of_cable(kind)?);
            }
            Kind::Stall => {
                let fault = self.of_cable(cable::Kind::Stall)?;
                let for_s = self.for_s.unwrap_or_default();
                let expected = format_args!("at most {LONGEST_STALL_S} for a stall");
                let fits = for_s <= LONGEST_STALL_S;
                range::check("for_s", format_args!("{for_s}"), fits, expected)?;
                faults.cable.push(fault);
            }
            Kind::WrongBaud => {
                let form = "the reader's baud rate over the sensor's";
                let ratio = number("ratio", self.ratio, RATIOS, form)?;
                faults.cable.push(OfCable {
                    span: self.span()?,
                    kind: cable::Kind::WrongBaud { ratio },
                });
            }
            Kind::Noise => {
                let bytes = struck("bytes", self.bytes)?;
                faults.bytes.push(self.of_bytes(Damage::Noise { bytes }));
            }
            Kind::DropBytes => {
                let bytes = struck("bytes", self.bytes)?;
                faults
                    .bytes
                    .push(self.of_bytes(Damage::DropBytes { bytes }));
            }
            Kind::Flip => {
                let bits = struck("bits", self.bits)?;
                faults.bytes.push(self.of_bytes(Damage::Flip { bits }));
            }
            Kind::Repeat => faults.bytes.push(self.of_bytes(Damage::Repeat)),
            Kind::Stuck => {
                let counts = self.counts.unwrap_or(FULL_SCALE_COUNTS);
                faults.taxels.push(self.of_some(Change::Stuck { counts })?);
            }
            Kind::Dead => {
                let change = Change::Stuck { counts: 0 };
                faults.taxels.push(self.of_some(change)?);
            }
            Kind::Contact => {
                let range = (0.0, MOST_NEWTONS);
                let newtons = number("newtons", self.newtons, range, "for each taxel")?;
                range::check("newtons", 0, newtons != 0.0, "more than 0")?;
                faults
                    .taxels
                    .push(self.of_some(Change::Contact { newtons })?);
            }
            Kind::Drift => {
                let newtons_per_hour = number(
                    "newtons_per_hour",
                    self.newtons_per_hour,
                    (-MOST_NEWTONS, MOST_NEWTONS),
                    "for each taxel",
                )?;
                let change = Change::Drift { newtons_per_hour };
                faults.taxels.push(self.of_taxels(change)?);
            }
        }
        Ok(())
    }

    /// A key that the kind does not have.
    fn misplaced(&self) -> Option<&'static str> {
        let given = [
            ("for_s", self.for_s.is_some()),
            ("bytes", self.bytes.is_some()),
            ("bits", self.bits.is_some()),
            ("frames", self.frames.is_some()),
            ("other_half", self.other_half.is_some()),
            ("ratio", self.ratio.is_some()),
            ("rows", self.rows.is_some()),
            ("cols", self.cols.is_some()),
            ("counts", self.counts.is_some()),
            ("newtons", self.newtons.is_some()),
            ("newtons_per_hour", self.newtons_per_hour.is_some()),
        ];
        let mut given = given.into_iter().filter(|(_, is_given)| *is_given);
        let misplaced = given.find(|(key, _)| !self.kind.keys().contains(key));
        misplaced.map(|(key, _)| key)
    }

    /// The time of the fault, which does not end without `for_s`.
    fn span(&self) -> Result<Span, Unfit> {
        let for_s = self.for_s.unwrap_or(f64::INFINITY);
        let fits = self.for_s.is_none_or(f64::is_finite) && for_s > 0.0;
        range::check("for_s", format_args!("{for_s}"), fits, "seconds above 0")?;
        let to_s = self.at_s + for_s;
        let from_s = self.at_s;
        Ok(Span { from_s, to_s })
    }

    /// A fault of the cable that needs `for_s`.
    fn of_cable(&self, kind: cable::Kind) -> Result<OfCable, Unfit> {
        let span = self.span()?;
        if self.for_s.is_none() {
            let (key, form) = ("for_s", "in seconds");
            return Err(Unfit::Needed { key, form });
        }
        Ok(OfCable { span, kind })
    }

    fn of_bytes(&self, damage: Damage) -> OfBytes {
        let frames = Frames {
            from_s: self.at_s,
            left: self.frames.unwrap_or(1),
        };
        OfBytes { frames, damage }
    }

    /// A fault of taxels that must say which.
    fn of_some(&self, change: Change) -> Result<OfTaxels, Unfit> {
        if self.rows.is_none() && self.cols.is_none() {
            let (key, form) = ("rows or cols", "as [first, last]");
            return Err(Unfit::Needed { key, form });
        }
        self.of_taxels(change)
    }

    fn of_taxels(&self, change: Change) -> Result<OfTaxels, Unfit> {
        Ok(OfTaxels {
            span: self.span()?,
            region: Region {
                rows: side("rows", self.rows.as_deref(), Array::JX255N.rows)?,
                cols: side("cols", self.cols.as_deref(), Array::JX255N.cols)?,
            },
            change,
        })
    }
}

/// How many bytes or bits of a frame a fault strikes.
fn struck(key: &'static str, given: Option<usize>) -> Result<usize, Unfit> {
    let found = given.unwrap_or(1);
    let expected = format_args!("at most {MOST_STRUCK}");
    range::check(key, found, found <= MOST_STRUCK, expected)?;
    Ok(found)
}

/// A number that the fault needs.
fn number(
    key: &'static str,
    given: Option<f64>,
    (least, most): (f64, f64),
    form: &'static str,
) -> Result<f64, Unfit> {
    let found = given.ok_or(Unfit::Needed { key, form })?;
    let fits = (least..=most).contains(&found);
    let expected = format_args!("{least} to {most}");
    range::check(key, format_args!("{found}"), fits, expected)?;
    Ok(found)
}

/// The first and the last row or column. The parser would drop the rest of a list longer than a
/// pair, so the script has a list of any length.
fn side(key: &'static str, given: Option<&[usize]>, sides: usize) -> Result<[usize; 2], Unfit> {
    match given {
        None => Ok([0, sides - 1]),
        Some(&[first, last]) if first <= last && last < sides => Ok([first, last]),
        Some(found) => {
            let expected = format_args!("[first, last] of 0 to {}", sides - 1);
            Err(OutOfRange::new(key, found, expected).into())
        }
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
                "invalid value: integer `-1`",
            ),
            (
                "[[fault]]\nat_s = \"soon\"\nkind = \"flip\"",
                "invalid type: string \"soon\"",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"half\"",
                "for_s: this kind of fault needs it, in seconds",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"silence\"\nfor_s = 1.0\nother_half = true",
                "other_half: this kind of fault does not have it",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"stall\"\nfor_s = 61",
                "for_s: found 61, expected at most 60 for a stall",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"repeat\"\nfor_s = 1.0",
                "for_s: this kind of fault does not have it",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"wrong-baud\"",
                "ratio: this kind of fault needs it, the reader's baud rate",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"wrong-baud\"\nratio = 0",
                "ratio: found 0, expected 0.01 to 100",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"stuck\"\ncounts = 255",
                "rows or cols: this kind of fault needs it, as [first, last]",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"stuck\"\nrows = [0, 0]\ncounts = 70000",
                "invalid value: integer `70000`",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"dead\"\nrows = [13, 28]",
                "fault 1: rows: found [13, 28], expected [first, last] of 0 to 27",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"dead\"\ncols = [14, 13]",
                "cols: found [14, 13]",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"dead\"\nrows = [1, 2, 3]",
                "rows: found [1, 2, 3]",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"dead\"\nrows = 13",
                "invalid type: integer `13`",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"contact\"\nrows = [1, 2]",
                "newtons: this kind of fault needs it, for each taxel",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"contact\"\nrows = [1, 2]\nnewtons = 0.0",
                "newtons: found 0, expected more than 0",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"contact\"\nrows = [1, 2]\nnewtons = -1",
                "newtons: found -1, expected 0 to 1000000",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"drift\"",
                "newtons_per_hour: this kind of fault needs it",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"drift\"\nnewtons_per_hour = nan",
                "newtons_per_hour: found NaN",
            ),
            (
                "[[fault]]\nat_s = 1.0\nkind = \"drift\"\nnewtons_per_hour = 1\nfor_s = 0",
                "for_s: found 0, expected seconds above 0",
            ),
        ] {
            let problem = parse(script).unwrap_err().to_string();
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
