//! Writes an array at its place as settings, and decodes the bytes with them.
//!
//! In: the [`Parts`] of a frame, and all the bytes. Out: a [`Proposal`] that the daemon's own decoder
//! has tried.

use std::ops::Range;

use hardnessd_core::frame::Array;
use hardnessd_core::wire::{
    Cell, Checksum, ChecksumOver, Decoder, FooterBytes, HexBytes, Layout, LengthField, Preset,
    Settings,
};

use super::checks::What;
use super::columns::{Columns, Kind, Number};
use super::period::Frames;
use super::places::Place;

/// A layout, and the outcome of decoding the bytes with it.
#[derive(Debug, Clone)]
pub(super) struct Proposal {
    /// The settings of the layout, with the fewest keys.
    pub(super) settings: Settings,
    pub(super) frames: u64,
    pub(super) frames_damaged: u64,
    /// The greatest count of a taxel.
    pub(super) most_counts: u16,
    /// Share of all bytes that whole frames hold.
    pub(super) share: f64,
    /// What else there is to say.
    pub(super) remarks: Vec<String>,
    /// What these bytes leave open about the proposal.
    pub(super) doubt: Option<String>,
}

/// A number of bytes in words.
fn bytes(number: usize) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} byte{plural}")
}

/// The bytes that are decoded at once.
const CHUNK_BYTES: usize = 8 * 1024;
/// The least share of the bytes that a layout must explain.
const LEAST_SHARE: f64 = 0.5;

impl Proposal {
    /// Decodes `bytes` with the settings. `None` if they find too few frames, or many damaged ones.
    pub(super) fn decoded(settings: Settings, bytes: &[u8]) -> Option<Self> {
        let mut decoder = Decoder::new(Layout::new(&settings).ok()?);
        let (mut frames, mut frames_damaged, mut most_counts) = (0, 0, 0);
        let mut count = |decoder: &mut Decoder| {
            while let Some(item) = decoder.next_frame() {
                match item {
                    Ok(found) => {
                        frames += 1;
                        let counts = found.frame.counts.iter().copied();
                        most_counts = counts.fold(most_counts, u16::max);
                    }
                    Err(_) => frames_damaged += 1,
                }
            }
        };
        for chunk in bytes.chunks(CHUNK_BYTES) {
            decoder.push(chunk);
            count(&mut decoder);
        }
        decoder.settle();
        count(&mut decoder);
        let explained = decoder.received() - decoder.skipped() - decoder.pending() as u64;
        let share = explained as f64 / bytes.len() as f64;
        (frames >= 3 && share >= LEAST_SHARE && 4 * frames_damaged <= frames).then_some(Self {
            settings,
            frames,
            frames_damaged,
            most_counts,
            share,
            remarks: Vec::new(),
            doubt: None,
        })
    }

    /// The proposal for an array in frames.
    pub(super) fn of(parts: &Parts, bytes: &[u8]) -> Option<Self> {
        let tried = [parts.check(), None].map(|check| parts.settings(check));
        let mut proposal = tried
            .into_iter()
            .flatten()
            .find_map(|settings| Self::decoded(settings, bytes))?;
        proposal.remarks = parts.remarks();
        Some(proposal)
    }
}

/// The parts of a frame of an array.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parts<'a> {
    pub(super) frames: &'a Frames<'a>,
    pub(super) columns: &'a Columns,
    pub(super) place: &'a Place,
    pub(super) array: Array,
    pub(super) cell: Cell,
}

/// A stretch of the bytes beside the cells, counted from the end of the cells.
type Beside = Range<usize>;

/// A checksum, the place of its first byte, and where what it covers begins if it is not the cells.
type Checked = (Checksum, usize, Option<usize>);

impl Parts<'_> {
    fn check(&self) -> Option<Checked> {
        let check = self.place.check.as_ref()?;
        match check.what {
            What::From(checksum, begin) => Some((checksum, check.at.start, Some(begin))),
            What::Cells(checksum) => Some((checksum, check.at.start, None)),
            What::Sum => None,
        }
    }

    /// The value of a byte beside the cells, if it may belong to a mark.
    fn constant(&self, at: usize) -> Option<u8> {
        let beside = &self.place.beside;
        let (after, before) = self.place.skipped();
        (after..beside.len() - before)
            .contains(&at)
            .then(|| beside[at].constant())?
    }

    /// The end of the constant bytes that begin at `from`.
    fn constant_end(&self, from: usize) -> usize {
        (from..)
            .find(|&at| self.constant(at).is_none())
            .expect("there is an end of the bytes")
    }

    /// The likeliest mark: the constant bytes with the most that are not 0.
    fn mark(&self) -> Option<Beside> {
        let begins = (0..self.place.beside.len()).filter(|&at| {
            self.constant(at).is_some() && (at == 0 || self.constant(at - 1).is_none())
        });
        let runs = begins.map(|start| self.without_numbers(start..self.constant_end(start)));
        let weight = |run: &Beside| {
            let values = run.clone().map(|at| self.constant(at));
            values.filter(|&value| value != Some(0)).count()
        };
        runs.rev().max_by_key(weight).filter(|run| weight(run) > 0)
    }

    /// Constant bytes without the zeros at their ends that may be the high bytes of a number.
    fn without_numbers(&self, run: Beside) -> Beside {
        let beside = &self.place.beside;
        let is_number = |at: usize| beside.get(at) == Some(&Kind::Number);
        let is_other = |&at: &usize| self.constant(at) != Some(0);
        let (mut start, mut end) = (run.start, run.end);
        if is_number(run.start.wrapping_sub(1)) {
            start = run.clone().find(is_other).unwrap_or(run.end);
        }
        if is_number(run.end) {
            end = run.clone().rfind(is_other).map_or(run.start, |at| at + 1);
        }
        start..end.max(start)
    }

    /// The settings for this array with the fewest keys.
    fn settings(&self, check: Option<Checked>) -> Option<Settings> {
        let begin = check
            .and_then(|(_, _, begin)| begin)
            .or_else(|| self.beginning());
        let mark = match check {
            Some((checksum, at, _)) => {
                let end = at + checksum.bytes();
                end..self.constant_end(begin.unwrap_or(end).max(end))
            }
            None => self.mark()?,
        };
        if mark.is_empty() || mark.clone().any(|at| self.constant(at).is_none()) {
            return None;
        }
        let splits = match begin.filter(|at| (mark.start..=mark.end).contains(at)) {
            Some(at) => at..=at,
            None => mark.start..=mark.end,
        };
        splits
            .filter_map(|split| self.of_split(&mark, split, check))
            .min_by_key(keys)
    }

    /// The numbers of bytes between the mark and the cells, and between the cells and the mark.
    pub(super) fn around(&self) -> Option<(usize, usize)> {
        let mark = self.mark()?;
        Some((self.place.beside.len() - mark.end, mark.start))
    }

    /// The place beside the cells at which the stream begins.
    fn beginning(&self) -> Option<usize> {
        let period = self.columns.kinds.len();
        let turn = self.frames.turn_of_beginning()?;
        let end = self.place.start + self.place.bytes;
        let at = (turn + 2 * period - end) % period;
        (at <= self.place.beside.len()).then_some(at)
    }

    /// The settings for a frame that begins at `split` within the mark.
    fn of_split(&self, mark: &Beside, split: usize, check: Option<Checked>) -> Option<Settings> {
        let values =
            |range: Beside| -> Vec<u8> { range.filter_map(|at| self.constant(at)).collect() };
        let (tail, mut sync) = (values(mark.start..split), values(split..mark.end));
        let Self { array, cell, .. } = *self;
        let bytes = self.place.bytes as u16;
        let fields = [
            (LengthField::U16le, bytes.to_le_bytes().to_vec()),
            (LengthField::U16be, bytes.to_be_bytes().to_vec()),
            (LengthField::U8, vec![bytes as u8]),
        ];
        let field = fields.into_iter().find(|(field, written)| {
            (*field != LengthField::U8 || bytes <= 0xFF)
                && sync.len() > written.len()
                && sync.ends_with(written)
        });
        let length = field.map_or(LengthField::None, |(field, written)| {
            sync.truncate(sync.len() - written.len());
            field
        });
        let sides = Settings {
            rows: Some(array.rows),
            cols: Some(array.cols),
            ..Settings::default()
        };
        let is_ff_tail = self.place.beside.len() == 1 && tail == [0xFF] && cell == Cell::U8;
        let is_ff = |byte: &&u8| **byte == 0xFF;
        if is_ff_tail
            && self
                .frames
                .iter()
                .all(|frame| frame.iter().filter(is_ff).count() <= 1)
        {
            return simplest(&[Preset::FfTail], &sides);
        }
        let settings = Settings {
            sync: Some(HexBytes(sync)),
            tail: Some(HexBytes(tail)),
            length: Some(length),
            header_bytes: Some(self.place.beside.len() - mark.end),
            cell: Some(cell),
            footer_bytes: Some(FooterBytes::Each(check.map_or(mark.start, |(_, at, _)| at))),
            checksum: Some(check.map_or(Checksum::None, |(checksum, ..)| checksum)),
            checksum_over: Some(match check {
                Some((_, _, None)) => ChecksumOver::Cells,
                _ => ChecksumOver::All,
            }),
            ..sides
        };
        simplest(&FREE, &settings)
    }

    fn remarks(&self) -> Vec<String> {
        let period = self.columns.kinds.len();
        let number = |number: &Number| {
            let at = (number.at + 2 * period - self.place.start - self.place.bytes) % period;
            let is_after = at < self.mark().map_or(0, |mark| mark.start);
            let place = if is_after {
                format!("{} after the last cell", bytes(at))
            } else {
                "before the cells".to_owned()
            };
            let kind = if number.step == 1 {
                "a counter"
            } else {
                "a clock, or a counter"
            };
            format!(
                "a number of {}, {place}, grows by about {} a frame: {kind}; it is skipped",
                bytes(number.bytes),
                number.step
            )
        };
        let mut remarks: Vec<String> = self.columns.numbers.iter().map(number).collect();
        let checked = self
            .place
            .check
            .as_ref()
            .map_or(0..0, |check| check.at.clone());
        let beside = self.place.beside.iter().enumerate();
        let unknown = beside
            .filter(|(at, kind)| **kind == Kind::Active && !checked.contains(at))
            .count();
        if unknown > 0 {
            remarks.push(format!(
                "the meaning of {} beside the cells is unknown: skipped",
                bytes(unknown)
            ));
        }
        if matches!(&self.place.check, Some(check) if check.what == What::Sum) {
            remarks.push(format!(
                "a sum of the cells takes {}: no key describes it, so it is skipped",
                bytes(checked.len())
            ));
        }
        let is_checked_from_mark = matches!(self.check(), Some((_, _, Some(_))));
        if !is_checked_from_mark && self.beginning().is_none() {
            remarks.push(
                "whether the mark begins a frame or ends it does not show here: record from the moment the sensor is \
                 switched on, or read its data sheet"
                    .to_owned(),
            );
        }
        remarks
    }
}

/// The layout of a preset that has only rows and columns.
pub(super) fn sized(preset: Preset, array: Array, bytes: &[u8]) -> Option<Proposal> {
    let settings = Settings {
        rows: Some(array.rows),
        cols: Some(array.cols),
        ..Settings::default()
    };
    Proposal::decoded(simplest(&[preset], &settings)?, bytes)
}

/// The presets of frames of one length whose keys are all free.
const FREE: [Preset; 7] = [
    Preset::Jx255n,
    Preset::Jx255nU16,
    Preset::Jq,
    Preset::JqTail,
    Preset::JqU16,
    Preset::Flexitac,
    Preset::M1616,
];

/// The same layout with the fewest keys, below one of these presets.
fn simplest(presets: &[Preset], settings: &Settings) -> Option<Settings> {
    let below = presets.iter().filter_map(|&preset| {
        let settings = Settings {
            preset,
            ..settings.clone()
        };
        let layout = Layout::new(&settings).ok()?;
        let mut table = toml::Table::try_from(&settings).expect("settings are a table");
        let keys: Vec<String> = table.keys().cloned().collect();
        for key in keys.iter().filter(|key| *key != "preset") {
            let mut shorter = table.clone();
            shorter.remove(key);
            let settings = shorter.clone().try_into::<Settings>().ok()?;
            if Layout::new(&settings).as_ref() == Ok(&layout) {
                table = shorter;
            }
        }
        table.try_into().ok()
    });
    below.min_by_key(keys)
}

/// The number of keys, the preset included.
pub(super) fn keys(settings: &Settings) -> usize {
    toml::Table::try_from(settings)
        .expect("settings are a table")
        .len()
}
