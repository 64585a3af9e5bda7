//! The hardness levels as intervals of Shore OO.

use crate::random::Stream;

/// A hardness level, and what its objects read on a Shore OO durometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelRange {
    /// 1 (hardest) to 4.
    pub level: u8,
    /// Its name.
    pub label: &'static str,
    /// The interval as the paper's Table 1 writes it, in whole degrees.
    pub table: &'static str,
    /// The interval that leaves no gap to its neighbours.
    pub touching: &'static str,
    /// Lower border. With `--gaps` it is `gap` higher.
    low: f64,
    /// Upper border, which belongs to the level.
    high: f64,
    /// What the paper's table leaves to the level below.
    gap: f64,
}

/// The softest and the hardest reading of which objects are drawn by their Shore hardness.
const LEAST_SHORE: f64 = 15.0;
const MOST_SHORE: f64 = 95.0;

/// The one table of the levels. A reading on a border belongs to the softer level.
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

/// Whether the levels touch, or leave the gaps that the paper's Table 1 has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Borders {
    /// A real object does not avoid a border.
    Touching,
    /// 50 to 51, 60 to 61 and 70 to 71 are left out.
    Gaps,
}

impl LevelRange {
    /// What its objects read, from and to; harder ones of level 1 are drawn by their modulus.
    pub(super) fn shore(&self, borders: Borders) -> (f64, f64) {
        match borders {
            Borders::Touching => (self.low, self.high),
            Borders::Gaps => (self.low + self.gap, self.high),
        }
    }
}

/// A Shore hardness, even over all levels' intervals together.
pub(super) fn draw_shore(borders: Borders, stream: &mut Stream) -> f64 {
    let widths = LEVELS.map(|range| {
        let (low, high) = range.shore(borders);
        high - low
    });
    // From the hardest down; the upper border belongs to the level.
    let mut left = widths.iter().sum::<f64>() * stream.uniform();
    for (range, width) in LEVELS.iter().zip(widths) {
        if left < width {
            return range.shore(borders).1 - left;
        }
        left -= width;
    }
    LEAST_SHORE
}

/// The level of what reads `shore`.
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
