//! The operators that a graph may use, with their inputs and attributes.
//!
//! To allow another operator, add a line here. Its rule must compute the shapes of the outputs, and
//! refuse everything that the inference library cannot handle.

use super::problem::Problem;
use super::{Computed, Node, arithmetic, layers, learners, recurrent, shapes};

/// The values that an attribute may have.
#[derive(Debug, Clone, Copy)]
pub(super) enum Allowed {
    /// A whole number from the first bound to the second.
    Int(i64, i64),
    /// At most the first number of whole numbers, each from the second to the third number.
    Ints(usize, i64, i64),
    Float,
    /// At most this number of numbers.
    Floats(usize),
    /// One of these texts.
    Text(&'static [&'static str]),
    /// At most this number of these texts.
    Texts(usize, &'static [&'static str]),
    Tensor,
    Graph,
}

/// The way to compute the outputs of a node.
pub(super) enum Rule {
    /// The node alone is enough.
    Of(fn(&Node<'_>) -> Result<Computed, Problem>),
    /// A loop: the body is needed too.
    Scan,
}

/// An operator, or several that take the same inputs and attributes.
pub(super) struct Operator {
    pub(super) domain: &'static str,
    pub(super) names: &'static [&'static str],
    /// The fewest and the most inputs.
    pub(super) inputs: (usize, usize),
    /// The fewest and the most outputs.
    pub(super) outputs: (usize, usize),
    /// Whether an empty name may leave out an optional input or output.
    pub(super) gaps: bool,
    pub(super) attributes: &'static [(&'static str, Allowed)],
    pub(super) rule: Rule,
}

impl Operator {
    const fn new(
        names: &'static [&'static str],
        inputs: (usize, usize),
        attributes: &'static [(&'static str, Allowed)],
        rule: fn(&Node<'_>) -> Result<Computed, Problem>,
    ) -> Self {
        Self {
            domain: "",
            names,
            inputs,
            outputs: (1, 1),
            gaps: false,
            attributes,
            rule: Rule::Of(rule),
        }
    }

    const fn outputs(mut self, least: usize, most: usize) -> Self {
        self.outputs = (least, most);
        self
    }

    const fn gaps(mut self) -> Self {
        self.gaps = true;
        self
    }

    /// Makes this one of ONNX's classic learners.
    const fn learner(mut self) -> Self {
        self.domain = "ai.onnx.ml";
        self
    }
}

/// The operator of this name, if it is allowed.
pub(super) fn find(domain: &str, name: &str) -> Option<&'static Operator> {
    let domain = if domain == "ai.onnx" { "" } else { domain };
    let mut operators = OPERATORS.iter();
    operators.find(|operator| operator.domain == domain && operator.names.contains(&name))
}

use Allowed::{Float, Floats, Graph, Int, Ints, Tensor, Text, Texts};

const AXIS: Allowed = Int(-8, 7);
const FLAG: Allowed = Int(0, 1);
/// The longest list: as many numbers as a file of the largest size holds.
const LONG: usize = 16_000_000;
/// The most nodes in all trees of a forest.
const TREE_NODES: usize = 1_000_000;
const TREE_PLACES: Allowed = Ints(TREE_NODES, 0, TREE_NODES as i64);
const POST_TRANSFORMS: Allowed = Text(&["NONE", "SOFTMAX", "LOGISTIC"]);

/// The window of a convolution or a pool.
const KERNEL: Allowed = Ints(2, 1, 64);
const STRIDES: Allowed = Ints(2, 1, 64);
const DILATIONS: Allowed = Ints(2, 1, 64);
const PADS: Allowed = Ints(4, 0, 256);
const AUTO_PAD: Allowed = Text(&["NOTSET", "VALID", "SAME_UPPER", "SAME_LOWER"]);

const REDUCE: &[(&str, Allowed)] = &[
    ("axes", Ints(8, -8, 7)),
    ("keepdims", FLAG),
    ("noop_with_empty_axes", FLAG),
];
const ARG: &[(&str, Allowed)] = &[
    ("axis", AXIS),
    ("keepdims", FLAG),
    ("select_last_index", FLAG),
];
const RECURRENT: &[(&str, Allowed)] = &[
    ("direction", Text(&["forward", "reverse", "bidirectional"])),
    ("hidden_size", Int(1, 4096)),
    ("layout", Int(0, 0)),
    ("linear_before_reset", FLAG),
    ("activations", Texts(6, &["Sigmoid", "Tanh"])),
    ("input_forget", Int(0, 0)),
];

#[rustfmt::skip]
pub(super) const OPERATORS: &[Operator] = &[
    // These operators work number by number.
    Operator::new(
        &["Relu", "Sigmoid", "Tanh", "Softplus", "Softsign", "HardSwish", "Mish", "Exp", "Log",
          "Sqrt", "Reciprocal", "Floor", "Ceil", "Round", "Erf", "Sin", "Cos"],
        (1, 1), &[], arithmetic::float),
    Operator::new(&["LeakyRelu", "Elu", "Celu", "ThresholdedRelu"], (1, 1),
        &[("alpha", Float)], arithmetic::float),
    Operator::new(&["Selu"], (1, 1), &[("alpha", Float), ("gamma", Float)], arithmetic::float),
    Operator::new(&["HardSigmoid"], (1, 1), &[("alpha", Float), ("beta", Float)],
        arithmetic::float),
    Operator::new(&["Gelu"], (1, 1), &[("approximate", Text(&["none", "tanh"]))],
        arithmetic::float),
    Operator::new(&["Abs", "Neg", "Sign"], (1, 1), &[], arithmetic::signed),
    Operator::new(&["IsNaN"], (1, 1), &[], arithmetic::question),
    Operator::new(&["IsInf"], (1, 1), &[("detect_positive", FLAG), ("detect_negative", FLAG)],
        arithmetic::question),
    Operator::new(&["Not"], (1, 1), &[], arithmetic::not),
    Operator::new(&["Cast"], (1, 1), &[("to", Int(1, 13)), ("saturate", FLAG)], arithmetic::cast),
    // These operators work on two or more values, number by number.
    Operator::new(&["Add", "Sub", "Mul", "Div"], (2, 2), &[], arithmetic::binary),
    Operator::new(&["Sum", "Mean", "Min", "Max"], (1, 16), &[], arithmetic::several),
    Operator::new(&["Pow"], (2, 2), &[], arithmetic::power),
    Operator::new(&["PRelu"], (2, 2), &[], arithmetic::prelu),
    Operator::new(&["Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual"], (2, 2), &[],
        arithmetic::compare),
    Operator::new(&["And", "Or", "Xor"], (2, 2), &[], arithmetic::logic),
    Operator::new(&["Where"], (3, 3), &[], arithmetic::choose),
    Operator::new(&["Clip"], (1, 3), &[], arithmetic::clip).gaps(),
    // These operators work on shapes.
    Operator::new(&["Identity"], (1, 1), &[], shapes::identity),
    Operator::new(&["Dropout"], (1, 3), &[("seed", Int(i64::MIN, i64::MAX))], shapes::dropout)
        .outputs(1, 2).gaps(),
    Operator::new(&["Constant"], (0, 0),
        &[("value", Tensor), ("value_float", Float), ("value_floats", Floats(LONG)),
          ("value_int", Int(i64::MIN, i64::MAX)),
          ("value_ints", Ints(LONG, i64::MIN, i64::MAX))],
        shapes::constant),
    Operator::new(&["ConstantOfShape"], (1, 1), &[("value", Tensor)], shapes::constant_of_shape),
    Operator::new(&["Shape"], (1, 1), &[("start", AXIS), ("end", Int(-8, 8))], shapes::shape),
    Operator::new(&["Reshape"], (2, 2), &[("allowzero", FLAG)], shapes::reshape),
    Operator::new(&["Flatten"], (1, 1), &[("axis", Int(-8, 8))], shapes::flatten),
    Operator::new(&["Transpose"], (1, 1), &[("perm", Ints(8, 0, 7))], shapes::transpose),
    Operator::new(&["Squeeze"], (1, 2), &[], shapes::squeeze),
    Operator::new(&["Unsqueeze"], (2, 2), &[], shapes::unsqueeze),
    Operator::new(&["Concat"], (1, 256), &[("axis", AXIS)], shapes::concat),
    Operator::new(&["Split"], (1, 2), &[("axis", AXIS), ("num_outputs", Int(1, 256))],
        shapes::split).outputs(1, 256),
    Operator::new(&["Slice"], (3, 5), &[], shapes::slice).gaps(),
    Operator::new(&["Gather"], (2, 2), &[("axis", AXIS)], shapes::gather),
    Operator::new(&["Pad"], (2, 4), &[("mode", Text(&["constant", "reflect", "edge"]))],
        shapes::pad).gaps(),
    Operator::new(&["Expand"], (2, 2), &[], shapes::expand),
    Operator::new(&["Tile"], (2, 2), &[], shapes::tile),
    // These operators are layers.
    Operator::new(&["MatMul"], (2, 2), &[], layers::matmul),
    Operator::new(&["Gemm"], (2, 3),
        &[("alpha", Float), ("beta", Float), ("transA", FLAG), ("transB", FLAG)], layers::gemm),
    Operator::new(&["Conv"], (2, 3),
        &[("auto_pad", AUTO_PAD), ("dilations", DILATIONS), ("group", Int(1, 4096)),
          ("kernel_shape", KERNEL), ("pads", PADS), ("strides", STRIDES)],
        layers::conv),
    Operator::new(&["MaxPool"], (1, 1),
        &[("auto_pad", AUTO_PAD), ("ceil_mode", FLAG), ("dilations", DILATIONS),
          ("kernel_shape", KERNEL), ("pads", PADS), ("storage_order", Int(0, 0)),
          ("strides", STRIDES)],
        layers::pool),
    Operator::new(&["AveragePool"], (1, 1),
        &[("auto_pad", AUTO_PAD), ("ceil_mode", FLAG), ("count_include_pad", FLAG),
          ("dilations", DILATIONS), ("kernel_shape", KERNEL), ("pads", PADS),
          ("strides", STRIDES)],
        layers::pool),
    Operator::new(&["GlobalAveragePool", "GlobalMaxPool"], (1, 1), &[], layers::global_pool),
    Operator::new(&["BatchNormalization"], (5, 5),
        &[("epsilon", Float), ("momentum", Float), ("training_mode", Int(0, 0))],
        layers::batch_norm),
    Operator::new(&["InstanceNormalization"], (3, 3), &[("epsilon", Float)],
        layers::instance_norm),
    Operator::new(&["LayerNormalization"], (2, 3),
        &[("axis", AXIS), ("epsilon", Float), ("stash_type", Int(1, 1))], layers::layer_norm),
    Operator::new(&["Softmax", "LogSoftmax"], (1, 1), &[("axis", AXIS)], layers::softmax),
    Operator::new(
        &["ReduceL1", "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMax", "ReduceMean",
          "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare"],
        (1, 2), REDUCE, layers::reduce),
    Operator::new(&["ArgMax", "ArgMin"], (1, 1), ARG, layers::arg),
    // These operators work on sequences.
    Operator::new(&["RNN", "GRU"], (3, 6), RECURRENT, recurrent::recurrent)
        .outputs(1, 2).gaps(),
    Operator::new(&["LSTM"], (3, 7), RECURRENT, recurrent::recurrent).outputs(1, 3).gaps(),
    Operator {
        domain: "",
        names: &["Scan"],
        inputs: (1, 64),
        outputs: (1, 64),
        gaps: false,
        attributes: &[("body", Graph), ("num_scan_inputs", Int(1, 32)),
            ("scan_input_axes", Ints(32, 0, 7)), ("scan_input_directions", Ints(32, 0, 1)),
            ("scan_output_axes", Ints(32, 0, 7)), ("scan_output_directions", Ints(32, 0, 1))],
        rule: Rule::Scan,
    },
    // These operators are classic learners.
    Operator::new(&["Normalizer"], (1, 1), &[("norm", Text(&["MAX", "L1", "L2"]))],
        learners::normalizer).learner(),
    Operator::new(&["LinearRegressor"], (1, 1),
        &[("coefficients", Floats(LONG)), ("intercepts", Floats(LONG)),
          ("post_transform", POST_TRANSFORMS), ("targets", Int(1, 4096))],
        learners::linear_regressor).learner(),
    Operator::new(&["LinearClassifier"], (1, 1),
        &[("classlabels_ints", Ints(4096, 0, 1 << 31)), ("coefficients", Floats(LONG)),
          ("intercepts", Floats(LONG)), ("multi_class", FLAG),
          ("post_transform", POST_TRANSFORMS)],
        learners::linear_classifier).learner().outputs(2, 2),
    Operator::new(&["TreeEnsembleClassifier"], (1, 1),
        &[("base_values", Floats(4096)), ("class_ids", Ints(TREE_NODES, 0, 4095)),
          ("class_nodeids", TREE_PLACES), ("class_treeids", TREE_PLACES),
          ("class_weights", Floats(TREE_NODES)), ("classlabels_int64s", Ints(4096, 0, 1 << 31)),
          ("nodes_falsenodeids", TREE_PLACES), ("nodes_featureids", Ints(TREE_NODES, 0, 1 << 24)),
          ("nodes_hitrates", Floats(TREE_NODES)),
          ("nodes_missing_value_tracks_true", Ints(TREE_NODES, 0, 1)),
          ("nodes_modes", Texts(TREE_NODES, &["BRANCH_LEQ", "BRANCH_LT", "BRANCH_GTE",
              "BRANCH_GT", "BRANCH_EQ", "BRANCH_NEQ", "LEAF"])),
          ("nodes_nodeids", TREE_PLACES), ("nodes_treeids", TREE_PLACES),
          ("nodes_truenodeids", TREE_PLACES), ("nodes_values", Floats(TREE_NODES)),
          ("post_transform", POST_TRANSFORMS)],
        learners::trees).learner().outputs(2, 2),
];
