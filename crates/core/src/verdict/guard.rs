//! What a model's graph may contain.
//!
//! In: the graph, before and after the inference library reads it. Out: the first thing in it that
//! is not allowed. The library may panic, hang or fill the memory while it reads a graph or judges
//! the check frames. A trial in a child process (`crate::trial`) finds that, so nothing here does.
//! A trial cannot find what happens with another frame than the check frames. This module refuses
//! what the library would not survive then: indices and lengths that an input decides.

use std::collections::{HashMap, HashSet};

use tract_onnx::pb;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::ops::scan::Scan;

use super::error::{ModelError, RUNNING};
use super::file::shown;

/// Operators whose input decides which graph runs, and how often.
const RUN_GRAPHS: [&str; 3] = ["If", "Loop", "SequenceMap"];

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

/// Refuses the first operator that is not allowed, also in a graph within the graph.
pub(super) fn check_operators(graph: &pb::GraphProto) -> Result<(), ModelError> {
    for node in &graph.node {
        let checked = match node.op_type.as_str() {
            operator if RUN_GRAPHS.contains(&operator) => {
                Err("an operator that runs a graph as an input of the model says is not supported")
            }
            "TreeEnsembleClassifier" => check_trees(node),
            _ => Ok(()),
        };
        let name = match node.output.first() {
            Some(output) if node.name.is_empty() => output,
            _ => &node.name,
        };
        checked.map_err(|problem| refused(name, &node.op_type, problem))?;
        let mut inner = node
            .attribute
            .iter()
            .filter_map(|attribute| attribute.g.as_ref());
        inner.try_for_each(check_operators)?;
    }
    Ok(())
}

fn refused(node: &str, operator: &str, problem: &str) -> ModelError {
    let (node, operator) = (shown(node), shown(operator));
    let operator = operator.trim_matches('"');
    ModelError::new(format!("model node {node} ({operator}): {problem}"))
}

/// Checks a forest: nodes and votes as lists, tree after tree. The inference library follows the
/// indices in these lists unchecked, and writes to the place of a class unchecked. It checks the
/// number of features itself.
fn check_trees(node: &pb::NodeProto) -> Result<(), &'static str> {
    let attribute = |name| {
        let mut attributes = node.attribute.iter();
        attributes.find(|attribute| attribute.name == name)
    };
    let list = |name| attribute(name).map_or(&[][..], |found| found.ints.as_slice());
    let texts = |name| attribute(name).map_or(&[][..], |found| found.strings.as_slice());
    let (trees, ids) = (list("nodes_treeids"), list("nodes_nodeids"));
    let (yes, no) = (list("nodes_truenodeids"), list("nodes_falsenodeids"));
    let modes = texts("nodes_modes");
    let (classes, class_trees) = (list("class_ids"), list("class_treeids"));
    let class_nodes = list("class_nodeids");
    let lists = [trees.len(), yes.len(), no.len(), modes.len()];
    let votes = [class_trees.len(), class_nodes.len()];
    if lists != [ids.len(); 4] || votes != [classes.len(); 2] {
        return Err("the lists of its trees differ in length");
    }
    let mut sizes = HashMap::new();
    for (&tree, &id) in trees.iter().zip(ids) {
        let size = sizes.entry(tree).or_insert(0);
        if id != *size {
            return Err("the nodes of a tree are not in order");
        }
        *size += 1;
    }
    let mut leaves = HashSet::new();
    for (place, (&tree, &id)) in trees.iter().zip(ids).enumerate() {
        // A path that only goes forward has an end.
        let is_forward = |next: i64| id < next && next < sizes[&tree];
        match modes[place].as_slice() {
            b"LEAF" => drop(leaves.insert((tree, id))),
            _ if is_forward(yes[place]) && is_forward(no[place]) => {}
            _ => return Err("a branch leads to no later node of its tree"),
        }
    }
    let labels = list("classlabels_int64s").len() + texts("classlabels_strings").len();
    for ((&class, &tree), &id) in classes.iter().zip(class_trees).zip(class_nodes) {
        let exists = usize::try_from(class).is_ok_and(|class| class < labels);
        if !exists || !leaves.contains(&(tree, id)) {
            return Err("a vote is for a class or of a leaf that does not exist");
        }
    }
    Ok(())
}

/// Checks the graph as the inference library reads it: everything that depends on no input is
/// computed, and the type and the shape of each value are known. So each judgement takes as much memory
/// as the first one.
pub(super) fn check_values(model: &TypedModel) -> Result<(), ModelError> {
    for node in model.nodes() {
        let refused = |problem| Err(refused(&node.name, &node.op.name(), problem));
        let mut outputs = node.outputs.iter();
        if outputs.any(|output| output.fact.shape.as_concrete().is_none()) {
            return refused("the shape of its output depends on an input of the model");
        }
        if !TAKES_ANY_INTEGER.contains(&&*node.op.name()) {
            for &input in &node.inputs {
                let fact = model.outlet_fact(input).map_err(ModelError::of(RUNNING))?;
                let is_integer = fact.datum_type.is_integer() || fact.datum_type.is_tdim();
                if is_integer && fact.konst.is_none() {
                    return refused("it takes integers that depend on an input of the model");
                }
            }
        }
        if let Some(scan) = node.op_as::<Scan>() {
            check_values(&scan.body)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
