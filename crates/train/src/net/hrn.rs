//! The hardness recognition network: the trunk, one linear layer, softmax.
//!
//! In: frames with levels. Out: weights, and the graph of the exported file. 32,196 parameters
//! for four levels.

use burn::tensor::{Device, Tensor, activation};

use crate::net::graph::{Graph, Inputs, RAW};
use crate::net::image::PixelScale;
use crate::net::layers::STRIDE;
use crate::net::network::{
    self, BATCH_NORM_EPSILON, FEATURES, LEAKY_SLOPE, Normalisation, Statistics, TRUNK, Weights,
};
use hardnessd_simulator::random::Stream;

/// Initial weights for `levels` levels: with the trunk of a USTGAN's discriminator, or else one of random weights.
/// The last layer is always new, because the discriminator's separated real from generated frames.
pub fn initial(
    discriminator: Option<&Weights>,
    levels: usize,
    mean_pooling: bool,
    seed: u64,
    device: &Device,
) -> Weights {
    let stream = Stream::new(seed, "hrn weights");
    let mut weights = discriminator.map_or_else(|| Weights::new(device), without_head);
    if discriminator.is_none() {
        network::add_trunk(&mut weights, &stream);
    }
    let features = if mean_pooling { 2 * FEATURES } else { FEATURES };
    network::add_head(&mut weights, [features, levels], &stream);
    weights
}

fn without_head(discriminator: &Weights) -> Weights {
    let mut weights = discriminator.clone();
    let is_kept = |name: &str| !name.starts_with("head.");
    weights.entries.retain(|weight| is_kept(&weight.name));
    weights
}

/// HRN from a discriminator whose first `levels` logits are the levels. Further logits are cut off.
pub fn of_levels(discriminator: &Weights, levels: usize) -> Weights {
    let mut weights = without_head(discriminator);
    let outputs = discriminator.numbers("head.bias").len();
    for (name, dims) in [
        ("head.matrix", vec![FEATURES, levels]),
        ("head.bias", vec![levels]),
    ] {
        let rows = discriminator.numbers(name);
        let rows = rows.chunks(outputs).flat_map(|row| &row[..levels]);
        weights.add(name, &dims, rows.copied().collect());
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
    let of_levels = activation::log_softmax(logits, 1).mul(targets);
    of_levels.sum().neg().div_scalar(batch)
}

/// The graph from newtons to logits. The inference library fuses batch normalisation with the convolution
/// before it.
pub fn graph(weights: &Weights, statistics: &Statistics, scale: PixelScale) -> Graph {
    let mut graph = Graph::of(weights, Inputs::Frame);
    // `network::trunk` raises the image by 1, too.
    graph.add(&scale.formula());
    let (mut x, mut size) = ("image".to_owned(), 0);
    for layer in TRUNK {
        let (name, (before, after)) = (layer.name, layer.padding);
        let geometry = format!("strides={STRIDE}x{STRIDE}, pads={before}x{before}x{after}x{after}");
        x = format!("Conv({x}, {name}.kernel, {name}.bias, {geometry})");
        if layer.normalised {
            for (part, values) in ["mean", "variance"].into_iter().zip(statistics.layer(name)) {
                let values = network::numbers(&values);
                graph.constant(&format!("{name}.{part}"), &[layer.outputs], &values);
            }
            let parts = ["gamma", "beta", "mean", "variance"].map(|part| format!("{name}.{part}"));
            let parts = parts.join(", ");
            x = format!("BatchNormalization({x}, {parts}, epsilon={BATCH_NORM_EPSILON})");
        }
        x = format!("LeakyRelu({x}, alpha={LEAKY_SLOPE})");
        size = layer.small();
    }
    graph.add(&format!("last = {x}"));
    // A pool of the images' size and a matrix product give the same as ONNX's global pools, for which
    // the inference library takes many times as long.
    let mut features =
        format!("Reshape(MaxPool(last, kernel_shape={size}x{size}), [1x{FEATURES}])");
    if network::takes_means(weights) {
        let places = size * size;
        graph.constant("share", &[places, 1], &vec![1.0 / places as f32; places]);
        let means = format!("MatMul(Reshape(last, [{FEATURES}x{places}]), share)");
        features = format!("Concat({features}, Reshape({means}, [1x{FEATURES}]), axis=1)");
    }
    graph.add(&format!("{RAW} = Dense({features}, head)"));
    graph
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::resampled;
    use hardnessd_simulator::{self, DatasetSettings};

    #[test]
    fn the_network_has_the_papers_number_of_parameters() {
        let weights = initial(None, 4, false, 1, &Device::flex());
        let sizes = weights.entries.iter().map(|weight| weight.dims.iter());
        assert_eq!(sizes.map(Iterator::product::<usize>).sum::<usize>(), 32_196);
    }

    #[test]
    fn the_layers_begin_with_unit_variance() {
        // Pressed taxels are a small part of the full scale and most taxels are 0, so the sums
        // before a normalised layer are tiny at the start. After normalisation they must not be
        // tiny.
        let settings = DatasetSettings {
            objects: 1,
            test_objects: 0,
            presses: 12,
            ..DatasetSettings::default()
        };
        let objects = hardnessd_simulator::dataset(&settings).into_iter();
        let samples = objects.flat_map(|make| make());
        let frames: Vec<_> = samples.map(|sample| resampled(&sample.frame)).collect();
        let device = Device::flex();
        let weights = initial(None, 4, false, 1, &device);
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
            for layer in ["conv2", "conv3"] {
                let [_, variance] = statistics.layer(layer);
                let variances = network::numbers(&variance);
                let normalised = variances.iter().map(|v| v / (v + BATCH_NORM_EPSILON));
                let mean = normalised.sum::<f32>() / variances.len() as f32;
                assert!(mean > 0.9, "layer {layer}: {mean} of {variances:?}");
            }
        }
    }
}
