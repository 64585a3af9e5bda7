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
    let mut weights = discriminator.clone();
    weights
        .entries
        .retain(|weight| !weight.name.starts_with("head."));
    let stream = Stream::new(seed, "hrn weights");
    network::add_head(&mut weights, [features(pooling), levels], &stream, device);
    weights
}

/// HRN from a discriminator whose first `levels` logits are the levels. Further logits are cut off.
pub fn of_levels(discriminator: &Weights, levels: usize, device: &Device) -> Weights {
    let mut weights = discriminator.clone();
    weights
        .entries
        .retain(|weight| !weight.name.starts_with("head."));
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
    network::head(weights, network::trunk(weights, images, normalisation))
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

/// The weight of a sample of each level, `[1, L]`: the level's number of samples to the power of
/// `-share`, scaled to 1 on average over the samples. With a share of 1 all levels with samples
/// count the same, with 0 all samples do.
pub fn level_weights(
    levels_of: impl Iterator<Item = u8>,
    levels: usize,
    share: f32,
    device: &Device,
) -> Tensor<2> {
    let mut counts = vec![0.0_f32; levels];
    levels_of.for_each(|level| counts[usize::from(level) - 1] += 1.0);
    let raw: Vec<f32> = counts.iter().map(|n| n.max(1.0).powf(-share)).collect();
    let sum: f32 = raw.iter().zip(&counts).map(|(weight, n)| weight * n).sum();
    let scale = counts.iter().sum::<f32>() / sum;
    let weights = raw.into_iter().map(|weight| weight * scale).collect();
    Tensor::from_data(TensorData::new(weights, [1, levels]), device)
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
    let means = network::takes_means(weights);
    let trunk = (weights, Some(statistics));
    let flat = trunk_nodes(&mut graph, graph::INPUT, trunk, scale, means);
    let features = weights.dims("head.matrix")[0];
    let bias = weights.numbers("head.bias");
    let matrix = weights.numbers("head.matrix");
    let matrix = graph.constant("head.matrix", &[features, bias.len()], &matrix);
    let bias = graph.constant("head.bias", &[bias.len()], &bias);
    let raw_logits = graph.node("Gemm", &[&flat, &matrix, &bias], "raw_logits", Vec::new());
    (graph, raw_logits)
}

/// Adds the nodes from newtons to each channel's greatest value, `[1, 64]`, or with the means after
/// them, `[1, 128]`. Without statistics, no layer is normalised. Returns the name of their output.
pub(super) fn trunk_nodes(
    graph: &mut Graph,
    newtons: &str,
    (weights, statistics): (&Weights, Option<&Statistics>),
    scale: PixelScale,
    with_means: bool,
) -> String {
    // `network::trunk` raises the image by 1, too.
    let mut x = scale.nodes(graph, newtons);
    let mut normalised_index = 0;
    for layer in &TRUNK {
        let name = layer.name;
        let weight = |graph: &mut Graph, part: &str| {
            let name = format!("{name}.{part}");
            graph.constant(&name, weights.dims(&name), &weights.numbers(&name))
        };
        let kernel = weight(graph, "kernel");
        let bias = weight(graph, "bias");
        let (before, after) = (layer.padding.0 as i64, layer.padding.1 as i64);
        let attributes = vec![
            graph::integers("kernel_shape", &[layer.kernel as i64; 2]),
            graph::integers("strides", &[STRIDE as i64; 2]),
            graph::integers("pads", &[before, before, after, after]),
        ];
        let sum = format!("{name}.sum");
        x = graph.node("Conv", &[&x, &kernel, &bias], &sum, attributes);
        if let Some(statistics) = statistics.filter(|_| layer.normalised) {
            let (mean, variance) = statistics.layer(normalised_index);
            normalised_index += 1;
            let [mean, variance] =
                [("mean", mean), ("variance", variance)].map(|(part, values)| {
                    let values = network::numbers(&values);
                    graph.constant(&format!("{name}.{part}"), &[layer.outputs], &values)
                });
            let [gamma, beta] = ["gamma", "beta"].map(|part| weight(graph, part));
            x = graph.node(
                "BatchNormalization",
                &[&x, &gamma, &beta, &mean, &variance],
                &format!("{name}.normalised"),
                vec![graph::number("epsilon", network::BATCH_NORM_EPSILON)],
            );
        }
        let slope = vec![graph::number("alpha", LEAKY_SLOPE)];
        x = graph.node("LeakyRelu", &[&x], &format!("{name}.out"), slope);
    }
    pool_nodes(graph, &x, with_means)
}

/// Adds the nodes from the last layer's images to [`network::pooled`], `[1, 64]` or `[1, 128]`. A
/// pool of the images' size and a matrix product give the same as ONNX's global pools, for which
/// the inference library takes many times as long.
fn pool_nodes(graph: &mut Graph, x: &str, with_means: bool) -> String {
    let size = TRUNK
        .iter()
        .fold(ROWS, |size, layer| layer.geometry(size).small());
    let places = size * size;
    let kernel = vec![graph::integers("kernel_shape", &[size as i64; 2])];
    let greatest = graph.node("MaxPool", &[x], "greatest", kernel);
    let row = graph.indices("a row", &[1, FEATURES as i64]);
    let greatest = graph.node(
        "Reshape",
        &[&greatest, &row],
        "greatest in a row",
        Vec::new(),
    );
    if !with_means {
        return greatest;
    }
    let rows = graph.indices("a row for each channel", &[FEATURES as i64, places as i64]);
    let channels = graph.node("Reshape", &[x, &rows], "channels", Vec::new());
    let share = vec![1.0 / places as f32; places];
    let share = graph.constant("share of a place", &[places, 1], &share);
    let means = graph.node("MatMul", &[&channels, &share], "means", Vec::new());
    let means = graph.node("Reshape", &[&means, &row], "means in a row", Vec::new());
    let along = vec![graph::integer("axis", 1)];
    graph.node("Concat", &[&greatest, &means], "pooled", along)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::resampled;
    use hardnessd_core::verdict::{COLS, ModelFrame};
    use hardnessd_simulator::{self, DatasetSettings};

    fn device() -> Device {
        Device::flex()
    }

    fn scale(full_scale_n: f64) -> PixelScale {
        PixelScale {
            full_scale_n,
            log_above_n: 0.0,
        }
    }

    /// A frame with a Gaussian blob of `width` taxels at (row, column).
    fn blob(row: f32, column: f32, width: f32) -> ModelFrame {
        let mut frame = ModelFrame::default();
        for (index, newtons) in frame.newtons.iter_mut().enumerate() {
            let (r, c) = ((index / COLS) as f32 - row, (index % COLS) as f32 - column);
            *newtons = 2.0 * (-(r * r + c * c) / (2.0 * width * width)).exp();
        }
        frame
    }

    #[test]
    fn the_network_has_the_papers_number_of_parameters() {
        assert_eq!(initial(4, Pooling::Max, 1, &device()).count(), 32_196);
    }

    #[test]
    fn every_parameter_receives_a_gradient() {
        let frames: Vec<ModelFrame> = (0..8).map(|n| blob(9.0 + n as f32, 14.0, 2.0)).collect();
        let weights = initial(4, Pooling::MaxMean, 3, &device()).tracked();
        let x = scale(10.2).images(frames.iter(), &device());
        let y = targets((0..8).map(|n| n % 4 + 1), 4, &device());
        let loss = cross_entropy(logits(&weights, x, &mut Normalisation::Batch), y);
        let gradients = loss.backward();
        for weight in &weights.entries {
            let gradient = weight.values.grad(&gradients).expect(&weight.name);
            let size = network::numbers(&gradient)
                .iter()
                .map(|g| g.abs())
                .fold(0.0, f32::max);
            // Batch normalisation subtracts such a bias again with the mean.
            let cancelled = matches!(weight.name.as_str(), "conv2.bias" | "conv3.bias");
            assert!(
                size.is_finite() && (cancelled || size > 1e-9),
                "{}: {size}",
                weight.name
            );
        }
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let frames: Vec<ModelFrame> = (0..6)
            .map(|n| blob(8.0 + 2.0 * n as f32, 13.0, 2.5))
            .collect();
        let mut weights = initial(4, Pooling::MaxMean, 5, &device());
        let x = scale(2.0).images(frames.iter(), &device());
        let y = targets((0..6).map(|n| n % 4 + 1), 4, &device());
        let loss = |weights: &Weights| {
            let logits = logits(weights, x.clone(), &mut Normalisation::Batch);
            cross_entropy(logits, y.clone())
        };
        let tracked = weights.tracked();
        let gradients = loss(&tracked).backward();
        for (name, place) in [("head.matrix", 7), ("conv3.gamma", 11), ("head.bias", 2)] {
            let index = weights.entries.iter().position(|w| w.name == name).unwrap();
            let gradient = tracked.entries[index].values.grad(&gradients).unwrap();
            let analytic = network::numbers(&gradient)[place];
            let original = weights.numbers(name);
            let mut at = |offset: f32| {
                let mut values = original.clone();
                values[place] += offset;
                let length = values.len();
                weights.entries[index].values =
                    Tensor::from_data(TensorData::new(values, [length]), &device());
                let value = network::numbers(&loss(&weights))[0];
                f64::from(value)
            };
            let step = 0.02;
            let numeric = (at(step) - at(-step)) / f64::from(2.0 * step);
            at(0.0);
            let difference = (numeric - f64::from(analytic)).abs();
            assert!(
                difference < 2e-3 * numeric.abs().max(1e-2),
                "{name}: {analytic} {numeric}"
            );
        }
    }

    #[test]
    fn statistics_of_a_batch_give_its_own_logits() {
        let frames: Vec<ModelFrame> = (0..5).map(|n| blob(9.0 + n as f32, 14.0, 2.0)).collect();
        let weights = initial(4, Pooling::Max, 9, &device());
        let x = scale(10.2).images(frames.iter(), &device());
        let mut statistics = Statistics::default();
        let in_batch = logits(
            &weights,
            x.clone(),
            &mut Normalisation::Collect(&mut statistics),
        );
        let fixed = logits(&weights, x, &mut Normalisation::Fixed(&statistics));
        let (left, right) = (network::numbers(&in_batch), network::numbers(&fixed));
        let largest = largest_difference(&left, &right);
        assert!(largest < 1e-5, "{largest}");
    }

    #[test]
    fn the_graph_computes_what_the_layers_do_and_gives_the_network_back() {
        check_graph(Pooling::Max, scale(10.2));
        let log_above_n = 0.1;
        let scale = PixelScale {
            log_above_n,
            ..scale(10.2)
        };
        check_graph(Pooling::MaxMean, scale);
    }

    fn check_graph(pooling: Pooling, scale: PixelScale) {
        let frames: Vec<ModelFrame> = (0..5).map(|n| blob(9.0 + n as f32, 14.0, 2.0)).collect();
        let weights = initial(4, pooling, 9, &device()).moved(9, &device());
        let x = scale.images(frames.iter(), &device());
        let mut statistics = Statistics::default();
        logits(
            &weights,
            x.clone(),
            &mut Normalisation::Collect(&mut statistics),
        );
        let fixed = logits(&weights, x, &mut Normalisation::Fixed(&statistics));
        let (graph, name) = graph(&weights, &statistics, scale);
        let plan = graph::Plan::new(graph, &name, &[1, 4]).unwrap();
        let computed = frames.iter().flat_map(|frame| plan.run(frame).unwrap());
        let (computed, fixed) = (computed.collect::<Vec<_>>(), network::numbers(&fixed));
        let largest = largest_difference(&computed, &fixed);
        assert!(largest < 1e-4, "{largest}: {computed:?} {fixed:?}");
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
        let weights = initial(4, Pooling::Max, 1, &device());
        for log_above_n in [0.0, 0.1] {
            let scale = PixelScale {
                log_above_n,
                ..scale(10.2)
            };
            let images = scale.images(frames.iter(), &device());
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

    fn largest_difference(left: &[f32], right: &[f32]) -> f32 {
        assert_eq!(left.len(), right.len());
        let differences = left.iter().zip(right).map(|(l, r)| (l - r).abs());
        differences.fold(0.0, f32::max)
    }
}
