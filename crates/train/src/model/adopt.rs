//! Makes a model that the daemon loads from an ONNX file of another program.
//!
//! In: the file, with a graph from newtons to logits or probabilities, and the data set that it
//! learnt from. Out: the same graph with the metadata, and its evaluation on the test split. Only
//! three things in the graph change: names, the batch size, and the last step between logits and
//! probabilities.

use anyhow::{Context as _, ensure};
use prost::Message as _;
use serde_json::json;
use tract_onnx::pb;

use super::evaluated::Evaluated;
use super::export;
use super::file;
use crate::data::dataset::{self, Dataset};
use crate::net::graph::{INPUT, frame_input, integer, value_info};
use hardnessd_core::trial;
use hardnessd_core::verdict::{
    COLS, COURSE_FRAMES, Card, Check, Checks, Hrn, ModelFrame, ROWS, course_inputs, describe,
};
use hardnessd_simulator::Split;

/// The least probability before a logarithm, because the file's probabilities may round to 0.
const LEAST_PROBABILITY: f32 = 1e-30;

/// The reason a graph cannot be adopted.
#[derive(Debug, thiserror::Error)]
pub enum Foreign {
    /// The file is not an ONNX model.
    #[error("not an ONNX model: {0}")]
    NotOnnx(String),
    /// The inputs differ from one frame.
    #[error("inputs: found {found}, expected one, f32 [1,1,{ROWS},{COLS}]")]
    Inputs {
        /// The file's inputs or outputs, with type and shape.
        found: String,
    },
    /// The inputs are those of format 2.
    #[error(
        "inputs: found {found}, those of the course of a press (format 2): adopt takes models of one \
         frame; docs/formats.md says how to write the metadata yourself"
    )]
    OfCourse {
        /// The file's inputs, with type and shape.
        found: String,
    },
    /// No output of the expected shape is called `logits` or `probabilities`, or both differ in
    /// their number of levels.
    #[error(
        "outputs: found {found}, expected `logits` or `probabilities` or both, f32 [1,L], by these \
         names"
    )]
    Outputs {
        /// The file's inputs or outputs, with type and shape.
        found: String,
    },
}

/// What the user states about a model besides its data.
#[derive(Debug, Clone)]
pub struct Stated {
    /// The value of `hrn.method`.
    pub method: String,
    /// The value of `hrn.validation`. `None` derives it from the origin of the data.
    pub validation: Option<String>,
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

/// Gives the graph the agreed input and outputs: their names, a batch of one, and whichever of
/// logits and probabilities is missing. Returns a list of the changes and the number of levels.
///
/// # Errors
///
/// Returns [`Foreign::Inputs`] or [`Foreign::Outputs`] if the inputs or outputs are not recognised.
pub fn mend(proto: &mut pb::ModelProto) -> Result<(Vec<String>, usize), Foreign> {
    let mut done = Vec::new();
    mend_input(proto, &mut done)?;
    let levels = mend_outputs(proto, &mut done)?;
    Ok((done, levels))
}

/// The inputs of a graph. Before ONNX IR 4, its weights are also listed among the inputs.
fn inputs(graph: &pb::GraphProto) -> impl Iterator<Item = &pb::ValueInfoProto> {
    let is_weight = |name: &str| graph.initializer.iter().any(|tensor| tensor.name == name);
    let inputs = graph.input.iter();
    inputs.filter(move |input| !is_weight(&input.name))
}

/// Whether an input has the name of one of format 2.
pub(super) fn has_course_inputs(proto: &pb::ModelProto) -> bool {
    let of_course = course_inputs(COURSE_FRAMES.1).map(|(name, _)| name);
    let mut inputs = proto.graph.iter().flat_map(inputs);
    inputs.any(|input| of_course.contains(&input.name.as_str()))
}

/// Mends the input only, and adds the changes to `done`.
pub(super) fn mend_input(
    proto: &mut pb::ModelProto,
    done: &mut Vec<String>,
) -> Result<(), Foreign> {
    let is_of_course = has_course_inputs(proto);
    let graph = proto.graph.get_or_insert_default();
    let inputs: Vec<&pb::ValueInfoProto> = inputs(graph).collect();
    let found = || describe(&inputs);
    if is_of_course {
        return Err(Foreign::OfCourse { found: found() });
    }
    let [input] = inputs[..] else {
        return Err(Foreign::Inputs { found: found() });
    };
    match dims(input).as_deref() {
        Some([batch, Some(1), Some(rows), Some(cols)])
            if batch.is_none_or(|batch| batch == 1) && (*rows, *cols) == (ROWS, COLS) =>
        {
            if batch.is_none() {
                done.push(format!("input {:?}: a batch of one", input.name));
            }
        }
        _ => return Err(Foreign::Inputs { found: found() }),
    }
    let name = input.name.clone();
    graph.input = vec![frame_input()];
    if name != INPUT {
        done.push(format!("input {name:?}: it is called `{INPUT}`"));
        graph.node.insert(0, node("Identity", &[INPUT], &name));
    }
    Ok(())
}

/// Mends the outputs only, and adds the changes to `done`. Returns the number of levels.
pub(super) fn mend_outputs(
    proto: &mut pb::ModelProto,
    done: &mut Vec<String>,
) -> Result<usize, Foreign> {
    let graph = proto.graph.get_or_insert_default();
    let outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    let found = describe(&outputs);
    let levels_of = |name: &str| {
        let output = outputs.iter().find(|output| output.name == name)?;
        match dims(output).as_deref() {
            Some([batch, Some(levels)]) if batch.is_none_or(|batch| batch == 1) => Some(*levels),
            _ => None,
        }
    };
    let others = outputs
        .iter()
        .map(|output| &output.name)
        .filter(|name| !["logits", "probabilities"].contains(&name.as_str()));
    done.extend(others.map(|name| format!("output {name:?}: left out")));
    let levels = match (levels_of("logits"), levels_of("probabilities")) {
        (Some(levels), Some(same)) if levels == same => levels,
        (Some(levels), None) => {
            done.push("output `probabilities`: the softmax of `logits`".to_owned());
            let mut softmax = node("Softmax", &["logits"], "probabilities");
            softmax.attribute.push(integer("axis", 1));
            graph.node.push(softmax);
            levels
        }
        (None, Some(levels)) => {
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
    graph.output = ["logits", "probabilities"]
        .map(|name| value_info(name, &[1, levels]))
        .to_vec();
    Ok(levels)
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

/// Sets the metadata of a file, replacing all its `hrn.` keys.
pub(super) fn set(proto: &mut pb::ModelProto, card: &Card, checks: &Checks) -> anyhow::Result<()> {
    proto
        .metadata_props
        .retain(|entry| !entry.key.starts_with("hrn."));
    proto.metadata_props.extend(file::metadata(card, checks)?);
    Ok(())
}

/// Adopts a file. Returns the file with its metadata, the changes in its graph, and its evaluation
/// on the test split if the data set has one. The daemon's own inference library computes the
/// probabilities of the check frames here, after a child process has tried the file.
///
/// # Errors
///
/// Fails if the inputs or outputs of the graph are not recognised, it has another number of levels
/// than the data set, the data set has no labelled training samples, or the daemon's loader refuses
/// the file.
pub fn adopt(
    bytes: &[u8],
    dataset: &Dataset,
    stated: &Stated,
) -> anyhow::Result<(Vec<u8>, Vec<String>, Option<Evaluated>)> {
    let mut proto = decode(bytes)?;
    let (done, found) = mend(&mut proto)?;
    let levels = dataset::stated_levels(&dataset.path())?;
    let expected = levels.len();
    ensure!(
        found == expected,
        "outputs: found {found} levels, expected {expected}, those of the data set"
    );
    let train = dataset.labelled(Split::Train)?;
    let learnt = train.iter().map(|&index| dataset.samples[index].frame);
    let mut card = Card {
        format: "1".to_owned(),
        levels,
        pitch_mm: dataset.pitch_mm() as f32,
        method: stated.method.clone(),
        data: export::data(&dataset.sources)?,
        metrics: json!({}),
        validation: stated
            .validation
            .clone()
            .unwrap_or_else(|| export::validation(&dataset.sources).to_owned()),
        range: export::range(learnt),
        conformal: None,
    };
    let frames = export::check_frames(dataset, &train);
    let mut check = Check {
        frames: frames.iter().map(|frame| frame.newtons.to_vec()).collect(),
        probabilities: vec![vec![0.0; expected]; frames.len()],
    };
    set(&mut proto, &card, &Checks::Frames(check.clone()))?;
    let unchecked = proto.encode_to_vec();
    trial::survives(&unchecked)?;
    let hrn = Hrn::read(&unchecked)?;
    let computed = |frame: &&ModelFrame| Ok(hrn.judge(frame)?.probabilities);
    let computed: anyhow::Result<Vec<Vec<f32>>> = frames.iter().map(computed).collect();
    check.probabilities = computed?;
    let evaluation = match dataset.labelled(Split::Test) {
        Ok(test) => Some(export::evaluate(&hrn, dataset, &test)?),
        Err(_) => None,
    };
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation.levels);
    }
    set(&mut proto, &card, &Checks::Frames(check))?;
    let adopted = proto.encode_to_vec();
    Hrn::load(&adopted).context("the adopted model")?;
    Ok((adopted, done, evaluation))
}
