//! The problems of a graph, worded for the author of its file.

use tract_onnx::pb::attribute_proto::AttributeType;

use super::{
    Datum, MOST_NAME_BYTES, MOST_NODES, MOST_NUMBERS, MOST_NUMBERS_IN_ALL, MOST_RANK, MOST_TENSORS,
    MOST_WORK, ModelError, Value,
};

/// The type and the shape of a value, for a message.
#[derive(Debug)]
pub(super) struct Form {
    datum: Datum,
    shape: Vec<usize>,
}

impl From<&Value> for Form {
    fn from(value: &Value) -> Self {
        Self {
            datum: value.datum,
            shape: value.shape.clone(),
        }
    }
}

impl std::fmt::Display for Form {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let lengths: Vec<String> = self.shape.iter().map(usize::to_string).collect();
        write!(out, "{} [{}]", self.datum.name(), lengths.join(","))
    }
}

/// The first thing in a graph that is not allowed. Names are already quoted.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    // Limits of every graph: features that no graph may have.
    #[error("{0} not supported")]
    Unsupported(&'static str),
    #[error("attribute {0} is not supported")]
    UnknownAttribute(String),
    #[error("attribute `{name}`{problem}")]
    Attribute {
        name: String,
        problem: AttributeProblem,
    },
    #[error("numbers of type {0} are not supported")]
    Numbers(String),

    // Bounds.
    #[error("more than {MOST_NODES} nodes")]
    Nodes,
    #[error("{0} tensors: at most {MOST_TENSORS} are accepted")]
    Tensors(usize),
    #[error("with it more than {MOST_NUMBERS_IN_ALL} numbers are computed")]
    NumbersInAll,
    #[error("with it a verdict takes more than {MOST_WORK} steps")]
    Work,
    #[error("rank {0}: at most {MOST_RANK} is accepted")]
    Rank(usize),
    #[error("an output of rank {0}: at most {MOST_RANK} is accepted")]
    OutputRank(usize),
    #[error("an output without numbers ({0})")]
    EmptyOutput(Form),
    #[error("an output of more than {MOST_NUMBERS} numbers ({0})")]
    LargeOutput(Form),

    // Names.
    #[error("a name of {0} bytes, expected 1 to {MOST_NAME_BYTES}")]
    Name(usize),
    #[error("this name occurs twice")]
    NameTwice,
    #[error("input {0} is computed by no node before it")]
    Uncomputed(String),

    // Inputs and outputs.
    #[error("found {found}, expected {expected}")]
    Found { found: Form, expected: String },
    #[error("found nothing that computes it, expected {0}")]
    NothingComputes(Form),
    #[error("{found} inputs, expected {least} to {most}")]
    Inputs {
        found: usize,
        least: usize,
        most: usize,
    },
    #[error("{0} outputs: it cannot have that many")]
    Outputs(usize),
    #[error("input {0} is missing")]
    Missing(usize),
    #[error("input {index} is {found}, expected {expected}")]
    Input {
        index: usize,
        found: Form,
        expected: &'static str,
    },
    #[error("input {0} ({1}) is not a short constant of integers")]
    Unknown(usize, Form),
    #[error("input {0} ({1}) is not constant")]
    NotConstant(usize, Form),
    #[error("input {index} ({found}), expected f32 [{channels}]")]
    PerChannel {
        index: usize,
        found: Form,
        channels: usize,
    },
    #[error("input {index} ({scale}) with {value}")]
    Scale {
        index: usize,
        scale: Form,
        value: Form,
    },
    #[error("{0} and {1} are of different types")]
    Types(Form, Form),
    #[error("{0} and {1} do not go together")]
    Together(Form, Form),
    #[error("shapes {0:?} and {1:?} do not go together")]
    Shapes(Vec<usize>, Vec<usize>),

    // Axes, lists and shapes.
    #[error("axis {axis} of a value of rank {rank}")]
    Axis { axis: i64, rank: usize },
    #[error("axis {0} twice")]
    AxisTwice(usize),
    #[error("without `axis`")]
    NoAxis,
    #[error("in opset {opset} its axes are {place}")]
    Axes { opset: i64, place: &'static str },
    #[error("axes {0:?} of {1} are longer than 1")]
    LongAxes(Vec<usize>, Form),
    #[error("`{0}` and `{1}`: expected one of them")]
    Both(&'static str, &'static str),
    #[error("`{name}` {found:?}, expected {expected} values")]
    Values {
        name: &'static str,
        found: Vec<i64>,
        expected: usize,
    },
    #[error("a shape of {0} lengths")]
    ShapeRank(usize),
    #[error("a shape of {0:?}")]
    Shape(Vec<i64>),
    #[error("{0} does not fill the shape {1:?}")]
    Fill(Form, Vec<i64>),
    #[error("`perm` {0:?} of {1}")]
    Order(Vec<i64>, Form),
    #[error("no length is asked for")]
    NoLength,
    #[error("repeats {0:?} of {1}")]
    Repeats(Vec<usize>, Form),
    #[error("{0} into {1} parts")]
    Parts(Form, usize),
    #[error("{0} into parts of other lengths")]
    PartLengths(Form),
    #[error("starts, ends, axes and steps do not go together")]
    SliceLists,
    #[error("{start} to {end} by {step} of {length}")]
    Slice {
        start: i64,
        end: i64,
        step: i64,
        length: usize,
    },
    #[error("indices {0}")]
    Indices(Form),
    #[error("index {index} into axis {axis} of {value}")]
    Index {
        index: i64,
        axis: usize,
        value: Form,
    },
    #[error("a fill of {0}")]
    PadFill(Form),
    #[error("{0} pads of {1}")]
    Pads(usize, Form),
    #[error("a pad of {pad} on axis {axis} of {value}")]
    Pad { pad: i64, axis: usize, value: Form },

    // Arithmetic.
    #[error("of {0}")]
    Of(Form),
    #[error("a quotient of integers that are not known")]
    Quotient,
    #[error("{operator} of {left} and {right}")]
    Integers {
        operator: String,
        left: i64,
        right: i64,
    },
    #[error("slopes {0} of values {1}")]
    Slopes(Form, Form),
    #[error("a bound {0} of values {1}")]
    Bound(Form, Form),
    #[error("a ratio {0}")]
    Ratio(Form),
    #[error("it is set to training")]
    Training,

    // Layers.
    #[error("{0} by {1}")]
    Product(Form, Form),
    #[error("{0} by {1}: expected rank 2 or more")]
    ProductRank(Form, Form),
    #[error("a bias {bias} of f32 [{rows},{columns}]")]
    MatrixBias {
        bias: Form,
        rows: usize,
        columns: usize,
    },
    #[error("a bias {0}")]
    Bias(Form),
    #[error("a window of {span} on a length of {length} with pads of {before} and {after}")]
    Window {
        span: usize,
        length: usize,
        before: usize,
        after: usize,
    },
    #[error("{0} with a window of {1:?}")]
    Pool(Form, Vec<usize>),
    #[error("{0} with kernels {1}")]
    Kernels(Form, Form),
    #[error("{0} with kernels {1} in {2} groups")]
    Groups(Form, Form, usize),
    #[error("{0}, expected rank {1} or more")]
    LowRank(Form, usize),

    // Recurrent layers and loops.
    #[error("{0} with weights {1} and {2}")]
    Weights(Form, Form, Form),
    #[error("a beginning of {0}")]
    Start(Form),
    #[error("without its body")]
    NoBody,
    #[error("{inputs} inputs, a body of {body} and {sequences} sequences")]
    LoopInputs {
        inputs: usize,
        body: usize,
        sequences: usize,
    },
    #[error("other outputs than its body")]
    LoopOutputs,
    #[error("`{0}`: expected {1} values")]
    LoopAxes(&'static str, usize),
    #[error("axis {0} of a sequence {1}")]
    SequenceAxis(usize, Form),
    #[error("axis {0} of {1}")]
    OutputAxis(usize, Form),
    #[error("sequences of {0} steps")]
    Steps(usize),
    #[error("its body's input {0} is not declared as {1}")]
    BodyInput(String, Form),
    #[error("no node of its body computes {0}")]
    BodyOutput(String),
    #[error("state {0} becomes {1}")]
    State(String, Form),
    #[error("in its body, {0}")]
    InBody(Box<ModelError>),

    // Tensors, and declared inputs and outputs.
    #[error("no tensor")]
    NoTensor,
    #[error("a length of {0}")]
    Length(i64),
    #[error("a length that is no number above 0")]
    OpenLength,
    #[error("more than {MOST_NUMBERS} numbers")]
    LargeTensor,
    #[error("a tensor without numbers")]
    EmptyTensor,
    #[error("found {found} {unit} of data, expected those of {numbers} numbers")]
    Data {
        found: usize,
        unit: &'static str,
        numbers: usize,
    },
    #[error("expected one value")]
    OneValue,
    #[error("a value {0}")]
    FillValue(Form),

    // Classic learners.
    #[error("{0}, expected rows of features")]
    Rows(Form),
    #[error("{coefficients} coefficients of {lines} {of} with {value}")]
    Coefficients {
        coefficients: usize,
        lines: usize,
        of: &'static str,
        value: Form,
    },
    #[error("{0} classes")]
    Classes(usize),
    #[error("lists of {0} and {1:?} nodes")]
    TreeLists(usize, [usize; 7]),
    #[error("node {id} of tree {tree} is out of order")]
    TreeOrder { id: i64, tree: i64 },
    #[error("node {id} of tree {tree} leads nowhere")]
    TreeEnd { id: i64, tree: i64 },
    #[error("node {id} of tree {tree} asks for feature {feature} of {features}")]
    TreeFeature {
        id: i64,
        tree: i64,
        feature: i64,
        features: usize,
    },
    #[error("lists of {0} votes that differ in length")]
    VoteLists(usize),
    #[error("a vote for class {class} at node {id} of tree {tree}")]
    Vote { class: i64, id: i64, tree: i64 },
}

/// The problem with an attribute.
#[derive(Debug, thiserror::Error)]
pub(super) enum AttributeProblem {
    #[error(" twice")]
    Twice,
    #[error(" refers to another")]
    Reference,
    #[error(": expected {0}")]
    Kind(AttributeType),
    #[error(": found {found}, expected {low} to {high}")]
    Range { found: i64, low: i64, high: i64 },
    #[error(": {found} values, expected at most {most}")]
    Long { found: usize, most: usize },
    #[error(": found {found}, expected one of {expected}")]
    Text { found: String, expected: String },
    #[error(": expected some of {0}")]
    Texts(String),
    #[error(": without its tensor")]
    NoTensor,
    #[error(": without its graph")]
    NoGraph,
}
