//! References are tried before they are used: each is judged with the others, and with none.
//!
//! In: presses on pieces of which something is known. Out: how many are judged rightly with the others,
//! and without. References that make verdicts on themselves worse would make those on other objects worse
//! too.

use super::references::{Piece, ReferencePress, References};
use super::{Borders, Format, Model, ModelError, argmax};

/// A probability below it counts as this.
const LEAST_PROBABILITY: f32 = 0.01;
/// References are worse if so many more of them are judged wrongly. One of four is chance.
const LEAST_WRONG: u32 = 2;
/// They are worse, too, if the mean logarithm of the probability of the truth falls by more than this. With 0.1 and one
/// press, good references were ignored, and verdicts on unseen sensors lost 2 points.
const MOST_LOSS: f32 = 0.5;

/// How references judge each other.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tried {
    /// The presses of which something is known.
    pub presses: u32,
    /// How many of them are judged rightly with the others, and without any.
    pub right: [u32; 2],
    /// The mean logarithm of the probability of the truth, with the others and without any.
    log_probability: [f32; 2],
}

impl Tried {
    /// Whether the references make verdicts on themselves worse.
    pub fn are_worse(&self) -> bool {
        let ([with, without], [right_with, right_without]) = (self.log_probability, self.right);
        right_with + LEAST_WRONG <= right_without || with < without - MOST_LOSS
    }
}

impl Model {
    /// The same model, which knows a sensor by these references, unless they make verdicts on themselves
    /// worse.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Model::judge_taxels`].
    ///
    /// # Panics
    ///
    /// Panics as [`Model::references`] does.
    pub fn identified_by(&self, presses: &[ReferencePress]) -> Result<(Self, Tried), ModelError> {
        let references = self.references(presses)?;
        let tried = self.tried(presses, &references)?;
        let references = match tried.are_worse() {
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
            let levels = match press.piece {
                // A rigid piece is harder than any object.
                Piece::Flat { .. } | Piece::Ball { .. } => 0..=0,
                piece if piece.is_unknown() => continue,
                Piece::Shore { range: [low, high] } => {
                    borders.place_of(high)..=borders.place_of(low)
                }
            };
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
        Ok(tried)
    }
}
