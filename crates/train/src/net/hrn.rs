//! The hardness recognition network: the trunk, one linear layer, softmax.
//!
//! In: frames with levels. Out: weights, and the graph of the exported file. 32,196 parameters
//! for four levels.

use burn::tensor::{Device, Tensor, TensorData, activation};

use crate::net::graph::{self, Graph};
use crate::net::image::PixelScale;
use crate::net::layers::STRIDE;
use crate::net::network::{self, FEATURES, LEAKY_SLOPE, Normalisation, Statistics, TRUNK, Weights};
use crate::settings::network::Pooling;
use hardnessd_core::verdict::ROWS;
use hardnessd_simulator::random::Stream;

/// The number of features that a pooling makes.
fn features(pooling: Pooling) -> usize {
    match pooling {
        Pooling::Max => FEATURES,
        Pooling::MaxMean => 2 * FEATURES,
    }
}

/// Initial weights for `levels` levels.
pub fn initial(levels: usize, pooling: Pooling, seed: u64, device: &Device) -> Weights {
    let stream = Stream::new(seed, "hrn weights");
    let mut weights = Weights::default();
    network::add_trunk(&mut weights, &stream, device);
    network::add_head(&mut weights, [features(pooling), levels], &stream, device);
    weights
}

/// HRN before pretraining or fine-tuning: a USTGAN's discriminator with a head for `levels` levels
/// in place of its own head, which separated real from generated frames.
pub fn inherited(
    discriminator: &Weights,
    levels: usize,
    pooling: Pooling,
    seed: u64,
    device: &Device,
) -> Weights {
    let mut weights = without_head(discriminator);
    let stream = Stream::new(seed, "hrn weights");
    network::add_head(&mut weights, [features(pooling), levels], &stream, device);
    weights
}

fn without_head(discriminator: &Weights) -> Weights {
    let mut weights = discriminator.clone();
    let is_kept = |name: &str| !name.starts_with("head.");
    weights.entries.retain(|weight| is_kept(&weight.name));
    weights
}

/// HRN from a discriminator whose first `levels` logits are the levels. Further logits are cut off.
pub fn of_levels(discriminator: &Weights, levels: usize, device: &Device) -> Weights {
    let mut weights = without_head(discriminator);
    let outputs = discriminator.numbers("head.bias").len();
    for (name, dims) in [
        ("head.matrix", vec![FEATURES, levels]),
        ("head.bias", vec![levels]),
    ] {
        let rows = discriminator.numbers(name);
        let rows = rows.chunks(outputs).flat_map(|row| &row[..levels]);
        weights.add(name, &dims, rows.copied().collect(), device);
    }
    weights
}

/// Logits `[batch, L]` of images `[batch, 1, 28, 28]`.
pub fn logits(
    weights: &Weights,
    images: Tensor<4>,
    normalisation: &mut Normalisation,
) -> Tensor<2> {
    let features = network::trunk(weights, images, normalisation);
    network::dense(weights, "head", features)
}

/// Eq. (9): `-1/N sum_n sum_i delta(y_n = i) log P(f(x_n) in class i)`, from logits.
///
/// `targets` is `[batch, L]` with a 1 at each sample's level.
pub fn cross_entropy(logits: Tensor<2>, targets: Tensor<2>) -> Tensor<1> {
    let batch = logits.dims()[0] as f32;
    activation::log_softmax(logits, 1)
        .mul(targets)
        .sum()
        .neg()
        .div_scalar(batch)
}

/// Levels 1..=L as rows with a 1 at the level: `[batch, L]`.
pub fn targets(
    levels_of: impl ExactSizeIterator<Item = u8>,
    levels: usize,
    device: &Device,
) -> Tensor<2> {
    let batch = levels_of.len();
    let mut values = vec![0.0_f32; batch * levels];
    for (row, level) in levels_of.enumerate() {
        values[row * levels + usize::from(level) - 1] = 1.0;
    }
    Tensor::from_data(TensorData::new(values, [batch, levels]), device)
}

/// The graph from newtons to logits, and the logits' name. The inference library fuses batch
/// normalisation with the convolution before it.
pub fn graph(weights: &Weights, statistics: &Statistics, scale: PixelScale) -> (Graph, String) {
    let mut graph = Graph::default();
    // `network::trunk` raises the image by 1, too.
    let mut x = scale.nodes(&mut graph, graph::INPUT);
    let (mut size, mut normalised_index) = (ROWS, 0);
    for layer in &TRUNK {
        let name = layer.name;
        size = layer.geometry(size).small();
        let [kernel, bias] =
            ["kernel", "bias"].map(|part| graph.weight(weights, &format!("{name}.{part}")));
        let (before, after) = (layer.padding.0 as i64, layer.padding.1 as i64);
        let attributes = vec![
            graph::integers("kernel_shape", &[layer.kernel as i64; 2]),
            graph::integers("strides", &[STRIDE as i64; 2]),
            graph::integers("pads", &[before, before, after, after]),
        ];
        let sum = format!("{name}.sum");
        x = graph.with("Conv", &[&x, &kernel, &bias], &sum, attributes);
        if layer.normalised {
            let (mean, variance) = statistics.layer(normalised_index);
            normalised_index += 1;
            let [mean, variance] =
                [("mean", mean), ("variance", variance)].map(|(part, values)| {
                    let values = network::numbers(&values);
                    graph.constant(&format!("{name}.{part}"), &[layer.outputs], &values)
                });
            let [gamma, beta] =
                ["gamma", "beta"].map(|part| graph.weight(weights, &format!("{name}.{part}")));
            x = graph.with(
                "BatchNormalization",
                &[&x, &gamma, &beta, &mean, &variance],
                &format!("{name}.normalised"),
                vec![graph::number("epsilon", network::BATCH_NORM_EPSILON)],
            );
        }
        let slope = vec![graph::number("alpha", LEAKY_SLOPE)];
        x = graph.with("LeakyRelu", &[&x], &format!("{name}.out"), slope);
    }
    // A pool of the images' size and a matrix product give the same as ONNX's global pools, for which
    // the inference library takes many times as long.
    let kernel = vec![graph::integers("kernel_shape", &[size as i64; 2])];
    let greatest = graph.with("MaxPool", &[&x], "greatest", kernel);
    let mut features = graph.reshaped(&greatest, &[1, FEATURES], "greatest in a row");
    if network::takes_means(weights) {
        let places = size * size;
        let channels = graph.reshaped(&x, &[FEATURES, places], "channels");
        let share = vec![1.0 / places as f32; places];
        let share = graph.constant("share of a place", &[places, 1], &share);
        let means = graph.node("MatMul", &[&channels, &share], "means");
        let means = graph.reshaped(&means, &[1, FEATURES], "means in a row");
        features = graph.joined(&[&features, &means], "pooled");
    }
    let raw = graph.dense(weights, "head", &features);
    (graph, raw)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::resampled;
    use hardnessd_simulator::{self, DatasetSettings};

    #[test]
    fn the_network_has_the_papers_number_of_parameters() {
        let weights = initial(4, Pooling::Max, 1, &Device::flex());
        let sizes = weights.entries.iter().map(|weight| weight.dims.iter());
        assert_eq!(sizes.map(Iterator::product::<usize>).sum::<usize>(), 32_196);
    }

    #[test]
    fn the_layers_begin_with_unit_variance() {
        // Pressed taxels are a small part of the full scale and most taxels are 0, so the sums
        // before a normalised layer are tiny at the start. After normalisation they must not be
        // tiny.
        let samples = hardnessd_simulator::dataset(
            &DatasetSettings {
                objects: 1,
                test_objects: 0,
                presses: 12,
                ..DatasetSettings::default()
            },
            1,
            |_| (),
        );
        let frames: Vec<_> = samples
            .iter()
            .map(|sample| resampled(&sample.frame))
            .collect();
        let device = Device::flex();
        let weights = initial(4, Pooling::Max, 1, &device);
        for log_above_n in [0.0, 0.1] {
            let scale = PixelScale {
                full_scale_n: 10.2,
                log_above_n,
            };
            let images = scale.images(frames.iter(), &device);
            let mut statistics = Statistics::default();
            logits(
                &weights,
                images,
                &mut Normalisation::Collect(&mut statistics),
            );
            for layer in 0..2 {
                let (_, variance) = statistics.layer(layer);
                let variances = network::numbers(&variance);
                let normalised = variances
                    .iter()
                    .map(|v| v / (v + network::BATCH_NORM_EPSILON));
                let mean = normalised.sum::<f32>() / variances.len() as f32;
                assert!(mean > 0.9, "layer {layer}: {mean} of {variances:?}");
            }
        }
    }
}
