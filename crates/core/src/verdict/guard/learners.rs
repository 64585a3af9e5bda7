//! Classic learners, from ONNX's domain `ai.onnx.ml`.
//!
//! The inference library follows trees without checking that a place exists. So every place that a
//! tree names is checked here.

use std::collections::HashMap;

use super::problem::Problem;
use super::{Computed, Datum, Node, Value, count};

/// The first input, which has to be rows of features, and its lengths.
fn rows<'a>(node: &'a Node<'_>) -> Result<(&'a Value, usize, usize), Problem> {
    let value = node.of(0, Datum::F32)?;
    match value.shape.as_slice() {
        &[rows, features] => Ok((value, rows, features)),
        _ => Err(Problem::Rows(value.into())),
    }
}

fn floats<'a>(node: &'a Node<'_>, name: &str) -> Option<&'a [f32]> {
    node.attribute(name).map(|found| found.floats.as_slice())
}

/// Scores of this shape, and their work. Each score takes `each` steps.
fn scores(rows: usize, columns: usize, each: u64) -> (Value, u64) {
    let value = Value::new(Datum::F32, vec![rows, columns]);
    let work = count(&value.shape).map_or(u64::MAX, |numbers| numbers.saturating_mul(each));
    (value, work)
}

pub(super) fn normalizer(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, _, _) = rows(node)?;
    Ok(Value::new(Datum::F32, value.shape.clone()).into())
}

pub(super) fn linear_regressor(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, rows, features) = rows(node)?;
    let targets = node.int("targets", 1) as usize;
    let coefficients = floats(node, "coefficients").unwrap_or_default().len();
    let intercepts = floats(node, "intercepts").map(<[f32]>::len);
    if features.checked_mul(targets) != Some(coefficients)
        || intercepts.is_some_and(|found| found != targets)
    {
        return Err(Problem::Coefficients {
            coefficients,
            lines: targets,
            of: "targets",
            value: value.into(),
        });
    }
    let (value, work) = scores(rows, targets, features as u64);
    Ok(Computed {
        values: vec![value],
        work,
    })
}

pub(super) fn linear_classifier(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, rows, features) = rows(node)?;
    let classes = node.ints("classlabels_ints").unwrap_or_default().len();
    let coefficients = floats(node, "coefficients").unwrap_or_default().len();
    let intercepts = floats(node, "intercepts").map(<[f32]>::len);
    // Two classes may share one line of coefficients.
    let one_line = classes == 2 && coefficients == features && node.int("multi_class", 0) == 0;
    let lines = if one_line { 1 } else { classes };
    if classes < 2
        || features.checked_mul(lines) != Some(coefficients)
        || intercepts.is_some_and(|found| found != lines)
        || (intercepts.is_none() && classes == 2 && !one_line)
    {
        return Err(Problem::Coefficients {
            coefficients,
            lines: classes,
            of: "classes",
            value: value.into(),
        });
    }
    let (scores, work) = scores(rows, classes, features as u64);
    Ok(Computed {
        values: vec![Value::new(Datum::I64, vec![rows]), scores],
        work,
    })
}

/// A forest: nodes and leaves as lists, tree after tree.
pub(super) fn trees(node: &Node<'_>) -> Result<Computed, Problem> {
    let (_, rows, features) = rows(node)?;
    let list = |name: &str| node.ints(name).unwrap_or_default();
    let classes = list("classlabels_int64s").len();
    if classes < 2 || floats(node, "base_values").is_some_and(|found| found.len() != classes) {
        return Err(Problem::Classes(classes));
    }
    let (ids, of_tree) = (list("nodes_nodeids"), list("nodes_treeids"));
    let (yes, no) = (list("nodes_truenodeids"), list("nodes_falsenodeids"));
    let feature = list("nodes_featureids");
    let modes = node
        .attribute("nodes_modes")
        .map(|found| found.strings.as_slice())
        .unwrap_or_default();
    let nodes = ids.len();
    let lengths = [
        of_tree.len(),
        yes.len(),
        no.len(),
        feature.len(),
        modes.len(),
        floats(node, "nodes_values").unwrap_or_default().len(),
        node.ints("nodes_missing_value_tracks_true")
            .map_or(nodes, <[i64]>::len),
    ];
    if nodes == 0 || lengths.iter().any(|&length| length != nodes) {
        return Err(Problem::TreeLists(nodes, lengths));
    }
    // Each tree's nodes must be 0, 1, 2, ... in order, so that the tree's size tells which exist.
    let mut sizes: Vec<i64> = Vec::new();
    for (&tree, &id) in of_tree.iter().zip(ids) {
        if tree == sizes.len() as i64 {
            sizes.push(0);
        }
        let last = sizes.len() as i64 - 1;
        match sizes.last_mut() {
            Some(size) if tree == last && id == *size => *size += 1,
            _ => return Err(Problem::TreeOrder { id, tree }),
        }
    }
    let mut leaves = HashMap::new();
    for place in 0..nodes {
        let (tree, id) = (of_tree[place], ids[place]);
        if modes[place] == b"LEAF" {
            leaves.insert((tree, id), ());
            continue;
        }
        let size = sizes[tree as usize];
        // A path that only goes forward has an end.
        let forward = |next: i64| id < next && next < size;
        if !forward(yes[place]) || !forward(no[place]) {
            return Err(Problem::TreeEnd { id, tree });
        }
        if feature[place] as u64 >= features as u64 {
            let feature = feature[place];
            return Err(Problem::TreeFeature {
                id,
                tree,
                feature,
                features,
            });
        }
    }
    let (vote_class, vote_node) = (list("class_ids"), list("class_nodeids"));
    let vote_tree = list("class_treeids");
    let votes = vote_class.len();
    let weights = floats(node, "class_weights").unwrap_or_default().len();
    if votes == 0 || [vote_node.len(), vote_tree.len(), weights] != [votes; 3] {
        return Err(Problem::VoteLists(votes));
    }
    for vote in 0..votes {
        let (tree, id) = (vote_tree[vote], vote_node[vote]);
        if vote_class[vote] as u64 >= classes as u64 || !leaves.contains_key(&(tree, id)) {
            let class = vote_class[vote];
            return Err(Problem::Vote { class, id, tree });
        }
    }
    let (scores, _) = scores(rows, classes, 0);
    Ok(Computed {
        values: vec![Value::new(Datum::I64, vec![rows]), scores],
        work: (rows as u64).saturating_mul((nodes + votes) as u64),
    })
}
