//! The method `course`: the network that judges whole presses.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::ensure;
use burn::tensor::Device;

use super::Request;
use crate::data::courses::Courses;
use crate::data::dataset::{self, Source};
use crate::learn::conformal::LEAST_OBJECTS;
use crate::learn::course::{self, Task};
use crate::model::course::finish;
use crate::model::evaluated::Evaluated;
use crate::run::{Description, Run};
use hardnessd_core::verdict::Borders;
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

pub use super::settings::course as settings;

/// The description of a run, which uses all labels.
///
/// # Errors
///
/// Fails if the data has no labelled training presses, or if `validation.keep` is not `last`.
pub fn description(
    courses: &Courses,
    sources: Vec<Source>,
    request: &Request,
) -> anyhow::Result<Description> {
    request.settings.validation.check_last()?;
    dataset::warn_of_other_levels(&sources);
    let labels = courses.labelled(Split::Train).count();
    ensure!(
        labels > 0,
        "{}: no press of the train split has a level: collect some with `--sequences --level L`",
        sources.first().map_or("", |source| &source.name)
    );
    Ok(request.of("course", labels, sources))
}

/// Trains, and writes the model and its evaluation to the run's directory. A resumed run continues from
/// the files there.
///
/// # Errors
///
/// Fails if the training diverges, or the directory cannot be read or written.
pub fn train(
    courses: &Courses,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let all: Vec<usize> = courses.labelled(Split::Train).collect();
    let Description { settings, seed, .. } = description;
    let (train, held_out) = hold_out(courses, &all, settings.validation.share, *seed);
    let levels = dataset::levels_of(&description.data);
    let borders = Borders::of(&levels)?;
    let presses = course::presses(courses);
    let task = Task {
        stage: "course",
        presses: &presses,
        train: &train,
        held_out: &held_out,
        borders: &borders,
        levels: levels.len(),
        reports: settings.reports,
        settings: &settings.training,
        seed: *seed,
        device,
    };
    let trained = course::fit(&task, run)?;
    if let Some(missing) = trained.calibration.missing() {
        hardnessd_core::stderr_line!("{missing}");
    }
    if !task.has_shore() {
        hardnessd_core::stderr_line!(
            "no labelled training press has a measured Shore hardness: the model learns only how likely \
             each level is, and its Shore hardness says no more"
        );
    }
    finish(
        run,
        description,
        courses,
        (&presses, &train),
        (&trained, &borders),
        device,
    )
}

/// Splits presses into presses to learn from and presses to calibrate on. `share` is the share held
/// out: of the sensors, with all their objects, where the data has references of many sensors, and
/// else of each level's objects.
fn hold_out(courses: &Courses, all: &[usize], share: f64, seed: u64) -> (Vec<usize>, Vec<usize>) {
    if let Some(split) = hold_out_sensors(courses, all, share, seed) {
        return split;
    }
    let mut by_level = BTreeMap::<u8, BTreeSet<u32>>::new();
    for &place in all {
        let press = &courses.presses[place];
        let objects = by_level.entry(press.level).or_default();
        objects.insert(press.object);
    }
    let stream = Stream::new(seed, "held-out objects");
    let mut held = BTreeSet::new();
    for (level, objects) in by_level {
        let mut objects: Vec<u32> = objects.into_iter().collect();
        stream.child(level.into()).shuffle(&mut objects);
        // At least one object of the level stays to learn from.
        let count = (share * objects.len() as f64).round() as usize;
        let objects = &objects[..count.min(objects.len() - 1)];
        held.extend(objects.iter().map(|&object| (level, object)));
    }
    let is_held = |place: &usize| {
        let press = &courses.presses[*place];
        held.contains(&(press.level, press.object))
    };
    all.iter().partition(|place| !is_held(place))
}

/// Holds out sensors. Sensors that objects were pressed on in common stay together. `None` if the data
/// has too few of them, or no references, so that their numbers say nothing.
fn hold_out_sensors(
    courses: &Courses,
    all: &[usize],
    share: f64,
    seed: u64,
) -> Option<(Vec<usize>, Vec<usize>)> {
    let references = courses.presses.iter().filter(|p| p.reference.is_some());
    let known: BTreeSet<u32> = references.map(|press| press.sensor).collect();
    let presses = || all.iter().map(|&place| &courses.presses[place]);
    let mut first_of_object = BTreeMap::<u32, u32>::new();
    for press in presses() {
        let first = first_of_object.entry(press.object).or_insert(press.sensor);
        *first = press.sensor.min(*first);
    }
    let station = |place: &usize| {
        let press = &courses.presses[*place];
        let is_known = known.contains(&press.sensor);
        is_known.then(|| first_of_object[&press.object])
    };
    let stations: BTreeSet<u32> = all.iter().filter_map(station).collect();
    let mut stations: Vec<u32> = stations.into_iter().collect();
    Stream::new(seed, "held-out sensors").shuffle(&mut stations);
    let count = (share * stations.len() as f64).round() as usize;
    if count < LEAST_OBJECTS {
        return None;
    }
    let held: BTreeSet<u32> = stations[..count].iter().copied().collect();
    let is_held = |place: &usize| station(place).is_some_and(|station| held.contains(&station));
    Some(all.iter().partition(|place| !is_held(place)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::courses::Press;

    #[test]
    fn every_level_keeps_an_object_to_learn_from() {
        // Level 1 has six objects, level 2 two, and level 3 one, with three presses each.
        let objects = [(1, 0..6_u32), (2, 6..8), (3, 8..9)];
        let mut courses = Courses::default();
        for (level, numbers) in objects {
            for object in numbers.flat_map(|object| [object; 3]) {
                courses.presses.push(Press {
                    level,
                    object,
                    material: 0,
                    split: Split::Train,
                    shore: f32::NAN,
                    force_n: 1.0,
                    arm_n_per_mm: 0.0,
                    sensor: 0,
                    reference: None,
                    best: 0,
                });
            }
        }
        let all: Vec<usize> = courses.labelled(Split::Train).collect();
        for seed in 0..20 {
            let (kept, held) = hold_out(&courses, &all, 0.5, seed);
            let of = |places: &[usize], level| {
                let presses = places.iter().map(|&place| &courses.presses[place]);
                presses.filter(|press| press.level == level).count()
            };
            assert_eq!([1, 2, 3].map(|level| of(&kept, level)), [9, 3, 3]);
            assert_eq!([1, 2, 3].map(|level| of(&held, level)), [9, 3, 0]);
        }
    }
}
