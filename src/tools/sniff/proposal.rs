//! Measures how well layouts explain bytes, and ranks them.
//!
//! In: raw bytes. Out: [`Proposal`]s, best first. The daemon's own decoder decodes all the bytes
//! for each of them. The same bytes give the same proposals. The number of bytes bounds the time.

use std::cmp::Reverse;

use super::candidates::{candidates, marked_array, packed_array, text_array};
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Cell, Checksum, Decoder, Layout, LengthField, Preset, Settings};

/// The number of pieces that candidates are first tried on. The pieces come from all over the
/// bytes, so that neither a bad beginning nor a long rest decides.
const PIECES: usize = 8;
/// The bytes of a piece: five of the longest frames, or ten of the JX255N's.
const PIECE_BYTES: usize = 8 * 1024;
/// The number of candidates that are tried on all the bytes.
const FINALISTS: usize = 4;
/// The least share of the bytes that a layout must explain. Noise contains some frames of `ff-tail`
/// or `zero-run` by chance.
const LEAST_SHARE: f64 = 0.5;
/// The least number of whole frames that a layout must find.
const LEAST_FRAMES: u64 = 3;
/// Without a checksum, at most one in this many candidates for a frame may be damaged, because
/// marks repeat in a text too.
const CANDIDATES_A_DAMAGED: u64 = 10;

/// The bits of a layout in which every byte of a frame must be in order. That is as good as a
/// checksum.
const ALL_IN_ORDER: u32 = u32::MAX;

/// The bits of `ff-tail`: more than any one byte, because its cells have no FF, and less than any
/// two bytes.
const FF_TAIL_BITS: u32 = 16;

/// A layout, and the outcome of decoding the bytes with it.
#[derive(Debug, Clone)]
pub(super) struct Proposal {
    /// The settings of the layout, with the fewest keys.
    pub(super) settings: Settings,
    /// The number of whole frames.
    pub(super) frames: u64,
    /// The number of whole frames that differ from the one before.
    pub(super) frames_changed: u64,
    pub(super) frames_damaged: u64,
    /// The number of bytes in whole frames.
    pub(super) bytes_explained: u64,
    /// Share of all bytes that the proposal explains.
    pub(super) share: f64,
    /// Mean difference of neighbouring taxels, in counts.
    roughness: f64,
    /// The information of the constant bytes, in bits.
    bits: u32,
    is_checked: bool,
    length_bytes: usize,
    is_preset: bool,
    overhead_bytes: usize,
    keys: usize,
    /// Whether the bytes begin with the layout's tail, which is then a header.
    is_headed_by_tail: bool,
    /// The values for the criteria of [`MERITS`], in the same order. More is better.
    merits: [u64; MERITS.len()],
}

/// The place of the criterion for checksums in [`MERITS`].
const CHECKED: usize = 0;
/// The place of the criterion for constant bytes in [`MERITS`].
const CONSTANT: usize = 3;

/// The criteria for preferring a layout. The first one in which two layouts differ decides.
const MERITS: [&str; 9] = [
    "its checksum fits frames that change",
    "it explains more of the bytes",
    "the bytes begin with its header, which the other takes for a tail",
    "its constant bytes are less likely to be there by chance",
    "its length field has the right value",
    "it is a preset as it is",
    "it leaves fewer bytes beside the cells",
    "it needs fewer keys",
    "it explains a few bytes more",
];

/// Layouts that explain `bytes`, best first. Empty if there is none.
pub(super) fn propose(bytes: &[u8]) -> Vec<Proposal> {
    let sample = sample(bytes);
    let presets = [
        (Preset::FfTail, FF_TAIL_BITS, marked_array(&sample)),
        (Preset::Ascii, ALL_IN_ORDER, text_array(&sample)),
        (Preset::ZeroRun, ALL_IN_ORDER, packed_array(&sample)),
    ]
    .into_iter()
    .filter_map(|(preset, bits, array)| {
        let Array { rows, cols } = array?;
        let settings = Settings {
            preset,
            rows: (rows != Array::JX255N.rows).then_some(rows),
            cols: (cols != Array::JX255N.cols).then_some(cols),
            ..Settings::default()
        };
        Some((settings, bits))
    })
    .collect::<Vec<_>>();
    let mut proposals: Vec<Proposal> = candidates(&sample)
        .iter()
        .chain(&presets)
        .filter_map(|(settings, bits)| Proposal::of(settings, *bits, &sample))
        .collect();
    rank(&mut proposals);
    proposals.truncate(FINALISTS);
    proposals = proposals
        .iter()
        .filter_map(|proposal| smoother(proposal, bytes))
        // This holds only for all the bytes: the pieces of the sample begin and end within frames.
        .filter(|p| p.is_checked || is_little_damaged(p))
        .collect();
    rank(&mut proposals);
    proposals
}

impl Proposal {
    /// Decodes `bytes` with the layout of `settings`. `None` if it explains too little.
    fn of(settings: &Settings, bits: u32, bytes: &[u8]) -> Option<Self> {
        let layout = Layout::new(settings).ok()?;
        let mut decoder = Decoder::new(layout);
        let mut tally = Tally::default();
        for chunk in bytes.chunks(PIECE_BYTES) {
            decoder.push(chunk);
            tally.take(&mut decoder);
        }
        decoder.settle();
        tally.take(&mut decoder);
        let bytes_explained = decoder.received() - decoder.skipped() - decoder.pending() as u64;
        let share = bytes_explained as f64 / bytes.len() as f64;
        if tally.frames < LEAST_FRAMES || share < LEAST_SHARE {
            return None;
        }
        let is_headed_by_tail = is_headed_by_tail(settings, bytes);
        let settings = simplest(settings, decoder.layout());
        Some(Self {
            bits,
            keys: keys(&settings),
            is_checked: bits == ALL_IN_ORDER
                || is_other(&settings, decoder.layout(), |settings| {
                    settings.checksum = Some(Checksum::None);
                }),
            length_bytes: length_bytes(&settings, decoder.layout()),
            is_preset: is_preset(&settings),
            overhead_bytes: overhead_bytes(&settings, decoder.layout()),
            is_headed_by_tail,
            merits: Default::default(),
            settings,
            frames: tally.frames,
            frames_changed: tally.changed,
            frames_damaged: tally.damaged,
            bytes_explained,
            share,
            roughness: tally.roughness as f64 / tally.frames as f64,
        })
    }

    /// The reason why this proposal ranks before `other`. `None` if there is no reason: the bytes
    /// do not tell the two apart.
    pub(super) fn reason(&self, other: &Self) -> Option<&'static str> {
        let mut merits = self.merits.iter().zip(&other.merits);
        let decisive = merits.position(|(ours, theirs)| ours > theirs)?;
        let is_in_order = self.bits == ALL_IN_ORDER && [CHECKED, CONSTANT].contains(&decisive);
        Some(if is_in_order {
            "every byte of its frames is in order"
        } else {
            MERITS[decisive]
        })
    }

    /// Whether the two layouts write the same stream, except for its first and last bytes. One then
    /// has a header where the other has a tail.
    pub(super) fn is_same_but_for_the_ends(&self, other: &Self) -> bool {
        let encoded = |proposal: &Self| {
            let mut bytes = Vec::new();
            let layout = Layout::new(&proposal.settings).ok()?;
            let mut frame = RawFrame::zero(layout.array());
            let counts = frame.counts.iter_mut().zip(0..);
            counts.for_each(|(count, taxel)| *count = taxel);
            layout.encode(&frame, &mut bytes);
            Some(bytes)
        };
        let (Some(ours), Some(theirs)) = (encoded(self), encoded(other)) else {
            return false;
        };
        ours.len() == theirs.len() && theirs.repeat(2).windows(ours.len()).any(|at| at == ours)
    }

    /// The number of bytes in frames that differ from the one before.
    fn bytes_changed(&self) -> u64 {
        self.frames_changed * self.bytes_explained / self.frames
    }
}

/// Counts over one decoding.
#[derive(Default)]
struct Tally {
    frames: u64,
    changed: u64,
    damaged: u64,
    roughness: u64,
    last: Option<hardnessd_core::frame::RawFrame>,
}

impl Tally {
    fn take(&mut self, decoder: &mut Decoder) {
        while let Some(item) = decoder.next_frame() {
            let Ok(decoded) = item else {
                self.damaged += 1;
                continue;
            };
            let counts = &decoded.frame.counts;
            self.frames += 1;
            self.changed += u64::from(
                self.last
                    .as_ref()
                    .is_some_and(|last| last.counts != *counts),
            );
            self.roughness += counts
                .array_windows()
                .map(|[a, b]| u64::from(a.abs_diff(*b)))
                .sum::<u64>();
            self.last = Some(decoded.frame);
        }
    }
}

/// Sorts the proposals, best first, by the criteria of [`MERITS`]:
///
/// - A checksum that fits frames which change is no accident, even if another layout finds more in
///   damaged frames.
/// - Shares of explained bytes within two frames or a fiftieth of the best are equal, because
///   damage in a mark costs the longer mark more.
/// - The first bytes of all are not a tail.
/// - Marks with more information come first, then a length field before a longer sync, an unchanged
///   preset, few bytes beside the cells (the rest are taxels at rest), and few keys.
fn rank(proposals: &mut [Proposal]) {
    let most = |of: fn(&Proposal) -> u64| proposals.iter().map(of).max().unwrap_or_default();
    let changed = most(Proposal::bytes_changed);
    let enough = most(|p| {
        let slack = (p.bytes_explained / 50).max(2 * p.bytes_explained / p.frames);
        p.bytes_explained - slack
    });
    for p in proposals.iter_mut() {
        let is_checked = p.is_checked && 4 * p.bytes_changed() >= 3 * changed;
        p.merits = [
            u64::from(p.bits == ALL_IN_ORDER || is_checked),
            p.bytes_explained.min(enough),
            u64::from(!p.is_headed_by_tail),
            u64::from(p.bits),
            p.length_bytes as u64,
            u64::from(p.is_preset),
            u64::MAX - p.overhead_bytes as u64,
            u64::MAX - p.keys as u64,
            p.bytes_explained,
        ];
    }
    proposals.sort_by_key(|p| Reverse(p.merits));
}

fn is_little_damaged(proposal: &Proposal) -> bool {
    let Proposal {
        frames,
        frames_damaged,
        ..
    } = proposal;
    CANDIDATES_A_DAMAGED * frames_damaged <= frames + frames_damaged
}

/// The layout on all the bytes. Two-byte cells get the byte order that makes smoother frames.
fn smoother(of_sample: &Proposal, bytes: &[u8]) -> Option<Proposal> {
    let (settings, bits) = (&of_sample.settings, of_sample.bits);
    // The sample begins as the bytes do, so it has shown whether the tail is a header.
    let proposed = |settings| {
        let proposal = Proposal::of(settings, bits, bytes)?;
        Some(Proposal {
            is_headed_by_tail: of_sample.is_headed_by_tail,
            ..proposal
        })
    };
    let proposal = proposed(settings)?;
    let swapped = |cell| Settings {
        cell: Some(cell),
        ..settings.clone()
    };
    let as_is = Layout::new(settings);
    // Only a layout of two-byte cells stays the same with `U16le` cells.
    if Layout::new(&swapped(Cell::U16le)) != as_is {
        return Some(proposal);
    }
    match proposed(&swapped(Cell::U16be)) {
        Some(other) if other.roughness < proposal.roughness => Some(other),
        _ => Some(proposal),
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
fn shortened(mut settings: Settings, layout: &Layout) -> Settings {
    let forget: [fn(&mut Settings); 7] = [
        |settings| settings.sync = None,
        |settings| settings.tail = None,
        |settings| settings.length = None,
        |settings| settings.cell = None,
        |settings| settings.checksum = None,
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

/// Whether `change` makes another layout, and a valid one.
fn is_other(settings: &Settings, layout: &Layout, change: impl Fn(&mut Settings)) -> bool {
    let mut changed = settings.clone();
    change(&mut changed);
    Layout::new(&changed).is_ok_and(|other| other != *layout)
}

/// Whether the layout is the same after `change`.
fn is_same(settings: &Settings, layout: &Layout, change: impl Fn(&mut Settings)) -> bool {
    let mut changed = settings.clone();
    change(&mut changed);
    Layout::new(&changed).as_ref() == Ok(layout)
}

/// Bytes of the length field.
fn length_bytes(settings: &Settings, layout: &Layout) -> usize {
    let has = |length| is_same(settings, layout, |settings| settings.length = Some(length));
    if has(LengthField::U8) {
        1
    } else if has(LengthField::U16le) || has(LengthField::U16be) {
        2
    } else {
        0
    }
}

/// Bytes of a frame beside its cells.
fn overhead_bytes(settings: &Settings, layout: &Layout) -> usize {
    let has = |cell| is_same(settings, layout, |settings| settings.cell = Some(cell));
    let is_wide = has(Cell::U16le) || has(Cell::U16be);
    let Array { rows, cols } = layout.array();
    layout.max_frame_bytes() - rows * cols * if is_wide { 2 } else { 1 }
}

/// Whether `bytes` begin with the layout's tail. Candidates give every key, so they give their
/// tail. Of the presets that are tried, only `ff-tail` has a tail.
fn is_headed_by_tail(candidate: &Settings, bytes: &[u8]) -> bool {
    let tail = match (&candidate.tail, candidate.preset) {
        (Some(tail), _) => &tail.0[..],
        (None, Preset::FfTail) => &[0xFF],
        (None, _) => &[],
    };
    !tail.is_empty() && bytes.starts_with(tail)
}

/// Whether nothing but the size of the array differs from the preset.
fn is_preset(settings: &Settings) -> bool {
    let Settings {
        preset, rows, cols, ..
    } = *settings;
    let sized = Settings {
        preset,
        rows,
        cols,
        ..Settings::default()
    };
    *settings == sized
}

/// The number of keys, the preset included.
fn keys(settings: &Settings) -> usize {
    toml::Table::try_from(settings)
        .expect("settings are a table")
        .len()
}

/// Pieces from all over `bytes`, or all of `bytes` if they are few.
fn sample(bytes: &[u8]) -> Vec<u8> {
    if bytes.len() <= PIECES * PIECE_BYTES {
        return bytes.to_vec();
    }
    let step = (bytes.len() - PIECE_BYTES) / (PIECES - 1);
    (0..PIECES)
        .flat_map(|piece| &bytes[piece * step..][..PIECE_BYTES])
        .copied()
        .collect()
}
