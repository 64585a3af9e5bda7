//! The hardness levels as intervals of Shore OO.

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
    /// Lower border, in Shore OO.
    pub(super) low: f64,
}

/// The table of the levels. A reading on a border belongs to the softer level.
pub const LEVELS: [LevelRange; 4] = [
    LevelRange {
        level: 1,
        label: "hard",
        table: ">70",
        touching: ">70",
        low: 70.0,
    },
    LevelRange {
        level: 2,
        label: "firm",
        table: "61-70",
        touching: "60-70",
        low: 60.0,
    },
    LevelRange {
        level: 3,
        label: "soft",
        table: "51-60",
        touching: "50-60",
        low: 50.0,
    },
    LevelRange {
        level: 4,
        label: "very-soft",
        table: "<=50",
        touching: "<=50",
        low: 0.0,
    },
];

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
    fn a_border_belongs_to_the_softer_level() {
        for pair in LEVELS.windows(2) {
            let (harder, softer) = (&pair[0], &pair[1]);
            assert_eq!(level_of(harder.low), softer.level);
            assert_eq!(level_of(harder.low + 0.01), harder.level);
        }
        assert_eq!([99.9, 3.0].map(level_of), [1, 4]);
    }
}
