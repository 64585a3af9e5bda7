//! What data cannot mean, found before anything is learnt from them.
//!
//! In: presses as they were read. Out: [`Findings`], one line each. Presses are compared by their frames and
//! not by their numbers: a recording that was collected twice has two numbers. An error means that no figure
//! of a model of these data would say what its reader thinks.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt;
use std::hash::{DefaultHasher, Hasher as _};

use anyhow::bail;
use hardnessd_core::verdict::Level;
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

/// Everything that is wrong with data. As text, a line each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Findings {
    /// Of such data no model should be made.
    pub errors: Vec<String>,
    /// What is doubtful.
    pub warnings: Vec<String>,
}

impl Findings {
    /// Looks through `presses`, of which a training uses `labels` labelled ones.
    pub fn of(presses: &Presses, labels: Option<usize>) -> Self {
        let mut found = Self::default();
        found.files(presses);
        found.contents(presses);
        found.errors.extend(units(presses));
        found.levels(presses);
        let labelled = presses.labelled(Split::Train).count();
        if let Some(labels) = labels.filter(|&labels| labels < labelled) {
            found.warnings.push(format!(
                "{labels} of {labelled} labelled training presses are used as such: --labels {labelled} uses all"
            ));
        }
        found
    }

    /// The same, if there is no error.
    ///
    /// # Errors
    ///
    /// Returns all errors as one.
    pub fn usable(self) -> anyhow::Result<Self> {
        match self.errors.is_empty() {
            true => Ok(self),
            false => bail!(
                "the data cannot mean what their labels say: {}",
                self.errors.join("; ")
            ),
        }
    }

    /// Levels with few labelled training presses, or none.
    fn levels(&mut self, presses: &Presses) {
        for Level { level, .. } in presses.levels() {
            let places = presses.labelled(Split::Train);
            let own = places.filter(|&place| presses.all[place].level == level);
            let objects: BTreeSet<_> = own.map(|place| presses.all[place].object).collect();
            let warning = match (objects.len(), objects.contains(&None)) {
                (0, _) => "no labelled training press: the model never learns to say it",
                (1, false) => {
                    "all training presses are of one object: the model may learn the object and not the hardness"
                }
                _ => continue,
            };
            self.warnings.push(format!("level {level}: {warning}"));
        }
    }

    fn files(&mut self, presses: &Presses) {
        let mut first = BTreeMap::new();
        for source in presses.sources.iter().filter(|one| !one.sha256.is_empty()) {
            if let Some(before) = first.insert(&source.sha256, &source.name) {
                let text = format!(
                    "{} and {before} are the same file: name it once",
                    source.name
                );
                self.errors.push(text);
            }
        }
    }

    /// What the frames say: copies of presses, and presses without a contact.
    fn contents(&mut self, presses: &Presses) {
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
        for (place, press) in presses.all.iter().enumerate() {
            let content = Content::of(presses, place);
            if content.taxels == 0 {
                count(DEAD, place, None);
            } else if content.is_one_frame {
                count(REPEATED, place, None);
            }
            if content.taxels < LEAST_TAXELS {
                continue;
            }
            let other = *first.entry(content.hash).or_insert(place);
            if other == place {
                continue;
            }
            let before = &presses.all[other];
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
        for ((is_usable, what), (count, first)) in counts {
            let presses_are = if count == 1 { "press" } else { "presses" };
            let text = format!("{count} {presses_are} {what}, such as {first}");
            match is_usable && count < presses.all.len() {
                true => self.warnings.push(text),
                false => self.errors.push(text),
            }
        }
    }
}

impl fmt::Display for Findings {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (word, texts) in [("error", &self.errors), ("warning", &self.warnings)] {
            for text in texts {
                writeln!(out, "{word}: {text}")?;
            }
        }
        Ok(())
    }
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

    /// Asserts that the presses have this one error, or this one warning, or neither.
    #[track_caller]
    fn check(presses: &Presses, labels: Option<usize>, error: &str, warning: &str) {
        let Findings {
            errors,
            mut warnings,
        } = Findings::of(presses, labels);
        warnings.retain(|warning| !warning.starts_with("level "));
        for (found, expected) in [(errors, error), (warnings, warning)] {
            let is_expected = |text: &String| !expected.is_empty() && text.contains(expected);
            assert!(found.iter().all(is_expected), "{found:?}");
            assert_eq!(found.len(), usize::from(!expected.is_empty()), "{expected}");
        }
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
        ] {
            check(
                &presses(&[(1, 1, train, 1), second], 0.01),
                None,
                error,
                warning,
            );
        }
        let both = presses(&[(1, 1, train, 1), (2, 1, test, 1)], 0.01);
        let expected = "such as press 1 of d.npz of object 2 and press 0 of d.npz of object 1";
        check(&both, None, expected, "");
    }

    #[test]
    fn units_dead_presses_labels_and_files_are_looked_at() {
        let train = Split::Train;
        let all = [(1, 1, train, 1), (2, 2, train, 2), (3, 2, train, 3)];
        check(&presses(&all, 10.0), None, "`frames` are newtons", "");
        check(&presses(&all, 0.0), None, "3 presses in which no taxel", "");
        check(&presses(&all, 0.01), Some(3), "", "");
        check(&presses(&all, 0.01), Some(2), "", "2 of 3 labelled");
        let mut twice = presses(&all, 0.01);
        let source = Source {
            sha256: "5e".to_owned(),
            ..twice.sources[0].clone()
        };
        twice.sources = vec![source.clone(), source];
        check(&twice, None, "are the same file", "");
        // One frame again and again.
        let mut still = presses(&all, 0.01);
        let mut frame = ModelFrame::default();
        frame.newtons[..40].fill(0.1);
        let moments = (0..5).map(|moment| (moment as f32, None, frame));
        still.push(Press::default(), moments);
        check(&still, None, "", "of one frame, repeated");
    }
}
