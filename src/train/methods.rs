//! The methods of the table, as recipes over the same parts.

use std::collections::BTreeSet;
use std::time::Instant;

use anyhow::{Context as _, ensure};
use burn::tensor::Device;

use super::dataset::{Dataset, Sample};
use super::export::{self, Recogniser};
use super::features::{self, Baseline};
use super::fit::{self, Trained};
use super::gan::{self, Gan};
use super::generator::{self, COMPONENTS};
use super::hrn;
use super::losses::Game;
use super::metrics::Evaluation;
use super::network::Weights;
use super::optimiser::{self, Rule};
use super::run::{Description, Row, Run};
use super::settings::{Keep, Profile, Settings, Training, Validation};
use super::sheet::{self, Strip};
use crate::frame::Frame;
use crate::random::Stream;
use crate::simulator::Split;

/// A row of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// USTGAN's start, pretraining on what the STGANs generate, fine-tuning: the whole of it.
    Ours,
    /// HRN from random weights on 15 % of the labels: 1,500 in the paper.
    Hrn15,
    /// The same on half of them.
    Hrn50,
    /// The same on all of them.
    Hrn100,
    /// A GAN whose discriminator has the levels and one more for generated frames (Odena 2016).
    Sgan,
    /// A GAN with feature matching (Salimans 2016).
    Igan,
    /// Ours without augmentation: USTGAN's start and fine-tuning.
    Nahrn,
    /// Ours without USTGAN's start: random weights, pretraining, fine-tuning.
    Nihrn,
    /// Control: HRN15 with as many steps as ours.
    Hrn15Long,
    /// Control: HRN15 with Adam, stopped early on objects held out of its own labels.
    Hrn15Tuned,
    /// Logistic regression on hand-made features of a frame.
    Features,
}

/// The paper's labels: what the shares below are of 10,000.
const PAPER_LABELS: u32 = 1_500;

impl Method {
    /// Its name in commands, files and tables.
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
            Self::Hrn15Long => "hrn15-long",
            Self::Hrn15Tuned => "hrn15-tuned",
            Self::Features => "features",
        }
    }

    /// Its settings, before anything overrides them.
    pub fn settings(self, profile: Profile) -> Settings {
        let mut settings = Settings::of(profile);
        match self {
            // As Salimans trains it; the average reaches over about a tenth of the steps.
            Self::Igan => {
                settings.ustgan.optimiser.learning_rate = 3e-3;
                settings.ustgan.averaging = match profile {
                    Profile::Paper => 0.9999,
                    Profile::Quick => 0.999,
                    Profile::Smoke => 0.9,
                };
            }
            // Ours takes `pretraining.epochs` passes over the generated samples first.
            Self::Hrn15Long => {
                let levels = super::dataset::levels().len() as u32;
                let generated =
                    settings.generation.samples_a_component * COMPONENTS as u32 * levels;
                let passes = generated.div_ceil(PAPER_LABELS);
                settings.training.epochs += settings.pretraining.epochs * passes;
            }
            Self::Hrn15Tuned => {
                settings.training = Training {
                    epochs: 5 * settings.training.epochs,
                    optimiser: optimiser::Settings {
                        rule: Rule::Adam,
                        ..settings.training.optimiser
                    },
                    ..settings.training
                };
                // Two of a level's eight objects.
                settings.validation = Validation {
                    share: 0.25,
                    every_epochs: 1,
                    keep: Keep::Best,
                };
            }
            _ => {}
        }
        settings
    }

    /// Labels it may use of `labelled` samples, unless told otherwise.
    fn labels(self, labelled: usize) -> usize {
        let percent = match self {
            Self::Hrn100 | Self::Features => 100,
            Self::Hrn50 => 50,
            _ => 15,
        };
        (labelled * percent).div_ceil(100)
    }
}

/// How many labels `method` uses of `dataset`, if it may use `asked` or its own share.
///
/// # Errors
///
/// If the data has no labelled training samples, fewer than asked for, or too few of them for one
/// of each level.
pub fn labels(method: Method, dataset: &Dataset, asked: Option<usize>) -> anyhow::Result<usize> {
    let labelled = dataset.labelled(Split::Train)?.len();
    let least = super::dataset::levels().len() * dataset.sources.len();
    let labels = asked.unwrap_or_else(|| method.labels(labelled).max(least).min(labelled));
    ensure!(
        asked.is_none() || (least..=labelled).contains(&labels),
        "{labels} labels asked for: the data has {labelled}, and one of each level and file is \
         needed"
    );
    Ok(labels)
}

/// Runs a method to its model and evaluation in the run's directory; takes up whatever is there.
/// Gives the evaluation on the test split, if the data has one.
///
/// # Errors
///
/// If the data has no labelled training samples, a GAN is left without unlabelled ones, or the
/// directory cannot be read or written.
pub fn train(
    method: Method,
    dataset: &Dataset,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluation>> {
    let all = dataset.labelled(Split::Train)?;
    let labelled = if description.labels == all.len() {
        all
    } else {
        let Description {
            labels,
            label_choice,
            seed,
            ..
        } = *description;
        dataset.choose_labelled(&all, labels, label_choice, seed)
    };
    if method == Method::Features {
        return baseline(dataset, &labelled, description, run);
    }
    let levels = super::dataset::levels().len();
    let (train, validation) = dataset.hold_out(
        &labelled,
        description.settings.validation.share,
        description.seed,
    );
    let recipe = Recipe {
        dataset,
        train: &train,
        validation: &validation,
        unlabelled: unlabelled(dataset, &labelled),
        levels,
        description,
        run,
        device,
    };
    let seed = description.seed;
    let random = || hrn::initial(levels, seed, device);
    let inherited = |ustgan: &Gan| hrn::inherited(&ustgan.discriminator, levels, seed, device);
    let trained = match method {
        Method::Ours => {
            let ustgan = recipe.ustgan()?;
            let generated = recipe.generated(&ustgan)?;
            let pretrained = recipe.pretrained(&generated, inherited(&ustgan))?;
            recipe.trained("fine-tuning", pretrained)?
        }
        Method::Nahrn => recipe.trained("fine-tuning", inherited(&recipe.ustgan()?))?,
        Method::Nihrn => {
            let generated = recipe.generated(&recipe.ustgan()?)?;
            let pretrained = recipe.pretrained(&generated, random())?;
            recipe.trained("fine-tuning", pretrained)?
        }
        Method::Sgan => recipe.semi_supervised("sgan", Game::FakeLevel)?,
        Method::Igan => recipe.semi_supervised("igan", Game::FeatureMatching)?,
        _ => recipe.trained("hrn", random())?,
    };
    recipe.finish(&trained)
}

/// Training samples whose level is not used: all but `labelled`.
fn unlabelled(dataset: &Dataset, labelled: &[usize]) -> Vec<usize> {
    let labelled: BTreeSet<usize> = labelled.iter().copied().collect();
    let wanted =
        |index: &usize| dataset.samples[*index].split == Split::Train && !labelled.contains(index);
    (0..dataset.samples.len()).filter(wanted).collect()
}

/// Stages of the four STGANs.
const STGANS: [&str; 4] = ["stgan1", "stgan2", "stgan3", "stgan4"];

/// The parts that methods are made of. Each part is a stage in the run's directory, or several.
struct Recipe<'a> {
    dataset: &'a Dataset,
    /// Labelled samples to learn from.
    train: &'a [usize],
    /// Labelled samples of held-out objects.
    validation: &'a [usize],
    unlabelled: Vec<usize>,
    levels: usize,
    description: &'a Description,
    run: &'a Run,
    device: &'a Device,
}

impl Recipe<'_> {
    fn settings(&self) -> &Settings {
        &self.description.settings
    }

    fn gan_task<'a>(
        &'a self,
        stage: &'static str,
        game: Game,
        settings: &'a gan::Settings,
    ) -> gan::Task<'a> {
        gan::Task {
            stage,
            game,
            dataset: self.dataset,
            real: &self.unlabelled,
            labelled: &[],
            full_scale_n: self.settings().full_scale_n,
            settings,
            seed: self.description.seed,
            device: self.device,
        }
    }

    fn ensure_unlabelled(&self) -> anyhow::Result<()> {
        ensure!(
            !self.unlabelled.is_empty(),
            "no unlabelled training samples are left for the GAN: {} labels are used, found 0, \
             expected 1 or more",
            self.description.labels
        );
        Ok(())
    }

    /// Stage 1: the GAN trained without labels.
    fn ustgan(&self) -> anyhow::Result<Gan> {
        self.ensure_unlabelled()?;
        let game = Game::RealOrFake;
        let task = self.gan_task("ustgan", game, &self.settings().ustgan);
        let initial = gan::initial(game, self.levels, self.description.seed, self.device);
        gan::fit(&task, initial, self.run)
    }

    /// Stages 2 and 3: a GAN a level, started from USTGAN's weights and with fresh optimisers,
    /// and equally many samples of each component of each. They are not stored: they follow from
    /// the STGANs' last checkpoints.
    fn generated(&self, ustgan: &Gan) -> anyhow::Result<Dataset> {
        let settings = self.settings();
        let (full_scale_n, seed) = (settings.full_scale_n, self.description.seed);
        let mut samples = Vec::new();
        let mut strips = Vec::new();
        for level in 1..=self.levels as u8 {
            let stage = STGANS[usize::from(level) - 1];
            let real: Vec<usize> = self
                .train
                .iter()
                .copied()
                .filter(|&index| self.dataset.samples[index].level == level)
                .collect();
            ensure!(!real.is_empty(), "{stage}: no labelled sample of its level");
            let task = gan::Task {
                real: &real,
                ..self.gan_task(stage, Game::RealOrFake, &settings.stgan)
            };
            let stgan = gan::fit(&task, ustgan.clone(), self.run)?;
            let generator = &stgan.generator;
            let batch = settings.stgan.samples_a_component;
            let statistics = generator::statistics(generator, batch, seed, self.device);
            let mut stream = Stream::new(seed, &format!("{stage} generated"));
            let frames = generator::generate(
                generator,
                &statistics,
                settings.generation.samples_a_component as usize,
                full_scale_n,
                &mut stream,
                self.device,
            );
            let real = real.iter().map(|&index| &self.dataset.samples[index].frame);
            let spread = real.len().div_ceil(sheet::TILES).max(1);
            let real: Vec<&Frame> = real.step_by(spread).collect();
            let generated: Vec<Frame> = frames.iter().take(2 * sheet::TILES).copied().collect();
            strips.push((level, real, generated));
            samples.extend(frames.into_iter().map(|frame| Sample {
                frame,
                level,
                object: None,
                material: None,
                force_n: None,
                split: Split::Train,
                shore: None,
                source: 0,
            }));
        }
        let rows: Vec<Strip> = strips
            .iter()
            .flat_map(|(level, real, generated)| {
                let (first, second) = generated.split_at(generated.len().min(sheet::TILES));
                [
                    Strip::of(&format!("{level} real"), real.iter().copied()),
                    Strip::of(&format!("{level} generated"), first.iter()),
                    Strip::of("", second.iter()),
                ]
            })
            .collect();
        let title = "levels, real and generated: contact area at 0.07 N, force, peak";
        self.run
            .write("samples/generated.png", &sheet::strips(title, &rows)?)?;
        Ok(Dataset {
            samples,
            sources: Vec::new(),
        })
    }

    /// Stage 4, first half: HRN on generated samples.
    fn pretrained(&self, generated: &Dataset, initial: Weights) -> anyhow::Result<Weights> {
        let train: Vec<usize> = (0..generated.samples.len()).collect();
        let task = fit::Task {
            dataset: generated,
            train: &train,
            validation: (&[], Validation::default()),
            settings: &self.settings().pretraining,
            ..self.fit_task("pretraining")
        };
        Ok(fit::fit(&task, initial, self.run)?.weights)
    }

    fn fit_task(&self, stage: &'static str) -> fit::Task<'_> {
        fit::Task {
            stage,
            dataset: self.dataset,
            train: self.train,
            validation: (self.validation, self.settings().validation),
            levels: self.levels,
            full_scale_n: self.settings().full_scale_n,
            settings: &self.settings().training,
            seed: self.description.seed,
            device: self.device,
        }
    }

    /// HRN on the labelled samples.
    fn trained(&self, stage: &'static str, initial: Weights) -> anyhow::Result<Trained> {
        fit::fit(&self.fit_task(stage), initial, self.run)
    }

    /// A GAN whose discriminator learns the levels too, and then is the recogniser.
    fn semi_supervised(&self, stage: &'static str, game: Game) -> anyhow::Result<Trained> {
        self.ensure_unlabelled()?;
        let task = gan::Task {
            labelled: self.train,
            ..self.gan_task(stage, game, &self.settings().ustgan)
        };
        let initial = gan::initial(game, self.levels, self.description.seed, self.device);
        let gan = gan::fit(&task, initial, self.run)?;
        let weights = hrn::of_levels(&gan.discriminator, self.levels, self.device);
        // The layers' statistics over all real frames that the discriminator has seen.
        let mut real = self.unlabelled.clone();
        real.extend(self.train);
        let task = fit::Task {
            train: &real,
            ..self.fit_task(stage)
        };
        Ok(task.with_statistics(weights))
    }

    /// Writes the model, what it is worth and what it still gets wrong.
    fn finish(&self, trained: &Trained) -> anyhow::Result<Option<Evaluation>> {
        let full_scale_n = self.settings().full_scale_n;
        self.draw_mistakes(trained)?;
        let (graph, raw_logits) = hrn::graph(&trained.weights, &trained.statistics, full_scale_n);
        let recogniser = Recogniser {
            graph,
            raw_logits,
            temperature: trained.temperature,
        };
        let probabilities = |frames: &[&Frame]| {
            let logits = trained.logits(frames.iter().copied(), full_scale_n, self.device);
            Ok(fit::probabilities(
                &logits,
                trained.temperature,
                self.device,
            ))
        };
        export::finish(
            self.run,
            self.description,
            self.dataset,
            self.train,
            &recogniser,
            probabilities,
        )
    }

    /// Draws labelled samples that are judged wrongly: of held-out objects where there are some,
    /// else of those learnt from.
    fn draw_mistakes(&self, trained: &Trained) -> anyhow::Result<()> {
        let (kind, indices) = if self.validation.is_empty() {
            ("training", self.train)
        } else {
            ("held-out", self.validation)
        };
        let frames = indices
            .iter()
            .map(|&index| &self.dataset.samples[index].frame);
        let logits = trained.logits(frames, self.settings().full_scale_n, self.device);
        let probabilities = fit::probabilities(&logits, trained.temperature, self.device);
        let mut rows: Vec<Strip> = (1..=self.levels)
            .map(|level| Strip {
                name: format!("level {level}"),
                tiles: Vec::new(),
            })
            .collect();
        let mut wrong = 0;
        for (&index, row) in indices.iter().zip(&probabilities) {
            let sample = &self.dataset.samples[index];
            let said = fit::largest(row);
            if said + 1 != usize::from(sample.level) {
                wrong += 1;
                let caption = format!("as {}, {:.0} %", said + 1, row[said] * 100.0);
                rows[usize::from(sample.level) - 1]
                    .tiles
                    .push((&sample.frame, caption));
            }
        }
        let title = format!("{wrong} of {} {kind} samples judged wrongly", indices.len());
        self.run
            .write("samples/mistakes.png", &sheet::strips(&title, &rows)?)
    }
}
/// Logistic regression on features.
fn baseline(
    dataset: &Dataset,
    labelled: &[usize],
    description: &Description,
    run: &Run,
) -> anyhow::Result<Option<Evaluation>> {
    let begun = Instant::now();
    let frames = labelled.iter().map(|&index| &dataset.samples[index].frame);
    let rows = features::features(frames).context("features")?;
    let level_of: Vec<usize> = labelled
        .iter()
        .map(|&index| usize::from(dataset.samples[index].level) - 1)
        .collect();
    let baseline = Baseline::fit(&rows, &level_of, super::dataset::levels().len());
    run.metrics("features", 0)?.add(&Row {
        step: baseline.steps.into(),
        epoch: baseline.steps,
        loss: baseline.loss,
        learning_rate: 1.0,
        accuracy: None,
        validation: None,
        seconds: begun.elapsed().as_secs_f64(),
        adversarial: None,
    })?;
    let (graph, raw_logits) = baseline.graph();
    let recogniser = Recogniser {
        graph,
        raw_logits,
        temperature: 1.0,
    };
    let probabilities = |frames: &[&Frame]| {
        let rows = features::features(frames.iter().copied())?;
        Ok(rows.iter().map(|row| baseline.probabilities(row)).collect())
    };
    export::finish(
        run,
        description,
        dataset,
        labelled,
        &recogniser,
        probabilities,
    )
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
        // Ours: 45,000 generated samples 200 times, then 1,500 labelled ones 200 times.
        let long = Method::Hrn15Long.settings(Profile::Paper).training;
        let ours = Method::Ours.settings(Profile::Paper);
        let steps = u64::from(long.epochs) * 15;
        let expected =
            u64::from(ours.pretraining.epochs) * 450 + u64::from(ours.training.epochs) * 15;
        assert_eq!((steps, expected), (93_000, 93_000));
    }

    #[test]
    fn every_methods_settings_are_within_their_ranges() {
        for &method in Method::value_variants() {
            for profile in [Profile::Paper, Profile::Quick, Profile::Smoke] {
                assert!(
                    method.settings(profile).checked().is_ok(),
                    "{}",
                    method.name()
                );
            }
        }
    }
}
