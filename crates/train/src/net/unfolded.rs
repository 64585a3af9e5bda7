//! The parts of HRN that its graph does not have, because each batch normalisation is folded into the
//! convolution before it. With them, training can continue from an exported file.
//!
//! In: weights and statistics at export, or this text and the graph's constants at the start of
//! further training. Out: the other one. The kernels are divided by what they were multiplied by,
//! so they are the same up to rounding.

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::net::hrn;
use crate::net::image::Scale;
use crate::net::network::{BATCH_NORM_EPSILON, FEATURES, Statistics, TRUNK, Weights, numbers};
use crate::net::start::Constant;
use crate::settings::network::Pooling;

/// What a file says of its network beside the graph: the metadata `hrn.unfolded`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Unfolded {
    /// The scale of the image.
    pub scale: Scale,
    /// The factor of the forces, which `scale` includes.
    pub force_factor: f32,
    /// The normalised layers, in their order.
    layers: Vec<Layer>,
}

/// A convolution with the batch normalisation after it: a number for each channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Layer {
    bias: Vec<f32>,
    gamma: Vec<f32>,
    beta: Vec<f32>,
    mean: Vec<f32>,
    variance: Vec<f32>,
}

/// An HRN to continue training from.
#[derive(Debug, Clone)]
pub struct Start {
    /// Weights of all layers.
    pub weights: Weights,
    /// Mean and variance of each normalised layer over the samples that it learnt from.
    pub statistics: Statistics,
    /// The pooling before the head.
    pub pooling: Pooling,
    /// The scale of the image.
    pub scale: Scale,
    /// The factor of the forces, which `scale` includes.
    pub force_factor: f32,
    /// The temperature by which the logits are divided.
    pub temperature: f32,
}

impl Layer {
    /// Whether the numbers can be those of a layer of `channels` channels.
    fn is_sound(&self, channels: usize) -> bool {
        let all = [
            &self.bias,
            &self.gamma,
            &self.beta,
            &self.mean,
            &self.variance,
        ];
        all.iter()
            .all(|list| list.len() == channels && list.iter().all(|number| number.is_finite()))
            && self.gamma.iter().all(|&gamma| gamma != 0.0)
            && self.variance.iter().all(|&variance| variance >= 0.0)
    }

    /// A folded kernel `[outputs, inputs, k, k]` as it was before.
    fn unfold(&self, kernel: &mut [f32]) {
        let share = kernel.len() / self.gamma.len();
        let channels = self.gamma.iter().zip(&self.variance);
        for (taps, (gamma, variance)) in kernel.chunks_mut(share).zip(channels) {
            let scale = (variance + BATCH_NORM_EPSILON).sqrt() / gamma;
            taps.iter_mut().for_each(|tap| *tap *= scale);
        }
    }
}

impl Unfolded {
    /// What the graph of this network loses.
    pub fn of(weights: &Weights, statistics: &Statistics, scale: Scale, force_factor: f32) -> Self {
        let normalised = TRUNK.iter().filter(|layer| layer.normalised);
        let layers = normalised.enumerate().map(|(index, layer)| {
            let part = |part: &str| weights.numbers(&format!("{}.{part}", layer.name));
            let (mean, variance) = statistics.layer(index);
            Layer {
                bias: part("bias"),
                gamma: part("gamma"),
                beta: part("beta"),
                mean: numbers(&mean),
                variance: numbers(&variance),
            }
        });
        Self {
            scale,
            force_factor,
            layers: layers.collect(),
        }
    }

    /// The network of `levels` levels, from its graph's constants. `None` if the graph is of
    /// another network, or these numbers cannot be its.
    pub fn start<'a>(
        &self,
        levels: usize,
        constant: impl Fn(&str) -> Option<&'a Constant>,
        device: &Device,
    ) -> Option<Start> {
        let (head, _) = constant("head.matrix")?;
        let pooling = match *head.first()? {
            FEATURES => Pooling::Max,
            features if features == 2 * FEATURES => Pooling::MaxMean,
            _ => return None,
        };
        let Scale {
            full_scale_n,
            log_above_n,
        } = self.scale;
        let is_sound = full_scale_n.is_finite()
            && full_scale_n > 0.0
            && log_above_n.is_finite()
            && log_above_n >= 0.0
            && self.force_factor.is_finite()
            && self.force_factor > 0.0;
        let normalised: Vec<_> = TRUNK.iter().filter(|layer| layer.normalised).collect();
        if !is_sound || normalised.len() != self.layers.len() {
            return None;
        }
        let mut weights = hrn::initial(levels, pooling, 0, device);
        let mut statistics = Vec::new();
        let tensor = |values: &[f32]| {
            Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), device)
        };
        for (layer, own) in normalised.into_iter().zip(&self.layers) {
            if !own.is_sound(layer.outputs) {
                return None;
            }
            for (part, values) in [
                ("bias", &own.bias),
                ("gamma", &own.gamma),
                ("beta", &own.beta),
            ] {
                weights.set(&format!("{}.{part}", layer.name), tensor(values));
            }
            let name = format!("{}.kernel", layer.name);
            let mut kernel = same_shape(&weights, &name, &constant)?;
            own.unfold(&mut kernel);
            weights.set(&name, tensor(&kernel));
            statistics.push((tensor(&own.mean), tensor(&own.variance)));
        }
        for name in ["conv1.kernel", "conv1.bias", "head.matrix", "head.bias"] {
            let values = same_shape(&weights, name, &constant)?;
            weights.set(name, tensor(&values));
        }
        let (_, temperature) = constant("temperature")?;
        Some(Start {
            weights,
            statistics: Statistics::of(statistics),
            pooling,
            scale: self.scale,
            force_factor: self.force_factor,
            temperature: *temperature.first()?,
        })
    }
}

/// The constant `name`, if it has the shape of the weight `name`.
fn same_shape<'a>(
    weights: &Weights,
    name: &str,
    constant: impl Fn(&str) -> Option<&'a Constant>,
) -> Option<Vec<f32>> {
    let (dims, values) = constant(name)?;
    (dims == weights.dims(name)).then(|| values.clone())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::net::network::{self, Normalisation};
    use hardnessd_core::frame::{COLS, Frame};

    #[test]
    fn a_file_gives_the_network_back() {
        let device = Device::flex();
        for (pooling, log_above_n) in [(Pooling::Max, 0.0), (Pooling::MaxMean, 0.1)] {
            let scale = Scale {
                full_scale_n: 10.2,
                log_above_n,
            };
            let frames: Vec<Frame> = (0..6)
                .map(|number| {
                    let mut frame = Frame::default();
                    for row in 8..12 + number {
                        frame.newtons[row * COLS + 10..row * COLS + 16]
                            .fill(0.2 + row as f32 * 0.05);
                    }
                    frame
                })
                .collect();
            let weights = hrn::initial(4, pooling, 9, &device).moved(9, &device);
            let images = scale.images(frames.iter(), &device);
            let mut statistics = Statistics::default();
            let mut collect = Normalisation::Collect(&mut statistics);
            hrn::logits(&weights, images.clone(), &mut collect);
            let logits = |weights: &Weights, statistics: &Statistics| {
                let mut fixed = Normalisation::Fixed(statistics);
                numbers(&hrn::logits(weights, images.clone(), &mut fixed))
            };
            let before = logits(&weights, &statistics);

            let text = serde_json::to_string(&Unfolded::of(&weights, &statistics, scale, 0.5));
            let unfolded: Unfolded = serde_json::from_str(&text.unwrap()).unwrap();
            let mut constants: BTreeMap<String, Constant> = weights
                .entries
                .iter()
                .map(|entry| {
                    (
                        entry.name.clone(),
                        (entry.dims.clone(), numbers(&entry.values)),
                    )
                })
                .collect();
            for (layer, folded) in TRUNK.iter().zip(network::fold(&weights, &statistics)) {
                let name = |part: &str| format!("{}.{part}", layer.name);
                constants.get_mut(&name("kernel")).unwrap().1 = folded.kernel;
                constants.get_mut(&name("bias")).unwrap().1 = folded.bias;
            }
            constants.insert("temperature".to_owned(), (vec![], vec![1.5]));
            let start =
                |unfolded: &Unfolded| unfolded.start(4, |name| constants.get(name), &device);
            let found = start(&unfolded).unwrap();
            assert_eq!((found.pooling, found.scale), (pooling, scale));
            assert_eq!((found.force_factor, found.temperature), (0.5, 1.5));
            let after = logits(&found.weights, &found.statistics);
            for (before, after) in before.iter().zip(&after) {
                assert!((before - after).abs() < 1e-4, "{before} {after}");
            }
            for entry in &weights.entries {
                let given_back = found.weights.numbers(&entry.name);
                for (was, is) in numbers(&entry.values).iter().zip(given_back) {
                    assert!(
                        (was - is).abs() < 1e-5 * was.abs().max(1.0),
                        "{}: {was} {is}",
                        entry.name
                    );
                }
            }

            let damage: [fn(&mut Unfolded); 6] = [
                |unfolded| unfolded.layers[0].gamma[3] = 0.0,
                |unfolded| unfolded.layers[1].variance[0] = -1.0,
                |unfolded| unfolded.layers[1].mean.truncate(5),
                |unfolded| unfolded.layers.truncate(1),
                |unfolded| unfolded.scale.full_scale_n = 0.0,
                |unfolded| unfolded.force_factor = f32::NAN,
            ];
            for damage in damage {
                let mut damaged = unfolded.clone();
                damage(&mut damaged);
                assert!(start(&damaged).is_none());
            }
        }
    }
}
