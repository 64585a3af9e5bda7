//! Hand-made features of frames, as nodes of an exported graph: areas, force, peak, moments and
//! roughness. Training computes them by running those nodes.
//!
//! A verdict needs the features of up to 48 frames, so sums over taxels are matrix products: one
//! pass over the taxels gives all moments.

use tract_onnx::pb;

use crate::frame::{COLS, Frame, ROWS, TAXELS};
use crate::press;
use crate::train::net::builder::Builder;
use crate::train::net::graph::{Graph, Plan, integer, integers};

/// The number of frames that are computed in one pass.
const FRAMES_AT_ONCE: usize = 48;
/// The number of features of a frame.
pub const FEATURES: usize = 13;
/// Thresholds, beside the contact threshold, above which taxels are counted, in newtons.
pub const AREA_THRESHOLDS_N: [f32; 4] = [0.2, 0.5, 1.0, 2.0];
/// Added to keep logarithms and quotients of an empty frame finite: to newtons, to squared taxels,
/// to taxels, and to a divisor.
const LITTLE_N: f32 = 0.05;
const LITTLE_SPREAD: f32 = 0.05;
const LITTLE_AREA: f32 = 0.5;
const TINY: f32 = 1e-4;
/// Index of the feature that is the logarithm of the force.
const FORCE: usize = 5;
/// The number of sums over taxels: of 1, row, column, and their products.
const SUMS: usize = 6;

/// Adds the nodes from `input`, which has `frames` frames, to features of `[frames, 1]` each.
/// Returns the features' names, and the name of the frames' forces `[frames, 1]`.
pub(super) fn nodes(b: &mut Builder, input: &str, frames: usize) -> (Vec<String>, String) {
    let taxels = b.reshaped(input, &[frames, TAXELS], "taxels");
    let of_taxel = |place: usize| {
        let middle = |length: usize| (length as f32 - 1.0) / 2.0;
        let (row, column) = ((place / COLS) as f32, (place % COLS) as f32);
        let (r, c) = (row - middle(ROWS), column - middle(COLS));
        [1.0, r, c, r * r, c * c, r * c]
    };
    let sums: Vec<f32> = (0..TAXELS).flat_map(of_taxel).collect();
    b.0.constant("sums", &[TAXELS, SUMS], &sums);
    b.0.constant("ones", &[TAXELS, 1], &[1.0; TAXELS]);

    let contact = above(b, &taxels, press::Settings::default().contact_threshold_n);
    let pressed = b.node("Mul", &[&taxels, &contact], "pressed");
    let (area, of_contact) = moments(b, &contact, "contact");
    let (force, of_force) = moments(b, &pressed, "pressed");
    let mut columns = vec![b.logarithm_of(&area, 1.0)];
    for threshold_n in AREA_THRESHOLDS_N {
        let mask = above(b, &taxels, threshold_n);
        let count = b.node(
            "MatMul",
            &[&mask, "ones"],
            &format!("area of {threshold_n}"),
        );
        columns.push(b.logarithm_of(&count, 1.0));
    }
    columns.push(b.logarithm_of(&force, LITTLE_N));
    let options = vec![integers("axes", &[1]), integer("keepdims", 1)];
    let peak = b.with("ReduceMax", &[&pressed], "peak", options);
    columns.push(b.logarithm_of(&peak, LITTLE_N));
    let [(force_trace, force_shape), (contact_trace, contact_shape)] = [of_force, of_contact];
    columns.push(b.logarithm_of(&force_trace, LITTLE_SPREAD));
    columns.push(b.logarithm_of(&contact_trace, LITTLE_SPREAD));
    columns.extend([force_shape, contact_shape]);

    let squares = b.node("Mul", &[&pressed, &pressed], "pressed squared");
    let energy = b.node("MatMul", &[&squares, "ones"], "energy");
    let force_squared = b.node("Mul", &[&force, &force], "force squared");
    let effective = b.quotient(&force_squared, &energy, TINY, "effective area");
    columns.push(b.logarithm_of(&effective, LITTLE_AREA));
    let variation = variation(b, &pressed, frames);
    columns.push(b.quotient(&variation, &force, LITTLE_N, "roughness"));
    debug_assert_eq!(columns.len(), FEATURES);
    (columns, force)
}

/// A mask: 1 for taxels of at least `threshold_n`, 0 for the others.
fn above(b: &mut Builder, taxels: &str, threshold_n: f32) -> String {
    let name = format!("at least {threshold_n}");
    let threshold = b.scalar(&name, threshold_n);
    let is = b.node("GreaterOrEqual", &[taxels, &threshold], &format!("{name}?"));
    let to = integer("to", pb::tensor_proto::DataType::Float as i64);
    b.with("Cast", &[&is], &name, vec![to])
}

/// Returns three values of `[frames, 1]` each: the sum of `weights` `[frames, 784]`, the trace of
/// their second central moments, and their anisotropy from 0 (round) to 1 (a line).
fn moments(b: &mut Builder, weights: &str, of: &str) -> (String, (String, String)) {
    let all = b.node("MatMul", &[weights, "sums"], &format!("sums of {of}"));
    let axis = b.0.indices(&format!("sum axis of {of}"), &[1]);
    let [total, r, c, rr, cc, rc] = std::array::from_fn(|place| {
        let [from, to] = [place, place + 1].map(|end| {
            b.0.indices(&format!("{place} to {end} of {of}"), &[end as i64])
        });
        b.node(
            "Slice",
            &[&all, &from, &to, &axis],
            &format!("sum {place} of {of}"),
        )
    });
    let [r, c, rr, cc, rc] = [("r", r), ("c", c), ("rr", rr), ("cc", cc), ("rc", rc)]
        .map(|(name, sum)| b.quotient(&sum, &total, TINY, &format!("mean {name} of {of}")));
    let mut central = |square: &str, left: &str, right: &str, name: &str| {
        let product = b.node("Mul", &[left, right], &format!("{name} of means of {of}"));
        b.node(
            "Sub",
            &[square, &product],
            &format!("central {name} of {of}"),
        )
    };
    let (rr, cc) = (central(&rr, &r, &r, "rr"), central(&cc, &c, &c, "cc"));
    let rc = central(&rc, &r, &c, "rc");
    let trace = b.node("Add", &[&rr, &cc], &format!("trace of {of}"));
    let trace = b.node("Relu", &[&trace], &format!("spread of {of}"));
    // anisotropy = sqrt((rr - cc)^2 + 4 rc^2) / (rr + cc)
    let difference = b.node("Sub", &[&rr, &cc], &format!("rr - cc of {of}"));
    let left = b.node("Mul", &[&difference, &difference], &format!("left of {of}"));
    let twice = b.node("Add", &[&rc, &rc], &format!("2 rc of {of}"));
    let right = b.node("Mul", &[&twice, &twice], &format!("right of {of}"));
    let sum = b.node("Add", &[&left, &right], &format!("discriminant of {of}"));
    let root = b.node("Sqrt", &[&sum], &format!("eccentricity of {of}"));
    let anisotropy = b.quotient(&root, &trace, TINY, &format!("anisotropy of {of}"));
    (total, (trace, anisotropy))
}

/// Sum of the absolute differences of neighbours along rows and columns, `[frames, 1]`.
fn variation(b: &mut Builder, pressed: &str, frames: usize) -> String {
    let image = b.reshaped(pressed, &[frames, ROWS, COLS], "pressed image");
    let pairs = (ROWS - 1) * COLS;
    b.0.constant("ones of pairs", &[pairs, 1], &vec![1.0; pairs]);
    let along = |b: &mut Builder, axis: i64| {
        let name = format!("along {axis}");
        let ends = [
            ("zero", 0),
            ("one", 1),
            ("last", ROWS as i64 - 1),
            ("all", ROWS as i64),
        ];
        let [zero, one, last, all] =
            ends.map(|(end, value)| b.0.indices(&format!("{end} {name}"), &[value]));
        let axis = b.0.indices(&format!("axis {name}"), &[axis]);
        let after = b.node(
            "Slice",
            &[&image, &one, &all, &axis],
            &format!("after {name}"),
        );
        let before = b.node(
            "Slice",
            &[&image, &zero, &last, &axis],
            &format!("before {name}"),
        );
        let difference = b.node("Sub", &[&after, &before], &format!("difference {name}"));
        let size = b.node("Abs", &[&difference], &format!("size {name}"));
        let flat = b.reshaped(&size, &[frames, pairs], &format!("pairs {name}"));
        b.node(
            "MatMul",
            &[&flat, "ones of pairs"],
            &format!("variation {name}"),
        )
    };
    let (down, right) = (along(b, 1), along(b, 2));
    b.node("Add", &[&down, &right], "variation")
}

/// Computes the features of a press's frames.
#[derive(Debug)]
pub struct Features(Plan);

impl Features {
    /// Prepares the graph.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library cannot run the graph.
    pub fn new() -> anyhow::Result<Self> {
        let mut b = Builder(Graph::default());
        let (columns, _) = nodes(&mut b, "frames", FRAMES_AT_ONCE);
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        let features = b.with("Concat", &columns, "features", vec![integer("axis", 1)]);
        let input = ("frames", vec![1, FRAMES_AT_ONCE, ROWS, COLS]);
        let output = (features.as_str(), vec![FRAMES_AT_ONCE, FEATURES]);
        Ok(Self(Plan::over(b.0, &input, &output)?))
    }

    /// The features of `frames`, a row of [`FEATURES`] numbers per frame.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library fails.
    pub fn of(&self, frames: &[Frame]) -> anyhow::Result<Vec<f32>> {
        let mut features = Vec::with_capacity(frames.len() * FEATURES);
        for part in frames.chunks(FRAMES_AT_ONCE) {
            let mut newtons = vec![0.0; FRAMES_AT_ONCE * TAXELS];
            for (frame, place) in part.iter().zip(newtons.chunks_mut(TAXELS)) {
                place.copy_from_slice(&frame.newtons);
            }
            features.extend(&self.0.run_on(&newtons)?[..part.len() * FEATURES]);
        }
        Ok(features)
    }
}

/// Total force of the taxels in contact, from a frame's features.
pub fn force_n(features: &[f32]) -> f32 {
    (features[FORCE].exp() - LITTLE_N).max(0.0)
}
