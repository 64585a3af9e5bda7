//! The network that judges the course of a press beside what its sensor's references say: fully
//! connected layers over hand-made features of the press.
//!
//! In: features of presses and of references. Out: weights, logits of the bins of Shore hardness, and the
//! graph of the exported file of format 3. A frame fixes only the ratio of radius and modulus,
//! whereas force against approach fixes both (`results/method.md`).

use burn::tensor::{Device, Tensor, TensorData, activation};
use tract_onnx::pb;

use crate::net::bins::BINS;
use crate::net::graph::{Graph, Inputs, RAW};
use crate::net::network::{Weights, dense};
use crate::net::standard::{self, Standard};
use hardnessd_core::verdict::features::FEATURES;
use hardnessd_core::verdict::{PIECE, Piece};
use hardnessd_simulator::random::Stream;

/// The most references that a model takes.
pub const REFERENCES: usize = 32;
/// The numbers of a reference's embedding.
pub const EMBEDDING: usize = 64;
/// The numbers that a sensor's references give beside a press: the mean of their embeddings, the mean
/// weighted by how much each resembles the press (attention), whether there are references, and the
/// logarithm of their count.
const BESIDE: usize = 2 * EMBEDDING + 2;
/// Width of the layer between a press and its embedding.
const LAYER: usize = 96;
/// The pieces' millimetres are divided by this, so that their logarithms are near 0.
const MM: f32 = 10.0;
/// The Shore hardness of 0, and of a step of 1.
const MIDDLE: f32 = 55.0;
const UNIT: f32 = 25.0;
/// The divisor of an attention's scores.
const SCORES: f32 = 8.0;
/// The divisor of the logarithm of the count.
const COUNT: f32 = 3.0;
/// Share of the numbers of a layer that a training step leaves out.
const DROPPED: f64 = 0.1;

/// Names of layers with the numbers of their inputs and outputs.
type Shapes<const N: usize> = [(&'static str, [usize; 2]); N];
/// The layers over a reference, and the one that asks the references of a sensor.
const OF_REFERENCES: Shapes<3> = [
    ("reference1", [FEATURES + PIECE, LAYER]),
    ("reference2", [LAYER, EMBEDDING]),
    ("question", [FEATURES, EMBEDDING]),
];
/// The layers over a press and its sensor's references. All but the last have a ReLU and dropout.
const JOINT: Shapes<4> = [
    ("joint1", [FEATURES + BESIDE, 512]),
    ("joint2", [512, 256]),
    ("joint3", [256, 128]),
    ("head", [128, BINS]),
];

/// Initial weights: N(0, 2 / inputs) before a ReLU. The variance is smaller before an attention and
/// before the outputs, so that outputs begin near 1.
pub fn initial(seed: u64, device: &Device) -> Weights {
    let root = Stream::new(seed, "course weights");
    let mut weights = Weights::new(device);
    for (name, [inputs, outputs]) in OF_REFERENCES.into_iter().chain(JOINT) {
        let gain = match name {
            "question" | "head" => 0.2,
            _ => 2.0,
        };
        let deviation = f64::sqrt(gain / inputs as f64);
        let mut stream = root.child(weights.entries.len() as u64);
        let values = (0..inputs * outputs).map(|_| (deviation * stream.normal()) as f32);
        weights.add_dense(name, [inputs, outputs], values.collect());
    }
    weights
}

/// The weights and the scale of the features in an exported file. `None` if the file has another network.
pub fn exported(graph: &pb::GraphProto, device: &Device) -> Option<(Weights, Standard)> {
    let constant = |name: &str, length: usize| {
        let tensor = graph.initializer.iter().find(|one| one.name == name)?;
        let (numbers, rest) = tensor.raw_data.as_chunks();
        let numbers: Vec<f32> = numbers.iter().copied().map(f32::from_le_bytes).collect();
        (numbers.len() == length && rest.is_empty()).then_some(numbers)
    };
    let mut weights = Weights::new(device);
    for weight in initial(0, device).entries {
        let length = weight.dims.iter().product();
        let values = constant(&weight.name, length)?;
        weights.add(&weight.name, &weight.dims, values);
    }
    let standard = Standard {
        mean: constant(standard::MEANS, FEATURES)?,
        deviation: constant(standard::DEVIATIONS, FEATURES)?,
    };
    Some((weights, standard))
}

/// Presses of one sensor, with its references.
#[derive(Debug, Clone, Default)]
pub struct Group {
    /// The standardised features of the presses to judge.
    pub presses: Vec<Vec<f32>>,
    /// The references: a press on each piece.
    pub references: Vec<(Vec<f32>, Piece)>,
}

/// Logits of the bins `[presses, BINS]` of the presses of all groups, one group after the other.
/// With `dropout`, which draws the numbers to leave out, they are those of a training step.
pub fn outputs(weights: &Weights, groups: &[Group], mut dropout: Option<&mut Stream>) -> Tensor<2> {
    let table = |rows: &mut dyn Iterator<Item = &Vec<f32>>| {
        let values: Vec<f32> = rows.flatten().copied().collect();
        let count = values.len() / FEATURES;
        Tensor::<2>::from_data(TensorData::new(values, [count, FEATURES]), &weights.device)
    };
    let beside = groups.iter().map(|group| {
        let presses = table(&mut group.presses.iter());
        let embeddings = (!group.references.is_empty()).then(|| {
            let pieces: Vec<Piece> = group.references.iter().map(|&(_, piece)| piece).collect();
            let references = table(&mut group.references.iter().map(|(inputs, _)| inputs));
            embeddings(weights, references, &pieces)
        });
        let beside = beside(weights, presses.clone(), embeddings);
        Tensor::cat(vec![presses, beside], 1)
    });
    let mut x = Tensor::cat(beside.collect(), 0);
    for (name, _) in JOINT {
        x = dense(weights, name, x);
        if name != "head" {
            x = activation::relu(x);
            if let Some(stream) = dropout.as_deref_mut() {
                x = x.clone().mul(kept(x.dims(), stream, &weights.device));
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

/// What the network takes of a piece.
fn columns(piece: Piece) -> [f32; PIECE] {
    let [flat, width_mm, ball, radius_mm, known, low, high] = Piece::numbers(Some(piece));
    let length = |is: f32, mm: f32| is * (mm.max(0.1) / MM).ln();
    [
        flat,
        length(flat, width_mm),
        ball,
        length(ball, radius_mm),
        known,
        known * (0.5 * (low + high) - MIDDLE) / UNIT,
        known * (high - low) / UNIT,
    ]
}

/// The embeddings `[presses, EMBEDDING]` of presses `[presses, FEATURES]` on these pieces.
fn embeddings(weights: &Weights, features: Tensor<2>, pieces: &[Piece]) -> Tensor<2> {
    let columns: Vec<f32> = pieces.iter().flat_map(|&piece| columns(piece)).collect();
    let columns = TensorData::new(columns, [pieces.len(), PIECE]);
    let columns = Tensor::<2>::from_data(columns, &weights.device);
    let all = Tensor::cat(vec![features, columns], 1);
    let layer = activation::relu(dense(weights, "reference1", all));
    activation::relu(dense(weights, "reference2", layer))
}

/// What the embeddings of one sensor say beside each of its presses: `[presses, BESIDE]`. All
/// 0 without references.
fn beside(weights: &Weights, features: Tensor<2>, embeddings: Option<Tensor<2>>) -> Tensor<2> {
    let presses = features.dims()[0];
    let Some(embeddings) = embeddings else {
        return Tensor::zeros([presses, BESIDE], &weights.device);
    };
    let count = embeddings.dims()[0] as f32;
    let questions = dense(weights, "question", features);
    let scores = questions.matmul(embeddings.clone().transpose());
    let attention = activation::softmax(scores.div_scalar(SCORES), 1);
    let attended = attention.matmul(embeddings.clone());
    let mean = embeddings.mean_dim(0).repeat_dim(0, presses);
    let counts = [1.0, count.ln_1p() / COUNT].repeat(presses);
    let counts = TensorData::new(counts, [presses, 2]);
    let counts = Tensor::<2>::from_data(counts, &weights.device);
    Tensor::cat(vec![mean, attended, counts], 1)
}

/// The formulas of [`columns`] from the input `piece`, of [`embeddings`] as `reference`, and of [`beside`] from the
/// inputs `references` and `given`. What is not given has no weight.
fn reference_formulas() -> String {
    let names = ["flat", "width", "ball", "radius", "known", "low", "high"];
    let slice = |(place, name)| format!("{name} = Slice(piece, [{place}], [{}], [1])\n", place + 1);
    let slices: String = names.into_iter().enumerate().map(slice).collect();
    let length = |is: &str, mm: &str| format!("Mul({is}, Log(Div(Max({mm}, 0.1), {MM})))");
    let (width, radius) = (length("flat", "width"), length("ball", "radius"));
    let middle = format!("Mul(known, Div(Sub(Mul(Add(low, high), 0.5), {MIDDLE}), {UNIT}))");
    let span = format!("Mul(known, Div(Sub(high, low), {UNIT}))");
    format!(
        "{slices}
        columns = Concat(flat, {width}, ball, {radius}, known, {middle}, {span}, axis=1)
        layer = Relu(Dense(Concat(standardised, columns, axis=1), reference1))
        reference = Relu(Dense(layer, reference2))

        all = Reshape(references, [{REFERENCES}x{EMBEDDING}])
        count = MatMul(given, each reference)
        mean = Div(MatMul(given, all), Max(count, 1))
        scores = Div(Gemm(Dense(standardised, question), all, transB=1), {SCORES})
        softmax = Softmax(Add(scores, Mul(Sub(given, 1), 10000)), axis=1)
        attended = MatMul(Mul(softmax, given), all)
        beside = Concat(mean, attended, Min(count, 1), Div(Log(Add(count, 1)), {COUNT}), axis=1)"
    )
}

/// The graph from the inputs of format 3 to the logits of the bins, before temperature. The press's embedding
/// as a reference is in `reference`, if the model takes references.
pub fn graph(weights: &Weights, standard: &Standard, inputs: Inputs) -> Graph {
    let mut graph = Graph::of(weights, inputs);
    standard.add_to(&mut graph, "features");
    if inputs == Inputs::References {
        graph.constant("each reference", &[REFERENCES, 1], &[1.0; REFERENCES]);
        graph.add(&reference_formulas());
    } else {
        // What the network gets without any reference.
        graph.constant("beside", &[1, BESIDE], &[0.0; BESIDE]);
    }
    let x = "Concat(standardised, beside, axis=1)";
    let x = format!("Relu(Dense(Relu(Dense(Relu(Dense({x}, joint1)), joint2)), joint3))");
    graph.add(&format!("{RAW} = Dense({x}, head)"));
    graph
}

#[cfg(test)]
mod tests {
    use std::slice;

    use super::*;
    use crate::net::network::numbers;

    fn press(stream: &mut Stream) -> Vec<f32> {
        (0..FEATURES).map(|_| stream.normal() as f32).collect()
    }

    const BALL: Piece = Piece::Ball { radius_mm: 10.0 };

    #[test]
    fn a_press_depends_on_its_own_features_and_references_alone() {
        let device = Device::flex();
        let weights = initial(1, &device);
        let mut stream = Stream::new(3, "columns");
        let of = |groups: &[Group]| numbers(&outputs(&weights, groups, None));
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
