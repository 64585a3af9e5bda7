//! The network of courses as ONNX nodes: from the inputs of format 2 to logits and Shore hardness.

use tract_onnx::pb;

use super::{COLUMNS, DILATIONS, FRAMES, HIDDEN, KERNEL, LAST, POOLS};
use crate::net::builder::Builder;
use crate::net::frames;
use crate::net::graph::Constant;
use crate::net::graph::{Graph, integer, integers};
use crate::net::network::Weights;
use crate::net::shore;
use crate::net::standard::Standard;

/// Added before a logarithm to keep it finite: to mm, s, and s between frames.
pub(super) const MM: f32 = 0.3;
pub(super) const TIME_S: f32 = 0.05;
pub(super) const STEP_S: f32 = 0.01;
/// The limits to which inputs are clipped.
pub(super) const MOST_MM: f32 = 30.0;
pub(super) const MOST_S: f32 = 30.0;
pub(super) const MOST_STEP_S: f32 = 1.0;
pub(super) const LEAST_ARM: f32 = 0.1;
/// Keeps the quotient by a press's force finite.
pub(super) const TINY_N: f32 = 1e-4;

impl Builder {
    /// The columns of [`super::motion`], `[1, FRAMES]` each.
    fn motion(&mut self, force: &str) -> Vec<String> {
        let time = self.logarithm("time_s", MOST_S, TIME_S);
        let [zero, one, last] = [0, 1, FRAMES as i64 - 1]
            .map(|index| self.0.indices(&format!("place {index}"), &[index]));
        let first = self.node("Slice", &["time_s", &zero, &one, &one], "first time");
        let others = self.node(
            "Slice",
            &["time_s", &zero, &last, &one],
            "times but the last",
        );
        let along = vec![integer("axis", 1)];
        let before = self.with("Concat", &[&first, &others], "time before", along);
        let step = self.node("Sub", &["time_s", &before], "step");
        let step = self.logarithm(&step, MOST_STEP_S, STEP_S);

        let nothing = self.scalar("unknown arm", 0.0);
        let is_known = self.node("Greater", &["arm_n_per_mm", &nothing], "is arm known");
        let to = integer("to", pb::tensor_proto::DataType::Float as i64);
        let is_known = self.with("Cast", &[&is_known], "arm known", vec![to]);
        let least = self.scalar("least arm", LEAST_ARM);
        let arm = self.node("Max", &["arm_n_per_mm", &least], "arm");
        let given = self.node("Div", &[force, &arm], "arm gave way");
        let indentation = self.node("Sub", &["approach_mm", &given], "indentation");
        let both = self.node("Mul", &["known", &is_known], "both known");

        let approach = self.logarithm("approach_mm", MOST_MM, MM);
        let approach = self.node("Mul", &["known", &approach], "known approach");
        let depth = self.logarithm(&indentation, MOST_MM, MM);
        let depth = self.node("Mul", &[&both, &depth], "known depth");
        let linear = self.node(
            "Mul",
            &[&both, &format!("{indentation} clipped")],
            "linear depth",
        );
        let stiffness = self.node("Log", &[&arm], "log arm");
        let stiffness = self.node("Mul", &[&stiffness, &is_known], "known stiffness");
        // The product with the mask repeats the stiffness for every frame.
        let stiffness = self.node("Mul", &["mask", &stiffness], "stiffness");

        vec![
            time,
            step,
            "known".to_owned(),
            approach,
            depth,
            linear,
            stiffness,
        ]
    }

    /// A residual convolution over time of `x` `[1, HIDDEN, FRAMES]`.
    fn convolution(&mut self, weights: &Weights, layer: usize, x: &str, mask: &str) -> String {
        let (name, dilation) = (format!("conv{layer}"), DILATIONS[layer - 1]);
        let rows = weights.numbers(&format!("{name}.matrix"));
        let mut kernel = vec![0.0; rows.len()];
        for (place, value) in rows.into_iter().enumerate() {
            kernel[in_kernel(place)] = value;
        }
        let kernel = self.0.constant(
            &format!("{name}.kernel"),
            &[HIDDEN, HIDDEN, KERNEL],
            &kernel,
        );
        let bias = weights.numbers(&format!("{name}.bias"));
        let bias = self.0.constant(&format!("{name}.bias"), &[HIDDEN], &bias);
        let padding = (KERNEL / 2 * dilation) as i64;
        let attributes = vec![
            integers("kernel_shape", &[KERNEL as i64]),
            integers("dilations", &[dilation as i64]),
            integers("pads", &[padding; 2]),
        ];
        let sum = self.with(
            "Conv",
            &[x, &kernel, &bias],
            &format!("{name}.sum"),
            attributes,
        );
        let added = self.node("Relu", &[&sum], &format!("{name}.added"));
        let all = self.node("Add", &[x, &added], &format!("{name}.all"));
        self.node("Mul", &[&all, mask], &format!("{name}.out"))
    }

    /// The pools over time of `x` `[1, HIDDEN, FRAMES]`, `[1, POOLS * HIDDEN]`. Both means are one
    /// matrix product.
    fn pooled(&mut self, x: &str, force: &str) -> String {
        let along = |axis| vec![integer("axis", axis)];
        let there = self.node("Mul", &[force, "mask"], "forces there");
        let shares = self.with("Concat", &["mask", &there], "shares", along(0));
        self.0.constant("ones", &[FRAMES, 1], &[1.0; FRAMES]);
        self.0.constant("tiny force", &[2, 1], &[0.0, TINY_N]);
        let total = self.node("Gemm", &[&shares, "ones", "tiny force"], "sums of shares");
        let by_channel = self.reshaped(x, &[HIDDEN, FRAMES], "by channel");
        let transposed = vec![integer("transB", 1)];
        let sums = self.with(
            "Gemm",
            &[&shares, &by_channel],
            "sums over time",
            transposed,
        );
        let means = self.node("Div", &[&sums, &total], "means over time");
        let means = self.reshaped(&means, &[1, 2 * HIDDEN], "means in a row");
        let [zero, half, all, axis] = [0, HIDDEN, 2 * HIDDEN, 1].map(|value| {
            self.0
                .indices(&format!("means at {value}"), &[value as i64])
        });
        let mean = self.node("Slice", &[&means, &zero, &half, &axis], "mean");
        let weighted = self.node("Slice", &[&means, &half, &all, &axis], "weighted mean");
        let image = self.reshaped(x, &[1, HIDDEN, 1, FRAMES], "as an image");
        let kernel = vec![integers("kernel_shape", &[1, FRAMES as i64])];
        let greatest = self.with("MaxPool", &[&image], "greatest", kernel);
        let greatest = self.reshaped(&greatest, &[1, HIDDEN], "greatest over time");
        self.with("Concat", &[&mean, &greatest, &weighted], "pooled", along(1))
    }
}

/// The place in the kernel `[out, in, tap]` of the number at `place` of a matrix `[tap, in, out]`.
fn in_kernel(place: usize) -> usize {
    let (tap, rest) = (place / (HIDDEN * HIDDEN), place % (HIDDEN * HIDDEN));
    let (input, output) = (rest / HIDDEN, rest % HIDDEN);
    (output * HIDDEN + input) * KERNEL + tap
}

/// A weight of [`super::initial`] from the constants of an exported graph, which holds the
/// convolutions as kernels.
pub(super) fn weight<'a>(
    name: &str,
    constant: impl Fn(&str) -> Option<&'a Constant>,
) -> Option<Constant> {
    let Some(layer) = name
        .strip_suffix(".matrix")
        .filter(|layer| layer.starts_with("conv"))
    else {
        return constant(name).cloned();
    };
    let (dims, kernel) = constant(&format!("{layer}.kernel"))?;
    let is_kernel = *dims == [HIDDEN, HIDDEN, KERNEL] && kernel.len() == HIDDEN * HIDDEN * KERNEL;
    let matrix = |kernel: &[f32]| {
        (0..kernel.len())
            .map(|place| kernel[in_kernel(place)])
            .collect()
    };
    is_kernel.then(|| (vec![KERNEL, HIDDEN, HIDDEN], matrix(kernel)))
}

/// The graph from the inputs of format 2 to raw logits `[1, levels]` and Shore OO `[1, 3]`, and the
/// names of both. `widths` widen the interval below and above.
pub fn graph(
    weights: &Weights,
    standard: &Standard,
    levels: usize,
    widths: [f32; 2],
) -> (Graph, String, String) {
    let mut b = Builder(Graph::default());
    let newtons = standard.forces_node(&mut b, "frames");
    let (features, force) = frames::nodes(&mut b, &newtons, FRAMES);
    let motion = b.motion(&force);
    let mut columns = vec![features.as_str()];
    columns.extend(motion.iter().map(String::as_str));
    let along = |axis| vec![integer("axis", axis)];
    let all = b.with("Concat", &columns, "columns", along(0));
    let x = standard.nodes(&mut b, &all);

    let matrix = weights.numbers("embed.matrix");
    let matrix = b.0.constant("embed.matrix", &[COLUMNS, HIDDEN], &matrix);
    let bias = weights.numbers("embed.bias");
    let bias = b.0.constant("embed.bias", &[HIDDEN], &bias);
    let bias = b.reshaped(&bias, &[HIDDEN, 1], "embed.bias of rows");
    // [COLUMNS, FRAMES] -> [HIDDEN, FRAMES]
    let transposed = vec![integer("transA", 1)];
    let x = b.with("Gemm", &[&matrix, &x, &bias], "embed.sum", transposed);
    let x = b.node("Relu", &[&x], "embedded");
    let x = b.reshaped(&x, &[1, HIDDEN, FRAMES], "over time");
    let mask = b.reshaped("mask", &[1, 1, FRAMES], "mask over time");
    let mut x = b.node("Mul", &[&x, &mask], "first");
    for layer in 1..=DILATIONS.len() {
        x = b.convolution(weights, layer, &x, &mask);
    }

    let pooled = b.pooled(&x, &force);
    let joint = b.dense(weights, "joint", [POOLS * HIDDEN, LAST], &pooled);
    let joint = b.node("Relu", &[&joint], "joint");
    let outputs = b.dense(weights, "head", [LAST, levels + shore::OUTPUTS], &joint);
    let (raw_logits, shore) = shore::nodes(&mut b, &outputs, levels, widths);
    (b.0, raw_logits, shore)
}
