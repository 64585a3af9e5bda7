//! Whether numbers at a place may be cells of a type, by the values that they take.
//!
//! In: frames in which something presses or rests, a place, and a type. Out: yes or no. A cell is no
//! number without a sign if it wraps below 0, and no part of a longer number.

use std::collections::BTreeSet;

use hardnessd_core::wire::Cell;

use crate::numbers::{self, is_signed, signed};
use crate::period::Frames;
use crate::pictures::{Presses, some};

/// One in so many numbers is below 0 at least, and so many times as many are by little as are by much.
const MANY: usize = 10;
const LITTLE: usize = 4;
/// So many cells change their sign, at so many moments.
const CROSSING_CELLS: usize = 2;
const CROSSING_MOMENTS: usize = 3;
/// So many bytes of a frame are looked at for it.
const CROSSING_BYTES: usize = 4096;
/// So many pairs of frames are looked at for numbers that pass through half of their range.
const PASSING_MOMENTS: usize = 300;
/// The largest of floats of 16 bits is at least 0.03 and finite: as a count it is between these.
const LEAST_HALF: f32 = 10_240.0;
const MOST_HALF: f32 = 31_743.0;
/// No number is between 0 and so much of the largest.
const GAP: f32 = 0.3;
/// Numbers from such a share of the largest on are large and those below the other one small. Where these have
/// noise, it is so many times as much.
const LARGE_HALF: f32 = 0.875;
const SMALL_HALF: f32 = 0.75;
const NOISY: f32 = 8.0;
const NOISIER: f32 = 2.0;
/// One of so many numbers that wraps is no damage.
const WRAPS: usize = 1000;
/// The fewest bytes that show whether bytes are parts of longer numbers.
const FEWEST_PARTS: usize = 64;
/// The high half of a number of 24 bits is smaller, and the high byte of one of 12 bits.
const HIGH_HALF: f32 = 256.0;
const HIGH_BYTE: f32 = 16.0;
/// All but one of so many are nearly all. At the ends of a place may be other parts of the frame.
const NEARLY_ALL: usize = 50;

/// The bytes at a place of each frame.
pub(crate) struct Cells<'a> {
    pub(crate) frames: &'a Frames<'a>,
    pub(crate) presses: &'a Presses,
    pub(crate) start: usize,
    pub(crate) bytes: usize,
}

impl<'a> Cells<'a> {
    /// Whether they may be taxels of so many numbers of this type.
    pub(crate) fn may_be(&self, cell: Cell, channels: usize) -> bool {
        let wraps = self.wraps(cell, channels) || self.crosses_zero(cell);
        let is_sign_right = match is_signed(cell) {
            true => (wraps || self.has_negative(cell)) && !self.passes_half(cell),
            false => !wraps || self.passes_half(cell),
        };
        is_sign_right && !self.is_part(cell)
    }

    fn of_frame(&self, index: usize) -> &'a [u8] {
        self.frames.from(index, self.start, self.bytes)
    }

    fn pressed(&self) -> impl Iterator<Item = &'a [u8]> + '_ {
        self.presses.frames().map(|index| self.of_frame(index))
    }

    /// Whether numbers are below 0, as those of a signed type are: many, and by little. Large numbers without
    /// a sign are few, and pass through the least ones.
    fn has_negative(&self, cell: Cell) -> bool {
        let quarter = 2.0_f32.powi(8 * cell.bytes() as i32 - 2);
        let (mut all, mut little, mut much) = (0, 0, 0);
        for number in self
            .pressed()
            .flat_map(|bytes| numbers::numbers(cell, bytes))
        {
            all += usize::from(number != 0.0);
            little += usize::from((-quarter..0.0).contains(&number));
            much += usize::from(number < -quarter);
        }
        little * MANY > all && little > LITTLE * much
    }

    /// Whether numbers are below 0 for a moment, or above it, by little. One that is may be a broken taxel, and all of
    /// one moment are taxels that saturate: without a sign, the number before 0 is the largest.
    fn crosses_zero(&self, cell: Cell) -> bool {
        let Some(cell) = signed(cell) else {
            return false;
        };
        let quarter = 2.0_f32.powi(8 * cell.bytes() as i32 - 2);
        let numbers = |index| {
            let bytes = self.of_frame(index);
            numbers::numbers(cell, &bytes[..bytes.len().min(CROSSING_BYTES)])
        };
        let (mut cells, mut moments) = (BTreeSet::new(), BTreeSet::new());
        let looked_at = self.presses.idle().chain(self.presses.frames());
        let last = self.frames.len() - 1;
        for moment in looked_at.filter(|moment| (1..last).contains(moment)) {
            let [before, now, after] = [moment - 1, moment, moment + 1].map(numbers);
            for at in 0..now.len() {
                let [before, now, after] = [before[at], now[at], after[at]];
                let is_little = [before, now, after]
                    .iter()
                    .all(|number| number.abs() < quarter);
                let is_below = now < 0.0;
                if is_little && is_below != (before < 0.0) && is_below != (after < 0.0) {
                    cells.insert(at);
                    moments.insert(moment);
                }
            }
        }
        cells.len() >= CROSSING_CELLS && moments.len() >= CROSSING_MOMENTS
    }

    /// Whether numbers without a sign pass through half of their range. With a sign they would jump from the largest to
    /// the least: they have none, and those that look like -1 are at their maximum.
    fn passes_half(&self, cell: Cell) -> bool {
        let Some(cell) = signed(cell) else {
            return false;
        };
        let half = 2.0_f32.powi(8 * cell.bytes() as i32 - 1);
        let passes = |&moment: &usize| {
            let [before, now] = [moment - 1, moment].map(|index| {
                let bytes = self.of_frame(index);
                numbers::numbers(cell, &bytes[..bytes.len().min(CROSSING_BYTES)])
            });
            let mut both = before.iter().zip(&now);
            both.any(|(before, now)| (before - now).abs() > half)
        };
        let moments: Vec<usize> = (1..self.frames.len()).collect();
        let moments = some(&moments, PASSING_MOMENTS);
        moments.iter().filter(|moment| passes(moment)).count() > CROSSING_MOMENTS
    }

    /// Whether numbers of 16 bits look like floats, which the daemon does not read: between 0 and the larger ones
    /// none is, or the larger ones have the less noise. A float has a step of its own for each power of two.
    pub(crate) fn may_be_halves(&self, cell: Cell) -> bool {
        match cell.bytes() {
            // They may be halves of them.
            1 => self.may_be_halves(Cell::U16le) || self.may_be_halves(Cell::U16be),
            2 => self.are_like_halves(cell),
            _ => false,
        }
    }

    fn are_like_halves(&self, cell: Cell) -> bool {
        let numbers = |index| numbers::numbers(cell, self.of_frame(index));
        let moments = self.presses.frames().chain(self.presses.idle());
        let pairs: Vec<[Vec<f32>; 2]> = moments
            .filter_map(|index| Some([index.checked_sub(1)?, index].map(numbers)))
            .collect();
        let all = || pairs.iter().flat_map(|[_, now]| now).copied();
        let most = all().fold(0.0, f32::max);
        if !(LEAST_HALF..=MOST_HALF).contains(&most) {
            return false;
        }
        let zeros = all().filter(|&number| number == 0.0).count();
        let least = all().filter(|&number| number != 0.0).fold(most, f32::min);
        if zeros * MANY > all().count() && least > GAP * most {
            return true;
        }
        let noise = |is_there: &dyn Fn(f32) -> bool| {
            let both = pairs
                .iter()
                .flat_map(|[before, now]| before.iter().zip(now));
            let there = both.filter(|&(&before, &now)| is_there(before) && is_there(now));
            let mut steps: Vec<f32> = there.map(|(before, now)| (now - before).abs()).collect();
            steps.sort_by(f32::total_cmp);
            // The lower quarter, for a press moves most of the larger ones.
            (steps.len() >= FEWEST_PARTS).then(|| steps[steps.len() / 4])
        };
        // What saturates has no noise either.
        let of_large = noise(&|number| (LARGE_HALF * most..most).contains(&number));
        let of_small = noise(&|number| number < SMALL_HALF * most);
        let less = |(small, large): (f32, f32)| small >= NOISY && small > NOISIER * large;
        of_small.zip(of_large).is_some_and(less)
    }

    /// Whether numbers without a sign jump by more than half of their range: at rest, or as one of several
    /// numbers of a taxel also in a press. They have a sign then, or are the low half of a longer number.
    fn wraps(&self, cell: Cell, channels: usize) -> bool {
        let cell = match cell {
            Cell::U8 | Cell::I8 => Cell::U8,
            Cell::U16le | Cell::I16le => Cell::U16le,
            Cell::U16be | Cell::I16be => Cell::U16be,
            _ => return false,
        };
        let half = 2.0_f32.powi(8 * cell.bytes() as i32 - 1);
        let numbers = |index| numbers::numbers(cell, self.of_frame(index));
        let rest: Vec<usize> = self.presses.rest().collect();
        let mut pairs: Vec<[usize; 2]> = rest.array_windows().copied().collect();
        if channels > 1 && cell.bytes() > 1 {
            pairs.extend(self.presses.frames().map(|index| [index - 1, index]));
        }
        let (mut all, mut jumps) = (0, 0);
        for [a, b] in pairs.into_iter().map(|pair| pair.map(numbers)) {
            all += a.len();
            let is_jump = |&(a, b): &(&f32, &f32)| (a - b).abs() > half;
            jumps += a.iter().zip(&b).filter(is_jump).count();
        }
        jumps * WRAPS > all
    }

    /// Whether numbers are parts of longer ones: of four bytes in a row one is nearly always the same and another
    /// often is not, or of two numbers in a row one is nearly always small, and the other is not.
    fn is_part(&self, cell: Cell) -> bool {
        match cell.bytes() {
            1 if self.bytes >= FEWEST_PARTS => {
                let changes = |phase: usize, one_in: usize| {
                    let bytes = || {
                        self.pressed()
                            .flat_map(|bytes| bytes.iter().skip(phase).step_by(4))
                    };
                    let usual = bytes().nth(1);
                    one_in * bytes().filter(|&byte| Some(byte) != usual).count() >= bytes().count()
                };
                // Where something small presses a large array, few bytes change, whichever they are.
                let is_pressed = (0..4).any(|phase| changes(phase, MANY));
                is_pressed && (0..4).any(|phase| !changes(phase, NEARLY_ALL))
                    || self.has_high_halves(Cell::I8, HIGH_BYTE)
            }
            2 => self.has_high_halves(cell, HIGH_HALF),
            _ => false,
        }
    }

    /// Whether of two numbers in a row one is nearly always less than `small`, and the other is not.
    fn has_high_halves(&self, cell: Cell, small: f32) -> bool {
        let range = 2.0_f32.powi(8 * cell.bytes() as i32);
        let (mut all, mut large) = (0, [0; 2]);
        for bytes in self.pressed() {
            for pair in numbers::numbers(cell, bytes).chunks_exact(2) {
                all += 1;
                for (large, &number) in large.iter_mut().zip(pair) {
                    let wrapped = if number >= range / 2.0 { range } else { 0.0 };
                    *large += usize::from((number - wrapped).abs() >= small);
                }
            }
        }
        // Of neighbours in an array, one may be large a little more often.
        let [less, more] = [large[0].min(large[1]), large[0].max(large[1])];
        NEARLY_ALL * less < all && NEARLY_ALL * more >= all && more > MANY * less
    }
}
