//! The network that judges the course of a press: a temporal convolution over hand-made features of
//! each frame and the arm's approach.
//!
//! In: the features of a press's frames, their times and the arm's approach. Out: weights, and the
//! graph of the exported file of format 2. A frame fixes only the ratio of radius and modulus,
//! whereas force against approach fixes both (`docs/method.md`).

use burn::tensor::{Device, Tensor, TensorData, activation};

use crate::net::frames::FEATURES;
use crate::net::graph::Constant;
use crate::net::network::{Weights, dense};
use crate::net::shore;
use crate::net::start::ExportedNetwork;
use hardnessd_core::verdict::COURSE_FRAMES;
use hardnessd_simulator::random::Stream;

pub use graph::graph;

mod graph;

/// The number of frames that a model takes.
pub const FRAMES: usize = COURSE_FRAMES.1;
/// The number of columns beside a frame's features.
pub const MOTION: usize = 7;
/// The number of columns of a moment.
pub const COLUMNS: usize = FEATURES + MOTION;
/// Width of the hidden layers, and of the layer before the outputs.
const HIDDEN: usize = 48;
const LAST: usize = 64;
/// Moments under a kernel, and the distance between them in each convolution.
const KERNEL: usize = 5;
const DILATIONS: [usize; 3] = [1, 2, 4];
/// The number of pools of a press: mean, greatest, and mean weighted by force.
const POOLS: usize = 3;
/// The number of presses that are computed together. Their patches then fit into a core's cache.
const PRESSES_AT_ONCE: usize = 32;

/// The measurements of a press at one moment, beside the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PressMoment {
    /// Seconds since the frame that began the press.
    pub time_s: f32,
    /// Approach of the arm since that frame, in mm. `None` if unknown.
    pub approach_mm: Option<f32>,
    /// Total force of the frame's taxels in contact.
    pub force_n: f32,
}

/// The columns beside the features, a row per moment. `arm_n_per_mm` is 0 if unknown.
///
/// With d the approach and k the arm's stiffness, d - F/k is the indentation of object and cover.
/// By Hertz F = 4/3 E* R^(1/2) (d - F/k)^(3/2), so logarithms turn the power law into a sum.
pub fn motion(moments: &[PressMoment], arm_n_per_mm: f32) -> Vec<[f32; MOTION]> {
    let is_arm_known = if arm_n_per_mm > 0.0 { 1.0 } else { 0.0 };
    let arm = arm_n_per_mm.max(graph::LEAST_ARM);
    let mut before_s = moments.first().map_or(0.0, |moment| moment.time_s);
    let row = |moment: &PressMoment| {
        let known = if moment.approach_mm.is_some() {
            1.0
        } else {
            0.0
        };
        let approach = moment.approach_mm.unwrap_or(0.0);
        let step_s = moment.time_s - before_s;
        before_s = moment.time_s;
        let logarithm = |mm: f32| (mm.clamp(0.0, graph::MOST_MM) + graph::MM).ln();
        let indentation = approach - moment.force_n / arm;
        let both = known * is_arm_known;
        [
            (moment.time_s.clamp(0.0, graph::MOST_S) + graph::TIME_S).ln(),
            (step_s.clamp(0.0, graph::MOST_STEP_S) + graph::STEP_S).ln(),
            known,
            known * logarithm(approach),
            both * logarithm(indentation),
            both * indentation.clamp(0.0, graph::MOST_MM),
            is_arm_known * arm.ln(),
        ]
    };
    moments.iter().map(row).collect()
}

/// The inputs of one press: the standardised columns of its frames, and the frames' forces.
pub type Inputs = (Vec<f32>, Vec<f32>);

/// A batch of presses as the network takes them. `frames` is the number of frames of the longest.
#[derive(Debug, Clone)]
struct Batch {
    /// Standardised columns, 0 where there is no frame: `[batch, frames, COLUMNS]`.
    columns: Tensor<3>,
    /// 1 where there is a frame: `[batch, frames, 1]`.
    mask: Tensor<3>,
    /// Each frame's share of the press's force: `[batch, frames, 1]`.
    weights: Tensor<3>,
}

impl Batch {
    fn new(presses: &[Inputs], device: &Device) -> Self {
        let batch = presses.len();
        let longest = presses.iter().map(|(_, forces)| forces.len()).max();
        let frames = longest.unwrap_or_default();
        let mut columns = vec![0.0; batch * frames * COLUMNS];
        let (mut mask, mut weights) = (vec![0.0; batch * frames], vec![0.0; batch * frames]);
        for (press, (rows, forces)) in presses.iter().enumerate() {
            columns[press * frames * COLUMNS..][..rows.len()].copy_from_slice(rows);
            let sum = forces.iter().sum::<f32>() + graph::TINY_N;
            for (place, &force_n) in forces.iter().enumerate() {
                mask[press * frames + place] = 1.0;
                weights[press * frames + place] = force_n / sum;
            }
        }
        let tensor = |values, dims: [usize; 3]| {
            Tensor::<3>::from_data(TensorData::new(values, dims), device)
        };
        Self {
            columns: tensor(columns, [batch, frames, COLUMNS]),
            mask: tensor(mask, [batch, frames, 1]),
            weights: tensor(weights, [batch, frames, 1]),
        }
    }
}

/// Initial weights for `levels` levels: N(0, 2 / inputs) before a ReLU. The variance is smaller
/// where a residual layer adds and before the outputs, so that outputs begin near 1.
pub fn initial(levels: usize, seed: u64, device: &Device) -> Weights {
    let root = Stream::new(seed, "course weights");
    let mut weights = Weights::default();
    let mut add = |name: &str, dims: &[usize], gain: f64| {
        let (outputs, count) = (dims[dims.len() - 1], dims.iter().product::<usize>());
        let deviation = (gain * outputs as f64 / count as f64).sqrt();
        let mut stream = root.child(weights.entries.len() as u64);
        let values = (0..count).map(|_| (deviation * stream.normal()) as f32);
        weights.add(&format!("{name}.matrix"), dims, values.collect(), device);
        weights.add(
            &format!("{name}.bias"),
            &[outputs],
            vec![0.0; outputs],
            device,
        );
    };
    add("embed", &[COLUMNS, HIDDEN], 2.0);
    for layer in 0..DILATIONS.len() {
        add(
            &format!("conv{}", layer + 1),
            &[KERNEL, HIDDEN, HIDDEN],
            0.25,
        );
    }
    add("joint", &[POOLS * HIDDEN, LAST], 2.0);
    add("head", &[LAST, levels + shore::OUTPUTS], 0.2);
    weights
}

/// The start of further training, from an exported graph's constants. `None` if they are of another
/// network.
pub fn start<'a>(
    constant: impl Fn(&str) -> Option<&'a Constant>,
    levels: usize,
    device: &Device,
) -> Option<ExportedNetwork> {
    let weight = |name: &str| graph::weight(name, &constant);
    ExportedNetwork::of_constants(initial(levels, 0, device), COLUMNS, weight, device)
}

/// Logits and Shore outputs `[presses, L + 3]`. Presses with similar numbers of frames should follow each
/// other: some are computed together, and the frames that a press lacks beside the longest of these cost
/// as much time as its own.
pub fn outputs(weights: &Weights, presses: &[Inputs], device: &Device) -> Tensor<2> {
    let parts = presses.chunks(PRESSES_AT_ONCE);
    let parts = parts.map(|part| of_batch(weights, &Batch::new(part, device)));
    Tensor::cat(parts.collect(), 0)
}

fn of_batch(weights: &Weights, batch: &Batch) -> Tensor<2> {
    let [presses, frames, _] = batch.mask.dims();
    let mask = || batch.mask.clone();
    let rows = presses * frames;
    let flat = batch.columns.clone().reshape([rows, COLUMNS]);
    let x = activation::relu(dense(weights, "embed", flat));
    let mut x = x.reshape([presses, frames, HIDDEN]).mul(mask());
    for (layer, dilation) in (1..).zip(DILATIONS) {
        let name = format!("conv{layer}");
        let zeros = Tensor::<3>::zeros([presses, KERNEL / 2 * dilation, HIDDEN], &x.device());
        let padded = Tensor::cat(vec![zeros.clone(), x.clone(), zeros], 1);
        let shifted = (0..KERNEL).map(|tap| {
            let first = tap * dilation;
            padded
                .clone()
                .slice([0..presses, first..first + frames, 0..HIDDEN])
        });
        let patches = Tensor::cat(shifted.collect(), 2).reshape([rows, KERNEL * HIDDEN]);
        let added = activation::relu(dense(weights, &name, patches));
        x = x.add(added.reshape([presses, frames, HIDDEN])).mul(mask());
    }
    let mean = x.clone().sum_dim(1).div(mask().sum_dim(1));
    let greatest = x.clone().max_dim(1);
    let weighted = x.mul(batch.weights.clone()).sum_dim(1);
    let pooled = Tensor::cat(vec![mean, greatest, weighted], 2).reshape([presses, POOLS * HIDDEN]);
    let joint = activation::relu(dense(weights, "joint", pooled));
    dense(weights, "head", joint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motion_is_0_where_nothing_is_known() {
        let moment = |time_s, approach_mm| PressMoment {
            time_s,
            approach_mm,
            force_n: 5.0,
        };
        let rows = motion(&[moment(0.0, None), moment(0.2, None)], 0.0);
        assert_eq!(rows[1][2..], [0.0; 5]);
        assert_eq!(rows[1][0], 0.25_f32.ln());
        assert_eq!(rows[1][1], 0.21_f32.ln());
        // 4 mm minus the 0.5 mm by which an arm of 10 N/mm gives way under 5 N.
        let rows = motion(&[moment(0.0, Some(0.0)), moment(0.2, Some(4.0))], 10.0);
        assert_eq!(rows[1][3], 4.3_f32.ln());
        assert_eq!(rows[1][4], 3.8_f32.ln());
        assert_eq!(rows[1][5], 3.5);
    }

    #[test]
    fn the_network_begins_with_outputs_of_moderate_size() {
        let device = Device::flex();
        let weights = initial(4, 1, &device);
        let mut stream = Stream::new(2, "columns");
        let press = |frames: usize, stream: &mut Stream| {
            let rows = (0..frames * COLUMNS).map(|_| stream.normal() as f32);
            (rows.collect::<Vec<f32>>(), vec![1.0; frames])
        };
        let presses: Vec<_> = (3..35).map(|frames| press(frames, &mut stream)).collect();
        let outputs = outputs(&weights, &presses, &device);
        let values = crate::net::network::numbers(&outputs);
        let variance = values.iter().map(|x| x * x).sum::<f32>() / values.len() as f32;
        assert!((0.1..10.0).contains(&variance), "{variance}");
    }

    #[test]
    fn what_lies_beyond_the_last_frame_does_not_count() {
        let device = Device::flex();
        let weights = initial(4, 1, &device);
        let rows: Vec<f32> = (0..5 * COLUMNS).map(|k| (k % 7) as f32 - 3.0).collect();
        let other = (vec![2.0; FRAMES * COLUMNS], vec![3.0; FRAMES]);
        let alone = outputs(&weights, &[(rows.clone(), vec![1.0; 5])], &device);
        let beside = outputs(&weights, &[other, (rows, vec![1.0; 5])], &device);
        let alone = crate::net::network::numbers(&alone);
        let beside = crate::net::network::numbers(&beside);
        for (a, b) in alone.iter().zip(&beside[alone.len()..]) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }
}
