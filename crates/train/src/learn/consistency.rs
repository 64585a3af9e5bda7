//! A training step that also learns from unlabelled samples, without a GAN.
//!
//! In: labelled images, and unlabelled ones in two views. The averaged weights judge the weak view,
//! and the network learns to judge the strong view alike (FixMatch, Sohn et al. 2020; averaged
//! teacher, Tarvainen and Valpola 2017). Out: the loss. The step changes the weights.

use burn::tensor::{Tensor, TensorData, activation};

use crate::learn::learner::Learner;
use crate::net::hrn;
use crate::net::network::{Normalisation, numbers};
use crate::settings::ConsistencySettings;
use hardnessd_core::verdict::argmax;

/// Labelled images with their targets, and two views of the unlabelled ones.
#[derive(Debug)]
pub struct Views {
    /// Labelled images `[batch, 1, 28, 28]`.
    pub labelled: Tensor<4>,
    /// Targets of the labelled images `[batch, L]`.
    pub targets: Tensor<2>,
    /// Unlabelled images `[unlabelled, 1, 28, 28]`, turned and shifted.
    pub weak: Tensor<4>,
    /// The same samples as another sensor would have measured them.
    pub strong: Tensor<4>,
}

/// Takes a step. Returns the loss, and the logits of the labelled images before the step.
///
/// Labelled and unlabelled images pass through the network separately, and each batch is normalised
/// by its own statistics, because the strong views are of other sensors.
pub fn step(
    hrn: &mut Learner,
    views: Views,
    settings: &ConsistencySettings,
    rate: f64,
) -> (f64, Vec<f32>) {
    let weak = hrn::logits(&hrn.evaluated(), views.weak, &mut Normalisation::Batch);
    let pseudo = pseudo_targets(weak, settings.confidence);
    let tracked = hrn.weights.tracked();
    let logits = hrn::logits(&tracked, views.labelled, &mut Normalisation::Batch);
    let judged = numbers(&logits);
    let mut loss = hrn::cross_entropy(logits, views.targets);
    if numbers(&pseudo).contains(&1.0) {
        let strong = hrn::logits(&tracked, views.strong, &mut Normalisation::Batch);
        // Where the teacher is not sure, the target is a row of zeros, which adds nothing to the
        // mean.
        let unlabelled = hrn::cross_entropy(strong, pseudo);
        loss = loss.add(unlabelled.mul_scalar(settings.weight));
    }
    let mut gradients = loss.backward();
    hrn.step(&tracked, &mut gradients, rate);
    (f64::from(numbers(&loss)[0]), judged)
}

/// Targets `[batch, L]` from a teacher's logits `[batch, L]`. A row has a 1 at the most probable level
/// where its probability reaches `confidence`, and only zeros elsewhere.
pub fn pseudo_targets(logits: Tensor<2>, confidence: f64) -> Tensor<2> {
    let (dims, device) = (logits.dims(), logits.device());
    let mut rows = numbers(&activation::softmax(logits, 1));
    for row in rows.chunks_mut(dims[1]) {
        let (level, probability) = argmax(row);
        row.fill(0.0);
        if f64::from(probability) >= confidence {
            row[level] = 1.0;
        }
    }
    Tensor::from_data(TensorData::new(rows, dims), &device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::OptimiserSettings;
    use crate::settings::network::Pooling;
    use burn::tensor::Device;
    use hardnessd_simulator::random::Stream;

    #[test]
    fn only_sure_verdicts_become_targets() {
        let device = Device::flex();
        let mut stream = Stream::new(1, "images");
        let values: Vec<f32> = (0..6 * 784)
            .map(|_| stream.uniform() as f32 - 0.5)
            .collect();
        let images = Tensor::from_data(TensorData::new(values, [6, 1, 28, 28]), &device);
        let teacher = hrn::initial(4, Pooling::Max, 1, &device);
        let logits = hrn::logits(&teacher, images.clone(), &mut Normalisation::Batch);
        let sum = |confidence| {
            numbers(&pseudo_targets(logits.clone(), confidence))
                .iter()
                .sum::<f32>()
        };
        assert_eq!((sum(0.0), sum(1.0)), (6.0, 0.0));

        // If the teacher is sure of no image, the step is the supervised one.
        let views = |confidence| {
            let mut learner = Learner::fresh(
                hrn::initial(4, Pooling::Max, 1, &device),
                OptimiserSettings::default(),
                0.9,
            );
            let settings = ConsistencySettings {
                confidence,
                ..ConsistencySettings::default()
            };
            let views = Views {
                labelled: images.clone(),
                targets: hrn::targets([1, 2, 3, 4, 1, 2].into_iter(), 4, &device),
                weak: images.clone(),
                strong: images.clone(),
            };
            let (loss, _) = step(&mut learner, views, &settings, 0.1);
            (loss, learner.weights.numbers("head.bias"))
        };
        let (supervised, bias) = views(1.0);
        let (with_unlabelled, other) = views(0.0);
        assert!(
            with_unlabelled > supervised + 1.0,
            "{with_unlabelled} {supervised}"
        );
        assert_ne!(bias, other);
    }
}
