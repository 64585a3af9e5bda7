//! A recogniser as the bytes of an ONNX file.
//!
//! In: a graph from a model's inputs to logits, the temperature, the card, and checks with the trainer's
//! probabilities. Out: the file. Nothing here loads it.

use prost::Message as _;
use tract_onnx::pb;

use crate::learn::{Inputs, Outputs};
use crate::net::bins::{BINS, LIFTS};
use crate::net::course::{EMBEDDING, REFERENCES};
use crate::net::graph::{Graph, INPUT, RAW, value_info};
use hardnessd_core::frame::Array;
use hardnessd_core::verdict::features::FEATURES;
use hardnessd_core::verdict::parts::PARTS;
use hardnessd_core::verdict::{COLS, Card, Checks, MIN_OPSET, PIECE, ROWS};

/// The IR version that goes with opset 17.
const IR_VERSION: i64 = 8;

/// The file: the logits over the temperature, what follows from them, and the metadata.
///
/// # Errors
///
/// Fails if the metadata cannot be written as JSON.
pub fn bytes(
    graph: &Graph,
    outputs: &Outputs,
    temperature: f32,
    card: &Card,
    checks: &Checks,
) -> anyhow::Result<Vec<u8>> {
    let mut graph = graph.clone();
    let mut given = match outputs {
        Outputs::Levels => {
            graph.add(&format!("logits = Div({RAW}, {temperature})"));
            graph.add("probabilities = Softmax(logits, axis=1)");
            let levels = card.levels.len();
            vec![
                value_info("logits", &[1, levels]),
                value_info("probabilities", &[1, levels]),
            ]
        }
        Outputs::Bins { lifts, .. } => {
            graph.constant(LIFTS, &[1, BINS], lifts);
            graph.add(&format!("bins = Add(Div({RAW}, {temperature}), {LIFTS})"));
            vec![value_info("bins", &[1, BINS])]
        }
    };
    let features = value_info("features", &[1, FEATURES]);
    let taken = match graph.inputs {
        Inputs::Frame => vec![value_info(INPUT, &[1, 1, ROWS, COLS])],
        Inputs::Parts(Array { rows, cols }) => vec![value_info("parts", &[1, PARTS, rows, cols])],
        Inputs::Features => vec![features],
        Inputs::References => {
            given.push(value_info("reference", &[1, EMBEDDING]));
            vec![
                features,
                value_info("piece", &[1, PIECE]),
                value_info("references", &[1, REFERENCES, EMBEDDING]),
                value_info("given", &[1, REFERENCES]),
            ]
        }
    };
    let model = pb::ModelProto {
        ir_version: IR_VERSION,
        opset_import: vec![pb::OperatorSetIdProto {
            domain: String::new(),
            version: MIN_OPSET,
        }],
        producer_name: "hrn-train".to_owned(),
        producer_version: env!("CARGO_PKG_VERSION").to_owned(),
        graph: Some(pb::GraphProto {
            name: "hrn".to_owned(),
            node: graph.nodes,
            initializer: graph.constants,
            input: taken,
            output: given,
            ..Default::default()
        }),
        metadata_props: metadata(card, checks)?,
        ..Default::default()
    };
    Ok(model.encode_to_vec())
}

fn metadata(card: &Card, checks: &Checks) -> anyhow::Result<Vec<pb::StringStringEntryProto>> {
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
    if let Some(Array { rows, cols }) = card.grid {
        entries.push(("hrn.grid", format!("[{rows}, {cols}]")));
    }
    if let Some(conformal) = &card.conformal {
        entries.push(("hrn.conformal", serde_json::to_string(conformal)?));
    }
    let entry = |(key, value): (&str, String)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value,
    };
    Ok(entries.into_iter().map(entry).collect())
}
