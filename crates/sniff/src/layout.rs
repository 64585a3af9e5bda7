//! Writes an array at its place as settings, and decodes the bytes with them.
//!
//! In: the [`Parts`] of a frame, and all the bytes. Out: a [`Proposal`] that the daemon's own decoder
//! has tried.

use std::ops::Range;

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{
    Cell, Checksum, ChecksumOver, Decoder, HexBytes, Layout, LengthField, Order, Preset, Settings,
};

use crate::checks::Check;
use crate::columns::{Columns, Number};
use crate::places::{LEAST_MARK, Place};

/// A layout, and the outcome of decoding the bytes with it.
#[derive(Debug, Clone)]
pub struct Proposal {
    /// The settings of the layout.
    pub settings: Settings,
    /// Whether a known board has this layout, which its preset names.
    pub is_board: bool,
    /// The frames that the daemon's decoder finds.
    pub frames: u64,
    /// The damaged frames among the bytes.
    pub frames_damaged: u64,
    /// Share of all bytes that whole frames hold.
    pub share: f64,
    /// What else there is to say.
    pub remarks: Vec<String>,
}

/// The bytes that are decoded at once.
const CHUNK_BYTES: usize = 8 * 1024;
/// The least share of the bytes that a layout must explain to be likely, and to be sure.
const LIKELY_SHARE: f64 = 0.5;
const SURE_SHARE: f64 = 0.9;
/// One in as many frames may be damaged.
const DAMAGED: u64 = 20;

/// How many ways to divide a mark into tail and header are tried.
const MOST_SPLITS: usize = 3;
/// A mark has at most so many bytes, if these find all frames. Constant bytes beside them may be numbers that change
/// seldom.
const MOST_MARK: usize = 4;

/// Hands each frame in `bytes` to `take`, as the daemon would decode it. Returns the number of damaged
/// ones, and the share of the bytes that frames hold. `None` for impossible settings.
pub(crate) fn decode(
    settings: &Settings,
    bytes: &[u8],
    mut take: impl FnMut(RawFrame),
) -> Option<(u64, f64)> {
    let mut decoder = Decoder::new(Layout::new(settings).ok()?);
    let mut damaged = 0;
    let mut drain = |decoder: &mut Decoder| {
        while let Some(item) = decoder.next_frame() {
            match item {
                Ok(found) => take(found.frame),
                Err(_) => damaged += 1,
            }
        }
    };
    for chunk in bytes.chunks(CHUNK_BYTES) {
        decoder.push(chunk);
        drain(&mut decoder);
    }
    decoder.settle();
    drain(&mut decoder);
    let explained = decoder.received() - decoder.skipped() - decoder.pending().len() as u64;
    Some((damaged, explained as f64 / bytes.len() as f64))
}

impl Proposal {
    /// Decodes `bytes` with the settings. `None` if they find too few frames, or many damaged ones.
    pub(crate) fn decoded(settings: Settings, is_board: bool, bytes: &[u8]) -> Option<Self> {
        let mut frames = 0;
        let (frames_damaged, share) = decode(&settings, bytes, |_| frames += 1)?;
        (frames >= 3 && share >= LIKELY_SHARE && 4 * frames_damaged <= frames).then_some(Self {
            settings,
            is_board,
            frames,
            frames_damaged,
            share,
            remarks: Vec::new(),
        })
    }

    /// Whether it is that of a known board, or has a checksum.
    pub(crate) fn is_checked(&self) -> bool {
        let checksum = self.settings.checksum.unwrap_or(Checksum::None);
        self.is_board || checksum != Checksum::None
    }

    /// The proposal for an array in frames.
    pub(crate) fn of(parts: &Parts, bytes: &[u8]) -> Option<Self> {
        let tried = [parts.check(), None]
            .into_iter()
            .flat_map(|check| parts.settings(check));
        let mut decoded =
            tried.filter_map(|(settings, is_board)| Self::decoded(settings, is_board, bytes));
        let first = decoded.next()?;
        let mut proposal = if first.explains_nearly_all() {
            first
        } else {
            decoded.find(Self::explains_nearly_all).unwrap_or(first)
        };
        proposal.remarks = parts.remarks();
        Some(proposal)
    }

    /// Whether the daemon would read nearly all that is sent.
    pub(crate) fn explains_nearly_all(&self) -> bool {
        self.share >= SURE_SHARE && DAMAGED * self.frames_damaged <= self.frames
    }

    /// The lines below `[sensor.frame]`.
    pub fn toml(&self) -> String {
        toml::to_string(&self.settings).expect("settings are keys and plain values")
    }
}

/// The boards that a preset is of, and the arrays that they have. An empty list is for all arrays.
const BOARDS: [(Preset, &[(usize, usize)]); 7] = [
    (Preset::Jx255n, &[(28, 28)]),
    (Preset::Jx255nU16, &[(28, 28)]),
    (Preset::Jq, &[]),
    (Preset::JqTail, &[]),
    (Preset::JqU16, &[]),
    (Preset::Flexitac, &[(12, 32), (16, 32), (32, 32)]),
    (Preset::M1616, &[(16, 16)]),
];

/// The preset of a board with this layout, with its sides if they are not those of the preset.
fn board(layout: &Layout) -> Option<Settings> {
    let Array { rows, cols } = layout.array();
    let of = BOARDS
        .iter()
        .filter(|(_, arrays)| arrays.is_empty() || arrays.contains(&(rows, cols)));
    let mut presets = of.flat_map(|&(preset, _)| {
        let named = Settings {
            preset: Some(preset),
            ..Settings::default()
        };
        let with_sides = Settings {
            rows: Some(rows),
            cols: Some(cols),
            ..named.clone()
        };
        [named, with_sides]
    });
    presets.find(|settings| Layout::new(settings).as_ref() == Ok(layout))
}

/// The parts of a frame of an array.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parts<'a> {
    pub(crate) columns: &'a Columns,
    pub(crate) place: &'a Place,
    pub(crate) array: Array,
    pub(crate) order: Order,
    pub(crate) cell: Cell,
    /// How many numbers a taxel has, and which of them is read.
    pub(crate) channels: usize,
    pub(crate) channel: usize,
    /// Where in the period a frame begins, if that is known.
    pub(crate) begin: Option<usize>,
}

/// Constant bytes by which the daemon finds frames, where a frame begins, if that is known, and what the checksum
/// covers.
type Mark = (Range<usize>, Option<usize>, Option<ChecksumOver>);

impl Parts<'_> {
    /// The checksum. Of several numbers a taxel, the cells that are read are not all that it covers.
    fn check(&self) -> Option<Check> {
        let check = self.place.check?;
        (check.begin.is_some() || self.channels == 1).then_some(check)
    }

    /// The settings for this array, the likeliest first, and whether a board has them.
    fn settings(&self, check: Option<Check>) -> Vec<(Settings, bool)> {
        let marks = self.marks(check);
        let of = |mark: &Mark| -> Vec<(Settings, bool)> {
            let (bytes, begin, _) = mark;
            let begin = begin.filter(|at| (bytes.start..=bytes.end).contains(at));
            let splits = begin.into_iter().chain(bytes.start..=bytes.end);
            let settings = splits.filter_map(|split| {
                let settings = self.of_split(mark, split, check);
                let layout = Layout::new(&settings).ok()?;
                Some(board(&layout).map_or((settings, false), |board| (board, true)))
            });
            settings.collect()
        };
        let short = marks.iter().map(|mark| self.shortened(mark.clone(), check));
        let mut tried: Vec<_> = short.flat_map(|mark| of(&mark)).collect();
        tried.truncate(MOST_SPLITS);
        let (boards, others): (Vec<_>, Vec<_>) = marks
            .iter()
            .flat_map(of)
            .partition(|(_, is_board)| *is_board);
        tried.extend(others.into_iter().take(MOST_SPLITS));
        [boards, tried].concat()
    }

    /// The marks that there may be, the likeliest first.
    fn marks(&self, check: Option<Check>) -> Vec<Mark> {
        let beginning = self.beginning();
        let Some(check) = check else {
            let mark = self.place.mark().into_iter();
            return mark.map(|bytes| (bytes, beginning, None)).collect();
        };
        let end = check.places().end;
        let from = |begin: usize| {
            let whole = end..self.place.constant_end(begin);
            let shorter = self.place.without_high_bytes(whole.clone()).end;
            end..shorter.max(begin + 1).min(whole.end)
        };
        let mut marks = match check.begin {
            None => {
                let begin = beginning.unwrap_or(end).max(end);
                vec![(from(begin), Some(begin), Some(ChecksumOver::Cells))]
            }
            Some(begin) => {
                let over = Some(ChecksumOver::AfterSync);
                let after = (end..begin, beginning.or(Some(end)), over);
                vec![after, (from(begin), Some(begin), None)]
            }
        };
        // A single constant byte before the covered ones may end the frame before. If two constant bytes begin the
        // covered ones, these are likelier the mark.
        if let Some(begin) = check.begin {
            let own = self.place.own_mark(&(end..begin));
            let before = begin - own.map_or(end, |own| own.end);
            let behind = self.place.constant_end(begin) - begin;
            if before < LEAST_MARK && (before == 0 || behind >= LEAST_MARK) {
                marks.reverse();
            }
        }
        marks.retain(|(bytes, ..)| {
            let is_constant = |at| self.place.constant(at).is_some();
            !bytes.is_empty() && bytes.clone().all(is_constant)
        });
        marks
    }

    /// The mark with no more bytes than are needed.
    fn shortened(&self, (bytes, begin, over): Mark, check: Option<Check>) -> Mark {
        let own = self.place.own_mark(&bytes);
        let first = match &own {
            Some(own) if check.is_none() => own.start,
            _ => bytes.start,
        };
        let from = check.and(begin).unwrap_or(first);
        let from = own.map_or(from, |own| from.max(own.end));
        let last = match over {
            Some(ChecksumOver::AfterSync) => bytes.end,
            _ => bytes.end.min(from + MOST_MARK),
        };
        (first..last, begin, over)
    }

    /// The place beside the cells at which a frame begins.
    fn beginning(&self) -> Option<usize> {
        let period = self.columns.kinds.len();
        let end = self.place.start + self.place.bytes;
        let at = (self.begin? + 2 * period - end) % period;
        (at <= self.place.beside.len()).then_some(at)
    }

    /// The settings for a frame that begins at `split` within the mark. Places are counted from the end of the
    /// cells. No key is left to its default.
    fn of_split(&self, (mark, _, over): &Mark, split: usize, check: Option<Check>) -> Settings {
        let read = check.and_then(|check| Some((check.checksum?, check.at)));
        let values = |range: Range<usize>| -> Vec<u8> {
            range.filter_map(|at| self.place.constant(at)).collect()
        };
        let (tail, mut sync) = (values(mark.start..split), values(split..mark.end));
        let bytes = self.place.bytes as u16;
        let fields = [
            (LengthField::U16le, bytes.to_le_bytes().to_vec()),
            (LengthField::U16be, bytes.to_be_bytes().to_vec()),
            (LengthField::U8, vec![bytes as u8]),
        ];
        let is_field = |(field, written): &(LengthField, Vec<u8>)| {
            self.channels == 1
                && (*field != LengthField::U8 || bytes <= 0xFF)
                && sync.len() > written.len()
                && sync.ends_with(written)
        };
        let field = fields.into_iter().find(is_field);
        let length = field.map_or(LengthField::None, |(field, written)| {
            sync.truncate(sync.len() - written.len());
            field
        });
        // The other numbers of the first taxel and of the last one are skipped too.
        let number = self.cell.bytes();
        let header = self.place.beside.len() - mark.end + self.channel * number;
        let footer =
            read.map_or(mark.start, |(_, at)| at) + (self.channels - 1 - self.channel) * number;
        Settings {
            sync: Some(HexBytes(sync)),
            tail: (!tail.is_empty()).then_some(HexBytes(tail)),
            length: Some(length),
            header_bytes: (header > 0).then_some(header),
            cell: Some(self.cell),
            stride_bytes: (self.channels > 1).then_some(self.channels * number),
            footer_bytes: (footer > 0).then_some(footer),
            checksum: Some(read.map_or(Checksum::None, |(checksum, _)| checksum)),
            checksum_over: read.and(*over),
            rows: Some(self.array.rows),
            cols: Some(self.array.cols),
            order: (self.order != Order::RowMajor).then_some(self.order),
            ..Settings::default()
        }
    }

    fn remarks(&self) -> Vec<String> {
        let period = self.columns.kinds.len();
        let number = |number: &Number| {
            let at = (number.at + 2 * period - self.place.start - self.place.bytes) % period;
            let is_after = at < self.place.mark().map_or(0, |mark| mark.start);
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
        if self.channels > 1 {
            remarks.push(format!(
                "each taxel has {} numbers; number {} is read, which changes most: for another, write other \
                 header_bytes and footer_bytes, by {} a number",
                self.channels,
                self.channel + 1,
                bytes(self.cell.bytes())
            ));
        }
        let unknown = self.place.unknown().count();
        if unknown > 0 {
            remarks.push(format!(
                "the meaning of {} beside the cells is unknown: skipped",
                bytes(unknown)
            ));
        }
        let is_checked_from_mark = self.check().is_some_and(|check| check.begin.is_some());
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

/// A number of bytes in words.
fn bytes(number: usize) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} byte{plural}")
}
