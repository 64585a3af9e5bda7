//! Writes a hypothesis as settings, and decodes the bytes with them.
//!
//! In: frames, a [`Hypothesis`] and all the bytes. Out: a [`Proposal`] that the daemon's own decoder
//! has tried.

use hardnessd_core::wire::{
    Cell, Checksum, ChecksumOver, Decoder, FooterBytes, HexBytes, Layout, LengthField, Preset,
    Settings,
};

use super::checks::{Check, Holds, Over};
use super::columns::{Kind, Number};
use super::hypotheses::{Framed, Hypothesis, cell_bytes};

/// A layout, and the outcome of decoding the bytes with it.
#[derive(Debug, Clone)]
pub(super) struct Proposal {
    /// The settings of the layout, with the fewest keys.
    pub(super) settings: Settings,
    pub(super) frames: u64,
    pub(super) frames_damaged: u64,
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
        let (mut frames, mut frames_damaged) = (0, 0);
        let mut count = |decoder: &mut Decoder| {
            while let Some(item) = decoder.next_frame() {
                *if item.is_ok() {
                    &mut frames
                } else {
                    &mut frames_damaged
                } += 1;
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
            share,
            remarks: Vec::new(),
            doubt: None,
        })
    }

    /// The proposal for an array in frames.
    pub(super) fn of(framed: &Framed, hypothesis: &Hypothesis, bytes: &[u8]) -> Option<Self> {
        let parts = Parts { framed, hypothesis };
        let checked = match &framed.holds {
            Some(Holds::Checksum(check)) => Some(parts.settings(Some(check))),
            _ => None,
        };
        let plain = || parts.settings(None);
        let tried = checked
            .into_iter()
            .flatten()
            .chain(std::iter::once_with(plain).flatten());
        let mut proposal = tried
            .into_iter()
            .find_map(|settings| Self::decoded(settings, bytes))?;
        proposal.remarks = parts.remarks();
        Some(proposal)
    }
}

/// The parts of a frame of an array.
struct Parts<'a> {
    framed: &'a Framed<'a>,
    hypothesis: &'a Hypothesis,
}

/// A stretch of the bytes between the cells of two frames, counted from the first of them.
type Between = std::ops::Range<usize>;

impl Parts<'_> {
    /// The place in a frame of a byte between the cells.
    fn column(&self, between: usize) -> usize {
        let period = self.framed.columns.kinds.len();
        (period - self.framed.overhead - self.hypothesis.skipped.1 + between) % period
    }

    /// The number of bytes between the cells of two frames.
    fn between(&self) -> usize {
        let (before, after) = self.hypothesis.skipped;
        after + self.framed.overhead + before
    }

    /// The value of a byte between the cells, if it may belong to a mark. Skipped zeros do not,
    /// unless they complete the field of the length or a mark of words.
    fn constant(&self, between: usize) -> Option<u8> {
        match self.framed.columns.kinds[self.column(between)] {
            Kind::Constant(value) if self.may_be_mark(between) => Some(value),
            _ => None,
        }
    }

    fn may_be_mark(&self, between: usize) -> bool {
        let (before, after) = self.hypothesis.skipped;
        let width = cell_bytes(self.hypothesis.cell);
        let length = self.hypothesis.array.taxels() * width;
        let is_skipped = between >= after + self.framed.overhead;
        between >= after && (!is_skipped || self.framed.completes_mark(before, length, width))
    }

    /// The end of the constant bytes that begin at `from`.
    fn constant_end(&self, from: usize) -> usize {
        (from..self.between())
            .find(|&at| self.constant(at).is_none())
            .unwrap_or(self.between())
    }

    /// The likeliest mark: the constant bytes with the most that are not 0.
    fn mark(&self) -> Option<Between> {
        let begins = (0..self.between()).filter(|&at| {
            self.constant(at).is_some() && (at == 0 || self.constant(at - 1).is_none())
        });
        let runs = begins.map(|start| self.without_numbers(start..self.constant_end(start)));
        let weight = |run: &Between| {
            let values = run.clone().map(|at| self.constant(at));
            values.filter(|&value| value != Some(0)).count()
        };
        runs.rev().max_by_key(weight).filter(|run| weight(run) > 0)
    }

    /// Constant bytes without the zeros at their ends that may be the high bytes of a number.
    fn without_numbers(&self, mut run: Between) -> Between {
        let is_number = |at: usize| self.framed.columns.kinds[self.column(at)] == Kind::Number;
        if run.start > 0 && is_number(run.start - 1) {
            run.start = run
                .clone()
                .find(|&at| self.constant(at) != Some(0))
                .unwrap_or(run.end);
        }
        if run.end < self.between() && is_number(run.end) {
            let last = run.clone().rfind(|&at| self.constant(at) != Some(0));
            run.end = last.map_or(run.start, |at| at + 1);
        }
        run
    }

    /// Settings for this array, those with the fewest keys first. All of them find the same frames.
    fn settings(&self, check: Option<&Check>) -> Vec<Settings> {
        let end =
            self.framed.columns.kinds.len() - self.framed.overhead - self.hypothesis.skipped.1;
        let check_at = check.map(|check| check.at.wrapping_sub(end));
        let check_end = check_at.map_or(0, |at| {
            at.wrapping_add(check.map_or(0, |check| check.checksum.bytes()))
        });
        if check_end > self.between() {
            return Vec::new();
        }
        let begins = match check.map(|check| &check.over) {
            Some(Over::All(start)) => Some(start - end),
            _ => self.beginning(),
        };
        let mark = match (check_at, begins) {
            (Some(_), Some(begins)) => check_end..self.constant_end(begins.max(check_end)),
            (Some(_), None) => check_end..self.constant_end(check_end),
            (None, _) => match self.mark() {
                Some(mark) => mark,
                None => return Vec::new(),
            },
        };
        if mark.clone().any(|at| self.constant(at).is_none()) || mark.is_empty() {
            return Vec::new();
        }
        let begins = begins.filter(|&at| (mark.start..=mark.end).contains(&at));
        let splits = match begins {
            Some(at) => at..=at,
            None => mark.start..=mark.end,
        };
        let mut found: Vec<Settings> = splits
            .filter_map(|split| self.of_split(&mark, split, check, check_at.unwrap_or(mark.start)))
            .collect();
        found.sort_by_key(keys);
        found
    }

    /// The place between the cells at which the stream begins.
    fn beginning(&self) -> Option<usize> {
        let turn = self.framed.frames.turn_of_beginning()?;
        (0..=self.between()).find(|&between| self.column(between) == turn)
    }

    /// The settings for a frame that begins at `split` within the mark.
    fn of_split(
        &self,
        mark: &Between,
        split: usize,
        check: Option<&Check>,
        footer: usize,
    ) -> Option<Settings> {
        let values =
            |range: Between| -> Vec<u8> { range.filter_map(|at| self.constant(at)).collect() };
        let (tail, mut sync) = (values(mark.start..split), values(split..mark.end));
        let Hypothesis { array, cell, .. } = *self.hypothesis;
        let length = (array.taxels() * cell_bytes(cell)) as u16;
        let fields = [
            (LengthField::U16le, length.to_le_bytes().to_vec()),
            (LengthField::U16be, length.to_be_bytes().to_vec()),
            (LengthField::U8, vec![length as u8]),
        ];
        let field = fields.into_iter().find(|(field, bytes)| {
            (*field != LengthField::U8 || length <= 0xFF)
                && sync.len() > bytes.len()
                && sync.ends_with(bytes)
        });
        let length = field.map_or(LengthField::None, |(field, bytes)| {
            sync.truncate(sync.len() - bytes.len());
            field
        });
        let settings = Settings {
            sync: Some(HexBytes(sync)),
            tail: Some(HexBytes(tail)),
            length: Some(length),
            header_bytes: Some(self.between() - mark.end),
            cell: Some(cell),
            footer_bytes: Some(FooterBytes::Each(footer)),
            checksum: Some(check.map_or(Checksum::None, |check| check.checksum)),
            checksum_over: Some(match check.map(|check| &check.over) {
                Some(Over::Cells(_)) => ChecksumOver::Cells,
                _ => ChecksumOver::All,
            }),
            rows: Some(array.rows),
            cols: Some(array.cols),
            ..Settings::default()
        };
        let layout = Layout::new(&settings).ok()?;
        let marked = Settings {
            preset: Preset::FfTail,
            rows: Some(array.rows),
            cols: Some(array.cols),
            ..Settings::default()
        };
        let plain =
            self.between() == 1 && settings.tail == Some(HexBytes(vec![0xFF])) && cell == Cell::U8;
        if plain
            && self
                .framed
                .frames
                .iter()
                .all(|frame| frame.iter().filter(|byte| **byte == 0xFF).count() <= 1)
        {
            let layout = Layout::new(&marked).ok()?;
            return Some(shortened(marked, &layout));
        }
        Some(simplest(&settings, &layout))
    }

    fn remarks(&self) -> Vec<String> {
        let (_, after) = self.hypothesis.skipped;
        let end = self.framed.columns.kinds.len() - self.framed.overhead;
        let number = |number: &Number| {
            let place = match number.at.checked_sub(end) {
                Some(offset) => format!("{} after the last cell", bytes(offset + after)),
                None => "before the cells".to_owned(),
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
        let mut remarks: Vec<String> = self.framed.columns.numbers.iter().map(number).collect();
        let kinds = (0..self.between()).map(|at| self.framed.columns.kinds[self.column(at)]);
        let unknown = kinds.filter(|&kind| kind == Kind::Active).count();
        if unknown > 0 {
            remarks.push(format!(
                "the meaning of {} beside the cells is unknown: skipped",
                bytes(unknown)
            ));
        }
        let is_checked_from_mark = matches!(&self.framed.holds, Some(Holds::Checksum(check)) if matches!(check.over, Over::All(_)));
        if let Some(Holds::Sum(sum)) = &self.framed.holds {
            remarks.push(format!(
                "a sum of the cells takes {}: no key describes it, so it is skipped",
                bytes(sum.len())
            ));
        }
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

/// The same layout with the fewest keys.
fn simplest(settings: &Settings, layout: &Layout) -> Settings {
    let bases = [
        Preset::Jx255n,
        Preset::Jx255nU16,
        Preset::Jq,
        Preset::JqTail,
        Preset::JqU16,
        Preset::Flexitac,
        Preset::M1616,
    ];
    bases
        .into_iter()
        .map(|preset| Settings {
            preset,
            ..settings.clone()
        })
        .filter(|other| Layout::new(other).as_ref() == Ok(layout))
        .map(|other| shortened(other, layout))
        .min_by_key(keys)
        .unwrap_or_else(|| settings.clone())
}

/// The settings without the keys whose absence changes nothing.
pub(super) fn shortened(mut settings: Settings, layout: &Layout) -> Settings {
    let forget: [fn(&mut Settings); 10] = [
        |settings| settings.sync = None,
        |settings| settings.tail = None,
        |settings| settings.length = None,
        |settings| settings.header_bytes = None,
        |settings| settings.cell = None,
        |settings| settings.footer_bytes = None,
        |settings| settings.checksum = None,
        |settings| settings.checksum_over = None,
        |settings| settings.rows = None,
        |settings| settings.cols = None,
    ];
    for forget in forget {
        let mut shorter = settings.clone();
        forget(&mut shorter);
        if Layout::new(&shorter).as_ref() == Ok(layout) {
            settings = shorter;
        }
    }
    settings
}

/// The number of keys, the preset included.
pub(super) fn keys(settings: &Settings) -> usize {
    toml::Table::try_from(settings)
        .expect("settings are a table")
        .len()
}
