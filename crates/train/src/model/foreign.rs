//! Makes the graph of another program's ONNX file that of a model of one frame.
//!
//! In: the file, as skl2onnx, PyTorch, Keras and others write it. Out: the same with the agreed input,
//! outputs and opset, and with operators that the daemon runs, or the reason why not. What changes in
//! the graph never changes its probabilities: names, the batch size, the shape of the input, the last
//! step between logits and probabilities, the number of the opset, and the operators of learners.

use std::collections::HashSet;

use prost::Message as _;
use tract_onnx::pb;

use super::learners::{self, LEARNERS, Learner};
use crate::net::graph::{INPUT, frame_input, integer, value_info};
use hardnessd_core::verdict::{
    COLS, COURSE_FRAMES, Level, MIN_OPSET, ROWS, TAXELS, course_inputs, describe,
};

/// The least probability before a logarithm, because the file's probabilities may round to 0.
const LEAST_PROBABILITY: f32 = 1e-30;
/// The agreed outputs.
const AGREED: [&str; 2] = ["logits", "probabilities"];
/// The largest difference of a sum of probabilities from 1.
const SUM_TOLERANCE: f32 = 1e-3;

/// The operators that meant something else before [`STABLE_OPSET`].
const CHANGED: [&str; 11] = [
    "Clip",
    "Dropout",
    "LogSoftmax",
    "Pad",
    "ReduceSum",
    "Scan",
    "Slice",
    "Softmax",
    "Split",
    "Squeeze",
    "Unsqueeze",
];
/// From this opset to [`MIN_OPSET`], no operator that the daemon runs changed its meaning.
const STABLE_OPSET: i64 = 13;
/// From this opset on, only [`CHANGED`] operators changed their meaning.
const FIRST_OPSET: i64 = 9;

/// The reason a graph cannot be adopted.
#[derive(Debug, thiserror::Error)]
pub enum Foreign {
    /// The file is not an ONNX model.
    #[error("not an ONNX model: {0}")]
    NotOnnx(String),
    /// The opset is older than the daemon takes, and its operators changed since.
    #[error(
        "opset {found}: {operator} changed since: export with opset {MIN_OPSET} (skl2onnx: \
         `target_opset={MIN_OPSET}`, PyTorch: `opset_version={MIN_OPSET}`, tf2onnx: `--opset {MIN_OPSET}`)"
    )]
    Opset {
        /// The version in the file.
        found: i64,
        /// The operator that changed.
        operator: String,
    },
    /// The inputs differ from one frame.
    #[error(
        "inputs: found {found}, expected one, f32 [N,{TAXELS}], [N,{ROWS},{COLS}], [N,1,{ROWS},{COLS}] or \
         [N,{ROWS},{COLS},1]"
    )]
    Inputs {
        /// The file's inputs, with type and shape.
        found: String,
    },
    /// The input has numbers of another type.
    #[error(
        "inputs: found {found}, expected f32 (skl2onnx: `to_onnx(model, X[:1].astype(numpy.float32))`)"
    )]
    NotFloat {
        /// The file's inputs, with type and shape.
        found: String,
    },
    /// The inputs are those of format 2 or 3.
    #[error(
        "inputs: found {found}, those of the course of a press (format 2 or 3): adopt takes models of one \
         frame; docs/formats.md says how to write the metadata yourself"
    )]
    OfCourse {
        /// The file's inputs, with type and shape.
        found: String,
    },
    /// Nothing says which output has the logits or the probabilities, or both differ in their number
    /// of levels.
    #[error(
        "outputs: found {found}, expected `logits` or `probabilities` or both, f32 [1,L], by these \
         names (PyTorch: `output_names=[\"logits\"]`; Keras: end the model in a softmax; skl2onnx: no \
         options for the outputs)"
    )]
    Outputs {
        /// The file's outputs, with type and shape.
        found: String,
    },
    /// The file does not say which column of the probabilities belongs to which text.
    #[error(
        "outputs: found {found}: the classes are texts, and their order is not in the file: export \
         without the option `zipmap`"
    )]
    Texts {
        /// The file's outputs, with type and shape.
        found: String,
    },
    /// The classes are not the levels.
    #[error("outputs: found the classes {found}, expected {expected}, the levels of the data set")]
    Classes {
        /// The classes in the file.
        found: String,
        /// The labels of the levels.
        expected: String,
    },
    /// The probabilities are none.
    #[error(
        "outputs: `probabilities` of a check frame add up to {sum}, expected 1: these are scores \
         (scikit-learn: fit the model in a `CalibratedClassifierCV`, or `SVC` with `probability=True`)"
    )]
    Scores {
        /// The sum of the numbers of a check frame.
        sum: f32,
    },
    /// A learner of `ai.onnx.ml` that plain operators cannot replace.
    #[error(transparent)]
    Learner(#[from] Learner),
}

/// Reads an ONNX file.
///
/// # Errors
///
/// Returns [`Foreign::NotOnnx`] if the bytes are not an ONNX model with a graph.
pub fn decode(bytes: &[u8]) -> Result<pb::ModelProto, Foreign> {
    let proto = pb::ModelProto::decode(bytes);
    let proto = proto.map_err(|error| Foreign::NotOnnx(error.to_string()))?;
    match &proto.graph {
        Some(_) if proto.ir_version > 0 => Ok(proto),
        _ => Err(Foreign::NotOnnx("no graph in it".to_owned())),
    }
}

/// Gives the graph the agreed input and outputs and the agreed opset, and replaces the operators of
/// classic learners. Returns a list of the changes and the number of levels. The columns of a ZipMap
/// come into the order of `levels`.
///
/// # Errors
///
/// Returns a [`Foreign`] for the first part that is not recognised.
pub fn mend(proto: &mut pb::ModelProto, levels: &[Level]) -> Result<(Vec<String>, usize), Foreign> {
    if has_course_inputs(proto) {
        let graph = proto.graph.get_or_insert_default();
        let found = found_inputs(graph);
        return Err(Foreign::OfCourse { found });
    }
    let mut done = Vec::new();
    let found = mend_outputs(proto, Some(levels), &mut done)?;
    mend_opset(proto, &mut done)?;
    mend_nodes(proto, &mut done)?;
    mend_input(proto, &mut done)?;
    Ok((done, found))
}

/// The inputs of a graph. Before ONNX IR 4, its weights are also listed among the inputs.
fn inputs(graph: &pb::GraphProto) -> impl Iterator<Item = &pb::ValueInfoProto> {
    let is_weight = |name: &str| graph.initializer.iter().any(|tensor| tensor.name == name);
    let inputs = graph.input.iter();
    inputs.filter(move |input| !is_weight(&input.name))
}

/// The inputs with type and shape, for a message.
fn found_inputs(graph: &pb::GraphProto) -> String {
    let inputs: Vec<&pb::ValueInfoProto> = inputs(graph).collect();
    match inputs.len() {
        0..=8 => describe(&inputs),
        many => format!("{many} inputs, {} and others", describe(&inputs[..1])),
    }
}

/// Whether one of several inputs has the name of one of format 2 or 3.
pub(super) fn has_course_inputs(proto: &pb::ModelProto) -> bool {
    let of_course = course_inputs(COURSE_FRAMES.1);
    let inputs: Vec<_> = proto.graph.iter().flat_map(inputs).collect();
    let is_of_course =
        |input: &&pb::ValueInfoProto| of_course.iter().any(|(name, _)| *name == input.name);
    inputs.len() > 1 && inputs.iter().any(is_of_course)
}

/// Claims the oldest opset that the daemon takes, if the operators mean the same in it.
pub(super) fn mend_opset(
    proto: &mut pb::ModelProto,
    done: &mut Vec<String>,
) -> Result<(), Foreign> {
    let is_plain = |domain: &str| ["", "ai.onnx"].contains(&domain);
    let nodes = proto.graph.iter().flat_map(|graph| &graph.node);
    let mut plain = nodes.filter(|node| is_plain(&node.domain));
    let mut sets = proto.opset_import.iter_mut();
    let Some(set) = sets.find(|set| is_plain(&set.domain)) else {
        // A graph of learners alone needs no opset of plain operators.
        if plain.next().is_none() {
            proto.opset_import.push(pb::OperatorSetIdProto {
                version: MIN_OPSET,
                ..Default::default()
            });
            done.push(format!("opset: it is {MIN_OPSET}"));
        }
        return Ok(());
    };
    let found = set.version;
    if found >= MIN_OPSET {
        return Ok(());
    }
    let is_changed = |operator: &str| {
        found < FIRST_OPSET || (found < STABLE_OPSET && CHANGED.contains(&operator))
    };
    if let Some(node) = plain.find(|node| is_changed(&node.op_type)) {
        return Err(Foreign::Opset {
            found,
            operator: node.op_type.clone(),
        });
    }
    set.version = MIN_OPSET;
    done.push(format!(
        "opset {found}: it is {MIN_OPSET}, with the same operators"
    ));
    Ok(())
}

/// Replaces the operators of classic learners, and adds the changes to `done`.
pub(super) fn mend_nodes(
    proto: &mut pb::ModelProto,
    done: &mut Vec<String>,
) -> Result<(), Foreign> {
    let mut sets = proto.opset_import.iter();
    let plain = sets.find(|set| ["", "ai.onnx"].contains(&set.domain.as_str()));
    let opset = plain.map_or(MIN_OPSET, |set| set.version);
    let graph = proto.graph.get_or_insert_default();
    let replaced = learners::replace(graph, opset)?;
    if !replaced.is_empty() {
        keep_needed(graph);
    }
    let replaced = replaced.into_iter();
    done.extend(replaced.map(|operator| format!("operator {operator}: replaced by plain ones")));
    Ok(())
}

/// Mends the input only, and adds the changes to `done`.
pub(super) fn mend_input(
    proto: &mut pb::ModelProto,
    done: &mut Vec<String>,
) -> Result<(), Foreign> {
    let graph = proto.graph.get_or_insert_default();
    let inputs: Vec<&pb::ValueInfoProto> = inputs(graph).collect();
    let found = found_inputs(graph);
    let [input] = inputs[..] else {
        return Err(Foreign::Inputs { found });
    };
    let Some(shape) = dims(input) else {
        return Err(Foreign::NotFloat { found });
    };
    let name = input.name.clone();
    // A frame row by row, with any axes of length 1.
    let is_frame = match &shape[..] {
        [None | Some(1), rest @ ..] => {
            let rest: Vec<Option<usize>> = rest
                .iter()
                .copied()
                .filter(|&length| length != Some(1))
                .collect();
            rest == [Some(TAXELS)] || rest == [Some(ROWS), Some(COLS)]
        }
        _ => false,
    };
    if !is_frame {
        return Err(Foreign::Inputs { found });
    }
    if shape[0].is_none() {
        done.push(format!("input {name:?}: a batch of one"));
    }
    graph.input = vec![frame_input()];
    let agreed = [1, 1, ROWS, COLS];
    let lengths: Vec<usize> = shape.iter().map(|length| length.unwrap_or(1)).collect();
    if name == INPUT && lengths == agreed {
        return Ok(());
    }
    // The other nodes read the input by its old name, or by a new one if it has ours.
    rename(graph, INPUT, "frame/file");
    let old = match name.as_str() {
        INPUT => "frame/file",
        other => other,
    };
    if name != INPUT {
        done.push(format!("input {name:?}: it is called `{INPUT}`"));
    }
    if lengths == agreed {
        graph.node.insert(0, node("Identity", &[INPUT], old));
    } else {
        done.push(format!(
            "input {name:?}: the frame in the shape {lengths:?}"
        ));
        let shape = "frame/shape";
        let lengths: Vec<i64> = lengths.iter().map(|&length| length as i64).collect();
        graph.initializer.push(indices(shape, lengths));
        graph.node.insert(0, node("Reshape", &[INPUT, shape], old));
    }
    Ok(())
}

/// Mends the outputs only, and adds the changes to `done`. Removes the nodes that no output needs.
/// Returns the number of levels. Without `levels`, the columns of a ZipMap stay in their order.
pub(super) fn mend_outputs(
    proto: &mut pb::ModelProto,
    levels: Option<&[Level]>,
    done: &mut Vec<String>,
) -> Result<usize, Foreign> {
    let graph = proto.graph.get_or_insert_default();
    let outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    let found = describe(&outputs);
    let has_texts = outputs.iter().any(|output| is_text(output));
    let is_agreed = |output: &pb::ValueInfoProto| AGREED.contains(&output.name.as_str());
    if !take_zip_map(graph, levels, done)? {
        if has_texts {
            return Err(Foreign::Texts { found });
        }
        if !graph.output.iter().any(is_agreed) {
            take_softmax(graph, done);
        }
    }
    let outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    let levels_of = |name: &str| {
        let output = outputs.iter().find(|output| output.name == name)?;
        levels_in(output)
    };
    let others = outputs.iter().filter(|output| !is_agreed(output));
    done.extend(others.map(|output| format!("output {:?}: left out", output.name)));
    let levels = match AGREED.map(levels_of) {
        [Some(levels), Some(same)] if levels == same => levels,
        [Some(levels), None] => {
            rename(graph, "probabilities", "probabilities/file");
            done.push("output `probabilities`: the softmax of `logits`".to_owned());
            let mut softmax = node("Softmax", &["logits"], "probabilities");
            softmax.attribute.push(integer("axis", 1));
            graph.node.push(softmax);
            levels
        }
        [None, Some(levels)] => {
            rename(graph, "logits", "logits/file");
            done.push("output `logits`: the logarithm of `probabilities`".to_owned());
            let least = "hrn.least_probability";
            graph.initializer.push(pb::TensorProto {
                name: least.to_owned(),
                data_type: pb::tensor_proto::DataType::Float as i32,
                float_data: vec![LEAST_PROBABILITY],
                ..Default::default()
            });
            let above = "hrn.above_least";
            graph
                .node
                .push(node("Max", &["probabilities", least], above));
            graph.node.push(node("Log", &[above], "logits"));
            levels
        }
        _ => return Err(Foreign::Outputs { found }),
    };
    graph.output = AGREED.map(|name| value_info(name, &[1, levels])).to_vec();
    keep_needed(graph);
    Ok(levels)
}

/// Takes the probabilities of a ZipMap, a list of pairs of class and probability, for the output
/// `probabilities`. Returns whether there is one.
fn take_zip_map(
    graph: &mut pb::GraphProto,
    levels: Option<&[Level]>,
    done: &mut Vec<String>,
) -> Result<bool, Foreign> {
    let is_output = |name: &String| graph.output.iter().any(|output| output.name == *name);
    let place = graph.node.iter().position(|node| {
        node.op_type == "ZipMap" && node.domain == LEARNERS && node.output.iter().any(is_output)
    });
    let Some(place) = place else {
        return Ok(false);
    };
    let zip_map = graph.node.remove(place);
    let (Some(from), Some(to)) = (zip_map.input.first(), zip_map.output.first()) else {
        return Ok(false);
    };
    let mut columns = Vec::new();
    for attribute in &zip_map.attribute {
        columns.extend(attribute.ints.iter().map(i64::to_string));
        let texts = attribute.strings.iter();
        columns.extend(texts.map(|text| String::from_utf8_lossy(text).into_owned()));
    }
    done.push(format!(
        "output {to:?}: `probabilities`, without their ZipMap"
    ));
    graph.output.retain(|output| output.name != *to);
    graph
        .output
        .push(value_info("probabilities", &[1, columns.len()]));
    let order = levels.map(|levels| order(&columns, levels)).transpose()?;
    rename(graph, "probabilities", "probabilities/file");
    let from = match from.as_str() {
        "probabilities" => "probabilities/file",
        other => other,
    };
    let Some(order) = order.filter(|order| !order.is_sorted()) else {
        rename(graph, from, "probabilities");
        return Ok(true);
    };
    done.push("output `probabilities`: the columns in the order of the levels".to_owned());
    let which = "probabilities/order";
    graph.initializer.push(indices(which, order));
    let mut gather = node("Gather", &[from, which], "probabilities");
    gather.attribute.push(integer("axis", 1));
    graph.node.push(gather);
    Ok(true)
}

/// The column of each level. The classes are the numbers of the levels, from 1 or from 0, or their
/// labels.
fn order(columns: &[String], levels: &[Level]) -> Result<Vec<i64>, Foreign> {
    let place = |name: &str| columns.iter().position(|column| column == name);
    let all = |name: &dyn Fn(&Level) -> String| {
        let places = levels.iter().map(|level| place(&name(level)));
        places
            .map(|place| Some(place? as i64))
            .collect::<Option<Vec<i64>>>()
    };
    let found = all(&|level| level.level.to_string())
        .or_else(|| all(&|level| (i64::from(level.level) - 1).to_string()))
        .or_else(|| all(&|level| level.label.clone()));
    match found {
        Some(order) if order.len() == columns.len() => Ok(order),
        _ => {
            let labels = levels.iter().map(|level| level.label.as_str());
            let expected = format!(
                "1 to {}, 0 to {} or {}",
                levels.len(),
                levels.len().saturating_sub(1),
                labels.collect::<Vec<_>>().join(", ")
            );
            let found = columns.iter().take(16).cloned().collect::<Vec<_>>();
            Err(Foreign::Classes {
                found: found.join(", "),
                expected,
            })
        }
    }
}

/// Takes the only output of numbers for `probabilities`, if a softmax computes it.
fn take_softmax(graph: &mut pb::GraphProto, done: &mut Vec<String>) {
    let of_levels = |output: &&pb::ValueInfoProto| levels_in(output).is_some();
    let mut found = graph.output.iter().filter(of_levels);
    let (Some(output), None) = (found.next(), found.next()) else {
        return;
    };
    let output = output.name.clone();
    let by = |name: &str| {
        let mut nodes = graph.node.iter();
        nodes.find(|node| node.output.iter().any(|output| output == name))
    };
    let mut source = by(&output);
    // A broken file may have a ring of them.
    for _ in 0..graph.node.len() {
        match source {
            Some(node) if node.op_type == "Identity" => {
                source = node.input.first().and_then(|input| by(input));
            }
            _ => break,
        }
    }
    if source.is_none_or(|node| node.op_type != "Softmax") {
        return;
    }
    done.push(format!("output {output:?}: it is called `probabilities`"));
    rename(graph, "probabilities", "probabilities/file");
    rename(graph, &output, "probabilities");
    for value in &mut graph.output {
        if value.name == output {
            "probabilities".clone_into(&mut value.name);
        }
    }
}

/// Renames a value inside a graph and its loops.
fn rename(graph: &mut pb::GraphProto, from: &str, to: &str) {
    for tensor in &mut graph.initializer {
        if tensor.name == from {
            to.clone_into(&mut tensor.name);
        }
    }
    for node in &mut graph.node {
        for name in node.input.iter_mut().chain(&mut node.output) {
            if name == from {
                to.clone_into(name);
            }
        }
        for inner in node
            .attribute
            .iter_mut()
            .filter_map(|found| found.g.as_mut())
        {
            rename(inner, from, to);
        }
    }
}

/// Removes the nodes and constants that no output needs, such as those that compute a label.
fn keep_needed(graph: &mut pb::GraphProto) {
    fn add(needed: &mut HashSet<String>, node: &pb::NodeProto) {
        needed.extend(node.input.iter().cloned());
        let inner = node.attribute.iter().filter_map(|found| found.g.as_ref());
        for graph in inner {
            needed.extend(graph.output.iter().map(|output| output.name.clone()));
            graph.node.iter().for_each(|node| add(needed, node));
        }
    }
    let outputs = graph.output.iter().map(|output| output.name.clone());
    let mut needed: HashSet<String> = outputs.collect();
    // ONNX lists a node after those that it reads from.
    let mut kept: Vec<pb::NodeProto> = Vec::new();
    for node in std::mem::take(&mut graph.node).into_iter().rev() {
        if node.output.iter().any(|output| needed.contains(output)) {
            add(&mut needed, &node);
            kept.push(node);
        }
    }
    kept.reverse();
    graph.node = kept;
    // An input that is also a weight stays one.
    graph.initializer.retain(|tensor| {
        needed.contains(&tensor.name) || graph.input.iter().any(|input| input.name == tensor.name)
    });
    // The file's types of these values may be those of others now.
    graph.value_info.clear();
}

fn node(operator: &str, inputs: &[&str], output: &str) -> pb::NodeProto {
    pb::NodeProto {
        name: format!("hrn.{output}"),
        op_type: operator.to_owned(),
        input: inputs.iter().map(|&name| name.to_owned()).collect(),
        output: vec![output.to_owned()],
        ..Default::default()
    }
}

fn indices(name: &str, values: Vec<i64>) -> pb::TensorProto {
    pb::TensorProto {
        name: name.to_owned(),
        data_type: pb::tensor_proto::DataType::Int64 as i32,
        dims: vec![values.len() as i64],
        int64_data: values,
        ..Default::default()
    }
}

/// The levels of an f32 value `[1, L]`, with any batch.
fn levels_in(output: &pb::ValueInfoProto) -> Option<usize> {
    match dims(output).as_deref() {
        Some([batch, Some(levels)]) if batch.is_none_or(|batch| batch == 1) => Some(*levels),
        _ => None,
    }
}

fn is_text(value: &pb::ValueInfoProto) -> bool {
    let Some(pb::type_proto::Value::TensorType(tensor)) =
        value.r#type.as_ref().and_then(|found| found.value.as_ref())
    else {
        return false;
    };
    tensor.elem_type == pb::tensor_proto::DataType::String as i32
}

/// The dimensions of an f32 value, each `None` where the file leaves it open. `None` for a value of
/// another type.
fn dims(value: &pb::ValueInfoProto) -> Option<Vec<Option<usize>>> {
    use pb::tensor_shape_proto::dimension::Value;
    let Some(pb::type_proto::Value::TensorType(tensor)) = &value.r#type.as_ref()?.value else {
        return None;
    };
    (tensor.elem_type == pb::tensor_proto::DataType::Float as i32).then_some(())?;
    let dims = tensor.shape.as_ref()?.dim.iter();
    Some(
        dims.map(|dim| match dim.value {
            Some(Value::DimValue(length)) => usize::try_from(length).ok().filter(|&l| l > 0),
            _ => None,
        })
        .collect(),
    )
}

/// Refuses rows that do not add up to 1.
pub(super) fn check_sums(probabilities: &[Vec<f32>]) -> Result<(), Foreign> {
    let mut sums = probabilities.iter().map(|row| row.iter().sum::<f32>());
    match sums.find(|sum| (sum - 1.0).abs() > SUM_TOLERANCE) {
        Some(sum) => Err(Foreign::Scores { sum }),
        None => Ok(()),
    }
}
