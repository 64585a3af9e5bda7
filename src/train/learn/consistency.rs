//! A training step that also learns from unlabelled samples, without a GAN.
//!
//! In: labelled images, and unlabelled ones in two views. The averaged weights judge the weak view,
//! and the network learns to judge the strong view alike (FixMatch, Sohn et al. 2020; averaged
//! teacher, Tarvainen and Valpola 2017). Out: the loss. The step changes the weights.

use burn::tensor::{Tensor, TensorData, activation};

use crate::train::learn::learner::Learner;
use crate::train::net::hrn;
use crate::train::net::network::{Normalisation, Weights, numbers};
use crate::train::settings::ConsistencySettings;
use crate::verdict::argmax;

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

/// Takes a step. Returns the loss, the logits of the labelled images before the step, and the share
/// of unlabelled samples that the network learnt from.
///
/// Labelled and unlabelled images pass through the network separately, and each batch is normalised
/// by its own statistics, because the strong views are of other sensors.
pub fn step(
    hrn: &mut Learner,
    views: Views,
    settings: &ConsistencySettings,
    rate: f64,
) -> (f64, Vec<f32>, f64) {
    let teacher = hrn.evaluated();
    let (pseudo, share) = pseudo_targets(&teacher, views.weak, settings.confidence);
    let tracked = hrn.weights.tracked();
    let logits = hrn::logits(&tracked, views.labelled, &mut Normalisation::Batch);
    let judged = numbers(&logits);
    let mut loss = hrn::cross_entropy(logits, views.targets);
    if share > 0.0 {
        let strong = hrn::logits(&tracked, views.strong, &mut Normalisation::Batch);
        // Where the teacher is not sure, the target is a row of zeros, which adds nothing to the
        // mean.
        let unlabelled = hrn::cross_entropy(strong, pseudo);
        loss = loss.add(unlabelled.mul_scalar(settings.weight));
    }
    let mut gradients = loss.backward();
    hrn.step(&tracked, &mut gradients, rate);
    (f64::from(numbers(&loss)[0]), judged, share)
}

/// The targets `[batch, L]`, and the share of images with a target. A row has a 1 at the teacher's
/// level where the teacher's probability reaches `confidence`, and only zeros elsewhere.
fn pseudo_targets(teacher: &Weights, images: Tensor<4>, confidence: f64) -> (Tensor<2>, f64) {
    let device = images.device();
    let logits = hrn::logits(teacher, images, &mut Normalisation::Batch);
    let [batch, levels] = logits.dims();
    let probabilities = numbers(&activation::softmax(logits, 1));
    let mut targets = vec![0.0_f32; batch * levels];
    let mut sure = 0;
    for (row, of_image) in probabilities.chunks(levels).enumerate() {
        let (level, probability) = argmax(of_image);
        if f64::from(probability) >= confidence {
            targets[row * levels + level] = 1.0;
            sure += 1;
        }
    }
    let targets = Tensor::from_data(TensorData::new(targets, [batch, levels]), &device);
    (targets, f64::from(sure) / batch as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;
    use crate::train::settings::OptimiserSettings;
    use crate::train::settings::network::Pooling;
    use burn::tensor::Device;

    #[test]
    fn only_sure_verdicts_become_targets() {
        let device = Device::flex();
        let mut stream = Stream::new(1, "images");
        let values: Vec<f32> = (0..6 * 784)
            .map(|_| stream.uniform() as f32 - 0.5)
            .collect();
        let images = Tensor::from_data(TensorData::new(values, [6, 1, 28, 28]), &device);
        let teacher = hrn::initial(4, Pooling::Max, 1, &device);
        let (all, share) = pseudo_targets(&teacher, images.clone(), 0.0);
        assert_eq!((numbers(&all).iter().sum::<f32>(), share), (6.0, 1.0));
        let (none, share) = pseudo_targets(&teacher, images.clone(), 1.0);
        assert_eq!((numbers(&none).iter().sum::<f32>(), share), (0.0, 0.0));

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
            let (loss, ..) = step(&mut learner, views, &settings, 0.1);
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
