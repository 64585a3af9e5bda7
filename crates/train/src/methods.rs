//! The stages that methods consist of: USTGAN, the STGANs and the samples they generate, pretraining, and
//! the last one, which makes the recogniser.

use std::io::Cursor;

use anyhow::{Context as _, anyhow};
use burn::tensor::Device;
use serde_json::json;

use crate::data::presses::{self, Layout, Press, Presses};
use crate::data::split::Parts;
use crate::learn::course::Course;
use crate::learn::gan::{self, Gan};
use crate::learn::hrn::{Frames, Hrn};
use crate::learn::regression::{Regression, Seen};
use crate::learn::{self, Learning};
use crate::net::generator;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::Game;
use crate::net::network::Weights;
use crate::recipe::{Kind, Recipe};
use crate::run::Run;
use crate::run::start::Start;
use crate::settings::{Settings, Training};
use hardnessd_core::npz::Writer;
use hardnessd_simulator::random::Stream;

/// Why there is no model of the taxels.
const NO_GRID: &str = "the data have no whole presses on one array of square taxels: make them with `collect \
                       --sequences`";
/// Generated samples of each level that a run keeps to look at.
const KEPT: usize = 24;

/// What all stages of a run share.
#[derive(Debug, Clone, Copy)]
pub struct Stages<'a> {
    /// The data.
    pub presses: &'a Presses,
    /// Which presses are learnt from, and how.
    pub parts: &'a Parts,
    /// The run's settings.
    pub settings: &'a Settings,
    /// Seed of everything random.
    pub seed: u64,
    /// The model from which a course model starts, in place of random weights.
    pub start: Option<&'a Start>,
    /// The run's directory, to which the stages write.
    pub run: &'a Run,
    /// The device that computes.
    pub device: &'a Device,
}

/// The last stage of a method, before its first step. The stages before it are done here. A resumed run
/// continues each stage from its last checkpoint.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, or a training diverges.
pub fn last_stage<'a>(
    recipe: &Recipe,
    stages: &Stages<'a>,
) -> anyhow::Result<Box<dyn Learning + 'a>> {
    let (presses, parts, device) = (stages.presses, stages.parts, stages.device);
    Ok(match recipe.learning {
        Kind::Sgan => Box::new(stages.semi_supervised("sgan", Game::FakeLevel)),
        Kind::Igan => Box::new(stages.semi_supervised("igan", Game::FeatureMatching)),
        Kind::Features | Kind::Taxels => {
            let seen = match recipe.learning {
                Kind::Taxels => Seen::parts(presses).context(NO_GRID)?,
                _ => Seen::Features,
            };
            Box::new(Regression::new(presses, seen, parts, device))
        }
        Kind::Course => {
            let (settings, seed) = (stages.settings, stages.seed);
            let course = Course::new(presses, parts, settings, seed, stages.start, device);
            Box::new(course.context("levels of the data")?)
        }
        Kind::Hrn => {
            let needs_gan = recipe.from_ustgan || recipe.pretrained;
            let ustgan = needs_gan.then(|| stages.ustgan()).transpose()?;
            let (levels, means) = (stages.levels(), stages.settings.mean_pooling);
            let start = ustgan.as_ref().filter(|_| recipe.from_ustgan);
            let start = start.map(|[_, discriminator]| discriminator);
            let mut weights = hrn::initial(start, levels, means, stages.seed, device);
            if let Some(ustgan) = ustgan.as_ref().filter(|_| recipe.pretrained) {
                weights = stages.pretrained(ustgan, weights)?;
            }
            let stage = if needs_gan { "fine-tuning" } else { "hrn" };
            Box::new(Hrn {
                on: stages.on(stage, stages.settings.training),
                augmentation: stages.settings.augmentation,
                train: parts.train.clone(),
                held_out: &parts.held_out,
                initial: weights,
            })
        }
    })
}

impl<'a> Stages<'a> {
    fn levels(&self) -> usize {
        self.presses.levels().len()
    }

    fn scale(&self) -> PixelScale {
        PixelScale {
            full_scale_n: self.settings.full_scale_n,
            log_above_n: self.settings.log_above_n,
        }
    }

    fn on(&self, stage: &'static str, training: Training) -> Frames<'a> {
        Frames {
            stage,
            presses: self.presses,
            levels: self.levels(),
            scale: self.scale(),
            training,
            seed: self.seed,
            device: self.device,
        }
    }

    /// A GAN whose discriminator also learns the levels and becomes the recogniser.
    fn semi_supervised(&self, stage: &'static str, game: Game) -> Gan<'a> {
        let real = &self.parts.unlabelled;
        Gan {
            on: self.on(stage, self.settings.ustgan),
            game,
            real,
            labelled: &self.parts.train,
            initial: gan::initial(game, self.levels(), self.seed, self.device),
            sensor: gan::sensor(self.presses, real),
        }
    }

    /// Trains USTGAN, the GAN without labels.
    fn ustgan(&self) -> anyhow::Result<[Weights; 2]> {
        let gan = Gan {
            labelled: &[],
            ..self.semi_supervised("ustgan", Game::RealOrFake)
        };
        sides(learn::run(&gan, self.run)?)
    }

    /// Trains HRN on samples that one STGAN of each level generates.
    fn pretrained(&self, ustgan: &[Weights; 2], initial: Weights) -> anyhow::Result<Weights> {
        let generated = self.generated(ustgan)?;
        let hrn = Hrn {
            on: Frames {
                presses: &generated,
                ..self.on("pretraining", self.settings.pretraining)
            },
            augmentation: self.settings.augmentation,
            train: (0..generated.all.len()).collect(),
            held_out: &[],
            initial,
        };
        let weights = learn::run(&hrn, self.run)?;
        Ok(weights.into_iter().next().expect("HRN has one side"))
    }

    /// Trains one STGAN per level and generates equally many samples from each component of each.
    /// The STGANs start from USTGAN's weights with fresh optimisers. The samples are not stored,
    /// because the STGANs' last checkpoints determine them. Some are kept to look at.
    fn generated(&self, ustgan: &[Weights; 2]) -> anyhow::Result<Presses> {
        let (mut all, mut kept) = (Presses::default(), Presses::default());
        for level in 1..=self.levels() as u8 {
            let stage: &str = format!("stgan{level}").leak();
            let of_level = |press: &&usize| self.presses.all[**press].level == level;
            let real: Vec<usize> = self.parts.train.iter().filter(of_level).copied().collect();
            let gan = Gan {
                on: self.on(stage, self.settings.stgan),
                game: Game::RealOrFake,
                real: &real,
                labelled: &[],
                initial: ustgan.clone(),
                sensor: gan::sensor(self.presses, &real),
            };
            let [generator, _] = sides(learn::run(&gan, self.run)?)?;
            let frames = generator::generate(
                &generator,
                (self.scale(), gan.sensor),
                self.settings.generated_a_component as usize,
                (
                    self.seed,
                    &mut Stream::new(self.seed, &format!("{stage} generated")),
                ),
                self.device,
            );
            let press = Press {
                level,
                ..Press::default()
            };
            for frame in &frames[..KEPT.min(frames.len())] {
                kept.push(press.clone(), [(0.0, None, frame.newtons)]);
            }
            for frame in frames {
                all.push(press.clone(), [(0.0, None, frame.newtons)]);
            }
        }
        let meta = json!({ "generator": "STGANs of hrn-train", "levels": self.presses.levels() });
        let npz = Writer::new(Cursor::new(Vec::new()));
        let file = presses::write(npz, &kept, Layout::Frames, &meta)?;
        self.run
            .write("samples/generated.npz", &file.into_inner())?;
        Ok(all)
    }
}

fn sides(weights: Vec<Weights>) -> anyhow::Result<[Weights; 2]> {
    <[Weights; 2]>::try_from(weights).map_err(|_| anyhow!("a GAN has two sides"))
}
