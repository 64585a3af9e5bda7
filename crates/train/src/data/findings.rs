//! What data cannot mean, found before anything is learnt from them.
//!
//! In: presses as they were read. Out: [`Findings`], one line each. Presses are compared by their frames and
//! not by their numbers: a recording that was collected twice has two numbers. An error means that no figure
//! of a model of these data would say what its reader thinks.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::hash::{DefaultHasher, Hasher as _};

use hardnessd_simulator::Split;

use super::presses::{Press, Presses};

/// Presses with fewer taxels that are not 0, over all frames, may be alike by chance.
const LEAST_TAXELS: usize = 32;
/// No hand or gripper presses a finger's array so hard.
const MOST_N: f64 = 500.0;
/// Less than noise.
const LEAST_N: f64 = 0.005;
/// A press of so many frames that are all the same is no press.
const LEAST_REPEATED: usize = 4;

/// What is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A file is named twice.
    FileTwice,
    /// A press is in both splits.
    InBothSplits,
    /// A press has two levels.
    TwoLevels,
    /// A press is one of two objects.
    TwoObjects,
    /// No taxel of any press reads anything.
    AllDead,
    /// The forces are no newtons.
    Units,
    /// An object has the same press twice.
    Twice,
    /// No taxel of a press reads anything.
    Dead,
    /// All frames of a press are the same.
    Repeated,
    /// Some labels are not used.
    LabelsUnused,
}

impl Kind {
    /// Whether no model should be made of such data.
    pub fn is_error(self) -> bool {
        self < Self::Twice
    }
}

/// Something that is wrong with data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// What is wrong.
    pub kind: Kind,
    /// Where, and what to do.
    pub text: String,
}

/// Everything that is wrong with data, errors first. As text, a line each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Findings(pub Vec<Finding>);

/// Data of which no model should be made.
#[derive(Debug, thiserror::Error)]
#[error("the data cannot mean what their labels say: {0}")]
pub struct Unusable(String);

impl Findings {
    /// Looks through `presses`, of which a training uses `labels` labelled ones.
    pub fn of(presses: &Presses, labels: Option<usize>) -> Self {
        let mut found = files(presses);
        found.extend(contents(presses));
        found.extend(units(presses));
        if let Some(labels) = labels {
            let labelled = presses.labelled(Split::Train).count();
            if labels < labelled {
                let text = format!(
                    "{labels} of {labelled} labelled training presses are used as such: --labels {labelled} uses all"
                );
                found.push((Kind::LabelsUnused, text));
            }
        }
        let mut found: Vec<Finding> = found
            .into_iter()
            .map(|(kind, text)| Finding { kind, text })
            .collect();
        found.sort_by_key(|finding| finding.kind);
        Self(found)
    }

    /// The same, if there is no error.
    ///
    /// # Errors
    ///
    /// Returns the first error.
    pub fn usable(self) -> Result<Self, Unusable> {
        match self.0.iter().find(|finding| finding.kind.is_error()) {
            Some(first) => Err(Unusable(first.text.clone())),
            None => Ok(self),
        }
    }
}

impl fmt::Display for Findings {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Finding { kind, text } in &self.0 {
            let word = if kind.is_error() { "error" } else { "warning" };
            writeln!(out, "{word}: {text}")?;
        }
        Ok(())
    }
}

fn files(presses: &Presses) -> Vec<(Kind, String)> {
    let mut first = BTreeMap::new();
    let sources = presses.sources.iter().filter(|one| !one.sha256.is_empty());
    let twice = sources.filter_map(|source| {
        let before = first.insert(&source.sha256, &source.name)?;
        let text = format!(
            "{} and {before} are the same file: name it once",
            source.name
        );
        Some((Kind::FileTwice, text))
    });
    twice.collect()
}

/// The press as its reader would find it.
fn named(presses: &Presses, place: usize) -> String {
    let Press {
        source,
        object,
        name,
        ..
    } = &presses.all[place];
    let object = object.map(|object| format!(" of object {object}"));
    let name = name.as_ref().map(|name| format!(" ({name})"));
    format!(
        "press {place} of {}{}{}",
        presses.sources.get(*source).map_or("", |one| &one.name),
        object.unwrap_or_default(),
        name.unwrap_or_default()
    )
}

/// What the frames say: copies of presses, and presses without a contact.
fn contents(presses: &Presses) -> Vec<(Kind, String)> {
    let mut first = HashMap::<u64, usize>::new();
    // Of each kind the number of presses, and the first of them.
    let mut counts = BTreeMap::<Kind, (usize, String)>::new();
    let mut count = |kind: Kind, place: usize, other: Option<usize>| {
        let (count, _) = counts.entry(kind).or_insert_with(|| {
            let with = other.map(|other| format!(" and {}", named(presses, other)));
            (0, named(presses, place) + &with.unwrap_or_default())
        });
        *count += 1;
    };
    let mut dead = 0;
    for (place, press) in presses.all.iter().enumerate() {
        let content = Content::of(presses, place);
        if content.taxels == 0 {
            dead += 1;
            count(Kind::Dead, place, None);
        } else if content.is_one_frame {
            count(Kind::Repeated, place, None);
        }
        if content.taxels < LEAST_TAXELS {
            continue;
        }
        let Some(&other) = first.get(&content.hash) else {
            first.insert(content.hash, place);
            continue;
        };
        let before = &presses.all[other];
        let kind = if press.split != before.split {
            Kind::InBothSplits
        } else if press.level != before.level && press.level > 0 && before.level > 0 {
            Kind::TwoLevels
        } else if press.object != before.object {
            Kind::TwoObjects
        } else {
            Kind::Twice
        };
        count(kind, place, Some(other));
    }
    if dead > 0 && dead == presses.all.len() {
        counts.remove(&Kind::Dead);
        counts.insert(Kind::AllDead, (dead, String::new()));
    }
    let text = |(kind, (count, first)): (Kind, (usize, String))| {
        let presses = if count == 1 { "press" } else { "presses" };
        let text = match kind {
            Kind::InBothSplits => format!(
                "{count} {presses} in training and in test, such as {first}: a test on them says nothing"
            ),
            Kind::TwoLevels => format!("{count} {presses} with two levels, such as {first}"),
            Kind::TwoObjects => format!(
                "{count} {presses} of two objects, such as {first}: was a recording collected twice?"
            ),
            Kind::AllDead => "no taxel of any press reads anything".to_owned(),
            Kind::Twice => format!("{count} {presses} twice, such as {first}"),
            Kind::Dead => {
                format!("{count} {presses} in which no taxel reads anything, such as {first}")
            }
            _ => format!("{count} {presses} of one frame, repeated, such as {first}"),
        };
        (kind, text)
    };
    counts.into_iter().map(text).collect()
}

/// What identifies a press, whatever its numbers are.
struct Content {
    hash: u64,
    /// The number of taxels that are not 0, over all frames.
    taxels: usize,
    /// Whether it has some frames, and all are the same.
    is_one_frame: bool,
}

impl Content {
    fn of(presses: &Presses, place: usize) -> Self {
        let (mut hash, mut taxels, mut frames) = (DefaultHasher::new(), 0, 0);
        let (mut before, mut is_one_frame) = (None, true);
        for frame in presses.contents(place) {
            for (place, newtons) in &frame {
                hash.write_u16(*place);
                hash.write_u32(newtons.to_bits());
            }
            hash.write_u16(u16::MAX);
            taxels += frame.len();
            frames += 1;
            is_one_frame &= before.is_none_or(|before| before == frame);
            before = Some(frame);
        }
        Self {
            hash: hash.finish(),
            taxels,
            is_one_frame: is_one_frame && frames >= LEAST_REPEATED,
        }
    }
}

/// Whether the forces can be newtons.
fn units(presses: &Presses) -> Option<(Kind, String)> {
    let force = |place| -> f64 {
        let frame = presses.frame(place);
        frame.newtons.iter().copied().map(f64::from).sum()
    };
    let mut forces: Vec<f64> = (0..presses.all.len())
        .map(force)
        .filter(|&n| n > 0.0)
        .collect();
    if forces.is_empty() {
        return None;
    }
    let middle = forces.len() / 2;
    let (_, &mut median, _) = forces.select_nth_unstable_by(middle, f64::total_cmp);
    let text = if median > MOST_N {
        format!(
            "half of the presses have {median:.0} N or more: are `frames` in millinewtons? They are newtons, or \
             `frames_mn`"
        )
    } else if median < LEAST_N {
        format!("half of the presses have {median:.1e} N or less: are `frames` in newtons?")
    } else {
        return None;
    };
    Some((Kind::Units, text))
}

#[cfg(test)]
mod tests {
    use hardnessd_core::verdict::ModelFrame;

    use super::*;
    use crate::data::source::Source;

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
                (moment as f32 * 0.1, None, frame)
            });
            presses.push(press, moments);
        }
        presses.sources = vec![Source {
            name: "d.npz".to_owned(),
            ..Source::default()
        }];
        presses
    }

    fn kinds(presses: &Presses, labels: Option<usize>) -> Vec<Kind> {
        let Findings(found) = Findings::of(presses, labels);
        found.iter().map(|finding| finding.kind).collect()
    }

    #[test]
    fn copies_are_found_by_their_frames_whatever_their_numbers() {
        let (train, test) = (Split::Train, Split::Test);
        for (all, expected) in [
            (vec![(1, 1, train, 1), (2, 2, test, 2)], vec![]),
            (
                vec![(1, 1, train, 1), (2, 1, test, 1)],
                vec![Kind::InBothSplits],
            ),
            (
                vec![(1, 1, train, 1), (1, 2, train, 1)],
                vec![Kind::TwoLevels],
            ),
            (
                vec![(1, 1, train, 1), (2, 0, train, 1)],
                vec![Kind::TwoObjects],
            ),
            (vec![(1, 1, train, 1), (1, 1, train, 1)], vec![Kind::Twice]),
        ] {
            let presses = presses(&all, 0.01);
            assert_eq!(kinds(&presses, None), expected, "{all:?}");
            let is_usable = expected.iter().all(|kind| !kind.is_error());
            assert_eq!(Findings::of(&presses, None).usable().is_ok(), is_usable);
        }
        let both = presses(&[(1, 1, train, 1), (2, 1, test, 1)], 0.01);
        assert_eq!(
            Findings::of(&both, None).to_string(),
            "error: 1 press in training and in test, such as press 1 of d.npz of object 2 and press 0 of d.npz of \
             object 1: a test on them says nothing\n"
        );
    }

    #[test]
    fn units_dead_presses_labels_and_files_are_looked_at() {
        let train = Split::Train;
        let all = [(1, 1, train, 1), (2, 2, train, 2), (3, 2, train, 3)];
        assert_eq!(kinds(&presses(&all, 10.0), None), [Kind::Units]);
        assert_eq!(kinds(&presses(&all, 0.0), None), [Kind::AllDead]);
        assert_eq!(kinds(&presses(&all, 0.01), Some(3)), []);
        assert_eq!(kinds(&presses(&all, 0.01), Some(2)), [Kind::LabelsUnused]);
        let mut twice = presses(&all, 0.01);
        let source = Source {
            sha256: "5e".to_owned(),
            ..twice.sources[0].clone()
        };
        twice.sources = vec![source.clone(), source];
        assert_eq!(kinds(&twice, None), [Kind::FileTwice]);
        // One frame again and again.
        let mut still = presses(&all, 0.01);
        let mut frame = ModelFrame::default();
        frame.newtons[..40].fill(0.1);
        let moments = (0..5).map(|moment| (moment as f32, None, frame));
        still.push(Press::default(), moments);
        assert_eq!(kinds(&still, None), [Kind::Repeated]);
    }
}
