//! The stages that methods consist of: USTGAN, the STGANs and the samples they generate,
//! pretraining, training.
//!
//! In: labelled and unlabelled samples, settings, a seed. Out: weights, and in the run's directory
//! the checkpoints, metrics and pictures of each stage. A resumed run continues each stage from its
//! last checkpoint.

use burn::tensor::Device;

use crate::data::dataset::{Dataset, Sample};
use crate::judge::sheet::{self, Strip};
use crate::learn::fit::{self, Trained};
use crate::learn::gan::{self, Gan};
use crate::learn::temperature;
use crate::model::evaluated::Evaluated;
use crate::model::export::{self, Recogniser};
use crate::net::generator;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::Game;
use crate::net::network::Weights;
use crate::run::{Description, Run};
use crate::settings::{AugmentationSettings, GanSettings, Settings, Training, Validation};
use hardnessd_core::verdict::{ModelFrame, argmax};
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

/// Stage names of the four STGANs, one for each hardness level.
const STGANS: [&str; 4] = ["stgan1", "stgan2", "stgan3", "stgan4"];

fn levels() -> usize {
    crate::data::dataset::levels().len()
}

/// The inputs that all stages of a run share.
#[derive(Debug)]
pub struct Stages<'a> {
    /// The data set that the indices below refer to.
    pub dataset: &'a Dataset,
    /// Labelled samples to learn from. STGANs need samples of every level.
    pub train: &'a [usize],
    /// Labelled samples of held-out objects; may be empty.
    pub validation: &'a [usize],
    /// Training samples whose levels are not used. A GAN needs at least one.
    pub unlabelled: &'a [usize],
    /// The run's settings and seed.
    pub description: &'a Description,
    /// The run's directory, to which the stages write.
    pub run: &'a Run,
    /// The device that computes.
    pub device: &'a Device,
}

impl Stages<'_> {
    fn settings(&self) -> &Settings {
        &self.description.settings
    }

    fn scale(&self) -> PixelScale {
        let settings = self.settings();
        PixelScale {
            full_scale_n: settings.full_scale_n,
            log_above_n: settings.network.log_above_n,
        }
    }

    fn gan_task<'a>(
        &'a self,
        stage: &'static str,
        game: Game,
        settings: &'a GanSettings,
    ) -> gan::Task<'a> {
        gan::Task {
            stage,
            game,
            dataset: self.dataset,
            real: self.unlabelled,
            labelled: &[],
            scale: self.scale(),
            settings,
            seed: self.description.seed,
            device: self.device,
        }
    }

    /// HRN's random initial weights.
    pub fn random(&self) -> Weights {
        let pooling = self.settings().network.pooling;
        hrn::initial(levels(), pooling, self.description.seed, self.device)
    }

    /// HRN's initial weights, taken from USTGAN's discriminator.
    pub fn inherited(&self, ustgan: &Gan) -> Weights {
        let (pooling, seed) = (self.settings().network.pooling, self.description.seed);
        hrn::inherited(&ustgan.discriminator, levels(), pooling, seed, self.device)
    }

    /// Trains USTGAN, the GAN without labels.
    ///
    /// # Errors
    ///
    /// Fails if the run's directory cannot be read or written, or the training diverges.
    pub fn ustgan(&self) -> anyhow::Result<Gan> {
        let game = Game::RealOrFake;
        let task = self.gan_task("ustgan", game, &self.settings().ustgan);
        let initial = gan::initial(game, levels(), self.description.seed, self.device);
        gan::fit(&task, initial, self.run)
    }

    /// Trains one STGAN per level and generates equally many samples from each component of each.
    /// The STGANs start from USTGAN's weights with fresh optimisers. The samples are not stored,
    /// because the STGANs' last checkpoints determine them.
    ///
    /// # Errors
    ///
    /// Fails if the run's directory cannot be read or written, or a training diverges.
    pub fn generated(&self, ustgan: &Gan) -> anyhow::Result<Dataset> {
        let mut samples = Vec::new();
        for (stage, level) in STGANS.into_iter().zip(1..) {
            let real = self.of_level(level);
            let frames = self.generated_of(stage, &real, ustgan)?;
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
        self.draw_generated(&samples)?;
        Ok(Dataset {
            samples,
            sources: Vec::new(),
            paths: Vec::new(),
        })
    }

    /// The training samples of `level`.
    fn of_level(&self, level: u8) -> Vec<usize> {
        let wanted = |index: &usize| self.dataset.samples[*index].level == level;
        self.train.iter().copied().filter(wanted).collect()
    }

    /// Draws real samples of each level above generated ones.
    fn draw_generated(&self, generated: &[Sample]) -> anyhow::Result<()> {
        let mut rows = Vec::new();
        for level in 1..=levels() as u8 {
            let real = self.of_level(level);
            let spread = real.len().div_ceil(sheet::TILES);
            let real = real.iter().step_by(spread);
            let real = real.map(|&index| &self.dataset.samples[index].frame);
            rows.push(Strip::of(&format!("{level} real"), real));
            let frames = generated.iter().filter(|sample| sample.level == level);
            let frames: Vec<&ModelFrame> = frames.map(|sample| &sample.frame).collect();
            for part in frames.chunks(sheet::TILES).take(2) {
                let name = format!("{level} generated");
                rows.push(Strip::of(&name, part.iter().copied()));
            }
        }
        let title = format!("levels, real and generated: {}", sheet::captions());
        let picture = sheet::strips(&title, &rows)?;
        self.run.write("samples/generated.png", &picture)
    }

    /// Trains an STGAN on the samples `real` and returns the frames it generates.
    fn generated_of(
        &self,
        stage: &'static str,
        real: &[usize],
        ustgan: &Gan,
    ) -> anyhow::Result<Vec<ModelFrame>> {
        let settings = self.settings();
        let seed = self.description.seed;
        let task = gan::Task {
            real,
            ..self.gan_task(stage, Game::RealOrFake, &settings.stgan)
        };
        let generator = gan::fit(&task, ustgan.clone(), self.run)?.generator;
        let batch = settings.stgan.samples_a_component;
        let statistics = generator::statistics(&generator, batch, seed, self.device);
        let making = generator::Making {
            weights: &generator,
            statistics: &statistics,
            scale: self.scale(),
            sensor: task.sensor(),
            device: self.device,
        };
        Ok(generator::generate(
            &making,
            settings.generation.samples_a_component as usize,
            &mut Stream::new(seed, &format!("{stage} generated")),
        ))
    }

    /// Trains HRN on generated samples.
    ///
    /// # Errors
    ///
    /// Fails if the run's directory cannot be read or written, or the training diverges.
    pub fn pretrained(&self, generated: &Dataset, initial: Weights) -> anyhow::Result<Weights> {
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
            scale: self.scale(),
            settings: &self.settings().training,
            seed: self.description.seed,
            device: self.device,
        }
    }

    /// Trains HRN on the labelled samples.
    ///
    /// # Errors
    ///
    /// Fails if the run's directory cannot be read or written, or the training diverges.
    pub fn trained(&self, stage: &'static str, initial: Weights) -> anyhow::Result<Trained> {
        fit::fit(&self.fit_task(stage), initial, self.run)
    }

    /// Trains a GAN whose discriminator also learns the levels and becomes the recogniser.
    ///
    /// # Errors
    ///
    /// Fails if the run's directory cannot be read or written, or the training diverges.
    pub fn semi_supervised(&self, stage: &'static str, game: Game) -> anyhow::Result<Trained> {
        let task = gan::Task {
            labelled: self.train,
            ..self.gan_task(stage, game, &self.settings().ustgan)
        };
        let initial = gan::initial(game, levels(), self.description.seed, self.device);
        let gan = gan::fit(&task, initial, self.run)?;
        let weights = hrn::of_levels(&gan.discriminator, levels(), self.device);
        // Compute the layers' statistics over all real frames that the discriminator has seen, in
        // batches of the same size and without augmentation, as in its training.
        let mut real = self.unlabelled.to_vec();
        real.extend(self.train);
        let settings = Training {
            batch: self.settings().ustgan.batch,
            augmentation: AugmentationSettings::default(),
            ..self.settings().training
        };
        let task = fit::Task {
            train: &real,
            settings: &settings,
            ..self.fit_task(stage)
        };
        task.finished(weights, self.settings().ustgan.epochs)
    }

    /// Writes the model, its evaluation and a picture of its mistakes.
    ///
    /// # Errors
    ///
    /// Fails if the daemon's loader refuses the model, or the run's directory cannot be written.
    pub fn finish(&self, trained: &Trained) -> anyhow::Result<Option<Evaluated>> {
        let scale = self.scale();
        let (graph, raw_logits) = hrn::graph(&trained.weights, &trained.statistics, scale);
        let recogniser = Recogniser {
            graph,
            raw_logits,
            shore: None,
            temperature: trained.temperature,
        };
        self.export(&recogniser, |frames| {
            let logits = trained.logits(frames.iter().copied(), scale, self.device);
            Ok(temperature::probabilities(
                &logits,
                trained.temperature,
                self.device,
            ))
        })
    }

    /// Writes a model, its evaluation and a picture of its mistakes. `probabilities` computes those of
    /// frames without the file.
    ///
    /// # Errors
    ///
    /// Fails if the daemon's loader refuses the model, or the run's directory cannot be written.
    pub fn export(
        &self,
        recogniser: &Recogniser,
        probabilities: impl Fn(&[&ModelFrame]) -> anyhow::Result<Vec<Vec<f32>>>,
    ) -> anyhow::Result<Option<Evaluated>> {
        self.draw_mistakes(&probabilities)?;
        export::finish(
            self.run,
            self.description,
            self.dataset,
            self.train,
            recogniser,
            probabilities,
        )
    }

    /// Draws the samples of held-out objects that are judged wrongly, or the training samples if no
    /// objects are held out.
    fn draw_mistakes(
        &self,
        probabilities: impl Fn(&[&ModelFrame]) -> anyhow::Result<Vec<Vec<f32>>>,
    ) -> anyhow::Result<()> {
        let (kind, indices) = if self.validation.is_empty() {
            ("training", self.train)
        } else {
            ("held-out", self.validation)
        };
        let samples = indices.iter().map(|&index| &self.dataset.samples[index]);
        let frames: Vec<&ModelFrame> = samples.clone().map(|sample| &sample.frame).collect();
        let mut rows: Vec<Strip> = (1..=levels())
            .map(|level| Strip {
                name: format!("level {level}"),
                tiles: Vec::new(),
            })
            .collect();
        let mut wrong = 0;
        for (sample, row) in samples.zip(probabilities(&frames)?) {
            let (judged, confidence) = argmax(&row);
            if judged + 1 != usize::from(sample.level) {
                wrong += 1;
                let caption = format!("as {}, {:.0} %", judged + 1, confidence * 100.0);
                rows[usize::from(sample.level) - 1]
                    .tiles
                    .push((&sample.frame, caption));
            }
        }
        let title = format!("{wrong} of {} {kind} samples judged wrongly", indices.len());
        let picture = sheet::strips(&title, &rows)?;
        self.run.write("samples/mistakes.png", &picture)
    }
}
