//! References are tried before they are used: each is judged with the others, and with none.
//!
//! In: presses on pieces of which something is known. Out: how many are judged rightly with the others,
//! and without. References that make verdicts on themselves worse would make those on other objects worse
//! too.

use std::ops::RangeInclusive;

use super::references::{Piece, ReferencePress, References};
use super::{Borders, Format, Model, ModelError, argmax};

/// A probability below it counts as this.
const LEAST_PROBABILITY: f32 = 0.01;
/// References are worse if so many more of them are judged wrongly. One of four is chance, but not where all are of one
/// piece.
const LEAST_WRONG: u32 = 2;
/// They are worse, too, if the mean logarithm of the probability of the truth falls by more than this. With 0.1 and one
/// press, good references were ignored, and verdicts on unseen sensors lost 2 points.
const MOST_LOSS: f32 = 0.5;

/// The fewest presses of unknown objects that are used.
const LEAST_UNKNOWN: usize = 6;
/// The least standard deviation of their estimated Shore hardness.
const LEAST_SPREAD: f32 = 12.0;

/// How references judge each other.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tried {
    /// The presses of which something is known.
    pub presses: u32,
    /// How many of them are judged rightly with the others, and without any.
    pub right: [u32; 2],
    /// The number of presses of unknown objects that are left out, because they are too few or too alike.
    pub left_out: u32,
    /// The mean logarithm of the probability of the truth, with the others and without any.
    log_probability: [f32; 2],
    are_of_one_piece: bool,
}

impl Tried {
    /// Whether the references make verdicts on themselves worse.
    pub fn are_worse(&self) -> bool {
        let ([with, without], [right_with, right_without]) = (self.log_probability, self.right);
        let least_wrong = if self.are_of_one_piece {
            1
        } else {
            LEAST_WRONG
        };
        right_with + least_wrong <= right_without || with < without - MOST_LOSS
    }
}

/// Whether presses of unknown objects may be used, by the Shore hardness that a model estimates of each without
/// references. Presses of objects that are all alike make verdicts worse.
pub(crate) fn are_unlike(shores: &[f32]) -> bool {
    let count = shores.len() as f32;
    let mean = shores.iter().sum::<f32>() / count;
    let squares = shores.iter().map(|shore| (shore - mean).powi(2));
    shores.len() >= LEAST_UNKNOWN && (squares.sum::<f32>() / count).sqrt() >= LEAST_SPREAD
}

/// The places of the levels that are right for a piece of which something is known.
fn levels_of(piece: Piece, borders: &Borders) -> RangeInclusive<usize> {
    match piece {
        // A rigid piece is harder than any object.
        Piece::Flat { .. } | Piece::Ball { .. } => 0..=0,
        Piece::Shore { range: [low, high] } => {
            // A level does not reach the border below it.
            let least = if low < high { low.next_up() } else { low };
            borders.place_of(high)..=borders.place_of(least)
        }
    }
}

impl Model {
    /// The same model, which knows a sensor by these references, unless they make verdicts on themselves
    /// worse. Those of unknown objects must differ, as [own presses](crate::judge::OwnPresses) must.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Model::judge_taxels`].
    ///
    /// # Panics
    ///
    /// Panics as [`Model::references`] does.
    pub fn identified_by(&self, presses: &[ReferencePress]) -> Result<(Self, Tried), ModelError> {
        let (unknown, known): (Vec<_>, Vec<_>) = presses
            .iter()
            .cloned()
            .partition(|press| press.piece.is_unknown());
        let mut shores = Vec::new();
        for press in &unknown {
            let verdict = self.judge_beside(&press.course, &References::NONE)?;
            shores.extend(verdict.shore.map(|shore| shore.value));
        }
        let used = if are_unlike(&shores) { presses } else { &known };
        let references = self.references(used)?;
        let tried = Tried {
            left_out: (presses.len() - used.len()) as u32,
            ..self.tried(used, &references)?
        };
        let references = match tried.are_worse() || (used.is_empty() && !presses.is_empty()) {
            true => References::IGNORED,
            false => references,
        };
        Ok((self.identified(references)?, tried))
    }

    /// Tries references that this model computed of these presses.
    fn tried(
        &self,
        presses: &[ReferencePress],
        references: &References,
    ) -> Result<Tried, ModelError> {
        let mut tried = Tried::default();
        let (Ok(borders), Format::Course { .. }) =
            (Borders::of(&self.card().levels), self.format())
        else {
            return Ok(tried);
        };
        for (place, press) in presses.iter().enumerate() {
            if press.piece.is_unknown() {
                continue;
            }
            let levels = levels_of(press.piece, &borders);
            tried.presses += 1;
            for (way, beside) in [references.without(place), References::NONE]
                .iter()
                .enumerate()
            {
                let verdict = self.judge_beside(&press.course, beside)?;
                let (best, _) = argmax(&verdict.probabilities);
                tried.right[way] += u32::from(levels.contains(&best));
                let of_truth: f32 = verdict.probabilities[levels.clone()].iter().sum();
                tried.log_probability[way] += of_truth.max(LEAST_PROBABILITY).ln();
            }
        }
        let count = tried.presses.max(1) as f32;
        tried.log_probability = tried.log_probability.map(|sum| sum / count);
        tried.are_of_one_piece = presses
            .windows(2)
            .all(|pair| pair[0].piece == pair[1].piece);
        Ok(tried)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::BUILT_IN;

    #[test]
    fn a_reference_of_a_level_is_right_for_that_level_alone() {
        let hrn = Model::load(BUILT_IN).unwrap();
        let borders = Borders::of(&hrn.card().levels).unwrap();
        let of = |range| levels_of(Piece::Shore { range }, &borders);
        for place in 0..hrn.card().levels.len() {
            assert_eq!(of(borders.part(place)), place..=place);
        }
        assert_eq!([of([60.0; 2]), of([55.0, 65.0])], [2..=2, 1..=2]);
    }
}
