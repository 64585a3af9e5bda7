//! The methods of the table, each a sequence of the same stages; and whole presses.

pub mod course;
pub mod features;
pub mod frame;
mod settings;
pub mod task;

use std::collections::BTreeSet;

use anyhow::ensure;
use burn::tensor::Device;

use crate::data::dataset::{
    Dataset, DatasetError, LabelChoice, Sample, Source, warn_of_other_levels,
};
use crate::model::evaluated::Evaluated;
use crate::net::generator::COMPONENTS;
use crate::net::losses::Game;
use crate::run::{Description, Run};
use crate::settings::{Keep, Profile, Settings, SettingsError, Training, Validation};
use crate::stages::Stages;
use hardnessd_simulator::Split;

/// A method of single frames: a row of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// The paper's whole method: USTGAN's start, pretraining on generated samples, fine-tuning.
    Ours,
    /// HRN from random weights on 15 % of the labels (1,500 in the paper).
    Hrn15,
    /// HRN from random weights on half of the labels.
    Hrn50,
    /// HRN from random weights on all labels.
    Hrn100,
    /// A GAN whose discriminator also tells the levels apart, with one more class for generated
    /// frames (Odena 2016).
    Sgan,
    /// A GAN with feature matching (Salimans 2016).
    Igan,
    /// The paper's method without augmentation: USTGAN's start and fine-tuning.
    Nahrn,
    /// The paper's method without USTGAN's start: random weights, pretraining, fine-tuning.
    Nihrn,
    /// Control: ours with a GAN that does not break: gradient penalty R1, averaged weights of the generator,
    /// and the epoch whose generated samples lie nearest to the real ones.
    OursSteady,
    /// Control: hrn15 with as many steps as the paper's whole method.
    Hrn15Long,
    /// Control: hrn15 with Adam and five times as many epochs. It holds a quarter of its labelled
    /// objects out and keeps the weights that are best on them.
    Hrn15Tuned,
    /// Control: hrn15 with the default model's recipe: Adam, averaged weights, symmetries and shifts, a
    /// logarithmic image, mean pooling beside max pooling.
    Hrn15Strong,
    /// Logistic regression on hand-made features of a frame.
    Features,
    /// Judges a frame and gives its Shore hardness: convolutions beside hand-made features, on all labels.
    /// The default model is of this method.
    Frame,
}

/// Training steps of `hrn15-strong`, whatever its number of labels: about as many as the default
/// model takes.
fn strong_steps(profile: Profile) -> u64 {
    match profile {
        Profile::Paper => 4_800,
        Profile::Quick => 1_200,
        Profile::Smoke => 6,
    }
}

impl Method {
    /// All methods, in the order of the tables.
    pub fn all() -> &'static [Self] {
        <Self as clap::ValueEnum>::value_variants()
    }

    /// The method's name in commands, files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ours => "ours",
            Self::Hrn15 => "hrn15",
            Self::Hrn50 => "hrn50",
            Self::Hrn100 => "hrn100",
            Self::Sgan => "sgan",
            Self::Igan => "igan",
            Self::Nahrn => "nahrn",
            Self::Nihrn => "nihrn",
            Self::OursSteady => "ours-steady",
            Self::Hrn15Long => "hrn15-long",
            Self::Hrn15Tuned => "hrn15-tuned",
            Self::Hrn15Strong => "hrn15-strong",
            Self::Features => "features",
            Self::Frame => "frame",
        }
    }

    /// The method's settings, before a settings file or an option overrides them.
    pub fn settings(self, profile: Profile) -> Settings {
        match self {
            Self::Igan => settings::igan(profile),
            Self::OursSteady => settings::ours_steady(profile),
            Self::Hrn15Tuned => settings::hrn15_tuned(profile),
            Self::Frame => settings::frame(profile),
            Self::Hrn15Strong => settings::strong(profile),
            _ => Settings::of(profile),
        }
    }

    /// The number of labels that the method uses of `labelled` samples by default.
    fn labels(self, labelled: usize) -> usize {
        let percent = match self {
            Self::Hrn100 | Self::Features | Self::Frame => 100,
            Self::Hrn50 => 50,
            _ => 15,
        };
        (labelled * percent).div_ceil(100)
    }
}

/// An error of a requested number of labels.
#[derive(Debug, thiserror::Error)]
pub enum LabelsError {
    /// The data has no labelled training samples.
    #[error(transparent)]
    None(#[from] DatasetError),
    /// More labels were requested than the data has, or too few for one of each level and file.
    #[error(
        "--labels: found {asked}, expected at least {least} (one of each level and file) and at \
         most the data's {labelled}"
    )]
    Range {
        /// The requested number of labels.
        asked: usize,
        /// The number of levels times the number of files.
        least: usize,
        /// The number of labelled training samples.
        labelled: usize,
    },
}

/// The number of labels that `method` uses of `dataset`: `asked`, or else the method's own share.
///
/// # Errors
///
/// Fails if the data has no labelled training samples, or if `asked` is more than these or too few
/// for one of each level and file.
pub fn labels(
    method: Method,
    dataset: &Dataset,
    asked: Option<usize>,
) -> Result<usize, LabelsError> {
    let labelled = dataset.labelled(Split::Train)?.len();
    let least = crate::data::dataset::levels().len() * dataset.sources.len();
    match asked {
        Some(asked) if !(least..=labelled).contains(&asked) => Err(LabelsError::Range {
            asked,
            least,
            labelled,
        }),
        Some(asked) => Ok(asked),
        None => Ok(method.labels(labelled).max(least).min(labelled)),
    }
}

/// The labelled samples that a run learns from and validates on.
fn chosen(dataset: &Dataset, description: &Description) -> Result<Vec<usize>, DatasetError> {
    let all = dataset.labelled(Split::Train)?;
    let Description {
        labels,
        label_choice,
        seed,
        ..
    } = *description;
    Ok(if labels == all.len() {
        all
    } else {
        dataset.choose_labelled(&all, labels, label_choice, seed)
    })
}

/// A request for a run, before its data determines the labels and epochs.
#[derive(Debug, Clone)]
pub struct Request {
    /// The profile, which sets how long the run takes.
    pub profile: Profile,
    /// The seed of everything random.
    pub seed: u64,
    /// The number of labels to use instead of the method's share.
    pub labels: Option<usize>,
    /// How the labels are chosen.
    pub label_choice: LabelChoice,
    /// The settings with all overrides applied.
    pub settings: Settings,
}

impl Request {
    /// The description of a run of `method` on `dataset`. `hrn15-long` gets the number of epochs that makes
    /// as many steps as `ours` would take on the same labels under the same settings.
    /// `hrn15-strong` gets enough epochs for its steps.
    ///
    /// # Errors
    ///
    /// Fails as [`labels`] does.
    pub fn of_method(&self, method: Method, dataset: &Dataset) -> Result<Description, LabelsError> {
        let labels = labels(method, dataset, self.labels)?;
        let mut description = self.of(method.name(), labels, dataset.sources.clone());
        let labelled = chosen(dataset, &description)?;
        let share = self.settings.validation.share;
        let (train, _) = dataset.hold_out(&labelled, share, self.seed);
        if method == Method::Hrn15Long {
            description.settings.training.epochs =
                epochs_as_long_as_ours(&self.settings, train.len());
        }
        if method == Method::Hrn15Strong {
            let an_epoch = train.len().div_ceil(self.settings.training.batch).max(1) as u64;
            let epochs = strong_steps(self.profile).div_ceil(an_epoch);
            description.settings.training.epochs = u32::try_from(epochs).unwrap_or(u32::MAX);
        }
        Ok(description)
    }

    /// The description of a run called `method` that uses `labels` labels of the data.
    fn of(&self, method: &str, labels: usize, data: Vec<Source>) -> Description {
        Description {
            method: method.to_owned(),
            profile: self.profile,
            seed: self.seed,
            labels,
            label_choice: self.label_choice,
            settings: self.settings,
            data,
        }
    }
}

/// Checks, before anything is written, that the data has what all stages of a method need.
///
/// # Errors
///
/// Fails if the data has no labelled training samples, if no unlabelled ones remain for a method
/// that needs them, if an STGAN has none of its level, or if objects are to be held out without
/// effect.
fn check(method: Method, dataset: &Dataset, description: &Description) -> anyhow::Result<()> {
    let labelled = chosen(dataset, description)?;
    let needs_unlabelled = matches!(
        method,
        Method::Ours
            | Method::OursSteady
            | Method::Nahrn
            | Method::Nihrn
            | Method::Sgan
            | Method::Igan
    );
    let Validation { share, .. } = description.settings.validation;
    let (_, held_out) = dataset.hold_out(&labelled, share, description.seed);
    ensure!(
        !needs_unlabelled || !unlabelled(dataset, &labelled, &held_out).is_empty(),
        "no unlabelled training samples are left for {} beside its {} labelled ones and the held-out \
         objects: use fewer with --labels",
        description.method,
        description.labels
    );
    let has_stgans = matches!(method, Method::Ours | Method::OursSteady | Method::Nihrn);
    for level in crate::data::dataset::levels() {
        let of_level = |&index: &usize| dataset.samples[index].level == level.level;
        ensure!(
            !has_stgans || labelled.iter().any(of_level),
            "no labelled training samples of level {} for its STGAN: label some, or choose a method \
             without STGANs",
            level.level
        );
    }
    warn_of_other_levels(&dataset.sources);
    check_validation(method, dataset, description, &labelled)
}

/// Checks that the method uses held-out objects. Prints a warning where the share rounds to no
/// object.
fn check_validation(
    method: Method,
    dataset: &Dataset,
    description: &Description,
    labelled: &[usize],
) -> anyhow::Result<()> {
    let Validation { share, keep, .. } = description.settings.validation;
    if method == Method::Frame {
        description.settings.validation.check_last()?;
    }
    if share == 0.0 || method == Method::Features {
        return Ok(());
    }
    let refused = |expected| SettingsError::Range {
        key: "validation.share".to_owned(),
        found: share,
        expected,
    };
    if matches!(method, Method::Sgan | Method::Igan) {
        return Err(refused("0: sgan and igan have no use for held-out objects").into());
    }
    let (_, held_out) = dataset.hold_out(labelled, share, description.seed);
    if held_out.is_empty() && keep == Keep::Best {
        let expected = "one that, with `validation.keep` best, rounds to an object or more of a \
                        level's labelled ones";
        return Err(refused(expected).into());
    }
    if held_out.is_empty() {
        hardnessd_core::stderr_line!(
            "`validation.share`: {share} of the labelled objects of each level rounds to none: \
             nothing is held out, and no temperature is fitted"
        );
    }
    Ok(())
}

/// The number of epochs over `samples` that makes, to the nearest epoch, as many steps as `ours`
/// takes in pretraining and fine-tuning.
fn epochs_as_long_as_ours(settings: &Settings, samples: usize) -> u32 {
    let steps = |samples: u64, training: &Training| samples.div_ceil(training.batch as u64).max(1);
    let levels = crate::data::dataset::levels().len() as u64;
    let generated = u64::from(settings.generation.samples_a_component) * COMPONENTS as u64 * levels;
    let pretraining =
        steps(generated, &settings.pretraining).saturating_mul(settings.pretraining.epochs.into());
    let an_epoch = steps(samples as u64, &settings.training);
    let more = pretraining.saturating_add(an_epoch / 2) / an_epoch;
    let epochs = u64::from(settings.training.epochs).saturating_add(more);
    u32::try_from(epochs).unwrap_or(u32::MAX)
}

/// Trains a method on data that passed [`check`]: [`task::Task::train`].
fn train(
    method: Method,
    dataset: &Dataset,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let labelled = chosen(dataset, description)?;
    let Description { settings, seed, .. } = description;
    let (train, validation) = dataset.hold_out(&labelled, settings.validation.share, *seed);
    let stages = Stages {
        dataset,
        train: &train,
        validation: &validation,
        unlabelled: &unlabelled(dataset, &labelled, &validation),
        description,
        run,
        device,
    };
    let trained = match method {
        Method::Features => {
            // It holds nothing out.
            return features::train(&Stages {
                train: &labelled,
                validation: &[],
                ..stages
            });
        }
        Method::Frame => return frame::train(&stages),
        Method::Ours | Method::OursSteady => {
            let ustgan = stages.ustgan()?;
            let generated = stages.generated(&ustgan)?;
            let pretrained = stages.pretrained(&generated, stages.inherited(&ustgan))?;
            stages.trained("fine-tuning", pretrained)?
        }
        Method::Nahrn => {
            let ustgan = stages.ustgan()?;
            stages.trained("fine-tuning", stages.inherited(&ustgan))?
        }
        Method::Nihrn => {
            let generated = stages.generated(&stages.ustgan()?)?;
            let pretrained = stages.pretrained(&generated, stages.random())?;
            stages.trained("fine-tuning", pretrained)?
        }
        Method::Sgan => stages.semi_supervised("sgan", Game::FakeLevel)?,
        Method::Igan => stages.semi_supervised("igan", Game::FeatureMatching)?,
        Method::Hrn15
        | Method::Hrn50
        | Method::Hrn100
        | Method::Hrn15Long
        | Method::Hrn15Tuned
        | Method::Hrn15Strong => stages.trained("hrn", stages.random())?,
    };
    stages.finish(&trained)
}

/// The training samples whose level is not used: all except `labelled` and the other presses of the
/// objects in `held_out`. A method that learnt from those would be judged on what it has seen.
fn unlabelled(dataset: &Dataset, labelled: &[usize], held_out: &[usize]) -> Vec<usize> {
    let samples = &dataset.samples;
    let labelled: BTreeSet<usize> = labelled.iter().copied().collect();
    let is_held_out = |sample: &Sample| {
        let mut held_out = held_out.iter().map(|&index| &samples[index]);
        held_out.any(|held| held.shares_object_with(sample))
    };
    let wanted = |index: &usize| {
        let sample = &samples[*index];
        sample.split == Split::Train && !labelled.contains(index) && !is_held_out(sample)
    };
    (0..samples.len()).filter(wanted).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum as _;

    #[test]
    fn names_are_those_of_the_command_line() {
        for method in Method::value_variants() {
            let value = method.to_possible_value().unwrap();
            assert_eq!(value.get_name(), method.name());
        }
    }

    #[test]
    fn presses_of_held_out_objects_are_not_learnt_from() {
        let settings = hardnessd_simulator::DatasetSettings {
            objects: 4,
            test_objects: 1,
            presses: 3,
            ..hardnessd_simulator::DatasetSettings::default()
        };
        let simulated = hardnessd_simulator::dataset(&settings, 1, |_| {});
        let bytes = crate::data::simulated::to_bytes(&settings, simulated).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("data.npz");
        std::fs::write(&path, bytes).unwrap();
        let mut dataset = Dataset::read(&path).unwrap();
        // One press of each object is unlabelled.
        let samples = &mut dataset.samples;
        samples
            .iter_mut()
            .step_by(3)
            .for_each(|sample| sample.level = 0);
        let labelled = dataset.labelled(Split::Train).unwrap();
        let all = unlabelled(&dataset, &labelled, &[]);
        let (_, held_out) = dataset.hold_out(&labelled, 0.5, 1);
        let kept = unlabelled(&dataset, &labelled, &held_out);
        assert!(!kept.is_empty() && kept.len() < all.len());
        let held: BTreeSet<_> = held_out
            .iter()
            .map(|&k| dataset.samples[k].object)
            .collect();
        for index in kept {
            assert!(!held.contains(&dataset.samples[index].object), "{index}");
        }
    }

    #[test]
    fn methods_take_the_papers_labels_and_steps() {
        let budget = [
            (Method::Ours, 1_500),
            (Method::Hrn15Tuned, 1_500),
            (Method::Hrn50, 5_000),
            (Method::Hrn100, 10_000),
        ];
        for (method, labels) in budget {
            assert_eq!(method.labels(10_000), labels, "{}", method.name());
        }
    }

    #[test]
    fn hrn15_long_takes_the_steps_of_ours() {
        // `ours` takes 90,000 steps over 45,000 generated samples (200 epochs of batches of 100),
        // then 200 epochs over the labelled samples.
        for (profile, samples, epochs) in [
            (Profile::Paper, 1_500, 6_200),
            (Profile::Quick, 1_500, 620),
            (Profile::Paper, 600, 15_200),
            (Profile::Paper, 660, 13_057),
            (Profile::Smoke, 24, 10),
        ] {
            let settings = Method::Hrn15Long.settings(profile);
            let found = epochs_as_long_as_ours(&settings, samples);
            assert_eq!(found, epochs, "{profile:?}, {samples} labels");
        }
    }

    #[test]
    fn all_settings_are_within_their_ranges() {
        for &method in Method::all() {
            for profile in [Profile::Paper, Profile::Quick, Profile::Smoke] {
                for settings in [course::settings(profile), method.settings(profile)] {
                    assert!(settings.checked().is_ok(), "{}", method.name());
                }
            }
        }
    }
}
