//! The hardness levels as intervals of Shore OO.

/// A hardness level and its range of Shore OO readings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelRange {
    /// The name of the level.
    pub label: &'static str,
    /// The interval as the paper's Table 1 writes it, in whole degrees.
    pub table: &'static str,
    /// The interval that leaves no gap to its neighbours.
    pub touching: &'static str,
    /// Lower border, in Shore OO.
    low: f64,
}

const fn range(
    label: &'static str,
    table: &'static str,
    touching: &'static str,
    low: f64,
) -> LevelRange {
    LevelRange {
        label,
        table,
        touching,
        low,
    }
}

/// The table of the levels, from 1 (hardest) on. A reading on a border belongs to the softer level.
pub const LEVELS: [LevelRange; 4] = [
    range("hard", ">70", ">70", 70.0),
    range("firm", "61-70", "60-70", 60.0),
    range("soft", "51-60", "50-60", 50.0),
    range("very-soft", "<=50", "<=50", 0.0),
];

/// The level of an object that reads `shore`.
pub fn level_of(shore: f64) -> u8 {
    let levels = (1..).zip(&LEVELS);
    let mut found = levels.filter(|(_, range)| shore > range.low);
    found.next().map_or(4, |(level, _)| level)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_border_belongs_to_the_softer_level() {
        for (level, range) in (1..4).zip(&LEVELS) {
            assert_eq!(level_of(range.low), level + 1);
            assert_eq!(level_of(range.low + 0.01), level);
        }
        assert_eq!([99.9, 3.0].map(level_of), [1, 4]);
    }
}
