//! The method `course`, and `adapt` on presses: the network that judges whole presses, from random
//! weights or from those of a model file.

use anyhow::ensure;
use burn::tensor::Device;

use super::Method;
use super::adapt::NoStart;
use crate::random::Stream;
use crate::simulator::Split;
use crate::train::data::courses::Courses;
use crate::train::data::dataset::{self, LabelChoice, Source};
use crate::train::learn::conformal::Calibration;
use crate::train::learn::course::{self, Task};
use crate::train::learn::force;
use crate::train::model::course::finish;
use crate::train::model::evaluated::Evaluated;
use crate::train::model::file;
use crate::train::net::course as network;
use crate::train::net::start::Start;
use crate::train::run::{Description, Run};
use crate::train::settings::{Profile, Settings};
use crate::verdict::Hrn;

/// The description of a run of a method, which uses all labels.
///
/// # Errors
///
/// Fails if the data has no labelled training presses.
pub fn description(
    method: Method,
    courses: &Courses,
    sources: Vec<Source>,
    (profile, seed, settings): (Profile, u64, Settings),
) -> anyhow::Result<Description> {
    let labels = courses.labelled(Split::Train).count();
    ensure!(
        labels > 0,
        "{}: no press of the train split has a level: collect some with `--sequences --level L`",
        sources.first().map_or("", |source| &source.name)
    );
    Ok(Description {
        method: method.name().to_owned(),
        profile,
        seed,
        labels,
        label_choice: LabelChoice::Object,
        settings,
        data: sources,
    })
}

/// Trains from random weights or from `start`, and writes the model and its evaluation to the run's
/// directory. A resumed run continues from the files there.
///
/// # Errors
///
/// Fails if the training diverges, or the directory cannot be read or written.
pub fn train(
    courses: &Courses,
    start: Option<(Start, Calibration)>,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let all: Vec<usize> = courses.labelled(Split::Train).collect();
    let Description { settings, seed, .. } = description;
    let (train, held_out) = hold_out(courses, &all, settings.validation.share, *seed);
    let corrected = |(start, calibration)| {
        course::with_force_factor(start, courses, &train, device).map(|start| (start, calibration))
    };
    let start = start.map(corrected).transpose()?;
    let of_start = start.as_ref().map(|(start, _)| start);
    let force_factor = of_start.map_or(1.0, |start| start.standard.force_factor);
    if let Some(account) = force::account(force_factor) {
        crate::say!("{account}");
    }
    let presses = course::presses(courses, force_factor)?;
    let task = Task {
        stage: match start {
            Some(_) => "adapt",
            None => "course",
        },
        presses: &presses,
        train: &train,
        held_out: &held_out,
        levels: dataset::levels().len(),
        reports: settings.reports,
        settings: &settings.training,
        seed: *seed,
        device,
    };
    let trained = course::fit(&task, start, run)?;
    if let Some(missing) = trained.calibration.missing() {
        crate::say!("{missing}");
    }
    finish(
        run,
        description,
        courses,
        (&presses, &train),
        &trained,
        device,
    )
}

/// The start of `adapt`: the weights and calibration of a model file that the daemon's loader has
/// accepted.
///
/// # Errors
///
/// Returns [`NoStart`] if the file holds another network.
pub fn start(hrn: &Hrn, bytes: &[u8], device: &Device) -> anyhow::Result<(Start, Calibration)> {
    let constants = file::constants(bytes)?;
    let start = network::start(|name| constants.get(name), dataset::levels().len(), device);
    let start = start.ok_or_else(|| NoStart::of(hrn, "presses: course, or adapt of one"))?;
    let calibration = Calibration {
        temperature: start.temperature,
        widths: start.widths,
        ..Calibration::NONE
    };
    Ok((start, calibration))
}

/// Splits presses by their objects into presses to learn from and presses to calibrate on. `share`
/// is the share of the objects held out for calibration.
fn hold_out(courses: &Courses, all: &[usize], share: f64, seed: u64) -> (Vec<usize>, Vec<usize>) {
    let object_of = |&place: &usize| courses.presses[place].object;
    let mut objects: Vec<u32> = all.iter().map(object_of).collect();
    objects.sort_unstable();
    objects.dedup();
    Stream::new(seed, "held-out objects").shuffle(&mut objects);
    // At least one object stays to learn from.
    let count = (share * objects.len() as f64).round() as usize;
    let held = &objects[..count.min(objects.len().saturating_sub(1))];
    all.iter()
        .partition(|place| !held.contains(&object_of(place)))
}
