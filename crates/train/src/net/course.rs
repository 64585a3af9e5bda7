//! The network that judges the course of a press beside what its sensor's references say: fully
//! connected layers over hand-made features of the press.
//!
//! In: features of presses and of references. Out: weights, logits of the bins of Shore hardness, and the
//! graph of the exported file of format 3. A frame fixes only the ratio of radius and modulus,
//! whereas force against approach fixes both (`results/method.md`).

use burn::tensor::{Device, Tensor, TensorData, activation};

use crate::net::bins::BINS;
use crate::net::network::{Weights, dense};
use hardnessd_core::verdict::Piece;
use hardnessd_core::verdict::features::FEATURES;
use hardnessd_simulator::random::Stream;

pub use graph::graph;
pub use references::EMBEDDING;

mod graph;
mod references;

/// The most references that a model takes.
pub const REFERENCES: usize = 32;
/// Share of the numbers of a layer that a training step leaves out.
const DROPPED: f64 = 0.1;

/// Names of layers with the numbers of their inputs and outputs.
type Shapes<const N: usize> = [(&'static str, [usize; 2]); N];
/// The layers over a press and its sensor's references. All but the last have a ReLU and dropout.
const JOINT: Shapes<4> = [
    ("joint1", [FEATURES + references::BESIDE, 512]),
    ("joint2", [512, 256]),
    ("joint3", [256, 128]),
    ("head", [128, BINS]),
];

/// The inputs of one press: its standardised features.
pub type Inputs = Vec<f32>;

/// Initial weights: N(0, 2 / inputs) before a ReLU. The variance is smaller before an attention and
/// before the outputs, so that outputs begin near 1.
pub fn initial(seed: u64, device: &Device) -> Weights {
    let root = Stream::new(seed, "course weights");
    let mut weights = Weights::default();
    for (name, [inputs, outputs]) in references::LAYERS.into_iter().chain(JOINT) {
        let gain = match name {
            "question" | "head" => 0.2,
            _ => 2.0,
        };
        let deviation = f64::sqrt(gain / inputs as f64);
        let mut stream = root.child(weights.entries.len() as u64);
        let values = (0..inputs * outputs).map(|_| (deviation * stream.normal()) as f32);
        let (matrix, bias) = (format!("{name}.matrix"), format!("{name}.bias"));
        weights.add(&matrix, &[inputs, outputs], values.collect(), device);
        weights.add(&bias, &[outputs], vec![0.0; outputs], device);
    }
    weights
}

/// Presses of one sensor, with its references.
#[derive(Debug, Clone, Default)]
pub struct Group {
    /// The presses to judge.
    pub presses: Vec<Inputs>,
    /// The references: a press on each piece.
    pub references: Vec<(Inputs, Piece)>,
}

/// Logits of the bins `[presses, BINS]` of the presses of all groups, one group after the other.
/// With `dropout`, which draws the numbers to leave out, they are those of a training step.
pub fn outputs(
    weights: &Weights,
    groups: &[Group],
    mut dropout: Option<&mut Stream>,
    device: &Device,
) -> Tensor<2> {
    let table = |rows: &mut dyn Iterator<Item = &Inputs>| {
        let values: Vec<f32> = rows.flatten().copied().collect();
        let count = values.len() / FEATURES;
        Tensor::<2>::from_data(TensorData::new(values, [count, FEATURES]), device)
    };
    let beside = groups.iter().map(|group| {
        let presses = table(&mut group.presses.iter());
        let embeddings = (!group.references.is_empty()).then(|| {
            let pieces: Vec<Piece> = group.references.iter().map(|&(_, piece)| piece).collect();
            let references = table(&mut group.references.iter().map(|(inputs, _)| inputs));
            references::embeddings(weights, references, &pieces, device)
        });
        let beside = references::beside(weights, presses.clone(), embeddings, device);
        Tensor::cat(vec![presses, beside], 1)
    });
    let mut x = Tensor::cat(beside.collect(), 0);
    for (name, _) in JOINT {
        x = dense(weights, name, x);
        if name != "head" {
            x = activation::relu(x);
            if let Some(stream) = dropout.as_deref_mut() {
                x = x.clone().mul(kept(x.dims(), stream, device));
            }
        }
    }
    x
}

/// What numbers are multiplied by: 0 for those that are left out, more than 1 for the others.
fn kept(dims: [usize; 2], stream: &mut Stream, device: &Device) -> Tensor<2> {
    let factor = (1.0 / (1.0 - DROPPED)) as f32;
    let kept = (0..dims.iter().product()).map(|_| match stream.uniform() < DROPPED {
        true => 0.0,
        false => factor,
    });
    Tensor::from_data(TensorData::new(kept.collect::<Vec<f32>>(), dims), device)
}

#[cfg(test)]
mod tests {
    use std::slice;

    use super::*;
    use crate::net::network::numbers;

    fn press(stream: &mut Stream) -> Inputs {
        (0..FEATURES).map(|_| stream.normal() as f32).collect()
    }

    const BALL: Piece = Piece::Ball { radius_mm: 10.0 };

    #[test]
    fn the_network_begins_with_outputs_of_moderate_size() {
        let device = Device::flex();
        let weights = initial(1, &device);
        let mut stream = Stream::new(2, "columns");
        let presses: Vec<Inputs> = (0..32).map(|_| press(&mut stream)).collect();
        let references = presses[..4].iter().map(|press| (press.clone(), BALL));
        let group = Group {
            references: references.collect(),
            presses,
        };
        let values = numbers(&outputs(&weights, &[group], None, &device));
        let variance = values.iter().map(|x| x * x).sum::<f32>() / values.len() as f32;
        assert!((0.02..10.0).contains(&variance), "{variance}");
    }

    #[test]
    fn a_press_depends_on_its_own_features_and_references_alone() {
        let device = Device::flex();
        let weights = initial(1, &device);
        let mut stream = Stream::new(3, "columns");
        let of = |groups: &[Group]| numbers(&outputs(&weights, groups, None, &device));
        let alone = Group {
            presses: vec![press(&mut stream)],
            references: Vec::new(),
        };
        let identified = Group {
            references: vec![(press(&mut stream), BALL), (press(&mut stream), BALL)],
            ..alone.clone()
        };
        let others = Group {
            presses: vec![press(&mut stream), press(&mut stream)],
            references: vec![(press(&mut stream), BALL)],
        };
        let (without, with) = (
            of(slice::from_ref(&alone)),
            of(slice::from_ref(&identified)),
        );
        let together = of(&[others, identified, alone]);
        let differs = |a: &[f32], b: &[f32]| {
            let pairs = a.iter().zip(b);
            pairs.fold(0.0_f32, |most, (a, b)| most.max((a - b).abs()))
        };
        assert!(differs(&with, &together[2 * BINS..3 * BINS]) < 1e-5);
        assert!(differs(&without, &together[3 * BINS..]) < 1e-5);
        assert!(differs(&without, &with) > 1e-3);
    }
}
