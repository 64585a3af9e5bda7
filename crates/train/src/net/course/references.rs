//! What a network of courses takes of a sensor's references.
//!
//! In: the features of reference presses, and what is known of each piece. Out: an embedding of each,
//! and from the embeddings of a sensor what they say of one press: their mean, and their mean
//! weighted by how much each resembles the press (attention).

use burn::tensor::{Device, Tensor, TensorData, activation};

use super::Shapes;
use crate::net::network::{Weights, dense};
use hardnessd_core::verdict::features::FEATURES;
use hardnessd_core::verdict::{PIECE, Piece};

/// Width of the layer between a press and its embedding.
const LAYER: usize = 96;
/// The numbers of an embedding.
pub const EMBEDDING: usize = 64;
/// The numbers that a sensor's references give beside a press: two means of embeddings, whether there
/// are references, and the logarithm of their count.
pub(super) const BESIDE: usize = 2 * EMBEDDING + 2;
/// The pieces' millimetres are divided by this, so that their logarithms are near 0.
pub(super) const MM: f32 = 10.0;
/// The Shore hardness of 0, and of a step of 1.
pub(super) const MIDDLE: f32 = 55.0;
pub(super) const UNIT: f32 = 25.0;
/// The divisor of an attention's scores.
pub(super) const SCORES: f32 = 8.0;
/// The divisor of the logarithm of the count.
pub(super) const COUNT: f32 = 3.0;

/// The layers of this part.
pub(super) const LAYERS: Shapes<3> = [
    ("reference1", [FEATURES + PIECE, LAYER]),
    ("reference2", [LAYER, EMBEDDING]),
    ("question", [FEATURES, EMBEDDING]),
];

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
pub(super) fn embeddings(
    weights: &Weights,
    features: Tensor<2>,
    pieces: &[Piece],
    device: &Device,
) -> Tensor<2> {
    let columns: Vec<f32> = pieces.iter().flat_map(|&piece| columns(piece)).collect();
    let columns = Tensor::<2>::from_data(TensorData::new(columns, [pieces.len(), PIECE]), device);
    let all = Tensor::cat(vec![features, columns], 1);
    let layer = activation::relu(dense(weights, "reference1", all));
    activation::relu(dense(weights, "reference2", layer))
}

/// What the embeddings of one sensor say beside each of its presses: `[presses, BESIDE]`. All
/// 0 without references.
pub(super) fn beside(
    weights: &Weights,
    features: Tensor<2>,
    embeddings: Option<Tensor<2>>,
    device: &Device,
) -> Tensor<2> {
    let presses = features.dims()[0];
    let Some(embeddings) = embeddings else {
        return Tensor::zeros([presses, BESIDE], device);
    };
    let count = embeddings.dims()[0] as f32;
    let questions = dense(weights, "question", features);
    let scores = questions.matmul(embeddings.clone().transpose());
    let attention = activation::softmax(scores.div_scalar(SCORES), 1);
    let attended = attention.matmul(embeddings.clone());
    let mean = embeddings.mean_dim(0).repeat_dim(0, presses);
    let counts = [1.0, count.ln_1p() / COUNT].repeat(presses);
    let counts = Tensor::<2>::from_data(TensorData::new(counts, [presses, 2]), device);
    Tensor::cat(vec![mean, attended, counts], 1)
}
