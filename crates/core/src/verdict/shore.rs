//! A distribution over Shore hardness, and what a verdict says of it.
//!
//! In: the outputs of a model of format 3, one for each of a number of equal bins from 0 to 100 Shore
//! OO. Out: probabilities of the levels, a value and an interval. All are of the same distribution,
//! so none contradicts another.

use serde::{Deserialize, Serialize};

use super::error::ModelError;
use super::probabilities::{argmax, softmax};
use crate::wording::is_plain;

/// The most hardness levels that data or a configuration may have.
pub const MOST_LEVELS: usize = 16;

/// The longest `label` and `shore` of a level: every event carries a label.
const LONGEST_LABEL_BYTES: usize = 255;

/// One hardness level, as `hello` publishes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Level {
    /// The level's number, from 1; 1 is the hardest.
    pub level: u8,
    /// A short name without control characters, such as `very-soft`.
    pub label: String,
    /// The Shore hardness that the level covers, such as `51-60`.
    pub shore: String,
}

impl Level {
    /// A level with its number, its name and the range that it covers.
    pub fn new(level: u8, label: impl Into<String>, shore: impl Into<String>) -> Self {
        Self {
            level,
            label: label.into(),
            shore: shore.into(),
        }
    }
}

/// A `[[level]]` table of a configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LevelTable {
    /// The name of the level, such as `firm`.
    pub label: String,
    /// The least and the greatest Shore OO of the level.
    pub shore: [f32; 2],
}

impl LevelTable {
    /// The levels of these tables, the hardest first.
    ///
    /// # Errors
    ///
    /// Returns an error if the tables are fewer than 2 or more than [`MOST_LEVELS`], a label cannot be shown, or
    /// the levels are no parts of the scale.
    pub fn levels(tables: &[Self]) -> Result<Vec<Level>, ModelError> {
        let found = tables.len();
        if !(2..=MOST_LEVELS).contains(&found) {
            let expected = format!("none, or 2 to {MOST_LEVELS}");
            return Err(ModelError::new(format!(
                "found {found} tables, expected {expected}"
            )));
        }
        let level = |(level, table): (u8, &Self)| {
            let shore = format!("{}-{}", table.shore[0], table.shore[1]);
            Level::new(level, &table.label, shore)
        };
        let levels: Vec<Level> = (1..=u8::MAX).zip(tables).map(level).collect();
        if !are_levels(&levels) {
            let problem = "a label is empty, too long or not plain text";
            return Err(ModelError::new(problem));
        }
        Borders::of(&levels)?;
        Ok(levels)
    }
}

/// Whether a model may have these levels: numbers from 1, and labels that can be shown.
pub fn are_levels(levels: &[Level]) -> bool {
    let numbers = levels.iter().map(|level| level.level);
    let mut texts = levels.iter().flat_map(|level| [&level.label, &level.shore]);
    levels.len() >= 2
        && numbers.eq((1..=u8::MAX).take(levels.len()))
        && texts.all(|text| (1..=LONGEST_LABEL_BYTES).contains(&text.len()) && is_plain(text))
}

/// The end of the scale.
const MOST: f32 = 100.0;

/// A Shore hardness with its interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(into = "[f32; 3]", from = "[f32; 3]")]
pub struct Shore {
    /// The Shore hardness. Of a distribution, its median within the named level.
    pub value: f32,
    /// The beginning of the 90 % interval.
    pub low: f32,
    /// The end of the 90 % interval.
    pub high: f32,
}

impl Shore {
    /// The nearest value in this part of the scale, with an interval that contains it.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::verdict::Shore;
    ///
    /// let shore = Shore { value: 53.0, low: 48.0, high: 59.0 };
    /// let firm = Shore { value: 60.5, low: 48.0, high: 60.5 };
    /// assert_eq!(shore.within([60.5, 70.5]), firm);
    /// ```
    pub fn within(self, [low, high]: [f32; 2]) -> Self {
        let value = self.value.clamp(low, high);
        Self {
            value,
            low: self.low.min(value),
            high: self.high.max(value),
        }
    }
}

impl From<[f32; 3]> for Shore {
    fn from([value, low, high]: [f32; 3]) -> Self {
        Self { value, low, high }
    }
}

impl From<Shore> for [f32; 3] {
    fn from(shore: Shore) -> Self {
        [shore.value, shore.low, shore.high]
    }
}

/// The levels' parts of the scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Borders {
    /// The borders between the levels with the ends of the scale, descending: a level lies between
    /// its border and the next one.
    shore: Vec<f32>,
}

impl Borders {
    /// The borders of levels in their order, the hardest first. A border lies in the middle of a gap
    /// between two levels. The first and the last level go to the ends of the scale.
    ///
    /// # Errors
    ///
    /// Returns an error if a range cannot be read, or two levels overlap.
    pub fn of(levels: &[Level]) -> Result<Self, ModelError> {
        let error = |found: String| {
            let expected = "ranges of Shore OO from the hardest to the softest";
            ModelError::new(format!("found {found}, expected {expected}"))
        };
        let no_range = "which is no range such as \"60-70\", \">70\" or \"<=50\"";
        let range = |level: &Level| {
            let text = &level.shore;
            range(text).ok_or_else(|| error(format!("`shore` {text:?}, {no_range}")))
        };
        let ranges = levels.iter().map(range).collect::<Result<Vec<_>, _>>()?;
        let mut shore = vec![MOST];
        for (place, pair) in ranges.windows(2).enumerate() {
            let ([low, _], [_, high]) = (pair[0], pair[1]);
            if high > low || low >= shore[place] {
                let (harder, softer) = (&levels[place], &levels[place + 1]);
                return Err(error(format!(
                    "level {} ({}), which is not softer than the level before it ({})",
                    softer.level, softer.shore, harder.shore
                )));
            }
            shore.push(0.5 * (low + high));
        }
        shore.push(0.0);
        Ok(Self { shore })
    }

    /// The part of the scale of the level at this place, from 0.
    pub fn part(&self, place: usize) -> [f32; 2] {
        [self.shore[place + 1], self.shore[place]]
    }

    /// The place of the level that a Shore hardness belongs to. On a border it is the softer level.
    pub fn place_of(&self, shore: f32) -> usize {
        let softer = self.shore[1..self.count()].iter();
        softer.take_while(|&&border| shore <= border).count()
    }

    fn count(&self) -> usize {
        self.shore.len() - 1
    }
}

/// A range of Shore OO as levels state it.
fn range(text: &str) -> Option<[f32; 2]> {
    let text = text.trim();
    let number = |text: &str| {
        let number: f32 = text.trim().parse().ok()?;
        (0.0..=MOST).contains(&number).then_some(number)
    };
    let after = |signs: [&str; 2]| signs.iter().find_map(|sign| text.strip_prefix(sign));
    if let Some(low) = after([">=", ">"]) {
        return Some([number(low)?, MOST]);
    }
    if let Some(high) = after(["<=", "<"]) {
        return Some([0.0, number(high)?]);
    }
    let (low, high) = text.split_once('-')?;
    let (low, high) = (number(low)?, number(high)?);
    (low < high).then_some([low, high])
}

/// A distribution over the scale: a probability for each of a number of equal bins from 0 to 100.
#[derive(Debug, Clone, PartialEq)]
pub struct Distribution {
    /// The probability below the beginning of each bin, and below the end of the last one.
    below: Vec<f32>,
}

impl Distribution {
    /// The softmax of `logits`, one for each bin.
    pub fn of(logits: &[f32]) -> Self {
        let mut below = vec![0.0];
        let mut sum = 0.0;
        for share in softmax(logits) {
            sum += share;
            below.push(sum);
        }
        below.iter_mut().for_each(|below| *below /= sum);
        Self { below }
    }

    fn bins(&self) -> usize {
        self.below.len() - 1
    }

    /// The probability below `shore`. It is even within a bin.
    pub fn below(&self, shore: f32) -> f32 {
        let place = shore / MOST * self.bins() as f32;
        let place = place.clamp(0.0, self.bins() as f32);
        let bin = (place as usize).min(self.bins() - 1);
        self.below[bin] + (place - bin as f32) * (self.below[bin + 1] - self.below[bin])
    }

    /// The Shore hardness that has this share below it.
    fn quantile(&self, share: f32) -> f32 {
        let ends = &self.below[1..];
        let bin = ends.partition_point(|&below| below < share);
        let bin = bin.min(self.bins() - 1);
        let before = self.below[bin];
        let within = (share - before) / (self.below[bin + 1] - before).max(f32::MIN_POSITIVE);
        (bin as f32 + within.clamp(0.0, 1.0)) * MOST / self.bins() as f32
    }

    /// The probability of each level.
    pub fn levels(&self, borders: &Borders) -> Vec<f32> {
        let part = |place| {
            let [low, high] = borders.part(place);
            (self.below(high) - self.below(low)).max(0.0)
        };
        (0..borders.count()).map(part).collect()
    }

    /// The median within the most probable level, and the interval of the whole distribution, with the
    /// share `tail` of it on each side.
    pub fn shore(&self, borders: &Borders, tail: f32) -> Shore {
        let (best, _) = argmax(&self.levels(borders));
        let part @ [low, high] = borders.part(best);
        let middle = 0.5 * (self.below(low) + self.below(high));
        let [value, low, high] = [middle, tail, 1.0 - tail].map(|share| self.quantile(share));
        // With many levels, the most probable one may lie at an end.
        Shore { value, low, high }.within(part)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::verdict::TAIL;

    fn levels(ranges: &[&str]) -> Vec<Level> {
        let level = |(level, shore): (u8, &&str)| Level::new(level, format!("l{level}"), *shore);
        (1..).zip(ranges).map(level).collect()
    }

    fn borders(ranges: &[&str]) -> Borders {
        Borders::of(&levels(ranges)).unwrap()
    }

    #[test]
    fn borders_lie_between_the_levels() {
        let touching = borders(&[">70", "60-70", "50-60", "<=50"]);
        assert_eq!(touching.shore, [100.0, 70.0, 60.0, 50.0, 0.0]);
        let with_gaps = borders(&["70-90", "40-60", "10-39"]);
        assert_eq!(with_gaps.shore, [100.0, 65.0, 39.5, 0.0]);
        for (ranges, text) in [
            (
                &["60-70", "50-65"][..],
                "level 2 (50-65), which is not softer",
            ),
            (&["<=50", ">50"], "level 2 (>50)"),
            (&["hard", "<=50"], "`shore` \"hard\", which is no range"),
            (&["70-60", "<=50"], "no range"),
            (&[">170", "<=50"], "no range"),
        ] {
            let error = Borders::of(&levels(ranges)).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        }
    }

    #[test]
    fn a_value_on_a_border_belongs_to_the_softer_level() {
        let levels = borders(&[">70", "61-70", "51-60", "<=50"]);
        for (shore, place) in [
            (100.0, 0),
            (70.1, 0),
            (70.0, 1),
            (60.6, 1),
            (60.5, 2),
            (60.3, 2),
            (50.5, 3),
            (0.0, 3),
        ] {
            assert_eq!(levels.place_of(shore), place, "{shore}");
            let [low, high] = levels.part(place);
            assert!((low..=high).contains(&shore), "{shore}");
        }
        // The first and the last level go to the ends of the scale.
        let inside = borders(&["70-90", "40-60"]);
        assert_eq!(
            [95.0, 65.0, 10.0].map(|shore| inside.place_of(shore)),
            [0, 1, 1]
        );
    }

    proptest! {
        #[test]
        fn nothing_contradicts(
            logits in proptest::collection::vec(-30.0..30.0_f32, 2..80),
            mut cuts in proptest::collection::btree_set(1..100_u8, 1..12),
        ) {
            cuts.insert(50);
            let cuts: Vec<u8> = cuts.into_iter().rev().collect();
            let mut ranges = vec![format!(">{}", cuts[0])];
            ranges.extend(cuts.windows(2).map(|pair| format!("{}-{}", pair[1], pair[0])));
            ranges.push(format!("<={}", cuts[cuts.len() - 1]));
            let ranges: Vec<&str> = ranges.iter().map(String::as_str).collect();
            let borders = borders(&ranges);
            let distribution = Distribution::of(&logits);
            let levels = distribution.levels(&borders);
            prop_assert!((levels.iter().sum::<f32>() - 1.0).abs() < 1e-4);
            let shore = distribution.shore(&borders, TAIL);
            let [low, high] = borders.part(argmax(&levels).0);
            prop_assert!((low..=high).contains(&shore.value));
            prop_assert!((shore.low..=shore.high).contains(&shore.value));
            prop_assert!(0.0 <= shore.low && shore.high <= 100.001);
        }
    }
}
