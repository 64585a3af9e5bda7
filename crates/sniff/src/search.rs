//! From frames of one length to layouts: the order of the search.
//!
//! In: frames, and what the user knows of the array. Out: ranked layouts, or the reason why there is
//! none.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::{Cell, Order};
use hardnessd_core::wording::name;

use crate::Capture;
use crate::cells::Cells;
use crate::checks::{self, Tried};
use crate::columns::{Columns, Kind};
use crate::found::{
    Failure, Found, Known, LEAST_FRAMES, Ranked, doubt_of_cells, doubt_of_rows, is_too_large,
    name_bits,
};
use crate::layout::{Parts, Proposal};
use crate::model::{
    self, ALONE_BITS, CHANNEL_BITS, CONSTANT_BITS, EXPECTED_BITS, MOST_CHANNELS, SERPENTINE_BITS,
    SURE_BITS, Score, UNUSED_DIGIT_BITS,
};
use crate::numbers::{self, CELLS, is_float};
use crate::period::Frames;
use crate::pictures::{Pictures, Presses, energy, middle, quantiles, some};
use crate::places::{Beside, Place, places};

/// The longest side that is tried, so that an array that is too large is found.
const LONGEST_SIDE: usize = 128;
/// The most places, and fewer of long frames, which take longer. In a frame of 64x64 taxels the right place was
/// not among the first twelve.
const MOST_PLACES: usize = 60;
const FEWEST_PLACES: usize = 24;
const PLACE_BYTES: usize = 60_000;
/// The most bytes of a mark that look like cells at rest.
const MOST_RESTING: usize = 4;
/// At most so many of the likeliest candidates are decoded. Noise has thousands that all fail.
const MOST_CANDIDATES: usize = 40;
/// As many arrays are decoded: the mark of a known board counts only then.
const RANKED: usize = 6;
/// So many times as many places are tried for a checksum.
const UNCHECKED: usize = 3;
/// The most formats at a place.
const MOST_FORMATS: usize = 8;
/// Where a cell is so much more like one of the next but one than like its neighbour, a taxel has several
/// numbers, and one number for each takes so many bits more.
const INTERLEAVED: f64 = 0.7;
const INTERLEAVED_BITS: f64 = 60.0;
/// Where it is a little more like it, nothing is sure. Of 120 arrays of three axes with weak shear, 12 were taken
/// for arrays three times as wide when only [`INTERLEAVED`] counted.
const MAYBE_INTERLEAVED: f64 = 0.9;
/// Four columns are the numbers of a taxel where cells of a row differ by so many times as much as those of a column.
const UNLIKE: f64 = 1.1;
/// The full scale of a converter of 10 bits. Those of fewer are one byte.
const LEAST_FULL_SCALE: f32 = 1023.0;
/// A number of 16 bits that changes by so much in a frame went through 0.
const TURN: f32 = 64_900.0;
/// One in so many frames may be damaged.
const DAMAGED: usize = 10;
/// The number of frames that a checksum is tried on.
const CHECKED: usize = 40;
/// The share of the packets whose number follows the one before.
const COUNTING_SHARE: f64 = 0.95;

/// How taxels are written: numbers of one type, several for each taxel.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Format {
    cell: Cell,
    channels: usize,
}

impl Format {
    fn bytes(self) -> usize {
        self.cell.bytes() * self.channels
    }

    fn name_bits(self) -> f64 {
        numbers::name_bits(self.cell) + CHANNEL_BITS * (self.channels - 1) as f64
    }
}

/// The number of cells after which a cell is more like the one before it than like its neighbour, if their
/// difference is less than such a `share`.
fn interleaved(pictures: &Pictures, array: Array, most: usize, share: f64) -> Option<usize> {
    let differs = |by: usize| model::difference(pictures, array.cols, by);
    let mut numbers = (2..=most)
        .filter(|by| *by <= MOST_CHANNELS || by.is_multiple_of(4) && array.cols >= 4 * by)
        .filter(|by| array.cols.is_multiple_of(*by) && array.cols >= 2 * by)
        .peekable();
    numbers.peek()?;
    let neighbours = differs(1);
    numbers.find(|&by| differs(by) < share * neighbours)
}

/// The doubt that what looks like several columns is several numbers of a taxel, or several numbers one.
fn several_numbers(pictures: &Pictures, array: Array, format: Format) -> Option<String> {
    let say = "say --rows, --cols and --cell if it has one";
    // Numbers of 24 bits are rarer than the three axes of a force.
    if matches!(format.channels, 2 | 4) && format.cell.bytes() == 1 {
        let bytes = format.channels;
        return Some(format!(
            "the {bytes} bytes of each taxel may be one number or several: {say}"
        ));
    }
    // A few columns of many rows may be the axes of as many taxels.
    let is_unlike = |[beside, below]: [f64; 2]| beside > UNLIKE * below;
    let differ = [(array.cols, 1), (array.taxels(), array.cols)];
    let is_few = array.cols <= MOST_CHANNELS && array.rows > array.cols;
    let are_axes = is_few
        && (array.cols < MOST_CHANNELS
            || is_unlike(differ.map(|(cols, by)| model::difference(pictures, cols, by))));
    // Of long numbers, each has several cells.
    let most = MOST_CHANNELS * 4 / format.cell.bytes();
    let numbers = are_axes
        .then_some(array.cols)
        .or_else(|| interleaved(pictures, array, most, MAYBE_INTERLEAVED))?;
    Some(format!(
        "each taxel may have {} numbers, such as the axes of a force: {say}",
        numbers * format.channels
    ))
}

/// An array at a place.
#[derive(Debug, Clone)]
struct Candidate {
    array: Array,
    order: Order,
    format: Format,
    place: Place,
    score: Score,
}

/// The frames and what is known of them.
struct Search<'a> {
    frames: &'a Frames<'a>,
    columns: &'a Columns,
    presses: Presses,
    /// By press, the bits of each byte of which nothing is known.
    unknown: Vec<Vec<f64>>,
}

pub(crate) fn in_frames(
    frames: &Frames,
    capture: &Capture,
    known: Known,
) -> Result<Found, Failure> {
    let period = frames.period;
    // At a wrong distance, hardly a frame begins where the one before it ended.
    if frames.len() < LEAST_FRAMES || 2 * frames.pairs().count() < frames.len() {
        return Err(Failure::NotPeriodic(capture.bytes.len()));
    }
    let begin = frames.beginning(&capture.pauses());
    let frames = &frames.inner();
    let columns = &Columns::new(frames);
    let whole = frames.retained(|frame| columns.is_whole(frame));
    // At the edge of what presses, bytes change in so few frames that they look constant. Where many frames have such
    // ones, these are its presses, and no damage.
    let is_damage = DAMAGED * (frames.len() - whole.len()) <= frames.len();
    let frames = if is_damage { &whole } else { frames };
    if !columns.kinds.contains(&Kind::Active) {
        return Err(Failure::NoPress(period));
    }
    if let Some(packets) = packets(frames, columns) {
        return Err(packets);
    }
    let most = (PLACE_BYTES / period).clamp(FEWEST_PLACES, MOST_PLACES);
    let places = places(columns, UNCHECKED * most);
    if places.is_empty() {
        return Err(Failure::NoArray(period));
    }
    let activity = columns.activity(frames);
    let presses = (contrast(&activity) <= Some(CONTRAST))
        .then(|| numbers_that_press(frames))
        .flatten()
        .or_else(|| Presses::of(&activity))
        .ok_or(Failure::NoPress(period))?;
    let pictures = |index| numbers::numbers(Cell::U8, frames.get(index));
    let pictures = Pictures::of(&presses, pictures).expect("bytes are numbers");
    let unknown = model::unknown(&pictures);
    let search = Search {
        frames,
        columns,
        presses,
        unknown,
    };
    let mut tried = Tried::new();
    let mut places: Vec<Place> = places
        .into_iter()
        .map(|place| search.checked(place, &mut tried))
        .collect();
    places.sort_by(|a, b| a.bits(columns).total_cmp(&b.bits(columns)));
    places.truncate(most);
    // A checksum holds in all frames by no chance, and a part of it may look like a shorter one.
    let bytes = |place: &Place| place.check.map(|check| check.bytes());
    let most = places.iter().map(bytes).max().flatten();
    places.retain(|place| bytes(place) == most);
    let candidates = search.candidates(places, known);
    search.rank(&candidates, begin, &capture.bytes, known)
}

impl Search<'_> {
    fn pictures(&self, presses: &Presses, place: &Place, format: Format) -> Option<Pictures> {
        let numbers = |index: usize| {
            let bytes = place.bytes / format.bytes() * format.bytes();
            numbers::numbers(format.cell, self.frames.from(index, place.start, bytes))
        };
        Pictures::of(presses, numbers)
    }

    fn cells(&self, place: &Place) -> Cells<'_> {
        Cells {
            frames: self.frames,
            presses: &self.presses,
            start: place.start,
            bytes: place.bytes,
        }
    }

    /// The bits of a candidate, if the presses have these.
    fn score(
        &self,
        place: &Place,
        format: Format,
        array: Array,
        pictures: &Pictures,
        presses: &[f64],
    ) -> Score {
        let unknown: Vec<usize> = place.unknown().map(|beside| beside.at).collect();
        let beside = |of_press: &Vec<f64>| unknown.iter().map(|&at| of_press[at]).sum::<f64>();
        let unused = if is_float(format.cell) {
            0
        } else {
            pictures.step_exponent
        };
        Score {
            presses: presses
                .iter()
                .zip(&self.unknown)
                .map(|(bits, of_press)| bits + beside(of_press))
                .collect(),
            weights: pictures.weights.clone(),
            once: place.bits(self.columns)
                + name_bits(array)
                + format.name_bits()
                + UNUSED_DIGIT_BITS * f64::from(unused),
        }
    }

    /// The formats that may be at a place, the likeliest first, by the order of the wire alone.
    fn formats(&self, place: &Place, known: Known) -> Vec<Format> {
        let mut found = Vec::new();
        let is_allowed = |cell: &Cell| known.cell.is_none_or(|known| known == *cell);
        let most = if known.cell.is_none() {
            MOST_CHANNELS
        } else {
            1
        };
        for cell in CELLS.into_iter().filter(is_allowed) {
            let single = Format { cell, channels: 1 };
            let Some(pictures) = self.pictures(&self.presses, place, single) else {
                continue;
            };
            let later = later(&pictures).iter().sum::<f64>();
            for format in (1..=most).map(|channels| Format { cell, channels }) {
                let cells = place.bytes / format.bytes();
                // Each of several numbers of a taxel makes a picture.
                let is_picture = |pictures: Pictures| {
                    let alone: f64 = model::alone(&pictures).iter().flatten().sum();
                    model::rows(&pictures, cells, 1).iter().sum::<f64>() < alone
                };
                if cells < 2
                    || format.channels > 1
                        && (pictures.are_alike(format.channels)
                            || !pictures.split(format.channels).all(is_picture))
                {
                    continue;
                }
                let bits = model::rows(&pictures, cells, format.channels)
                    .iter()
                    .sum::<f64>();
                found.push((bits + later + format.name_bits(), format));
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found.truncate(MOST_FORMATS);
        found.into_iter().map(|(_, format)| format).collect()
    }

    /// The arrays at all places, the likeliest first.
    fn candidates(&self, places: Vec<Place>, known: Known) -> Vec<Candidate> {
        // Which formats are likely depends on where a number of four bytes begins.
        let mut formats: [Option<Vec<Format>>; 4] = [const { None }; 4];
        let mut found = Vec::new();
        for place in places {
            let formats =
                formats[place.start % 4].get_or_insert_with(|| self.formats(&place, known));
            for &mut format in formats {
                let cells = self.cells(&place);
                let is_likely = known.cell.is_some() || cells.may_be(format.cell, format.channels);
                if !is_likely || !place.bytes.is_multiple_of(format.bytes()) {
                    continue;
                }
                let count = place.bytes / format.bytes();
                let Some(pictures) = self.pictures(&self.presses, &place, format) else {
                    continue;
                };
                let later = later(&pictures);
                for array in known.arrays(count, LONGEST_SIDE) {
                    // Where a smaller array may be it, the larger ones are not.
                    if is_too_large(array) && count <= MOST_SIDE * MOST_SIDE {
                        continue;
                    }
                    let bits = added(model::rows(&pictures, array.cols, format.channels), &later);
                    let mut score = self.score(&place, format, array, &pictures, &bits);
                    if format.channels == 1
                        && interleaved(&pictures, array, MOST_CHANNELS, INTERLEAVED).is_some()
                    {
                        score.once += INTERLEAVED_BITS;
                    }
                    found.push(Candidate {
                        array,
                        order: Order::RowMajor,
                        format,
                        place: place.clone(),
                        score,
                    });
                }
            }
        }
        let likeliest = |found: &mut Vec<Candidate>| {
            found.sort_by(|a, b| a.score.bits().total_cmp(&b.score.bits()));
            found.truncate(MOST_CANDIDATES);
        };
        likeliest(&mut found);
        let serpentine = found
            .iter()
            .flat_map(|candidate| self.serpentine(candidate, known));
        let serpentine: Vec<Candidate> = serpentine.collect();
        found.extend(serpentine);
        likeliest(&mut found);
        found
    }

    /// The arrays of which each second row runs the other way, if `candidate` is one without. Two such rows, one behind
    /// the other, look like a row of twice as many taxels.
    fn serpentine(&self, candidate: &Candidate, known: Known) -> Vec<Candidate> {
        let Candidate {
            array,
            format,
            place,
            ..
        } = candidate;
        let Some(pictures) = self.pictures(&self.presses, place, *format) else {
            return Vec::new();
        };
        let later = later(&pictures);
        let of = |array: Array| {
            let (cols, channels) = (array.cols, format.channels);
            let turned = pictures.turned(cols, channels);
            let bits = added(model::rows(&turned, cols, channels), &later);
            let mut score = self.score(place, *format, array, &turned, &bits);
            score.once += SERPENTINE_BITS;
            Candidate {
                array,
                order: Order::Serpentine,
                score,
                ..candidate.clone()
            }
        };
        known
            .arrays(array.taxels(), LONGEST_SIDE)
            .filter(|other| other.cols == array.cols || 2 * other.cols == array.cols)
            .filter(|other| other.rows > 1 && other.cols > 1)
            .map(of)
            .collect()
    }

    /// The doubt that the mark is a taxel at full scale, where other bytes may be the mark.
    fn stuck_mark(&self, best: &Candidate, candidates: &[Candidate]) -> Option<String> {
        let Candidate { format, place, .. } = best;
        let bytes: Option<Vec<u8>> = place.mark()?.map(|at| place.constant(at)).collect();
        let bytes = bytes?;
        let mark = numbers::numbers(format.cell, &bytes);
        let of_frame = |index| {
            numbers::numbers(
                format.cell,
                self.frames.from(index, place.start, place.bytes),
            )
        };
        let all = self.presses.frames().flat_map(of_frame);
        let most = all.fold(f32::MIN, f32::max);
        // Full scale of a converter has all its bits set. The mark may be among the cells, and larger.
        let is_full = |&number: &f32| {
            let may_be = number > most || number >= LEAST_FULL_SCALE;
            number == most || may_be && (number as u32 + 1).is_power_of_two()
        };
        let is_full_scale = !mark.is_empty() && mark.iter().all(is_full);
        let mut others = candidates
            .iter()
            .filter(|other| other.format == *format && other.place.bytes == place.bytes);
        // FF FF is a usual mark, and 0F FF is none.
        let is_long = mark.iter().all(|&number| number >= LEAST_FULL_SCALE);
        let is_converters = is_long && bytes.iter().any(|&byte| byte != u8::MAX);
        let may_be = is_converters || others.any(|other| other.place.start != place.start);
        (is_full_scale && may_be).then(|| {
            "the mark may be a taxel that is stuck at full scale, and other bytes the mark: look it up in the data \
             sheet"
                .to_owned()
        })
    }

    /// The doubt that cells without a sign have one: one near 0 is near full scale in the next frame.
    fn may_have_sign(&self, best: &Candidate, known: Known) -> Option<String> {
        let Candidate { format, place, .. } = best;
        let signed = numbers::signed(format.cell).filter(|&signed| signed != format.cell)?;
        if known.cell.is_some() || signed.bytes() != 2 {
            return None;
        }
        let cells = |index| {
            let bytes = self.frames.from(index, place.start, place.bytes);
            numbers::numbers(format.cell, bytes)
        };
        let turns = |&(before, after): &(usize, usize)| {
            let mut both = cells(before).into_iter().zip(cells(after));
            both.any(|(before, after)| (before - after).abs() >= TURN)
        };
        // Damage does it once.
        let are_turned = self.frames.pairs().filter(turns).nth(1).is_some();
        are_turned.then(|| {
            let option = format!("--cell {}", name(&signed));
            format!("numbers near 0 are near full scale in the next frame: say `{option}` if they fell below 0")
        })
    }

    /// The doubt that the first cell is none, where there may be one more behind the last, and the other way around.
    fn shifted(&self, best: &Candidate, pictures: &Pictures) -> Option<String> {
        let Candidate {
            array,
            format,
            place,
            ..
        } = best;
        let (bytes, length) = (format.cell.bytes(), place.beside.len());
        let (last, period) = (pictures.changes.len() - 1, self.frames.period);
        let may_be_cell = |end: &[Beside]| {
            let mut unknown = place.unknown();
            unknown.any(|unknown| unknown.kind == Kind::Active && end.contains(unknown))
        };
        let as_neighbour = |pictures: &Pictures, at| {
            model::as_neighbour(pictures, array.cols, format.channels, at)
        };
        // The cell at an end may be none, and the one at the other end of cells that begin elsewhere acts no less as a
        // neighbour.
        let may_begin_at = |start: usize, own: usize, other: usize| {
            let bits = as_neighbour(pictures, own);
            let place = Place {
                start: start % period,
                ..place.clone()
            };
            let moved = self.pictures(&self.presses, &place, *format);
            let moved = moved.map(|moved| match best.order {
                Order::Serpentine => moved.turned(array.cols, format.channels),
                _ => moved,
            });
            let of_other = moved.map_or(0.0, |moved| as_neighbour(&moved, other));
            (!pictures.changes[own] || bits < -ALONE_BITS) && bits < of_other + SURE_BITS
        };
        let is_shifted = may_be_cell(&place.beside[..bytes.min(length)])
            && may_begin_at(place.start + bytes, 0, last)
            || may_be_cell(&place.beside[length.saturating_sub(bytes)..])
                && may_begin_at(place.start + period - bytes, last, 0);
        is_shifted.then(|| {
            format!("all cells may be {bytes} bytes further: press the first taxels and the last")
        })
    }

    /// Finds the checksum among the bytes beside the cells.
    fn checked(&self, place: Place, tried: &mut Tried) -> Place {
        if place.unknown().next().is_none() {
            return place;
        }
        let indices: Vec<usize> = (0..self.frames.len()).collect();
        let (period, length) = (self.frames.period, place.beside.len());
        let first = (place.start + period - length) % period;
        let span = |&index: &usize| self.frames.from(index, first, period + length);
        let spans: Vec<&[u8]> = some(&indices, CHECKED).iter().map(span).collect();
        let kinds: Vec<Kind> = place.beside.iter().map(|beside| beside.kind).collect();
        place.with(checks::find(&spans, &kinds, (first, period), tried))
    }

    /// Decodes the likeliest candidates.
    fn rank(
        &self,
        candidates: &[Candidate],
        begin: Option<usize>,
        bytes: &[u8],
        known: Known,
    ) -> Result<Found, Failure> {
        let mut ranked: Vec<Ranked> = Vec::new();
        let mut tried: Vec<(Array, Order, Format)> = Vec::new();
        for candidate in candidates {
            let Candidate {
                array,
                order,
                format,
                ..
            } = *candidate;
            if ranked.len() == RANKED || tried.contains(&(array, order, format)) {
                continue;
            }
            if is_too_large(array) {
                if ranked.is_empty() {
                    return Err(Failure::TooLarge(array));
                }
                continue;
            }
            let Some(mut pictures) = self.pictures(&self.presses, &candidate.place, format) else {
                continue;
            };
            if order == Order::Serpentine {
                pictures = pictures.turned(array.cols, format.channels);
            }
            let channels: Vec<Pictures> = pictures.split(format.channels).collect();
            let of_channel = channels.iter().enumerate();
            let (channel, strongest) = of_channel
                .map(|(channel, pictures)| (channel, pictures.strongest()))
                .max_by(|(_, a), (_, b)| energy(a).total_cmp(&energy(b)))
                .expect("a taxel has a number");
            let parts = Parts {
                columns: self.columns,
                place: &candidate.place,
                array,
                order,
                cell: format.cell,
                channels: format.channels,
                channel,
                begin,
            };
            let Some(mut proposal) = Proposal::of(&parts, bytes) else {
                continue;
            };
            let alone = added(model::sums(&model::alone(&pictures)), &later(&pictures));
            let alone = self.score(&candidate.place, format, array, &pictures, &alone);
            let mut score = candidate.score.clone();
            if proposal.is_board {
                // A known board has a known mark.
                let mark = candidate.place.mark().map_or(0, |mark| mark.len());
                score.once -= CONSTANT_BITS * mark as f64 - EXPECTED_BITS;
            }
            // Only the doubt of the likeliest counts.
            let is_best = ranked
                .iter()
                .all(|ranked| score.bits() < ranked.score.bits());
            let mut own_doubt = (!known.is_complete())
                .then(|| doubt_of_cells(array.taxels(), &score, &alone))
                .flatten();
            let of_place = || {
                self.stuck_mark(candidate, candidates)
                    .or_else(|| other_cells(candidate, candidates))
                    .or_else(|| self.shifted(candidate, &pictures))
            };
            if is_best && !proposal.is_board && known.is_complete() {
                // No more can be said of the array, and beside other bytes the cells may still begin elsewhere.
                let mark = candidate.place.mark().map_or(0, |mark| mark.len());
                match candidate.place.beside.len() > mark {
                    true => own_doubt = of_place(),
                    false => proposal.remarks.extend(of_place()),
                }
            } else if is_best && !proposal.is_board {
                let half = "they look like floats of 16 bits, which the daemon does not read: say --cell if they are \
                            not, or let a bridge send them as text";
                let cells = self.cells(&candidate.place);
                let are_halves = known.cell.is_none() && cells.may_be_halves(format.cell);
                let long = "they look like numbers of 64 bits, which the daemon does not read";
                own_doubt = own_doubt
                    .or_else(|| {
                        (format.channels == 1 && self.columns.are_of_64_bits)
                            .then(|| long.to_owned())
                    })
                    .or_else(|| are_halves.then(|| half.to_owned()))
                    .or_else(|| {
                        let is_given = known.rows.is_some() && known.cols.is_some();
                        let doubt = || doubt_of_rows(&pictures, array, format.channels);
                        (!is_given).then(doubt).flatten()
                    })
                    .or_else(|| several_numbers(&channels[channel], array, format))
                    .or_else(|| self.may_have_sign(candidate, known))
                    .or_else(|| {
                        // Other numbers beside the cells fill up a rare array.
                        let is_odd = array.rows % 2 + array.cols % 2 > 0;
                        (order == Order::Serpentine && is_odd).then(|| {
                            "other numbers may be taken for taxels: say --rows, --cols and --cell".to_owned()
                        })
                    })
                    .or_else(of_place);
            }
            tried.push((array, order, format));
            ranked.push(Ranked {
                array,
                order,
                cell: Some(format.cell),
                picture: strongest.to_vec(),
                proposal,
                score,
                own_doubt,
            });
        }
        Found::among(ranked, known.is_complete()).ok_or(Failure::NoArray(self.frames.period))
    }
}

/// Says where else the cells may begin and end, if that is as likely, or what beside them looks like
/// cells.
fn other_cells(best: &Candidate, candidates: &[Candidate]) -> Option<String> {
    let is_other = |other: &&Candidate| {
        other.format == best.format
            && (other.place.start, other.place.bytes) != (best.place.start, best.place.bytes)
            && !best.score.is_surely_before(&other.score)
    };
    let around = |place: &Place| {
        let mark = place.mark()?;
        Some((place.beside.len() - mark.end, mark.start))
    };
    if let Some(other) = candidates.iter().find(is_other)
        && let Some(((before, after), (other_before, other_after))) =
            around(&best.place).zip(around(&other.place))
    {
        if (before, after) == (other_before, other_after) {
            return Some(
                "which bytes are the mark: other ones that never change may be it, and not taxels; press all taxels"
                    .to_owned(),
            );
        }
        return Some(format!(
            "which bytes are cells: {before} bytes are between the mark and them and {after} behind them, or \
             {other_before} and {other_after}; press the first taxels and the last"
        ));
    }
    let row = best.array.cols * best.format.bytes();
    if best.place.longest_run() >= row {
        return Some(format!(
            "{row} equal bytes beside the cells may be a row of dead taxels: say --rows, --cols and --cell"
        ));
    }
    let resting = best.place.resting();
    (resting > MOST_RESTING).then(|| {
        format!("{resting} bytes beside the cells look like cells at rest: press the edges too")
    })
}

/// The presses by the numbers of frames, where bytes alone hardly show any: the low bytes of floats and of signed
/// numbers change as much at rest, and the high bytes of signed ones where they are near 0. Of all types of cells, the
/// one that shows the presses best.
fn numbers_that_press(frames: &Frames) -> Option<Presses> {
    let cells = CELLS.into_iter().filter(|cell| cell.bytes() > 1);
    let ways = cells.flat_map(|cell| (0..cell.bytes()).map(move |begin| (cell, begin)));
    let found = ways.filter_map(|(cell, begin)| {
        let numbers = |frame: &[u8]| numbers::numbers(cell, &frame[begin..]);
        let frames: Vec<Vec<f32>> = frames.iter().map(numbers).collect();
        let activity = activity(&frames)?;
        Some((contrast(&activity)?, Presses::of(&activity)?))
    });
    let best = found.max_by(|a, b| a.0.total_cmp(&b.0));
    best.filter(|(contrast, _)| *contrast > CONTRAST)
        .map(|(_, presses)| presses)
}

/// A press stands out by so many times as much as frames at rest differ.
const CONTRAST: f64 = 4.0;

/// By how many times as much as frames at rest differ, presses stand out.
fn contrast(activity: &[u32]) -> Option<f64> {
    let [least, quarter, most] = quantiles(activity)?;
    Some((most - quarter) / (quarter - least).max(1.0))
}

/// How far the numbers of each frame are from rest, by what they change from frame to frame.
fn activity(frames: &[Vec<f32>]) -> Option<Vec<u32>> {
    let rest = middle(frames);
    let mut activity = vec![0.0; frames.len()];
    for cell in 0..rest.len() {
        let of = |frame: &Vec<f32>| frame[cell];
        if !frames.iter().map(of).all(f32::is_finite) {
            continue;
        }
        let mut steps: Vec<f32> = frames
            .windows(2)
            .map(|pair| (of(&pair[1]) - of(&pair[0])).abs())
            .collect();
        steps.sort_by(f32::total_cmp);
        let usual = steps.get(steps.len() / 2)?.max(f32::MIN_POSITIVE);
        for (sum, frame) in activity.iter_mut().zip(frames) {
            *sum += f64::from(((of(frame) - rest[cell]).abs() / usual).min(64.0));
        }
    }
    Some(
        activity
            .into_iter()
            .map(|sum| (sum * 16.0) as u32)
            .collect(),
    )
}

/// The bits of each press that no shape changes.
fn later(pictures: &Pictures) -> Vec<f64> {
    added(model::later(pictures), &pictures.below_step_bits)
}

fn added(mut a: Vec<f64>, b: &[f64]) -> Vec<f64> {
    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
    a
}

/// The packets of a frame, if their number shows: what presses is in the same packet of each frame.
fn packets(frames: &Frames, columns: &Columns) -> Option<Failure> {
    let bytes = frames.period;
    (0..bytes).find_map(|at| {
        let values = || frames.iter().map(|frame| frame[at]);
        let (first, last) = (values().min()?, values().max()?);
        let packets = usize::from(last - first) + 1;
        if !(2..=MOST_SIDE).contains(&packets) || frames.len() < LEAST_FRAMES * packets {
            return None;
        }
        let next = |value: u8| if value == last { first } else { value + 1 };
        let pairs = frames.pairs().count();
        let counting = frames
            .pairs()
            .filter(|&(a, b)| frames.get(b)[at] == next(frames.get(a)[at]));
        let change = |distance: usize| {
            let changes = frames
                .at_distance(distance)
                .map(|(a, b)| columns.change(frames.get(a), frames.get(b)));
            let changes: Vec<u32> = changes.collect();
            f64::from(changes.iter().sum::<u32>()) / changes.len() as f64
        };
        // A counter may begin again too, but then the frames before and after are alike.
        (counting.count() as f64 >= COUNTING_SHARE * pairs as f64 && change(packets) < change(1))
            .then(|| {
                Failure::sure(format!(
                    "{bytes} bytes recur, with a number from {first} to {last} that begins again: a frame comes in \
                     {packets} packets, so write its [sensor.frame.packets]"
                ))
            })
    })
}
