//! What a model's graph may contain.
//!
//! In: the graph, before and after the inference library reads it. Out: the first thing in it that
//! is not allowed. The library may panic, hang or fill the memory while it reads a graph or judges
//! the check frames. A trial in a child process (`crate::trial`) finds that, so nothing here does.
//! A trial cannot find what happens with another frame than the check frames, or a wrong result
//! that the file's own probabilities repeat. This module refuses both.

use std::collections::{HashMap, HashSet};

use tract_onnx::pb;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::ops::scan::Scan;

use super::error::{MOST_NUMBERS, ModelError, NodeProblem};
use super::file::shown;

/// The domain of ONNX's classic learners.
const LEARNERS: &str = "ai.onnx.ml";

/// The domains and names of the operators that a graph may use. To allow another one, add a line,
/// here and in `docs/formats.md`.
///
/// An operator must not run a subgraph as often as its input says, as `Loop` does, and must not
/// follow indices of its attributes unchecked, as [`check_trees`] says.
#[rustfmt::skip]
const OPERATORS: &[(&str, &str)] = &[
    ("", "Abs"),
    ("", "Add"),
    ("", "And"),
    ("", "ArgMax"),
    ("", "ArgMin"),
    ("", "AveragePool"),
    ("", "BatchNormalization"),
    ("", "Cast"),
    ("", "Ceil"),
    ("", "Celu"),
    ("", "Clip"),
    ("", "Concat"),
    ("", "Constant"),
    ("", "ConstantOfShape"),
    ("", "Conv"),
    ("", "Cos"),
    ("", "Div"),
    ("", "Dropout"),
    ("", "Elu"),
    ("", "Equal"),
    ("", "Erf"),
    ("", "Exp"),
    ("", "Expand"),
    ("", "Flatten"),
    ("", "Floor"),
    ("", "GRU"),
    ("", "Gather"),
    ("", "Gelu"),
    ("", "Gemm"),
    ("", "GlobalAveragePool"),
    ("", "GlobalMaxPool"),
    ("", "Greater"),
    ("", "GreaterOrEqual"),
    ("", "HardSigmoid"),
    ("", "HardSwish"),
    ("", "Identity"),
    ("", "InstanceNormalization"),
    ("", "IsInf"),
    ("", "IsNaN"),
    ("", "LSTM"),
    ("", "LayerNormalization"),
    ("", "LeakyRelu"),
    ("", "Less"),
    ("", "LessOrEqual"),
    ("", "Log"),
    ("", "LogSoftmax"),
    ("", "MatMul"),
    ("", "Max"),
    ("", "MaxPool"),
    ("", "Mean"),
    ("", "Min"),
    ("", "Mish"),
    ("", "Mul"),
    ("", "Neg"),
    ("", "Not"),
    ("", "Or"),
    ("", "PRelu"),
    ("", "Pad"),
    ("", "Pow"),
    ("", "RNN"),
    ("", "Reciprocal"),
    ("", "ReduceL1"),
    ("", "ReduceL2"),
    ("", "ReduceLogSum"),
    ("", "ReduceMax"),
    ("", "ReduceMean"),
    ("", "ReduceMin"),
    ("", "ReduceProd"),
    ("", "ReduceSum"),
    ("", "ReduceSumSquare"),
    ("", "Relu"),
    ("", "Reshape"),
    ("", "Round"),
    ("", "Scan"),
    ("", "Selu"),
    ("", "Shape"),
    ("", "Sigmoid"),
    ("", "Sign"),
    ("", "Sin"),
    ("", "Slice"),
    ("", "Softmax"),
    ("", "Softplus"),
    ("", "Softsign"),
    ("", "Split"),
    ("", "Sqrt"),
    ("", "Squeeze"),
    ("", "Sub"),
    ("", "Sum"),
    ("", "Tanh"),
    ("", "ThresholdedRelu"),
    ("", "Tile"),
    ("", "Transpose"),
    ("", "Unsqueeze"),
    ("", "Where"),
    ("", "Xor"),
    (LEARNERS, "LinearClassifier"),
    (LEARNERS, "LinearRegressor"),
    (LEARNERS, "Normalizer"),
    (LEARNERS, "TreeEnsembleClassifier"),
];

/// The operators of the inference library that may take integers that depend on an input. They
/// compare them, change their type or move them. Others use integers as indices or lengths, or
/// divide by them.
const TAKES_ANY_INTEGER: [&str; 12] = [
    "AddAxis",
    "Cast",
    "Eq",
    "GT",
    "GTE",
    "LT",
    "LTE",
    "MoveAxis",
    "MultiBroadcastTo",
    "NE",
    "Reshape",
    "RmAxis",
];

/// Checks the operators of a graph as it is in the file.
pub(super) fn check_operators(graph: &pb::GraphProto) -> Result<(), ModelError> {
    for node in &graph.node {
        check_operator(node).map_err(|problem| {
            let name = match node.output.first() {
                Some(output) if node.name.is_empty() => output,
                _ => &node.name,
            };
            let operator = match node.domain.as_str() {
                "" | "ai.onnx" => node.op_type.clone(),
                domain => format!("{domain}.{}", node.op_type),
            };
            let operator = shown(&operator);
            let operator = operator.trim_matches('"');
            ModelError::Node {
                node: format!("{} ({operator})", shown(name)),
                problem,
            }
        })?;
        let mut attributes = node.attribute.iter();
        attributes.try_for_each(|attribute| attribute.g.iter().try_for_each(check_operators))?;
    }
    Ok(())
}

fn check_operator(node: &pb::NodeProto) -> Result<(), NodeProblem> {
    let domain = match node.domain.as_str() {
        "ai.onnx" => "",
        domain => domain,
    };
    let operator = node.op_type.as_str();
    if !OPERATORS.contains(&(domain, operator)) {
        return Err(NodeProblem::Operator);
    }
    match operator {
        "TreeEnsembleClassifier" => check_trees(node),
        "RNN" => check_recurrent(node, &[b"Tanh"]),
        "GRU" => check_recurrent(node, &[b"Sigmoid", b"Tanh"]),
        "LSTM" => check_recurrent(node, &[b"Sigmoid", b"Tanh", b"Tanh"]),
        "BatchNormalization" => check_default(node, "training_mode"),
        _ => Ok(()),
    }
}

fn attribute<'a>(node: &'a pb::NodeProto, name: &str) -> Option<&'a pb::AttributeProto> {
    let mut attributes = node.attribute.iter();
    attributes.find(|attribute| attribute.name == name)
}

/// Refuses a flag that the inference library ignores, if it is set.
fn check_default(node: &pb::NodeProto, name: &'static str) -> Result<(), NodeProblem> {
    match attribute(node, name) {
        Some(set) if set.i != 0 => Err(NodeProblem::Attribute(name)),
        _ => Ok(()),
    }
}

/// Refuses what the inference library ignores of a recurrent layer. It always computes with the
/// `usual` activations of each direction, and without `clip`.
fn check_recurrent(node: &pb::NodeProto, usual: &[&[u8]]) -> Result<(), NodeProblem> {
    if let Some(given) = attribute(node, "activations") {
        let mut directions = given.strings.chunks(usual.len());
        if !directions.all(|given| given == usual) {
            return Err(NodeProblem::Attribute("activations"));
        }
    }
    if attribute(node, "clip").is_some() {
        return Err(NodeProblem::Attribute("clip"));
    }
    check_default(node, "input_forget")
}

/// Checks a forest: nodes and votes as lists, tree after tree. The inference library follows the
/// indices in these lists unchecked, and writes to the place of a class unchecked. It checks the
/// number of features itself.
fn check_trees(node: &pb::NodeProto) -> Result<(), NodeProblem> {
    let list = |name| attribute(node, name).map_or(&[][..], |found| found.ints.as_slice());
    let texts = |name| attribute(node, name).map_or(&[][..], |found| found.strings.as_slice());
    let (trees, ids) = (list("nodes_treeids"), list("nodes_nodeids"));
    let (yes, no) = (list("nodes_truenodeids"), list("nodes_falsenodeids"));
    let modes = texts("nodes_modes");
    let (classes, class_trees) = (list("class_ids"), list("class_treeids"));
    let class_nodes = list("class_nodeids");
    let lists = [trees.len(), yes.len(), no.len(), modes.len()];
    let votes = [class_trees.len(), class_nodes.len()];
    if lists != [ids.len(); 4] || votes != [classes.len(); 2] {
        return Err(NodeProblem::TreeLists);
    }
    let mut sizes = HashMap::new();
    for (&tree, &id) in trees.iter().zip(ids) {
        let size = sizes.entry(tree).or_insert(0);
        if id != *size {
            return Err(NodeProblem::TreeOrder { tree, id });
        }
        *size += 1;
    }
    let mut leaves = HashSet::new();
    for (place, (&tree, &id)) in trees.iter().zip(ids).enumerate() {
        // A path that only goes forward has an end.
        let is_forward = |next: i64| id < next && next < sizes[&tree];
        match modes[place].as_slice() {
            b"LEAF" => drop(leaves.insert((tree, id))),
            // The inference library takes such a branch for a leaf.
            b"BRANCH_GTE" => return Err(NodeProblem::Attribute("nodes_modes")),
            _ if is_forward(yes[place]) && is_forward(no[place]) => {}
            _ => return Err(NodeProblem::TreeEnd { tree, id }),
        }
    }
    let labels = list("classlabels_int64s").len() + texts("classlabels_strings").len();
    for ((&class, &tree), &id) in classes.iter().zip(class_trees).zip(class_nodes) {
        let exists = usize::try_from(class).is_ok_and(|class| class < labels);
        if !exists || !leaves.contains(&(tree, id)) {
            return Err(NodeProblem::Vote { class, tree, id });
        }
    }
    Ok(())
}

/// Checks the graph as the inference library reads it: everything that depends on no input is
/// computed, and the type and the shape of each value are known.
pub(super) fn check_values(model: &TypedModel) -> Result<(), ModelError> {
    count_numbers(model, 0).map(|_| ())
}

/// Returns `numbers` and the numbers in the values of `model` and of its loops.
fn count_numbers(model: &TypedModel, mut numbers: usize) -> Result<usize, ModelError> {
    for node in model.nodes() {
        let refused = |problem| ModelError::Node {
            node: format!("{} ({})", shown(&node.name), node.op.name()),
            problem,
        };
        for output in &node.outputs {
            let shape = output.fact.shape.as_concrete();
            let shape = shape.ok_or_else(|| refused(NodeProblem::Shape))?;
            numbers = shape
                .iter()
                .try_fold(1_usize, |product, &length| product.checked_mul(length))
                .and_then(|product| product.checked_add(numbers))
                .filter(|&numbers| numbers <= MOST_NUMBERS)
                .ok_or_else(|| refused(NodeProblem::Numbers))?;
        }
        if !TAKES_ANY_INTEGER.contains(&&*node.op.name()) {
            for &input in &node.inputs {
                let fact = model.outlet_fact(input);
                let fact = fact.map_err(|error| ModelError::Graph(super::root_cause(&error)))?;
                let is_integer = fact.datum_type.is_integer() || fact.datum_type.is_tdim();
                if is_integer && fact.konst.is_none() {
                    return Err(refused(NodeProblem::Integers));
                }
            }
        }
        if let Some(scan) = node.op_as::<Scan>() {
            numbers = count_numbers(&scan.body, numbers)?;
        }
    }
    Ok(numbers)
}

#[cfg(test)]
mod tests;
