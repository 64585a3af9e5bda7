//! DeLiGAN's threshold scheme: whoever is behind takes the step.
//!
//! In: the generator's loss before each turn. Out: whose turn it is. The threshold follows: one
//! side taking many turns in a row moves it towards giving the other one more.

use serde::{Deserialize, Serialize};

/// The threshold's bounds, and how far it moves at once (DeLiGAN's code).
const LEAST: f64 = 0.70;
const GREATEST: f64 = 1.0;
const MOVE: f64 = 0.003;
/// Turns in a row of the generator, and of the discriminator, that move it (ditto).
const GENERATOR_ROW: u32 = 4;
const DISCRIMINATOR_ROW: u32 = 2;

/// Turns that a batch of real samples gives: as many updates as in alternation, where DeLiGAN's
/// code takes five.
pub(super) const TURNS_A_BATCH: u64 = 2;

/// One of the two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// G.
    Generator,
    /// D.
    Discriminator,
}

/// The threshold and what it follows from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Balance {
    /// The generator takes a turn at which its loss is above this, the discriminator any other.
    threshold: f64,
    /// Who took the last turns, and how many in a row since the threshold moved.
    row: (Side, u32),
    /// Turns the generator has taken.
    pub generator_turns: u64,
    /// Turns the discriminator has taken.
    pub discriminator_turns: u64,
}

impl Balance {
    /// Before the first turn.
    pub fn new() -> Self {
        Self {
            threshold: GREATEST,
            row: (Side::Generator, 0),
            generator_turns: 0,
            discriminator_turns: 0,
        }
    }

    /// Moves the threshold if a side has taken many turns in a row; once a batch.
    pub fn follow(&mut self) {
        let (side, turns) = self.row;
        let moved = match side {
            Side::Generator if turns >= GENERATOR_ROW => self.threshold + MOVE,
            Side::Discriminator if turns >= DISCRIMINATOR_ROW => self.threshold - MOVE,
            _ => return,
        };
        self.threshold = moved.clamp(LEAST, GREATEST);
        self.row.1 = 0;
    }

    /// Whose turn it is, where the generator's loss is this, without the penalty on sigma.
    pub fn turn(&mut self, generator_loss: f64) -> Side {
        let (side, turns) = if generator_loss > self.threshold {
            (Side::Generator, &mut self.generator_turns)
        } else {
            (Side::Discriminator, &mut self.discriminator_turns)
        };
        *turns += 1;
        self.row = (
            side,
            if self.row.0 == side {
                self.row.1 + 1
            } else {
                1
            },
        );
        side
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_generator_that_is_behind_takes_the_turn() {
        let mut balance = Balance::new();
        assert_eq!(balance.turn(1.01), Side::Generator);
        assert_eq!(balance.turn(1.0), Side::Discriminator);
        assert_eq!(balance.turn(f64::NAN), Side::Discriminator);
        let turns = (balance.generator_turns, balance.discriminator_turns);
        assert_eq!(turns, (1, 2));
    }

    #[test]
    fn the_threshold_follows_rows_within_its_bounds() {
        let mut balance = Balance::new();
        balance.turn(0.0);
        balance.follow();
        assert_eq!(balance.threshold, 1.0, "one turn is no row");
        balance.turn(0.0);
        balance.follow();
        assert!((balance.threshold - 0.997).abs() < 1e-12);
        balance.turn(0.0);
        balance.follow();
        assert!((balance.threshold - 0.997).abs() < 1e-12, "counted anew");
        for _ in 0..300 {
            balance.turn(0.0);
            balance.follow();
        }
        assert_eq!(balance.threshold, LEAST);
        for turn in 1..=4 {
            balance.follow();
            assert_eq!(balance.threshold, LEAST, "before turn {turn}");
            balance.turn(0.71);
        }
        balance.follow();
        assert!((balance.threshold - 0.703).abs() < 1e-12);
        for _ in 0..500 {
            balance.turn(2.0);
            balance.follow();
        }
        assert_eq!(balance.threshold, GREATEST);
    }
}
