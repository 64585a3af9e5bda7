//! The hardness levels as intervals of Shore OO.

use crate::random::Stream;

/// A hardness level and its range of Shore OO readings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelRange {
    /// The level, 1 (hardest) to 4.
    pub level: u8,
    /// The name of the level.
    pub label: &'static str,
    /// The interval as the paper's Table 1 writes it, in whole degrees.
    pub table: &'static str,
    /// The interval that leaves no gap to its neighbours.
    pub touching: &'static str,
    /// Lower border, in Shore OO. With `--gaps` it is `gap` higher.
    low: f64,
    /// Upper border, in Shore OO. It belongs to the level.
    high: f64,
    /// The gap in the paper's table between this level and the next softer one.
    gap: f64,
}

/// The softest and the hardest reading for objects drawn by their Shore hardness.
const LEAST_SHORE: f64 = 15.0;
const MOST_SHORE: f64 = 95.0;

/// The table of the levels. A reading on a border belongs to the softer level.
pub const LEVELS: [LevelRange; 4] = [
    LevelRange {
        level: 1,
        label: "hard",
        table: ">70",
        touching: ">70",
        low: 70.0,
        high: MOST_SHORE,
        gap: 1.0,
    },
    LevelRange {
        level: 2,
        label: "firm",
        table: "61-70",
        touching: "60-70",
        low: 60.0,
        high: 70.0,
        gap: 1.0,
    },
    LevelRange {
        level: 3,
        label: "soft",
        table: "51-60",
        touching: "50-60",
        low: 50.0,
        high: 60.0,
        gap: 1.0,
    },
    LevelRange {
        level: 4,
        label: "very-soft",
        table: "<=50",
        touching: "<=50",
        low: LEAST_SHORE,
        high: 50.0,
        gap: 0.0,
    },
];

/// Whether the levels touch, or have the gaps of the paper's Table 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Borders {
    /// The levels touch, because real objects do not avoid a border.
    Touching,
    /// The intervals 50 to 51, 60 to 61 and 70 to 71 are left out.
    Gaps,
}

impl LevelRange {
    /// The range of the level's readings. Harder objects of level 1 are drawn by their modulus.
    pub(super) fn shore(&self, borders: Borders) -> (f64, f64) {
        match borders {
            Borders::Touching => (self.low, self.high),
            Borders::Gaps => (self.low + self.gap, self.high),
        }
    }
}

/// Draws a Shore hardness, uniform over the intervals of all levels together.
pub(super) fn draw_shore(borders: Borders, stream: &mut Stream) -> f64 {
    let widths = LEVELS.map(|range| {
        let (low, high) = range.shore(borders);
        high - low
    });
    // Count from the hardest down, because the upper border belongs to the level.
    let mut left = widths.iter().sum::<f64>() * stream.uniform();
    for (range, width) in LEVELS.iter().zip(widths) {
        if left < width {
            return range.shore(borders).1 - left;
        }
        left -= width;
    }
    LEAST_SHORE
}

/// The level of an object that reads `shore`.
pub fn level_of(shore: f64) -> u8 {
    LEVELS
        .iter()
        .find(|range| shore > range.low)
        .map_or(4, |range| range.level)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_touch_and_gaps_are_the_papers() {
        assert_eq!(
            LEVELS.map(|range| range.low),
            [70.0, 60.0, 50.0, LEAST_SHORE]
        );
        for pair in LEVELS.windows(2) {
            let (harder, softer) = (&pair[0], &pair[1]);
            assert_eq!(harder.low, softer.high);
            assert_eq!(level_of(harder.low), softer.level);
            assert_eq!(level_of(harder.low + 0.01), harder.level);
            let gap = harder.shore(Borders::Gaps).0 - softer.shore(Borders::Gaps).1;
            assert_eq!(gap, 1.0, "61-70 after 51-60");
        }
        assert_eq!(level_of(99.9), 1);
        assert_eq!(level_of(3.0), 4);
    }
}
