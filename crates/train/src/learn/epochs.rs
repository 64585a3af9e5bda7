//! The epochs of a recogniser: the order of the samples, the rate of each step, validation, checks,
//! metrics and checkpoints. An interrupted run resumes from its checkpoint with bit-identical
//! results.

use std::time::Instant;

use burn::tensor::Device;

use crate::learn::learner::Learner;
use crate::net::network::Weights;
use crate::run::Run;
use crate::run::checkpoint::{BEST, Checkpoint, Progress};
use crate::run::history::Row;
use crate::run::progress::{ensure_finite, ensure_finite_weights, progress_bar, report};
use crate::settings::{Keep, Training, Validation};
use hardnessd_simulator::random::Stream;

/// The description of a training stage.
#[derive(Debug)]
pub struct Stage<'a> {
    /// The name of the stage in its checkpoints and in `metrics.csv`.
    pub name: &'static str,
    /// A hash of everything that determines the weights. A checkpoint of another origin is refused,
    /// except where the samples are generated.
    pub origin: String,
    /// Whether a GAN generated the samples. They may then differ in their last bits on another
    /// device or with more threads, and the run continues from its weights all the same.
    pub generated: bool,
    /// Samples to learn from.
    pub train: &'a [usize],
    /// Settings of the training.
    pub settings: &'a Training,
    /// Seed of the order of the samples.
    pub seed: u64,
}

/// One step's batch.
#[derive(Debug, Clone, Copy)]
pub struct Batch<'a> {
    /// The samples of the batch.
    pub samples: &'a [usize],
    /// The number of the step, from 0.
    pub step: u64,
    /// Learning rate.
    pub rate: f64,
}

/// How weights are judged on held-out samples: their loss and accuracy.
pub type Judge<'a> = &'a dyn Fn(&Weights) -> (f64, f64);

/// Trains `initial`, or continues from the stage's last checkpoint in `run`. `step` takes a step
/// and returns the batch's mean loss and how many of its samples were judged correctly before the
/// step. Returns the last weights, or those that `validation` found best.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another origin, the
/// loss or a weight is no longer finite, or `step` fails.
pub fn run(
    stage: &Stage,
    initial: Weights,
    run: &Run,
    device: &Device,
    validation: Option<(Validation, Judge)>,
    mut step: impl FnMut(&mut Learner, Batch) -> anyhow::Result<(f64, f64)>,
) -> anyhow::Result<Weights> {
    let Training {
        batch,
        epochs,
        optimiser,
        averaging,
        checkpoint_every_epochs,
        ..
    } = *stage.settings;
    let (name, origin) = (stage.name, &stage.origin);
    let fresh = Learner::fresh(initial, optimiser, averaging);
    let kept = run.latest(name, origin, epochs, &fresh.lists(""), device)?;
    let (mut progress, mut learner, mut best) = match kept {
        Some(checkpoint) => {
            if !stage.generated {
                run.check_origin(name, &checkpoint, origin)?;
            }
            let steps = checkpoint.progress.step;
            let learner = Learner::resumed(&checkpoint, "", steps, optimiser, averaging)?;
            let best = checkpoint.list(BEST).ok().cloned();
            (checkpoint.progress, learner, best)
        }
        None => (Progress::default(), fresh, None),
    };
    let count = stage.train.len();
    let steps = u64::from(epochs) * count.div_ceil(batch) as u64;
    let mut metrics = run.metrics.open(name, progress.step)?;
    let bar = progress_bar(name, steps, progress.step);
    let begun = Instant::now();
    while progress.epoch < epochs {
        let mut order = stage.train.to_vec();
        let stream = Stream::new(stage.seed, &format!("{name} order"));
        { stream.child(progress.epoch.into()) }.shuffle(&mut order);
        let (mut loss_sum, mut right, mut rate) = (0.0, 0.0, 0.0);
        for samples in order.chunks(batch) {
            rate = optimiser.rate_at(progress.step, steps);
            let batch = Batch {
                samples,
                step: progress.step,
                rate,
            };
            let (loss, of_batch) = step(&mut learner, batch)?;
            loss_sum += loss * samples.len() as f64;
            right += of_batch;
            progress.step += 1;
            bar.inc(1);
        }
        progress.epoch += 1;
        let Progress { epoch, step, .. } = progress;
        let due = |every: u32| epoch == epochs || epoch.is_multiple_of(every);
        let loss = loss_sum / count as f64;
        ensure_finite(name, epoch, "loss", loss)?;
        ensure_finite_weights(name, epoch, &learner.weights)?;
        let accuracy = right / count as f64;
        let mut message = format!("loss {loss:.4}, accuracy {:.1} %", 100.0 * accuracy);
        let mut judged = None;
        if let Some((settings, judge)) = validation
            && due(settings.every_epochs)
        {
            let weights = learner.evaluated();
            let (loss, accuracy) = judge(&weights);
            ensure_finite(name, epoch, "validation loss", loss)?;
            let better = progress.best_loss.is_none_or(|best| loss < best);
            if settings.keep == Keep::Best && better {
                progress.best_loss = Some(loss);
                best = Some(weights);
            }
            let percent = 100.0 * accuracy;
            message += &format!("; validation loss {loss:.4}, accuracy {percent:.1} %");
            judged = Some((loss, accuracy));
        }
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            accuracy: Some(accuracy),
            validation: judged,
            seconds: begun.elapsed().as_secs_f64(),
            ..Row::default()
        })?;
        report(&bar, name, epoch, epochs, message);
        if due(checkpoint_every_epochs) {
            let mut lists = learner.lists("");
            lists.extend(best.iter().map(|list| (BEST.to_owned(), list.clone())));
            let checkpoint = Checkpoint {
                origin: origin.clone(),
                progress,
                lists,
            };
            run.checkpoints.save(name, &checkpoint)?;
        }
    }
    bar.finish_and_clear();
    Ok(best.unwrap_or_else(|| learner.evaluated()))
}
