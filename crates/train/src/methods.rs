//! The stages that methods consist of: USTGAN, the STGANs and the samples they generate, pretraining, and
//! the last one, which makes the recogniser.

use std::io::Cursor;

use anyhow::{Context as _, anyhow};
use serde_json::json;

use crate::data::presses::{self, Layout, Press, Presses};
use crate::data::split::Parts;
use crate::learn::course::Course;
use crate::learn::gan::{self, Gan};
use crate::learn::hrn::Hrn;
use crate::learn::regression::{Regression, Seen};
use crate::learn::{self, Learning, Stage};
use crate::net::generator;
use crate::net::hrn;
use crate::net::losses::Game;
use crate::net::network::Weights;
use crate::recipe::{Kind, Recipe};
use crate::run::Run;
use crate::run::start::Start;
use crate::settings::Training;
use hardnessd_core::npz::Writer;

/// Why there is no model of the taxels.
const NO_GRID: &str = "the data have no whole presses on one array of square taxels: make them with `collect \
                       --sequences`";
/// Generated samples of each level that a run keeps to look at.
const KEPT: usize = 24;

/// What all stages of a run share.
#[derive(Debug, Clone)]
pub struct Stages<'a> {
    /// The last stage, with the name of the method.
    pub stage: Stage<'a>,
    /// The model from which a course model starts, in place of random weights.
    pub start: Option<&'a Start>,
    /// The run's directory, to which the stages write. `None` writes nothing.
    pub run: Option<&'a Run>,
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
    let stage = &stages.stage;
    Ok(match recipe.learning {
        Kind::Sgan => Box::new(stages.semi_supervised("sgan", Game::FakeLevel)),
        Kind::Igan => Box::new(stages.semi_supervised("igan", Game::FeatureMatching)),
        Kind::Features => Box::new(Regression::new(stage.clone(), Seen::Features)),
        Kind::Taxels => {
            let seen = Seen::parts(stage.presses).context(NO_GRID)?;
            Box::new(Regression::new(stage.clone(), seen))
        }
        Kind::Course => {
            let course = Course::new(stages.named("course", stage.training), stages.start);
            Box::new(course.context("levels of the data")?)
        }
        Kind::Hrn => {
            let needs_gan = recipe.from_ustgan || recipe.pretrained;
            let ustgan = needs_gan.then(|| stages.ustgan()).transpose()?;
            let start = ustgan.as_ref().filter(|_| recipe.from_ustgan);
            let start = start.map(|[_, discriminator]| discriminator);
            let means = stage.settings.mean_pooling;
            let mut initial = hrn::initial(start, stage.levels(), means, stage.seed, &stage.device);
            if let Some(ustgan) = ustgan.as_ref().filter(|_| recipe.pretrained) {
                initial = stages.pretrained(ustgan, initial)?;
            }
            let name = if needs_gan { "fine-tuning" } else { "hrn" };
            let stage = stages.named(name, stage.training);
            Box::new(Hrn { stage, initial })
        }
    })
}

impl<'a> Stages<'a> {
    fn named(&self, name: &'static str, training: Training) -> Stage<'a> {
        Stage {
            name,
            training,
            ..self.stage.clone()
        }
    }

    /// A GAN whose discriminator also learns the levels and becomes the recogniser.
    fn semi_supervised(&self, name: &'static str, game: Game) -> Gan<'a> {
        let stage = self.named(name, self.stage.settings.ustgan);
        let initial = gan::initial(game, stage.levels(), stage.seed, &stage.device);
        Gan::new(stage, game, initial)
    }

    /// Trains USTGAN, the GAN without labels.
    fn ustgan(&self) -> anyhow::Result<[Weights; 2]> {
        let mut gan = self.semi_supervised("ustgan", Game::RealOrFake);
        gan.stage.parts.train.clear();
        sides(learn::run(&gan, self.run)?)
    }

    /// Trains HRN on samples that one STGAN of each level generates.
    fn pretrained(&self, ustgan: &[Weights; 2], initial: Weights) -> anyhow::Result<Weights> {
        let generated = self.generated(ustgan)?;
        let stage = Stage {
            presses: &generated,
            parts: Parts::labelled((0..generated.all.len()).collect()),
            ..self.named("pretraining", self.stage.settings.pretraining)
        };
        let hrn = Hrn { stage, initial };
        let weights = learn::run(&hrn, self.run)?;
        Ok(weights.into_iter().next().expect("HRN has one side"))
    }

    /// Trains one STGAN per level and generates equally many samples from each component of each.
    /// The STGANs start from USTGAN's weights with fresh optimisers. The samples are not stored,
    /// because the STGANs' last checkpoints determine them. Some are kept to look at.
    fn generated(&self, ustgan: &[Weights; 2]) -> anyhow::Result<Presses> {
        let Stage { presses, seed, .. } = self.stage;
        let (mut all, mut kept) = (Presses::default(), Presses::default());
        // They are of the levels of the data.
        all.sources.clone_from(&presses.sources);
        for level in 1..=self.stage.levels() as u8 {
            let name: &str = format!("stgan{level}").leak();
            let of_level = |press: &&usize| presses.all[**press].level == level;
            let real = self.stage.parts.train.iter().filter(of_level);
            let parts = Parts {
                unlabelled: real.copied().collect(),
                ..Parts::default()
            };
            let stage = Stage {
                parts,
                ..self.named(name, self.stage.settings.stgan)
            };
            let gan = Gan::new(stage, Game::RealOrFake, ustgan.clone());
            let [generator, _] = sides(learn::run(&gan, self.run)?)?;
            let mut stream = gan.stage.stream("generated");
            let frames = generator::generate(
                &generator,
                (gan.stage.scale(), gan.sensor),
                self.stage.settings.generated_a_component as usize,
                (seed, &mut stream),
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
        let meta = json!({ "generator": "STGANs of hrn-train", "levels": presses.levels() });
        let npz = Writer::new(Cursor::new(Vec::new()));
        let file = presses::write(npz, &kept, Layout::Frames, &meta)?;
        if let Some(run) = self.run {
            run.write("samples/generated.npz", &file.into_inner())?;
        }
        Ok(all)
    }
}

fn sides(weights: Vec<Weights>) -> anyhow::Result<[Weights; 2]> {
    <[Weights; 2]>::try_from(weights).map_err(|_| anyhow!("a GAN has two sides"))
}
