//! Hand-made features of frames, as nodes of an exported graph: areas, force, peak, moments and
//! roughness. Training computes them by running those nodes.
//!
//! A verdict needs the features of up to 48 frames, so the nodes are those that the daemon's
//! inference library runs fast (`docs/performance.md`): one matrix product gives all moments, sums
//! go over rows and columns at once, and a threshold is a clip, because comparisons go element by
//! element. The features are rows with a number for each frame, so that they lie together.

use crate::net::builder::Builder;
use crate::net::graph::{Graph, Plan, integer, integers};
use hardnessd_core::press;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS, TAXELS};

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
/// The number of features that are logarithms. The last of them comes after the two shapes.
const LOGARITHMS: usize = 10;
/// The number of sums over taxels: of 1, of both factors of three products, and of the products.
const SUMS: usize = 10;
/// The products of places whose means give the second moments: row row, column column, row column.
const PRODUCTS: usize = 3;
/// A power of two above the quotient of 1 and the least step between forces near a threshold. The
/// product with it is exact.
const STEEP: f32 = (1_u128 << 100) as f32;

/// Adds the nodes from `input`, which is `[1, frames, 28, 28]`, to features. Returns the name of
/// the features `[FEATURES, frames]`.
pub(super) fn nodes(b: &mut Builder, input: &str, frames: usize) -> String {
    let of_taxel = |place: usize| {
        let middle = |length: usize| (length as f32 - 1.0) / 2.0;
        let (row, column) = ((place / COLS) as f32, (place % COLS) as f32);
        let (r, c) = (row - middle(ROWS), column - middle(COLS));
        [1.0, r, c, r, r, c, c, r * r, c * c, r * c]
    };
    let sums: Vec<f32> = (0..TAXELS).flat_map(of_taxel).collect();
    b.0.constant("sums", &[TAXELS, SUMS], &sums);
    b.0.indices("taxel axes", &[2, 3]);

    let contact = contact(b, input, press::Thresholds::default().contact_threshold_n);
    let pressed = b.node("Mul", &[input, &contact], "pressed");
    let counts: Vec<String> = AREA_THRESHOLDS_N
        .iter()
        .map(|&threshold_n| count(b, input, threshold_n))
        .collect();
    let [of_force, of_contact] = [(&pressed, "pressed"), (&contact, "contact")]
        .map(|(weights, of)| all_sums(b, weights, of, frames));
    let along = |axis| vec![integer("axis", axis)];
    let all = b.with("Concat", &[&of_force, &of_contact], "all sums", along(1));
    let (totals, traces, shapes) = moments(b, &all);
    let totals = b.reshaped(&totals, &[2, frames], "totals");
    let [force, area] =
        [("force", 0), ("area", 1)].map(|(name, row)| rows(b, &totals, row, 1, name));
    let traces = b.reshaped(&traces, &[2, frames], "spreads");
    let shapes = b.reshaped(&shapes, &[2, frames], "shapes");
    let peak = peak(b, &pressed, frames);

    let squares = b.node("Mul", &[&pressed, &pressed], "pressed squared");
    let energy = total(b, &squares, "energy");
    let force_squared = b.node("Mul", &[&force, &force], "force squared");
    let effective = b.quotient(&force_squared, &energy, TINY, "effective area");
    let variation = variation(b, &pressed);
    let roughness = b.quotient(&variation, &force, LITTLE_N, "roughness");

    let mut logarithms = vec![area.as_str()];
    logarithms.extend(counts.iter().map(String::as_str));
    logarithms.extend([force.as_str(), &peak, &traces, &effective]);
    let logarithms = b.with("Concat", &logarithms, "before logarithms", along(0));
    let [c1, c2, c3, c4] = AREA_THRESHOLDS_N.map(|threshold_n| 1.0 / step_n(threshold_n));
    let unit = [1.0, c1, c2, c3, c4, 1.0, 1.0, 1.0, 1.0, 1.0];
    let unit = b.0.constant("units", &[LOGARITHMS, 1], &unit);
    let added = [
        [1.0; 5].as_slice(),
        &[LITTLE_N; 2],
        &[LITTLE_SPREAD; 2],
        &[LITTLE_AREA],
    ]
    .concat();
    let added = b.0.constant("added", &[LOGARITHMS, 1], &added);
    let scaled = b.node("Mul", &[&logarithms, &unit], "in units");
    let raised = b.node("Add", &[&scaled, &added], "raised rows");
    let logarithms = b.node("Log", &[&raised], "logarithms");
    let first = rows(b, &logarithms, 0, LOGARITHMS - 1, "first logarithms");
    let last = rows(b, &logarithms, LOGARITHMS - 1, 1, "last logarithm");
    b.with(
        "Concat",
        &[&first, &shapes, &last, &roughness],
        "features",
        along(0),
    )
}

/// The least step from the next smaller force to a threshold.
fn step_n(threshold_n: f32) -> f32 {
    threshold_n - threshold_n.next_down()
}

/// Subtracts the next smaller force than a threshold from each force. Forces from the threshold on
/// then are a step or more, and the others are 0 or less.
fn beyond(b: &mut Builder, taxels: &str, threshold_n: f32) -> String {
    let name = format!("beyond {threshold_n}");
    let below = b.scalar(&name, threshold_n.next_down());
    b.node("Sub", &[taxels, &below], &name)
}

/// A mask: 1 for taxels of at least `threshold_n`, 0 for the others.
fn contact(b: &mut Builder, taxels: &str, threshold_n: f32) -> String {
    let beyond = beyond(b, taxels, threshold_n);
    let steep = b.scalar("steep", STEEP);
    let beyond = b.node("Mul", &[&beyond, &steep], "contact");
    b.clipped(&beyond, 0.0, 1.0)
}

/// The number of taxels of at least `threshold_n`, in units of [`step_n`]: a sum of such steps is
/// exact, and so a product for each taxel is saved.
fn count(b: &mut Builder, taxels: &str, threshold_n: f32) -> String {
    let beyond = beyond(b, taxels, threshold_n);
    let steps = b.clipped(&beyond, 0.0, step_n(threshold_n));
    total(b, &steps, &format!("area of {threshold_n}"))
}

/// The sum over the taxels of each frame, `[1, frames]`. A sum over two axes is faster than the
/// same sum over one axis.
fn total(b: &mut Builder, x: &str, name: &str) -> String {
    let options = vec![integer("keepdims", 0)];
    b.with("ReduceSum", &[x, "taxel axes"], name, options)
}

/// `count` rows of a matrix, from row `first` on.
fn rows(b: &mut Builder, x: &str, first: usize, count: usize, name: &str) -> String {
    let ends = [("first", first), ("end", first + count), ("axis", 0)];
    let [first, end, axis] =
        ends.map(|(end, value)| b.0.indices(&format!("{end} of {name}"), &[value as i64]));
    b.node("Slice", &[x, &first, &end, &axis], name)
}

/// The greatest force of each frame, `[1, frames]`.
fn peak(b: &mut Builder, pressed: &str, frames: usize) -> String {
    let taxels = b.reshaped(pressed, &[frames, TAXELS], "pressed taxels");
    let options = vec![integers("axes", &[1]), integer("keepdims", 1)];
    let peaks = b.with("ReduceMax", &[&taxels], "peaks", options);
    b.reshaped(&peaks, &[1, frames], "peak")
}

/// The sums over taxels of `weights`, `[SUMS, frames]`.
fn all_sums(b: &mut Builder, weights: &str, of: &str, frames: usize) -> String {
    let taxels = b.reshaped(weights, &[frames, TAXELS], &format!("taxels of {of}"));
    let transposed = vec![integer("transA", 1), integer("transB", 1)];
    b.with(
        "Gemm",
        &["sums", &taxels],
        &format!("sums of {of}"),
        transposed,
    )
}

/// From sums `[SUMS, n]` returns three values of `[1, n]` each: the total, the trace of the second
/// central moments, and their anisotropy from 0 (round) to 1 (a line).
///
/// Some small matrix products here only pick rows. If all users of a matrix product were slices,
/// the inference library would cut the product in pieces.
fn moments(b: &mut Builder, sums: &str) -> (String, String, String) {
    let means = SUMS - 1;
    let of_totals: Vec<f32> = (0..means * SUMS)
        .map(|place| if place % SUMS == 0 { 1.0 } else { 0.0 })
        .collect();
    b.0.constant("of totals", &[means, SUMS], &of_totals);
    b.0.constant("tiny", &[1, 1], &[TINY]);
    let divisors = b.node("Gemm", &["of totals", sums, "tiny"], "divisors");
    let total = rows(b, sums, 0, 1, "total");
    let sums = rows(b, sums, 1, means, "sums beside the total");
    let all = b.node("Div", &[&sums, &divisors], "means of all");
    let [left, right, square] = [(0, "left"), (1, "right"), (2, "square")]
        .map(|(part, name)| rows(b, &all, part * PRODUCTS, PRODUCTS, name));
    let product = b.node("Mul", &[&left, &right], "product of means");
    let central = b.node("Sub", &[&square, &product], "central moments");
    // From rr, cc and rc: rr + cc, rr - cc, 2 rc
    let turn = [1.0, 1.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 2.0];
    b.0.constant("turn", &[PRODUCTS, PRODUCTS], &turn);
    let turned = b.node("MatMul", &["turn", &central], "turned moments");
    let trace = rows(b, &turned, 0, 1, "trace");
    // anisotropy = sqrt((rr - cc)^2 + 4 rc^2) / (rr + cc)
    let squares = b.node("Mul", &[&turned, &turned], "turned squared");
    b.0.constant("of difference and 2 rc", &[1, PRODUCTS], &[0.0, 1.0, 1.0]);
    let sum = b.node(
        "MatMul",
        &["of difference and 2 rc", &squares],
        "discriminant",
    );
    let root = b.node("Sqrt", &[&sum], "eccentricity");
    let anisotropy = b.quotient(&root, &trace, TINY, "anisotropy");
    let spread = b.node("Relu", &[&trace], "spread");
    (total, spread, anisotropy)
}

/// Sum of the absolute differences of neighbours along rows and columns, `[1, frames]`.
fn variation(b: &mut Builder, pressed: &str) -> String {
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
            &[pressed, &one, &all, &axis],
            &format!("after {name}"),
        );
        let before = b.node(
            "Slice",
            &[pressed, &zero, &last, &axis],
            &format!("before {name}"),
        );
        let difference = b.node("Sub", &[&after, &before], &format!("difference {name}"));
        let size = b.node("Abs", &[&difference], &format!("size {name}"));
        total(b, &size, &format!("variation {name}"))
    };
    let (down, right) = (along(b, 2), along(b, 3));
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
        let features = nodes(&mut b, "frames", FRAMES_AT_ONCE);
        let by_frame = vec![integers("perm", &[1, 0])];
        let features = b.with("Transpose", &[&features], "by frame", by_frame);
        let input = ("frames", vec![1, FRAMES_AT_ONCE, ROWS, COLS]);
        let output = (features.as_str(), vec![FRAMES_AT_ONCE, FEATURES]);
        Ok(Self(Plan::over(b.0, &input, &output)?))
    }

    /// The features of `frames`, a row of [`FEATURES`] numbers per frame.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library fails.
    pub fn of(&self, frames: &[ModelFrame]) -> anyhow::Result<Vec<f32>> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taxel_counts_from_its_threshold_on() {
        let plan = Features::new().unwrap();
        let of = |newtons: f32| {
            let mut frame = ModelFrame::default();
            frame.newtons[300..310].fill(newtons);
            plan.of(&[frame]).unwrap()
        };
        let contact_n = press::Thresholds::default().contact_threshold_n;
        let thresholds = [&[contact_n], AREA_THRESHOLDS_N.as_slice()].concat();
        for (place, &threshold_n) in thresholds.iter().enumerate() {
            let ends = [threshold_n.next_down(), threshold_n, threshold_n.next_up()];
            let found = ends.map(|newtons| of(newtons)[place]);
            let ten = 11.0_f32.ln();
            for (found, expected) in found.iter().zip([0.0, ten, ten]) {
                assert!((found - expected).abs() < 1e-6, "{threshold_n}: {found}");
            }
        }
    }

    #[test]
    fn features_are_those_of_a_frame_by_hand() {
        let mut frame = ModelFrame::default();
        // Two taxels of one row with a taxel between them, and one that is too light to count.
        frame.newtons[10 * COLS + 4] = 1.0;
        frame.newtons[10 * COLS + 6] = 3.0;
        frame.newtons[20 * COLS + 20] = 0.01;
        let found = Features::new()
            .unwrap()
            .of(&[ModelFrame::default(), frame])
            .unwrap();
        let ln = f32::ln;
        // The columns' variance is 0.75 with the forces as weights, and 1 with all taxels alike.
        // Each taxel differs from its four neighbours. The small numbers in divisors are left out,
        // so the tolerance is wide.
        let expected = [
            ln(3.0),
            ln(3.0),
            ln(3.0),
            ln(3.0),
            ln(2.0),
            ln(4.05),
            ln(3.05),
            ln(0.75 + 0.05),
            ln(1.0 + 0.05),
            1.0,
            1.0,
            ln(16.0 / 10.0 + 0.5),
            16.0 / 4.05,
        ];
        for (place, (found, expected)) in found[FEATURES..].iter().zip(expected).enumerate() {
            assert!(
                (found - expected).abs() < 5e-3,
                "{place}: {found} {expected}"
            );
        }
        assert_eq!(found[FEATURES - 1], 0.0);
    }
}
