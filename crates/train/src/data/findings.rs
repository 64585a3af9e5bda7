//! What data cannot mean, found before anything is learnt from them.
//!
//! In: presses as they were read. Out: warnings, or an error: no figure of a model of these data would say what its
//! reader thinks. Presses are compared by their frames and not by their numbers: a recording that was collected twice
//! has two numbers.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::hash::{BuildHasher as _, RandomState};

use anyhow::ensure;
use hardnessd_core::frame::{Array, Frame, Pitch};
use hardnessd_core::verdict::Level;
use hardnessd_simulator::Split;

use super::presses::Presses;

/// Presses with fewer taxels that are not 0, over all frames, are never compared: two of few counts are often alike.
const LEAST_TAXELS: usize = 4;
/// Of presses with fewer taxels than these, some may be alike by chance: less than one in so many.
const SURE_TAXELS: usize = 32;
const CHANCE: usize = 50;
/// No hand or gripper presses a finger's array so hard.
const MOST_N: f64 = 500.0;
/// Less than noise.
const LEAST_N: f64 = 0.005;
/// A press of so many frames that are all the same is no press.
const LEAST_REPEATED: usize = 4;

/// What presses can be, with whether a model may still be made of such data.
type Kind = (bool, &'static str);
const IN_BOTH_SPLITS: Kind = (
    false,
    "in training and in test, so that a test says nothing",
);
const TWO_LEVELS: Kind = (false, "with two levels");
const TWO_OBJECTS: Kind = (false, "of two objects (was a recording collected twice?)");
const TWICE: Kind = (true, "twice");
const DEAD: Kind = (true, "in which no taxel reads anything");
const REPEATED: Kind = (true, "of one frame, repeated");

/// Looks through `presses`, of which a training uses `labels` labelled ones. Gives what is doubtful.
///
/// # Errors
///
/// Returns all reasons for which no model should be made of such data, as one error.
pub fn warnings(presses: &Presses, labels: usize) -> anyhow::Result<Vec<String>> {
    let mut warnings = doubtful(presses)?;
    warnings.extend(levels(presses));
    let labelled = presses.labelled(Split::Train).count();
    if labels < labelled {
        warnings.push(format!(
            "{labels} of {labelled} labelled training presses are used as such: --labels {labelled} uses all"
        ));
    }
    Ok(warnings)
}

/// Looks through `presses`, however many of them are used. Gives what is doubtful.
///
/// # Errors
///
/// As [`warnings`].
pub fn doubtful(presses: &Presses) -> anyhow::Result<Vec<String>> {
    let (mut errors, mut warnings) = (Vec::new(), Vec::new());
    let mut first = BTreeMap::new();
    for source in presses.sources.iter().filter(|one| !one.sha256.is_empty()) {
        if let Some(before) = first.insert(&source.sha256, &source.name) {
            let name = &source.name;
            errors.push(format!(
                "{name} and {before} are the same file: name it once"
            ));
        }
    }
    for ((is_usable, what), (count, first)) in contents(presses) {
        let presses_are = if count == 1 { "press" } else { "presses" };
        let text = format!("{count} {presses_are} {what}, such as {first}");
        match is_usable && count < presses.all.len() {
            true => warnings.push(text),
            false => errors.push(text),
        }
    }
    errors.extend(units(presses));
    ensure!(
        errors.is_empty(),
        "the data cannot mean what their labels say: {}",
        errors.join("; ")
    );
    warnings.extend(presses.object_in_both_splits().map(|object| {
        format!(
            "object {object} is in both splits: its presses are near-copies, so a test on some of them overrates a \
             model that learnt from the others"
        )
    }));
    let ours = presses.levels();
    for source in &presses.sources {
        if source.levels.as_ref().is_some_and(|own| *own != ours) {
            warnings.push(format!(
                "{}: states other levels than the first file, whose levels the model will state",
                source.name
            ));
        }
    }
    warnings.extend(of_two_levels(presses));
    warnings.extend(beyond_contacts(presses));
    Ok(warnings)
}

/// Frames of other programs that a model would get otherwise from the daemon.
pub fn beyond_contacts(presses: &Presses) -> Option<String> {
    let differs = |&place: &usize| {
        let source = presses.sources.get(presses.all[place].source);
        let source = source.filter(|source| !source.is_ours());
        source.is_some_and(|source| {
            let frame = Frame {
                array: Array::JX255N,
                newtons: presses.frame(place).newtons.into(),
            };
            let threshold_n = Pitch::square(source.pitch()).contact_threshold_n();
            frame.felt(threshold_n) != frame
        })
    };
    let count = (0..presses.all.len()).filter(differs).count();
    (count > 0).then(|| {
        format!(
            "{count} of {} frames have newtons more than two taxels from the contact: the daemon gives a model 0 there, so \
             its verdicts may be worse than these frames show",
            presses.all.len()
        )
    })
}

/// An object with two levels. Numbers that people give may begin anew for each level.
fn of_two_levels(presses: &Presses) -> Option<String> {
    let mut first = BTreeMap::<u32, usize>::new();
    let two = (0..presses.all.len()).find_map(|place| {
        let press = &presses.all[place];
        let object = press.object.filter(|_| press.level > 0)?;
        let before = *first.entry(object).or_insert(place);
        (presses.all[before].level != press.level).then_some([before, place])
    });
    let [one, other] = two?.map(|place| {
        let level = presses.all[place].level;
        format!("{} (level {level})", named(presses, place))
    });
    Some(format!(
        "one object has two levels, and is taken for two: {one} and {other}"
    ))
}

/// Levels with few labelled training presses, or none.
fn levels(presses: &Presses) -> Vec<String> {
    let warning = |Level { level, .. }: Level| {
        let places = presses.labelled(Split::Train);
        let own = places.filter(|&place| presses.all[place].level == level);
        let objects: BTreeSet<_> = own.map(|place| presses.all[place].object).collect();
        let warning = match (objects.len(), objects.contains(&None)) {
            (0, _) => "no labelled training press: the model never learns to say it",
            (1, false) => {
                "all training presses are of one object: the model may learn the object and not the hardness"
            }
            _ => return None,
        };
        Some(format!("level {level}: {warning}"))
    };
    presses.levels().into_iter().filter_map(warning).collect()
}

/// What the frames say: copies of presses, and presses without a contact. Of each kind the number of presses, and the
/// first of them.
fn contents(presses: &Presses) -> BTreeMap<Kind, (usize, String)> {
    let mut counts = BTreeMap::<Kind, (usize, String)>::new();
    let mut count = |kind: Kind, place: usize, other: Option<usize>| {
        let (count, _) = counts.entry(kind).or_insert_with(|| {
            let with = other.map(|other| format!(" and {}", named(presses, other)));
            (0, named(presses, place) + &with.unwrap_or_default())
        });
        *count += 1;
    };
    for place in 0..presses.all.len() {
        let frames: Vec<Vec<(u16, u32)>> = presses.contents(place).collect();
        let is_one_frame = frames.windows(2).all(|pair| pair[0] == pair[1]);
        if frames.iter().all(Vec::is_empty) {
            count(DEAD, place, None);
        } else if is_one_frame && frames.len() >= LEAST_REPEATED {
            count(REPEATED, place, None);
        }
    }
    let all: Vec<usize> = (0..presses.all.len()).collect();
    for (place, other) in copies(presses, &all) {
        let (press, before) = (&presses.all[place], &presses.all[other]);
        let kind = if press.split != before.split {
            IN_BOTH_SPLITS
        } else if press.level != before.level && press.level > 0 && before.level > 0 {
            TWO_LEVELS
        } else if press.object != before.object {
            TWO_OBJECTS
        } else {
            TWICE
        };
        count(kind, place, Some(other));
    }
    counts
}

/// The presses of `places` whose frames are those of an earlier one, each with the first such one.
fn copies(presses: &Presses, places: &[usize]) -> Vec<(usize, usize)> {
    let state = RandomState::new();
    let mut first = HashMap::<u64, usize>::new();
    let (mut sure, mut maybe, mut small) = (Vec::new(), Vec::new(), 0);
    for &place in places {
        let frames: Vec<Vec<(u16, u32)>> = presses.contents(place).collect();
        let taxels: usize = frames.iter().map(Vec::len).sum();
        if taxels < LEAST_TAXELS {
            continue;
        }
        let is_small = taxels < SURE_TAXELS;
        small += usize::from(is_small);
        let other = *first.entry(state.hash_one(&frames)).or_insert(place);
        if other != place {
            let found = if is_small { &mut maybe } else { &mut sure };
            found.push((place, other));
        }
    }
    if maybe.len() * CHANCE >= small {
        sure.extend(maybe);
    }
    sure
}

/// The presses of `places` but for later copies of one.
pub fn without_copies(presses: &Presses, places: &[usize]) -> Vec<usize> {
    let copies = copies(presses, places).into_iter();
    let later: HashSet<usize> = copies.map(|(place, _)| place).collect();
    let is_first = |place: &usize| !later.contains(place);
    places.iter().copied().filter(is_first).collect()
}

/// The press as its reader would find it.
fn named(presses: &Presses, place: usize) -> String {
    let press = &presses.all[place];
    let source = presses.sources.get(press.source);
    let source = source.map_or("", |one| &one.name);
    let object = press.object.map(|object| format!(" of object {object}"));
    let name = press.name.as_ref().map(|name| format!(" ({name})"));
    let (object, name) = (object.unwrap_or_default(), name.unwrap_or_default());
    format!("press {place} of {source}{object}{name}")
}

/// Why the forces cannot be newtons, if they cannot.
fn units(presses: &Presses) -> Option<String> {
    let force = |place| -> f64 {
        let frame = presses.frame(place);
        frame.newtons.iter().copied().map(f64::from).sum()
    };
    let forces = (0..presses.all.len()).map(force);
    let mut forces: Vec<f64> = forces.filter(|&n| n > 0.0).collect();
    let middle = forces.len() / 2;
    forces.sort_unstable_by(f64::total_cmp);
    let median = *forces.get(middle)?;
    let is_possible = (LEAST_N..=MOST_N).contains(&median);
    (!is_possible).then(|| {
        format!(
            "half of the presses have {median:.1e} N or {}: `frames` are newtons, and `frames_mn` millinewtons",
            if median > MOST_N { "more" } else { "less" }
        )
    })
}

#[cfg(test)]
mod tests {
    use hardnessd_core::verdict::ModelFrame;

    use super::*;
    use crate::data::presses::Press;
    use crate::data::source::{SIMULATOR, Source};

    /// Presses of `frames` frames each, on object, level and split, with a content of its own for each number.
    fn presses(all: &[(u32, u8, Split, u32)], scale: f32) -> Presses {
        let mut presses = Presses::default();
        for &(object, level, split, content) in all {
            let press = Press {
                object: Some(object),
                level,
                split,
                ..Press::default()
            };
            let moments = (0..5_u32).map(|moment| {
                let mut frame = ModelFrame::default();
                for taxel in 0..20 {
                    let newtons = (content * 31 + moment * 7 + taxel) % 97;
                    frame.newtons[300 + taxel as usize] = scale * newtons as f32;
                }
                (moment as f32 * 0.1, None, frame.newtons)
            });
            presses.push(press, moments);
        }
        presses.sources = vec![Source {
            name: "d.npz".to_owned(),
            generator: Some(SIMULATOR.to_owned()),
            ..Source::default()
        }];
        presses
    }

    /// Asserts that the presses have this one error, or this one warning, or neither.
    #[track_caller]
    fn check(presses: &Presses, labels: Option<usize>, error: &str, warning: &str) {
        let found = match warnings(presses, labels.unwrap_or(usize::MAX)) {
            Err(found) => found.to_string(),
            Ok(mut found) => {
                assert_eq!(error, "");
                found.retain(|warning| !warning.starts_with("level "));
                assert_eq!(found.len(), usize::from(!warning.is_empty()), "{found:?}");
                found.concat()
            }
        };
        assert!(found.contains(error) && found.contains(warning), "{found}");
    }

    #[test]
    fn copies_are_found_by_their_frames_whatever_their_numbers() {
        let (train, test) = (Split::Train, Split::Test);
        for (second, error, warning) in [
            ((2, 2, test, 2), "", ""),
            ((2, 1, test, 1), "in training and in test", ""),
            ((1, 2, train, 1), "with two levels", ""),
            ((2, 0, train, 1), "of two objects", ""),
            ((1, 1, train, 1), "", "1 press twice"),
            ((1, 1, test, 2), "", "object 1 is in both splits"),
            // An unlabelled press agrees with every level.
            ((1, 0, test, 2), "", "object 1 is in both splits"),
            ((1, 2, test, 2), "", "one object has two levels"),
            ((1, 2, train, 2), "", "one object has two levels"),
        ] {
            let both = presses(&[(1, 1, train, 1), second], 0.01);
            check(&both, None, error, warning);
        }
        let both = presses(&[(1, 1, train, 1), (2, 1, test, 1)], 0.01);
        let expected = "such as press 1 of d.npz of object 2 and press 0 of d.npz of object 1";
        check(&both, None, expected, "");
    }

    #[test]
    fn copies_of_small_single_frames_are_found_unless_they_are_few() {
        let error = |content: fn(u32) -> u32| {
            let mut all = presses(&[], 1.0);
            for object in 0..200 {
                let mut frame = ModelFrame::default();
                for (taxel, newtons) in (0..6).zip(&mut frame.newtons[300..]) {
                    *newtons = 0.01 * (content(object) * 31 + taxel * 7 + 1) as f32;
                }
                let press = Press {
                    object: Some(object),
                    split: [Split::Train, Split::Test][object as usize % 2],
                    ..Press::default()
                };
                all.push(press, [(0.0, None, frame.newtons)]);
            }
            doubtful(&all).err().map(|error| error.to_string())
        };
        assert_eq!(error(|object| object), None);
        assert_eq!(error(|object| object.max(1)), None);
        let copies = error(|object| object / 2).unwrap();
        let expected = "100 presses in training and in test";
        assert!(copies.contains(expected), "{copies}");
    }

    #[test]
    fn units_dead_presses_labels_and_files_are_looked_at() {
        let train = Split::Train;
        let all = [(1, 1, train, 1), (2, 2, train, 2), (3, 2, train, 3)];
        check(&presses(&all, 10.0), None, "`frames` are newtons", "");
        check(&presses(&all, 0.0), None, "3 presses in which no taxel", "");
        check(&presses(&all, 0.01), Some(3), "", "");
        check(&presses(&all, 0.01), Some(2), "", "2 of 3 labelled");
        let mut theirs = presses(&all, 0.01);
        theirs.sources[0].generator = None;
        let expected = "1 of 3 frames have newtons more than two";
        check(&theirs, None, "", expected);
        let mut twice = presses(&all, 0.01);
        let source = Source {
            sha256: "5e".to_owned(),
            ..twice.sources[0].clone()
        };
        twice.sources = vec![source.clone(), source];
        check(&twice, None, "are the same file", "");
        let levels = warnings(&presses(&all, 0.01), 3).unwrap().join("\n");
        for expected in [
            "level 1: all training presses are of one object",
            "level 4: no labelled training press: the model never learns to say it",
        ] {
            assert!(levels.contains(expected), "{levels}");
        }
        // One frame again and again.
        let mut still = presses(&all, 0.01);
        let mut frame = ModelFrame::default();
        frame.newtons[..40].fill(0.1);
        let moments = (0..5).map(|moment| (moment as f32, None, frame.newtons));
        still.push(Press::default(), moments);
        check(&still, None, "", "of one frame, repeated");
    }
}
