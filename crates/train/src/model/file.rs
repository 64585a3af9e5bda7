//! Writes a recogniser as an ONNX file and accepts it only if the daemon would.
//!
//! In: a [`Graph`] from newtons to logits, the temperature, the card, and check frames or presses
//! with the trainer's probabilities. Out: the bytes of the file, already read back through
//! [`verdict::Hrn`](hardnessd_core::verdict::Hrn), which refuses a file that does not reproduce its checks.

use std::collections::BTreeMap;

use anyhow::{Context as _, ensure};
use prost::Message as _;
use tract_onnx::pb;
use tract_onnx::prelude::Framework as _;

use crate::net::graph::{Graph, frame_input, integer, model, value_info};
use crate::net::unfolded::Unfolded;
use hardnessd_core::verdict::{COURSE_FRAMES, Card, Checks, Hrn, course_inputs};

/// The metadata key of [`Unfolded`].
const UNFOLDED: &str = "hrn.unfolded";

/// The outputs of a graph.
#[derive(Debug, Clone)]
pub struct Outputs {
    /// Name of the logits `[1, L]` in the graph, before temperature.
    pub raw_logits: String,
    /// The divisor of the logits.
    pub temperature: f32,
    /// Name of the Shore hardness `[1, 3]` in the graph, if it has one. A model of format 2 always
    /// has one.
    pub shore: Option<String>,
}

/// Writes the file: the logits over the temperature, their softmax, and the metadata. `unfolded` is
/// what further training needs beside the graph.
///
/// # Errors
///
/// Fails if the daemon's loader refuses the file, or reads another card from it.
pub fn write(
    mut graph: Graph,
    outputs: &Outputs,
    card: &Card,
    checks: &Checks,
    unfolded: Option<&Unfolded>,
) -> anyhow::Result<Vec<u8>> {
    let temperature = outputs.temperature;
    ensure!(
        temperature.is_finite() && temperature > 0.0,
        "temperature {temperature}: above 0"
    );
    let temperature = graph.constant("temperature", &[], &[temperature]);
    graph.node(
        "Div",
        &[&outputs.raw_logits, &temperature],
        "logits",
        Vec::new(),
    );
    graph.node(
        "Softmax",
        &["logits"],
        "probabilities",
        vec![integer("axis", 1)],
    );

    let levels = card.levels.len();
    let mut output = vec![
        value_info("logits", &[1, levels]),
        value_info("probabilities", &[1, levels]),
    ];
    output.extend(outputs.shore.iter().map(|name| value_info(name, &[1, 3])));
    let input = match checks {
        Checks::Frames(_) => vec![frame_input()],
        Checks::Courses(_) => course_inputs(COURSE_FRAMES.1)
            .iter()
            .map(|(name, dims)| value_info(name, dims))
            .collect(),
    };
    let mut metadata = metadata(card, checks)?;
    if let Some(unfolded) = unfolded {
        metadata.push(pb::StringStringEntryProto {
            key: UNFOLDED.to_owned(),
            value: serde_json::to_string(unfolded)?,
        });
    }
    let proto = model(graph, input, output, metadata);
    let bytes = proto.encode_to_vec();
    let read_back = Hrn::load(&bytes).context("the exported model does not pass the daemon's")?;
    ensure!(
        read_back.card() == card,
        "the exported model's card does not read back the same"
    );
    Ok(bytes)
}

pub(super) fn metadata(
    card: &Card,
    checks: &Checks,
) -> anyhow::Result<Vec<pb::StringStringEntryProto>> {
    let check = match checks {
        Checks::Frames(check) => serde_json::to_string(check)?,
        Checks::Courses(check) => serde_json::to_string(check)?,
    };
    let mut entries = vec![
        ("hrn.format", card.format.clone()),
        ("hrn.levels", serde_json::to_string(&card.levels)?),
        ("hrn.pitch_mm", card.pitch_mm.to_string()),
        ("hrn.method", card.method.clone()),
        ("hrn.data", card.data.clone()),
        ("hrn.metrics", serde_json::to_string(&card.metrics)?),
        ("hrn.validation", card.validation.clone()),
        ("hrn.range", serde_json::to_string(&card.range)?),
        ("hrn.check", check),
    ];
    if let Some(conformal) = &card.conformal {
        entries.push(("hrn.conformal", serde_json::to_string(conformal)?));
    }
    let entry = |(key, value): (&str, String)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value,
    };
    Ok(entries.into_iter().map(entry).collect())
}

/// Constants by name: the shape and the numbers of each.
pub type Constants = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn parsed(bytes: &[u8]) -> anyhow::Result<pb::ModelProto> {
    let mut reader = bytes;
    tract_onnx::onnx().proto_model_for_read(&mut reader)
}

/// The metadata `hrn.unfolded` of a file are damaged.
#[derive(Debug, thiserror::Error)]
#[error("hrn.unfolded: {0}")]
pub struct Damaged(serde_json::Error);

/// What a file that [`write()`] wrote has for further training beside its graph, if it has it.
///
/// # Errors
///
/// Fails if the bytes are not an ONNX model. Returns [`Damaged`] if the metadata are.
pub fn unfolded(bytes: &[u8]) -> anyhow::Result<Option<Unfolded>> {
    let entries = parsed(bytes)?.metadata_props;
    let entry = entries.iter().find(|entry| entry.key == UNFOLDED);
    let unfolded = entry.map(|entry| serde_json::from_str(&entry.value).map_err(Damaged));
    Ok(unfolded.transpose()?)
}

/// The f32 constants of a file that [`write()`] wrote.
///
/// # Errors
///
/// Fails if the bytes are not an ONNX model.
pub fn constants(bytes: &[u8]) -> anyhow::Result<Constants> {
    let tensors = parsed(bytes)?
        .graph
        .into_iter()
        .flat_map(|graph| graph.initializer);
    let floats =
        tensors.filter(|tensor| tensor.data_type == pb::tensor_proto::DataType::Float as i32);
    let constant = |tensor: pb::TensorProto| {
        let dims = tensor.dims.iter().map(|&length| length as usize).collect();
        let (numbers, _) = tensor.raw_data.as_chunks();
        let numbers = numbers.iter().map(|&bytes| f32::from_le_bytes(bytes));
        (tensor.name, (dims, numbers.collect()))
    };
    Ok(floats.map(constant).collect())
}
