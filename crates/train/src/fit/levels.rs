//! The levels of recordings: their names and borders, from the labels `level` and `shore`.

use std::collections::BTreeMap;

use anyhow::{bail, ensure};

use crate::data::source::papers_levels;
use hardnessd_core::recording::Labels;
use hardnessd_core::verdict::{Level, MOST_LEVELS};
use hardnessd_core::wording::is_misspelt;

/// The levels that the labels of recordings name. Numbers alone are those of the paper's levels, or of as
/// many as there are. Two names that differ in case alone are one. Names are put in the order of the Shore hardness that
/// was measured, the hardest first, or else of the alphabet.
///
/// # Errors
///
/// Fails if the labels name more levels than a model may have.
pub fn of_labels<'a>(all: impl Iterator<Item = &'a Labels>) -> anyhow::Result<Vec<Level>> {
    let mut spelt = BTreeMap::<String, &str>::new();
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
                let first = spelt.entry(label.to_ascii_lowercase()).or_insert(label);
                named.entry(*first).or_default().push(shore);
            }
        }
    }
    let papers = papers_levels();
    let is_papers = |name: &&str| {
        let mut labels = papers.iter().map(|level| &level.label);
        labels.any(|label| label.eq_ignore_ascii_case(name))
    };
    if named.keys().all(is_papers) && most <= papers.len() {
        return Ok(papers);
    }
    let meant = |name: &&str| {
        let name = name.to_ascii_lowercase();
        papers.iter().find(|level| is_misspelt(&name, &level.label))
    };
    let mut own = named.keys().filter(|name| !is_papers(name));
    if named.keys().any(is_papers)
        && let Some((name, meant)) = own.find_map(|name| Some((name, meant(name)?)))
    {
        bail!(
            "label level: found {name:?} beside names of the usual levels: did you mean {:?}?",
            meant.label
        );
    }
    let count = named.len().max(most);
    ensure!(
        count <= MOST_LEVELS,
        "label level: found {count} levels, expected at most {MOST_LEVELS}"
    );
    let names: Vec<String> = match most {
        0 => named.keys().map(|name| (*name).to_owned()).collect(),
        most => (1..=most).map(|number| number.to_string()).collect(),
    };
    let unmeasured = || {
        let names = names.into_iter();
        names.map(|name| (name, "-".to_owned())).collect()
    };
    let measured = measured(&named).filter(|_| most == 0);
    let levels = measured.unwrap_or_else(unmeasured);
    let level = |(level, (label, shore)): (u8, (String, String))| Level::new(level, label, shore);
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
    let border = |pair: &[(&str, f32, f32)]| {
        let (above, below) = (pair[0].1, pair[1].2);
        (above > below).then_some(0.5 * (above + below))
    };
    let borders: Vec<f32> = ranges.windows(2).map(border).collect::<Option<_>>()?;
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
        let papers = "hard >70, firm 61-70, soft 51-60, very-soft <=50";
        // The labels `level` and `shore` of each recording, and the levels that follow.
        let misspelt = ["b", "hrad", "soft"].map(|of| Labels::from([("level".into(), of.into())]));
        assert!(of_labels(misspelt.iter()).is_err());
        for (given, expected) in [
            ("1, 3 55", papers),
            ("Soft, hard", papers),
            ("1, 5", "1 -, 2 -, 3 -, 4 -, 5 -"),
            ("ripe, green, Ripe", "green -, ripe -"),
            (
                "ripe 20, green 80, ripe 30, half 50",
                "green >65, half 40-65, ripe <=40",
            ),
            // Levels that overlap have no borders.
            ("a 20, a 60, b 40", "a -, b -"),
        ] {
            let labels = given.split(", ").map(|of| {
                let values = ["level", "shore"].into_iter().zip(of.split(' '));
                values
                    .map(|(key, value)| (key.to_owned(), value.to_owned()))
                    .collect()
            });
            let labels: Vec<Labels> = labels.collect();
            let found = of_labels(labels.iter()).unwrap().into_iter();
            let found: Vec<String> = found
                .map(|of| format!("{} {}", of.label, of.shore))
                .collect();
            assert_eq!(found.join(", "), expected);
        }
    }
}
