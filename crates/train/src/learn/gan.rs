//! The training loop of generator and discriminator, shared by USTGAN, the STGANs, SGAN and IGAN.
//!
//! In: real frames, the game (see [`crate::net::losses`]) and the initial weights of both
//! sides. Out: both sides' trained weights. USTGAN and an STGAN differ only in their frames and
//! starting weights. SGAN and IGAN also use labelled frames. The run's directory receives metrics,
//! checkpoints and pictures of frames generated from fixed noise.

use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};

use crate::data::dataset::Dataset;
use crate::learn::learner::Learner;
use crate::net::generator;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::Game;
use crate::net::network::{self, FEATURES, Weights};
use crate::net::sensed::Sensor;
use crate::run::Run;
use crate::run::checkpoint::{BEST, Checkpoint, Origin, Progress};
use crate::run::history::{Adversarial, Row};
use crate::run::progress::{ensure_finite, ensure_finite_weights, progress_bar, report};
use crate::settings::{GanSettings, Keep};
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

mod samples;
mod step;
#[cfg(test)]
mod tests;

pub use step::{Batch, GradientPenalty, Rules, step};

/// The weights of generator and discriminator.
#[derive(Debug, Clone)]
pub struct Gan {
    /// Weights of the generator and its mixture.
    pub generator: Weights,
    /// Weights of trunk and head.
    pub discriminator: Weights,
}

/// Generator and discriminator before training. The game determines the discriminator's head.
pub fn initial(game: Game, levels: usize, seed: u64, device: &Device) -> Gan {
    let stream = Stream::new(seed, "discriminator weights");
    let mut discriminator = Weights::default();
    network::add_trunk(&mut discriminator, &stream, device);
    let dims = [FEATURES, game.outputs(levels)];
    network::add_head(&mut discriminator, dims, &stream, device);
    Gan {
        generator: generator::initial(seed, device),
        discriminator,
    }
}

/// The inputs of a training.
#[derive(Debug)]
pub struct Task<'a> {
    /// The name of the stage in its checkpoints, its pictures and `metrics.csv`.
    pub stage: &'static str,
    /// The classes that the discriminator distinguishes, and the losses.
    pub game: Game,
    /// The data set that the indices below refer to.
    pub dataset: &'a Dataset,
    /// Real samples, used without their levels.
    pub real: &'a [usize],
    /// Samples whose levels the discriminator learns; empty where the game has no levels.
    pub labelled: &'a [usize],
    /// The scale from newtons to images.
    pub scale: PixelScale,
    /// Settings of the training.
    pub settings: &'a GanSettings,
    /// Seed of the noise and of the order of the samples.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// Trains from `initial` with fresh optimisers, or from the stage's last checkpoint in `run`.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another stage than
/// this, or a loss or a weight is no longer finite.
pub fn fit(task: &Task, initial: Gan, run: &Run) -> anyhow::Result<Gan> {
    let GanSettings { batch, epochs, .. } = *task.settings;
    let steps = u64::from(epochs) * task.real.len().div_ceil(batch) as u64;
    let origin = task.origin(&initial);
    let fresh = State::fresh(initial, task.settings, task.sensor());
    let kept = fresh.checkpoint(&origin).lists;
    let mut state = match run.latest(task.stage, &origin, epochs, &kept, task.device)? {
        Some(checkpoint) => {
            run.check_origin(task.stage, &checkpoint, &origin)?;
            State::resumed(&checkpoint, task.settings, task.sensor())?
        }
        None => fresh,
    };
    let mut metrics = run.metrics.open(task.stage, state.progress.step)?;
    let mut reference = None;
    let bar = progress_bar(task.stage, steps, state.progress.step);
    let begun = Instant::now();

    while state.progress.epoch < epochs {
        let (mut discriminator_sum, mut generator_sum, mut rate) = (0.0, 0.0, 0.0);
        let order = task.order("order", task.real, state.progress.epoch.into());
        for indices in order.chunks(batch) {
            rate = task.settings.optimiser.rate_at(state.progress.step, steps);
            let losses = state.step(task, indices, rate);
            discriminator_sum += losses.0 * indices.len() as f64;
            generator_sum += losses.1 * indices.len() as f64;
            bar.inc(1);
        }
        state.progress.epoch += 1;
        let Progress { epoch, step, .. } = state.progress;
        let due = |every: u32| epoch == epochs || epoch.is_multiple_of(every);

        let n = task.real.len() as f64;
        let (loss, generator_loss) = (discriminator_sum / n, generator_sum / n);
        for loss in [loss, generator_loss] {
            ensure_finite(task.stage, epoch, "loss", loss)?;
        }
        for side in [&state.generator, &state.discriminator] {
            ensure_finite_weights(task.stage, epoch, &side.weights)?;
        }
        let generator = state.generator.evaluated();
        let sigma = sigma_range(&generator);
        let mut likeness = None;
        if due(task.settings.picture_every_epochs) {
            if reference.is_none() {
                reference = Some(task.reference()?);
            }
            let real = reference.as_ref().expect("set just now");
            let measured = task.likeness(real, &generator)?;
            state.keep(measured.feature_distance, generator, task.settings.keep);
            likeness = Some(measured);
            task.picture(&state.generator.evaluated(), epoch, run)?;
        }
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            accuracy: None,
            validation: None,
            seconds: begun.elapsed().as_secs_f64(),
            adversarial: Some(Adversarial {
                generator_loss,
                sigma,
                likeness,
            }),
        })?;
        let mut message = format!(
            "losses {loss:.3} {generator_loss:.3}, sigma {:.3}",
            sigma[1]
        );
        if let Some(likeness) = likeness {
            let (distance, std) = (likeness.feature_distance, likeness.pixel_std);
            message += &format!(", distance {distance:.3}, pixel std {std:.3}");
        }
        report(&bar, task.stage, epoch, epochs, message);
        if due(task.settings.checkpoint_every_epochs) {
            run.checkpoints
                .save(task.stage, &state.checkpoint(&origin))?;
        }
    }
    bar.finish_and_clear();
    Ok(state.kept())
}

/// Everything that changes from step to step, and the sensor.
#[derive(Debug)]
struct State {
    progress: Progress,
    sensor: Sensor,
    generator: Learner,
    discriminator: Learner,
    /// With [`Keep::Best`], the weights of the epoch with the least distance so far.
    best: Option<Gan>,
}

/// Prefixes of the generator's and the discriminator's lists in a checkpoint.
const SIDES: [&str; 2] = ["generator ", "discriminator "];

impl State {
    fn fresh(initial: Gan, settings: &GanSettings, sensor: Sensor) -> Self {
        let GanSettings {
            optimiser,
            averaging,
            generator_averaging,
            ..
        } = *settings;
        Self {
            progress: Progress::default(),
            sensor,
            generator: Learner::fresh(initial.generator, optimiser, generator_averaging),
            discriminator: Learner::fresh(initial.discriminator, optimiser, averaging),
            best: None,
        }
    }

    fn resumed(
        checkpoint: &Checkpoint,
        settings: &GanSettings,
        sensor: Sensor,
    ) -> anyhow::Result<Self> {
        let steps = checkpoint.progress.step;
        let resumed = |prefix: &str, averaging| {
            Learner::resumed(checkpoint, prefix, steps, settings.optimiser, averaging)
        };
        let best = |prefix: &str| checkpoint.list(&format!("{prefix}{BEST}")).ok().cloned();
        let best = match (best(SIDES[0]), best(SIDES[1])) {
            (Some(generator), Some(discriminator)) => Some(Gan {
                generator,
                discriminator,
            }),
            _ => None,
        };
        Ok(Self {
            progress: checkpoint.progress,
            sensor,
            generator: resumed(SIDES[0], settings.generator_averaging)?,
            discriminator: resumed(SIDES[1], settings.averaging)?,
            best,
        })
    }

    fn checkpoint(&self, origin: &str) -> Checkpoint {
        let mut lists = self.generator.lists(SIDES[0]);
        lists.extend(self.discriminator.lists(SIDES[1]));
        if let Some(best) = &self.best {
            for (side, weights) in SIDES.iter().zip([&best.generator, &best.discriminator]) {
                lists.push((format!("{side}{BEST}"), weights.clone()));
            }
        }
        Checkpoint {
            origin: origin.to_owned(),
            progress: self.progress,
            lists,
        }
    }

    /// Keeps the present weights, if these are to be kept and no generator was nearer to the real
    /// samples before. `generator` is the evaluated one.
    fn keep(&mut self, distance: f64, generator: Weights, keep: Keep) {
        let nearer = self.progress.best_loss.is_none_or(|best| distance < best);
        if keep == Keep::Best && nearer {
            self.progress.best_loss = Some(distance);
            self.best = Some(Gan {
                generator,
                discriminator: self.discriminator.evaluated(),
            });
        }
    }

    /// The weights to keep: the best ones, if any were chosen, or the last ones.
    fn kept(self) -> Gan {
        self.best.unwrap_or_else(|| Gan {
            generator: self.generator.evaluated(),
            discriminator: self.discriminator.evaluated(),
        })
    }

    /// Takes a step of both sides on the real samples `indices`. Returns the losses of
    /// discriminator and generator.
    fn step(&mut self, task: &Task, indices: &[usize], rate: f64) -> (f64, f64) {
        let number = self.progress.step;
        self.progress.step += 1;
        let batch = task.batch(indices, number);
        let settings = task.settings;
        let rules = Rules {
            game: task.game,
            sigma_penalty: settings.sigma_penalty,
            gradient_penalty: task.gradient_penalty(&batch, number),
            rate,
            sensing: Some((self.sensor, task.scale)),
        };
        let mut stream = task.stream("noise").child(number);
        let eta = generator::noise(settings.samples_a_component, &mut stream, task.device);
        step(
            &mut self.generator,
            &mut self.discriminator,
            &batch,
            eta,
            &rules,
        )
    }
}

/// Least, mean and greatest absolute value of the mixture's deviations, whose sign has no effect.
fn sigma_range(generator: &Weights) -> [f64; 3] {
    let sizes: Vec<f64> = generator
        .numbers("mixture.sigma")
        .iter()
        .map(|sigma| f64::from(sigma.abs()))
        .collect();
    [
        sizes.iter().copied().fold(f64::INFINITY, f64::min),
        sizes.iter().sum::<f64>() / sizes.len() as f64,
        sizes.iter().copied().fold(0.0, f64::max),
    ]
}

impl Task<'_> {
    /// The sensor that measured the real frames.
    pub fn sensor(&self) -> Sensor {
        Sensor::of(&self.frames(self.real))
    }

    fn origin(&self, initial: &Gan) -> String {
        let settings = (self.settings, self.scale);
        Origin::new(self.stage, &settings, self.seed)
            .samples(self.dataset, self.real)
            .samples(self.dataset, self.labelled)
            .weights(&initial.generator)
            .weights(&initial.discriminator)
            .finish()
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// `samples` in the random order of pass `pass`.
    fn order(&self, name: &str, samples: &[usize], pass: u64) -> Vec<usize> {
        let mut order = samples.to_vec();
        self.stream(name).child(pass).shuffle(&mut order);
        order
    }

    /// The gradient penalty of step `step`.
    fn gradient_penalty(&self, batch: &Batch, step: u64) -> Option<GradientPenalty> {
        let gamma = self.settings.gradient_penalty;
        (gamma > 0.0).then(|| {
            let dims = batch.real.dims();
            let mut stream = self.stream("gradient penalty").child(step);
            let normal = (0..dims.iter().product()).map(|_| stream.normal() as f32);
            let directions = TensorData::new(normal.collect::<Vec<_>>(), dims);
            GradientPenalty {
                gamma,
                directions: Tensor::from_data(directions, self.device),
            }
        })
    }

    fn frames(&self, indices: &[usize]) -> Vec<&ModelFrame> {
        let frame = |&index: &usize| &self.dataset.samples[index].frame;
        indices.iter().map(frame).collect()
    }

    /// The images of step `step`. The labelled samples are fewer than the real ones, so they repeat
    /// in passes of their own.
    fn batch(&self, real: &[usize], step: u64) -> Batch {
        let images = |indices: &[usize]| {
            self.scale
                .images(self.frames(indices).into_iter(), self.device)
        };
        let batches = self.labelled.len().div_ceil(self.settings.batch) as u64;
        let labelled = (batches > 0).then(|| {
            let order = self.order("labelled order", self.labelled, step / batches);
            let mut parts = order.chunks(self.settings.batch);
            let indices = parts
                .nth((step % batches) as usize)
                .expect("the step modulo the batches is one of them");
            let levels_of = indices
                .iter()
                .map(|&index| self.dataset.samples[index].level);
            let levels = crate::data::dataset::levels().len();
            (
                images(indices),
                hrn::targets(levels_of, levels, self.device),
            )
        });
        Batch {
            real: images(real),
            labelled,
        }
    }
}
