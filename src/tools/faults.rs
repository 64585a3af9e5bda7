//! Faults of a simulated sensor and its line, from a script. The same script and seed give the same
//! faults.
//!
//! In: a TOML file of `[[fault]]` tables, and frames. Out: the bytes to send, and whether to send
//! them. Times are in seconds of the sensor since its start. The seed decides which bytes and bits
//! are hit.

use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

use super::exit::{FAILED, Failure};
use super::read_text;
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::Layout;
use hardnessd_core::wording;
use hardnessd_simulator::random::Stream;

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

`bytes` and `bits` are 1 unless given, and at most 65535."#;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Script {
    #[serde(default, rename = "fault")]
    faults: Vec<Spanned<Fault>>,
}

/// A fault.
#[derive(Debug, Clone, Copy, Deserialize)]
struct Fault {
    /// When it begins, in seconds of the sensor.
    at_s: f64,
    /// How long it lasts.
    #[serde(default = "no_end")]
    for_s: f64,
    /// The most frames that it strikes.
    frames: Option<usize>,
    #[serde(flatten)]
    kind: Kind,
    /// The number of frames that it has struck.
    #[serde(skip)]
    struck: usize,
}

/// What happens. [`FORMAT`] says what each kind does. All have braces, because serde refuses an
/// unknown key only then.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
enum Kind {
    Unplug {},
    Silence {},
    Noise {
        #[serde(default = "one")]
        bytes: u16,
    },
    DropBytes {
        #[serde(default = "one")]
        bytes: u16,
    },
    Flip {
        #[serde(default = "one")]
        bits: u16,
    },
}

fn no_end() -> f64 {
    f64::INFINITY
}

fn one() -> u16 {
    1
}

impl Fault {
    /// Whether the fault is at work at a time. One of some frames counts this frame.
    fn strikes(&mut self, time_s: f64) -> bool {
        let frames = match self.kind {
            Kind::Unplug {} | Kind::Silence {} => usize::MAX,
            Kind::Noise { .. } | Kind::DropBytes { .. } | Kind::Flip { .. } => 1,
        };
        let is_now = (self.at_s..self.at_s + self.for_s).contains(&time_s);
        let strikes = is_now && self.struck < self.frames.unwrap_or(frames);
        self.struck += usize::from(strikes);
        strikes
    }
}

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

/// The longest script: some ten thousand faults.
const MOST_BYTES: u64 = 1 << 20;

impl Faults {
    /// No faults.
    pub(crate) fn none() -> Self {
        Self::new(Vec::new(), 0)
    }

    fn new(faults: Vec<Fault>, seed: u64) -> Self {
        Self {
            faults,
            stream: Stream::new(seed, "faults"),
        }
    }

    /// Reads a script.
    ///
    /// # Errors
    ///
    /// Fails if the script cannot be read, or has a key or value that cannot be used.
    pub(crate) fn load(path: &Path, seed: u64) -> Result<Self, Failure> {
        let faults = parse(&read_text(path, MOST_BYTES)?);
        let faults =
            faults.map_err(|why| Failure::new(FAILED, format!("{}: {why}", path.display())));
        Ok(Self::new(faults?, seed))
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
                    for _ in 0..bytes.len().min(count.into()) {
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

/// The faults of a script, or what is wrong in which line.
fn parse(text: &str) -> Result<Vec<Fault>, String> {
    let script: Script = toml::from_str(text).map_err(|error| wording::of_toml(text, &error))?;
    for fault in &script.faults {
        let line = text[..fault.span().start].matches('\n').count() + 1;
        let Fault { at_s, for_s, .. } = *fault.get_ref();
        if !(at_s >= 0.0 && for_s > 0.0) {
            let found = format!("found at_s = {at_s:?} and for_s = {for_s:?}");
            return Err(format!(
                "line {line}: {found}, expected at_s from 0 on and for_s above 0"
            ));
        }
    }
    Ok(script.faults.into_iter().map(Spanned::into_inner).collect())
}

/// The middle of a frame of the simulated array, as another array has it. Taxels that the simulated
/// one lacks read 0.
fn middle(raw: &RawFrame, array: Array) -> RawFrame {
    let from = |own: usize, side: usize, other: usize| {
        let place = (own + other / 2).checked_sub(side / 2);
        place.filter(|&place| place < other)
    };
    let mut cut = RawFrame::zero(array);
    for (place, count) in cut.counts.iter_mut().enumerate() {
        let (row, col) = array.position(place);
        let row = from(row, array.rows, raw.array.rows);
        if let (Some(row), Some(col)) = (row, from(col, array.cols, raw.array.cols)) {
            *count = raw.counts[raw.array.place(row, col)];
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
        let script = "fault = [
            { at_s = 1.0, kind = 'unplug', for_s = 0.5 },
            { at_s = 2.0, kind = 'silence', for_s = 0.5 },
            { at_s = 3.0, kind = 'noise', bytes = 7 },
            { at_s = 4.0, kind = 'drop-bytes', bytes = 3, frames = 2 },
            { at_s = 5.0, kind = 'flip' },
        ]";
        let mut faults = Faults::new(parse(script).unwrap(), 1);
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

    #[test]
    fn a_script_that_cannot_be_played_says_why() {
        // A fault, and what is said of it.
        let cases = "
            at_s = 1.0, kind = 'melt' | unknown variant `melt`
            at_s = 1.0, kind = 'flip', bit = 3 | unknown field `bit`
            at_s = 1.0, kind = 'unplug', bits = 3 | unknown field `bits`
            at_s = -1.0, kind = 'flip' | found at_s = -1.0 and for_s = inf, expected at_s from 0 on
            kind = 'flip' | missing field `at_s`
            at_s = 'soon', kind = 'flip' | invalid type: string \"soon\"
            at_s = 1.0, kind = 'flip', bits = 65536 | expected a whole number from 0 to 65535
            at_s = 1.0, kind = 'silence', for_s = 0 | for_s = 0.0, expected at_s from 0 on and for_s above 0";
        for case in cases.trim().lines() {
            let (fault, expected) = case.trim().split_once(" | ").unwrap();
            let keys = fault.replace(", ", "\n");
            let problem = parse(&format!("\n[[fault]]\n{keys}")).unwrap_err();
            // Each error names a line of its fault.
            let line = problem
                .strip_prefix("line ")
                .and_then(|rest| rest[..1].parse().ok());
            assert!(line.is_some_and(|line: u32| line > 1), "{problem}");
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
