//! The network that judges a frame, with Shore hardness: convolutions beside hand-made features.
//!
//! In: an image and the features of the same frame. Out: weights, outputs `[batch, L + 3]`, and the
//! graph of the exported file. Convolutions see the shape of a contact, and the features add up its
//! force and area. There is no batch normalisation, so a file holds the network's own weights, and
//! training can continue from any file.

use burn::tensor::{Device, Tensor, TensorData, activation};

use crate::net::builder::Builder;
use crate::net::frames::{self, FEATURES, Features};
use crate::net::graph::{Graph, INPUT, integer};
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::layers::leaky_relu;
use crate::net::network::{self, LEAKY_SLOPE, TRUNK, Weights, as_images, dense, pooled, sums};
use crate::net::shore;
use crate::net::standard::Standard;
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

/// The scale from newtons to an image. It is logarithmic, so that the light taxels of a contact's
/// edge count as much as the heavy ones.
pub const SCALE: PixelScale = PixelScale {
    full_scale_n: 10.2,
    log_above_n: 0.1,
};
/// The number of pooled values: each channel's greatest value and mean.
const POOLED: usize = 2 * network::FEATURES;
/// Width of the layer before the outputs.
const LAST: usize = 64;

/// Initial weights for `levels` levels: N(0, 2 / inputs) before a ReLU, and a quarter of that
/// variance before the outputs.
pub fn initial(levels: usize, seed: u64, device: &Device) -> Weights {
    let root = Stream::new(seed, "frame weights");
    let mut weights = Weights::default();
    let mut add = |name: &str, kind: &str, dims: &[usize], inputs: usize, gain: f64| {
        let outputs = if kind == "kernel" { dims[0] } else { dims[1] };
        let deviation = (gain / inputs as f64).sqrt();
        let mut stream = root.child(weights.entries.len() as u64);
        let values = (0..dims.iter().product()).map(|_| (deviation * stream.normal()) as f32);
        weights.add(&format!("{name}.{kind}"), dims, values.collect(), device);
        let bias = vec![0.0; outputs];
        weights.add(&format!("{name}.bias"), &[outputs], bias, device);
    };
    for layer in &TRUNK {
        let dims = [layer.outputs, layer.inputs, layer.kernel, layer.kernel];
        add(layer.name, "kernel", &dims, dims[1..].iter().product(), 2.0);
    }
    let joint = POOLED + FEATURES;
    add("joint", "matrix", &[joint, LAST], joint, 2.0);
    add(
        "head",
        "matrix",
        &[LAST, levels + shore::OUTPUTS],
        LAST,
        0.5,
    );
    weights
}

/// A batch of frames as the network takes them.
#[derive(Debug, Clone)]
pub struct Batch {
    /// The images `[batch, 1, 28, 28]`.
    pub images: Tensor<4>,
    /// The standardised features `[batch, FEATURES]`.
    pub features: Tensor<2>,
}

impl Batch {
    /// Prepares frames.
    ///
    /// # Errors
    ///
    /// Returns an error if the features cannot be computed.
    pub fn new(
        frames: &[ModelFrame],
        plan: &Features,
        standard: &Standard,
        device: &Device,
    ) -> anyhow::Result<Self> {
        let rows = plan.of(frames)?;
        let rows = rows.iter().enumerate();
        let rows: Vec<f32> = rows
            .map(|(at, &x)| standard.apply(at % FEATURES, x))
            .collect();
        let rows = TensorData::new(rows, [frames.len(), FEATURES]);
        Ok(Self {
            images: SCALE.images(frames.iter(), device),
            features: Tensor::from_data(rows, device),
        })
    }
}

/// Logits and Shore outputs `[batch, L + 3]`.
pub fn outputs(weights: &Weights, batch: &Batch) -> Tensor<2> {
    let count = batch.images.dims()[0];
    // Raised by 1, the background is 0, like the padding of the convolutions.
    let mut x = batch.images.clone().add_scalar(1.0).permute([1, 2, 3, 0]);
    for layer in &TRUNK {
        x = as_images(leaky_relu(sums(weights, layer, x), LEAKY_SLOPE), count);
    }
    let joint = Tensor::cat(vec![pooled(x, true), batch.features.clone()], 1);
    let joint = activation::relu(dense(weights, "joint", joint));
    dense(weights, "head", joint)
}

/// The graph from newtons to raw logits `[1, levels]` and Shore OO `[1, 3]`, and the names of both.
/// `widths` widen the interval below and above.
pub fn graph(
    weights: &Weights,
    standard: &Standard,
    levels: usize,
    widths: [f32; 2],
) -> (Graph, String, String) {
    let mut b = Builder(Graph::default());
    let pooled = hrn::trunk_nodes(&mut b.0, INPUT, (weights, None), SCALE, true);
    let columns = frames::nodes(&mut b, INPUT, 1);
    let columns = standard.nodes(&mut b, &columns);
    let columns = b.reshaped(&columns, &[1, FEATURES], "columns");
    let along = vec![integer("axis", 1)];
    let joint = b.with("Concat", &[&pooled, &columns], "both", along);
    let joint = b.dense(weights, "joint", [POOLED + FEATURES, LAST], &joint);
    let joint = b.node("Relu", &[&joint], "joint");
    let outputs = b.dense(weights, "head", [LAST, levels + shore::OUTPUTS], &joint);
    let (raw_logits, shore) = shore::nodes(&mut b, &outputs, levels, widths);
    (b.0, raw_logits, shore)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::dataset::laid;
    use crate::net::graph::Plan;
    use crate::net::network::numbers;
    use hardnessd_simulator::{self, DatasetSettings};

    fn frames() -> Vec<ModelFrame> {
        let settings = DatasetSettings {
            objects: 1,
            test_objects: 0,
            presses: 12,
            ..DatasetSettings::default()
        };
        let samples = hardnessd_simulator::dataset(&settings, 1, |_| ());
        samples.iter().map(|sample| laid(&sample.frame)).collect()
    }

    fn prepared(frames: &[ModelFrame], device: &Device) -> (Batch, Standard) {
        let plan = Features::new().unwrap();
        let rows = plan.of(frames).unwrap();
        let standard = Standard::of(FEATURES, rows.chunks(FEATURES));
        (
            Batch::new(frames, &plan, &standard, device).unwrap(),
            standard,
        )
    }

    #[test]
    fn the_layers_begin_with_moderate_sizes() {
        let device = Device::flex();
        let (batch, _) = prepared(&frames(), &device);
        let weights = initial(4, 1, &device);
        let size = |x: &[f32]| x.iter().map(|x| x * x).sum::<f32>() / x.len() as f32;
        let mut x = batch.images.clone().add_scalar(1.0).permute([1, 2, 3, 0]);
        let count = batch.images.dims()[0];
        for layer in &TRUNK {
            x = as_images(leaky_relu(sums(&weights, layer, x), LEAKY_SLOPE), count);
            let of_layer = size(&numbers(&x));
            assert!(
                (0.01..10.0).contains(&of_layer),
                "{}: {of_layer}",
                layer.name
            );
        }
        let of_outputs = size(&numbers(&outputs(&weights, &batch)));
        assert!((0.1..10.0).contains(&of_outputs), "{of_outputs}");
    }

    #[test]
    fn the_graph_computes_what_training_does() {
        let device = Device::flex();
        let frames = frames();
        let (_, standard) = prepared(&frames, &device);
        let weights = initial(4, 2, &device);
        let features = Features::new().unwrap();
        let (graph, raw_logits, _) = graph(&weights, &standard, 4, [0.0; 2]);
        let plan = Plan::new(graph, &raw_logits, &[1, 4]).unwrap();
        let batch = Batch::new(&frames, &features, &standard, &device).unwrap();
        let trained = numbers(&outputs(&weights, &batch));
        for (frame, expected) in frames.iter().zip(trained.chunks(4 + shore::OUTPUTS)) {
            for (found, expected) in plan.run(frame).unwrap().iter().zip(expected) {
                assert!((found - expected).abs() < 1e-4, "{found} {expected}");
            }
        }
    }

    #[test]
    fn every_parameter_receives_a_gradient() {
        let device = Device::flex();
        let (batch, _) = prepared(&frames(), &device);
        let weights = initial(4, 3, &device).tracked();
        let loss = outputs(&weights, &batch).powi_scalar(2).mean();
        let gradients = loss.backward();
        for weight in &weights.entries {
            let gradient = weight.values.grad(&gradients).expect(&weight.name);
            let size = numbers(&gradient)
                .iter()
                .map(|g| g.abs())
                .fold(0.0, f32::max);
            assert!(size.is_finite() && size > 1e-9, "{}: {size}", weight.name);
        }
    }
}
