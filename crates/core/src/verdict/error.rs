//! The bounds of a model, and the reasons why it is refused or takes no levels or references.

use std::time::Duration;

use super::shore::BordersError;
use crate::frame::Array;

/// The largest accepted model file, in bytes: 64 MB.
pub const MAX_FILE_BYTES: usize = 64_000_000;
/// The oldest accepted ONNX operator set.
pub const MIN_OPSET: i64 = 17;
/// The largest accepted difference from the check frames' probabilities.
pub const CHECK_TOLERANCE: f32 = 1e-4;
/// The largest accepted difference from the check presses' Shore hardness.
pub const SHORE_TOLERANCE: f32 = 1e-2;

/// The reason why a model file is refused, or why a judgement failed.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file has more than [`MAX_FILE_BYTES`].
    #[error("model file of {found} bytes: at most {MAX_FILE_BYTES} are accepted")]
    TooLarge {
        /// The size of the file.
        found: usize,
    },
    /// The bytes are no ONNX model.
    #[error("not an ONNX model: {0}")]
    NotOnnx(String),
    /// The operator set is too old or missing.
    #[error("ONNX opset {}: expected {MIN_OPSET} or newer", .found.map_or("missing".into(), |v| v.to_string()))]
    Opset {
        /// The default domain's version, if the file has one.
        found: Option<i64>,
    },
    /// A tensor's data lies outside the file.
    #[error(
        "tensor `{tensor}` lies in an external file: expected all data inside the model file (PyTorch: \
         `external_data=False`)"
    )]
    ExternalData {
        /// The name of the tensor.
        tensor: String,
    },
    /// The inputs or outputs have wrong names, types or shapes.
    #[error("model {what} {found}: expected {expected}")]
    Signature {
        /// `input`, `inputs` or `outputs`.
        what: &'static str,
        /// The names, types and shapes in the file.
        found: String,
        /// The names, types and shapes of the format.
        expected: String,
    },
    /// A metadata key is missing.
    #[error("model metadata `{key}` is missing")]
    KeyMissing {
        /// The key.
        key: &'static str,
    },
    /// A metadata key has an unusable value.
    #[error("model metadata `{key}`: found {found}, expected {expected}")]
    KeyInvalid {
        /// The key.
        key: &'static str,
        /// The value, or the problem with it.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// The sensor's array is not that of a model with a grid of its own.
    #[error(
        "the model takes frames of {}x{} taxels as they are, and the sensor has {}x{}: use the model of this sensor, \
         or none",
        .expected.rows, .expected.cols, .found.rows, .found.cols
    )]
    Grid {
        /// The sensor's array.
        found: Array,
        /// The model's.
        expected: Array,
    },
    /// The graph has a node that no model may have.
    #[error("model node {node}: {problem}")]
    Node {
        /// The name and the operator of the node.
        node: String,
        /// The problem with it.
        problem: NodeProblem,
    },
    /// The graph cannot be run.
    #[error("model graph cannot be run: {0}")]
    Graph(String),
    /// An output for a check is not what it should be.
    #[error("check {check}: {what} by up to {difference:.6}: expected at most {most}")]
    Differs {
        /// The check's index in `hrn.check`.
        check: usize,
        /// What differs from what.
        what: &'static str,
        /// The largest difference of a number.
        difference: f32,
        /// The largest difference that is accepted.
        most: f32,
    },
    /// A judgement returned NaN or infinity.
    #[error("model gave a number that is not finite in `{output}`")]
    NotFinite {
        /// The name of the output.
        output: &'static str,
    },
    /// A judgement failed inside the inference library.
    #[error("model could not judge a frame: {0}")]
    Inference(String),
    /// The trial process refused the file, or did not complete.
    #[error("{0}")]
    Trial(String),
    /// A verdict takes so long that frames would have to wait.
    #[error(
        "model takes {:.1} ms for a verdict: expected at most {:.1} ms, a tenth of the fastest \
         sensor's frame period (but 1 to 20 ms)",
        .found.as_secs_f64() * 1e3,
        .expected.as_secs_f64() * 1e3
    )]
    Slow {
        /// The median processor time of a verdict.
        found: Duration,
        /// The time that the sensors allow for a verdict.
        expected: Duration,
    },
}

/// The reason why a model cannot take other levels.
#[derive(Debug, thiserror::Error)]
pub enum LevelsError {
    /// The model gives no distribution over the scale.
    #[error(
        "found levels, expected none: the model has levels of its own, and only a model of format 3 takes others"
    )]
    Fixed,
    /// The levels are no parts of the scale.
    #[error("found {0}, expected ranges of Shore OO from the hardest to the softest")]
    Borders(#[from] BordersError),
}

/// References that another model computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "references: found {count} with {numbers} numbers, expected at most {most} with {features} numbers each, \
     as this model computes them"
)]
pub struct ReferencesError {
    pub(super) count: usize,
    pub(super) numbers: usize,
    pub(super) most: usize,
    pub(super) features: usize,
}

/// The problem with a node of a graph.
#[derive(Debug, thiserror::Error)]
pub enum NodeProblem {
    /// The operator runs another graph as an input says.
    #[error("an operator that runs a graph as an input of the model says is not supported")]
    Operator,
    /// A shape is unknown until the model runs.
    #[error("the shape of its output depends on an input of the model")]
    Shape,
    /// An index, a length or a divisor is unknown until the model runs.
    #[error("it takes integers that depend on an input of the model")]
    Integers,
    /// The lists of a forest lead nowhere.
    #[error("{0}")]
    Trees(&'static str),
}
