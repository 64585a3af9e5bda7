//! The levels of recordings: their names and borders, from the labels `level` and `shore`.

use std::collections::BTreeMap;

use anyhow::ensure;

use crate::data::source::{MOST_LEVELS, papers_levels};
use hardnessd_core::recording::Labels;
use hardnessd_core::verdict::Level;

/// The levels that the labels of recordings name. Numbers alone are those of the paper's levels, or of as
/// many as there are. Names are put in the order of the Shore hardness that was measured, the hardest first, or
/// else of the alphabet.
///
/// # Errors
///
/// Fails if the labels name more levels than a model may have.
pub fn of_labels(all: &[Labels]) -> anyhow::Result<Vec<Level>> {
    let mut named = BTreeMap::<&str, Vec<Option<f32>>>::new();
    let mut most = 0;
    for labels in all {
        let Some(label) = labels.get("level") else {
            continue;
        };
        match label.parse::<usize>() {
            Ok(number) => most = most.max(number),
            Err(_) => {
                let shore = labels.get("shore").and_then(|shore| shore.parse().ok());
                named.entry(label).or_default().push(shore);
            }
        }
    }
    let papers = papers_levels();
    let is_papers = |name: &&str| {
        papers
            .iter()
            .any(|level| level.label.eq_ignore_ascii_case(name))
    };
    if named.keys().all(is_papers) && most <= papers.len() {
        return Ok(papers);
    }
    let count = named.len().max(most);
    ensure!(
        count <= MOST_LEVELS,
        "label level: found {count} levels, expected at most {MOST_LEVELS}"
    );
    let unmeasured = |name: String| (name, "-".to_owned());
    let levels = match (most, measured(&named)) {
        (0, Some(measured)) => measured,
        (0, None) => named
            .keys()
            .map(|name| unmeasured((*name).to_owned()))
            .collect(),
        (most, _) => (1..=most)
            .map(|number| unmeasured(number.to_string()))
            .collect(),
    };
    let level = |(level, (label, shore)): (u8, (String, String))| Level {
        level,
        label,
        shore,
    };
    Ok((1..).zip(levels).map(level).collect())
}

/// Names with the Shore hardness of their recordings, the hardest first. `None` if it was not measured of all, or
/// two levels overlap.
fn measured(named: &BTreeMap<&str, Vec<Option<f32>>>) -> Option<Vec<(String, String)>> {
    let mut ranges = Vec::new();
    for (name, shore) in named {
        let shore: Vec<f32> = shore.iter().copied().collect::<Option<_>>()?;
        let least = shore.iter().copied().reduce(f32::min)?;
        let most = shore.into_iter().reduce(f32::max)?;
        ranges.push((*name, least, most));
    }
    ranges.sort_by(|one, other| other.2.total_cmp(&one.2));
    let borders: Option<Vec<f32>> = ranges
        .windows(2)
        .map(|pair| (pair[0].1 > pair[1].2).then_some(0.5 * (pair[0].1 + pair[1].2)))
        .collect();
    let borders = borders?;
    let shore = |place: usize| match (place.checked_sub(1), borders.get(place)) {
        (None, Some(low)) => format!(">{low}"),
        (Some(above), Some(low)) => format!("{low}-{}", borders[above]),
        (Some(above), None) => format!("<={}", borders[above]),
        (None, None) => "-".to_owned(),
    };
    let level =
        |(place, (name, ..)): (usize, &(&str, f32, f32))| ((*name).to_owned(), shore(place));
    Some(ranges.iter().enumerate().map(level).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_those_of_the_labels() {
        let check = |given: &[(&str, &str)], expected: &[(&str, &str)]| {
            let labels = |(level, shore): &(&str, &str)| {
                let mut labels = Labels::from([("level".to_owned(), (*level).to_owned())]);
                if !shore.is_empty() {
                    labels.insert("shore".to_owned(), (*shore).to_owned());
                }
                labels
            };
            let found = of_labels(&given.iter().map(labels).collect::<Vec<_>>()).unwrap();
            let found: Vec<_> = found.iter().map(|l| (&*l.label, &*l.shore)).collect();
            assert_eq!(found, expected);
        };
        let papers = [
            ("hard", ">70"),
            ("firm", "61-70"),
            ("soft", "51-60"),
            ("very-soft", "<=50"),
        ];
        check(&[("1", ""), ("3", "55")], &papers);
        check(&[("Soft", ""), ("hard", "")], &papers);
        check(
            &[("1", ""), ("5", "")],
            &["1", "2", "3", "4", "5"].map(|name| (name, "-")),
        );
        check(
            &[("ripe", ""), ("green", "")],
            &[("green", "-"), ("ripe", "-")],
        );
        check(
            &[
                ("ripe", "20"),
                ("green", "80"),
                ("ripe", "30"),
                ("half", "50"),
            ],
            &[("green", ">65"), ("half", "40-65"), ("ripe", "<=40")],
        );
        // Levels that overlap have no borders.
        check(
            &[("a", "20"), ("a", "60"), ("b", "40")],
            &[("a", "-"), ("b", "-")],
        );
    }
}
