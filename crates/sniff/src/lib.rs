//! Finds the layout of an unknown array's frames in raw bytes.
//!
//! In: bytes as they came, with the times of their arrival where they are known, and what the user knows
//! of the array. Out: ranked layouts, each tried with the daemon's own decoder, or the reason why there is
//! none. It opens no port and no file, and prints nothing.
//!
//! The files below are in reading order, and each uses only those above it. `model` says how likely a
//! layout is.

mod numbers;
mod pictures;
mod model;
mod period;
mod columns;
mod checks;
mod places;
mod cells;
mod layout;
mod scale;
mod found;
mod coding;
mod text;
mod search;
mod packed;

use hardnessd_core::wire::{Cell, Layout, Preset, Settings, TELNET};

use coding::Coding;
pub use found::{Failure, Found, Known, Ranked};
pub use layout::Proposal;
pub use scale::Scale;

/// Bytes of a sensor.
#[derive(Debug, Clone, Default)]
pub struct Capture {
    /// The bytes, in order.
    pub bytes: Vec<u8>,
    /// When bytes came, in order. Empty if that is not known.
    pub arrivals: Vec<Arrival>,
}

/// The arrival of some bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// How many bytes came before them.
    pub at: usize,
    /// When they came, in seconds from any moment.
    pub time_s: f64,
}

impl Capture {
    /// Takes bytes that came at this moment, in seconds.
    pub fn take(&mut self, bytes: &[u8], time_s: f64) {
        let at = self.bytes.len();
        self.arrivals.push(Arrival { at, time_s });
        self.bytes.extend_from_slice(bytes);
    }

    /// Where bytes came after a pause. Between the parts of a frame the pauses are much shorter.
    fn pauses(&self) -> Vec<usize> {
        let gap = |pair: &[Arrival]| pair[1].time_s - pair[0].time_s;
        let mut gaps: Vec<f64> = self.arrivals.windows(2).map(gap).collect();
        gaps.sort_by(f64::total_cmp);
        let Some(&long) = gaps.get(gaps.len() * 9 / 10) else {
            return Vec::new();
        };
        let after_pause = self
            .arrivals
            .windows(2)
            .filter(|pair| gap(pair) > long / 2.0);
        after_pause.map(|pair| pair[1].at).collect()
    }
}

/// The layouts that explain `capture`.
///
/// # Errors
///
/// Returns a [`Failure`] if nothing that the daemon could read is in the bytes.
pub fn sniff(capture: &Capture, known: Known) -> Result<Found, Failure> {
    let bytes = &capture.bytes[..];
    if bytes.is_empty() {
        return Err(Failure::sure(
            "nothing arrives: check the wiring, or the sensor sends only on a request (`request` and `start` of \
             [sensor.frame])",
        ));
    }
    match coding::of(bytes) {
        Some(Coding::Packed(framing)) => return packed::find(framing, bytes, known),
        Some(Coding::Unreadable(words)) => return Err(Failure::sure(words)),
        Some(Coding::Maybe(words)) => {
            let mut found = in_periods(capture, known).or(Err(Failure::sure(words)))?;
            match &mut found.doubt {
                Some(doubt) => *doubt += &format!("; or {words}"),
                None if found.best.proposal.is_checked() || found.best.proposal.is_board => {}
                // A mark may be FF FF.
                None if words == TELNET => {}
                none => *none = Some(words.to_owned()),
            }
            return Ok(found);
        }
        None => {}
    }
    if text::is_text(bytes) {
        return text::find(bytes, known);
    }
    let of_board = |preset, cell| {
        let found = board(bytes, preset, cell);
        found.filter(|found| found.best.is_as(known))
    };
    // Its packets have two lengths.
    if let Some(found) = of_board(Preset::JqGlove, Cell::U8) {
        return Ok(found);
    }
    let found = in_periods(capture, known);
    let board = of_board(Preset::Jx255n, Cell::U8)
        .or_else(|| of_board(Preset::Jx255nU16, Cell::U16le))
        .filter(|board| board.best.proposal.explains_nearly_all());
    let Some(board) = board else {
        return found;
    };
    // Its checksum holds. A picture can only show that the array has another shape or other cells: the length
    // is also that of 16x49, say, or of another order of bytes.
    let is_right = |found: &Found| {
        let has_shape = found.best.array == board.best.array && found.best.cell == board.best.cell;
        let is_board = found.best.proposal.is_board;
        let is_sure = found.doubt.is_none() && is_board;
        found.best.proposal.is_checked() && (is_sure || !has_shape)
    };
    if found.as_ref().is_ok_and(is_right) {
        return found;
    }
    Ok(board)
}

/// The layouts of frames of one length.
fn in_periods(capture: &Capture, known: Known) -> Result<Found, Failure> {
    let bytes = &capture.bytes[..];
    let mut open = None;
    let mut failure = Failure::NotPeriodic(bytes.len());
    for period in period::periods(bytes) {
        match search::in_frames(&period::Frames::new(bytes, &period), capture, known) {
            Ok(found) if found.doubt.is_none() => return Ok(found),
            Ok(found) => open = open.or(Some(found)),
            Err(sure @ Failure::Sure(_)) => return Err(sure),
            // The likeliest length comes first.
            Err(other) if other.rank() > failure.rank() => failure = other,
            Err(_) => {}
        }
    }
    open.ok_or(failure)
}

/// A known board, if its layout explains the bytes. It needs no picture.
fn board(bytes: &[u8], preset: Preset, cell: Cell) -> Option<Found> {
    let settings = Settings {
        preset: Some(preset),
        ..Settings::default()
    };
    let array = Layout::new(&settings).ok()?.array();
    let proposal = Proposal::decoded(settings, true, bytes)?;
    Some(Found::stated(array, Some(cell), proposal))
}
