//! One training, from data to a model file: read, split once, learn, calibrate, export.

use std::path::PathBuf;

use anyhow::{bail, ensure};
use burn::tensor::Device;

use crate::data::findings::Findings;
use crate::data::presses::Presses;
use crate::data::source::warn_of_other_levels;
use crate::data::split::Parts;
use crate::learn;
use crate::learn::calibration::Calibration;
use crate::methods::{Stages, last_stage};
use crate::model::evaluated::Evaluated;
use crate::model::export::{self, Learnt};
use crate::recipe::{Kind, Recipe};
use crate::run::progress::ensure_finite;
use crate::run::{Description, Run};
use crate::settings::{Profile, Settings};
use hardnessd_core::wording;
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

/// What to train, on what, and where to.
#[derive(Debug)]
pub struct Request {
    /// The method.
    pub recipe: &'static Recipe,
    /// The files to learn from.
    pub data: Vec<PathBuf>,
    /// The run's directory.
    pub out: PathBuf,
    /// How long the run may take.
    pub profile: Profile,
    /// Seed of everything random.
    pub seed: u64,
    /// The number of labels to use instead of the method's share.
    pub labels: Option<usize>,
    /// Settings that count more than the method's.
    pub given: toml::Table,
    /// Whether to continue the run that the directory has.
    pub resume: bool,
    /// Other runs, whose finished stages are taken where they are the same.
    pub from: Vec<PathBuf>,
    /// The device that computes.
    pub device: Device,
}

/// A requested number of labels that the data cannot give.
#[derive(Debug, thiserror::Error)]
#[error(
    "--labels: found {asked}, expected at least {least} (one of each level and file) and at most the data's {labelled}"
)]
pub struct LabelsError {
    asked: usize,
    least: usize,
    labelled: usize,
}

/// Trains, and gives the evaluation on the test split, if the data has one. `say` is told what the data are
/// before anything is learnt.
///
/// # Errors
///
/// Fails if the data do not have what the method needs, the directory has another run or cannot be written,
/// or the training diverges.
pub fn train(request: &Request, say: impl FnOnce(&Presses)) -> anyhow::Result<Option<Evaluated>> {
    let Request {
        recipe,
        profile,
        seed,
        given,
        device,
        ..
    } = request;
    recipe.settings(*profile, 1, given)?;
    let presses = Presses::read(&request.data)?;
    let labels = request.labels(&presses)?;
    let share = recipe.settings(*profile, labels, given)?.validation.share;
    let parts = Parts::of(&presses, labels, share, *seed);
    let settings = recipe.settings(*profile, parts.train.len(), given)?;
    check(recipe, &presses, &parts, &settings)?;
    let findings = Findings::of(&presses, Some(labels));
    hardnessd_core::stderr_part!("{}", wording::lines(&findings.to_string()));
    let findings = findings.usable()?;
    export::check_sources(&presses.sources)?;

    let description = Description {
        method: recipe.name.clone(),
        profile: *profile,
        seed: *seed,
        labels,
        settings,
        data: presses.sources.clone(),
    };
    let run = Run::open(&request.out, &description, request.resume)?;
    let run = run.taking_from(request.from.clone());
    if !findings.0.is_empty() {
        run.write("findings.txt", findings.to_string().as_bytes())?;
    }
    warn_of_other_levels(&presses.sources);
    say(&presses);

    let stages = Stages {
        presses: &presses,
        parts: &parts,
        settings: &settings,
        seed: *seed,
        run: &run,
        device,
    };
    let learning = &*last_stage(recipe, &stages)?;
    let weights = learn::run(learning, |press| presses.all[press].level, &run, device)?;
    // Finite weights can still give a logit that is not. One press is enough for this check.
    let first = learn::Question {
        presses: vec![parts.train[0]],
        references: Vec::new(),
    };
    for logit in learning.judge(&weights, &[first], None).concat() {
        ensure_finite(
            learning.stage(),
            settings.training.epochs,
            "logit",
            logit.into(),
        )?;
    }
    let mut stream = Stream::new(*seed, &format!("{} calibration", learning.stage()));
    let held_out = &parts.held_out;
    let calibration = Calibration::of(learning, &presses, held_out, &weights, &mut stream);
    if recipe.learning == Kind::Course {
        say_what_is_missing(&calibration, &presses, &parts);
    }
    let learnt = Learnt {
        learning,
        weights: &weights,
        calibration,
        presses: &presses,
        train: &parts.train,
    };
    export::finish(&learnt, &run, &description)
}

impl Request {
    /// The number of labels that the run uses: the requested one, or else the method's share.
    fn labels(&self, presses: &Presses) -> anyhow::Result<usize> {
        let labelled = presses.some_labelled(Split::Train)?.len();
        let least = presses.levels().len() * presses.sources.len();
        match self.labels {
            Some(asked) if !(least..=labelled).contains(&asked) => Err(LabelsError {
                asked,
                least,
                labelled,
            }
            .into()),
            Some(asked) => Ok(asked),
            None => {
                // Hundredths, because 0.15 is not exactly 15 %.
                let percent = (100.0 * self.recipe.labels).round() as usize;
                Ok((labelled * percent).div_ceil(100).max(least).min(labelled))
            }
        }
    }
}

/// Checks, before anything is written, that the data has what all stages of a method need.
fn check(
    recipe: &Recipe,
    presses: &Presses,
    parts: &Parts,
    settings: &Settings,
) -> anyhow::Result<()> {
    if recipe.learning == Kind::Course && !presses.are_over_time() {
        bail!(
            "{}: has single frames, not whole presses: make it with `simulate --sequences` or `collect \
             --sequences`",
            presses.path().display()
        );
    }
    ensure!(
        !recipe.needs_unlabelled() || !parts.unlabelled.is_empty(),
        "no unlabelled training presses are left for {} beside its {} labelled ones and the held-out \
         objects: use fewer with --labels",
        recipe.name,
        parts.train.len()
    );
    for level in presses.levels() {
        let has_own = presses
            .of(&parts.train)
            .any(|press| press.level == level.level);
        ensure!(
            !recipe.needs_every_level() || has_own,
            "no labelled training presses of level {} for its STGAN: label some, or choose a method \
             without STGANs",
            level.level
        );
    }
    let share = settings.validation.share;
    if share > 0.0 && parts.held_out.is_empty() {
        hardnessd_core::stderr_line!(
            "`validation.share`: {share} of the labelled objects of each level rounds to none: \
             nothing is held out, and no temperature is fitted"
        );
    }
    Ok(())
}

/// Says what a model of whole presses cannot promise.
fn say_what_is_missing(calibration: &Calibration, presses: &Presses, parts: &Parts) {
    if let Some(missing) = calibration.missing() {
        hardnessd_core::stderr_line!("{missing}");
    }
    if presses.of(&parts.train).all(|press| press.shore.is_none()) {
        hardnessd_core::stderr_line!(
            "no labelled training press has a measured Shore hardness: the model learns only how likely \
             each level is, and its Shore hardness says no more"
        );
    }
}
