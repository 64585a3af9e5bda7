//! A model of courses whose probabilities tell its inputs.
//!
//! The logits of levels 1 to 3 are 0, a tenth of the greatest force of a frame, and the last time in
//! seconds. Those of levels 4 to 6 are the sum of the known approach, the number of frames and the arm's
//! stiffness, each divided by 100 and far below the others, so that these levels are never likely.

use prost::Message as _;
use serde_json::{Value, json};
use tract_onnx::pb;

use super::graph::{indices, int, ints, node, number, value};

/// How far the last three logits are below the others.
const NEVER: f32 = 50.0;

/// The file for presses of `most` frames, for `Model::read`. `more` adds or replaces metadata.
pub(crate) fn course_model(most: usize, more: &[(&str, Value)]) -> Vec<u8> {
    encoded(most, more, |_| {})
}

/// The same file, changed by a closure.
pub(crate) fn encoded(
    most: usize,
    more: &[(&str, Value)],
    change: impl FnOnce(&mut pb::ModelProto),
) -> Vec<u8> {
    let level = |level: u8| json!({"level": level, "label": format!("l{level}"), "shore": "any"});
    let mut metadata = vec![
        ("hrn.format", json!("3")),
        ("hrn.pitch_mm", json!("3.5")),
        ("hrn.method", json!("sums")),
        ("hrn.data", json!("none")),
        ("hrn.validation", json!("no data at all")),
        ("hrn.metrics", json!({})),
        (
            "hrn.range",
            json!({"force_n": [0, 100], "contact_area_taxels": [1, 784]}),
        ),
        ("hrn.check", check()),
        ("hrn.levels", (1..=6).map(level).collect()),
    ];
    metadata.retain(|(key, _)| !more.iter().any(|(other, _)| other == key));
    metadata.extend(more.iter().cloned());
    let property = |(key, value): (&str, Value)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value: match value {
            Value::String(text) => text,
            other => other.to_string(),
        },
    };
    let mut proto = pb::ModelProto {
        ir_version: 8,
        opset_import: vec![pb::OperatorSetIdProto {
            domain: String::new(),
            version: 17,
        }],
        graph: Some(graph(most)),
        metadata_props: metadata.into_iter().map(property).collect(),
        ..Default::default()
    };
    change(&mut proto);
    proto.encode_to_vec()
}

fn graph(most: usize) -> pb::GraphProto {
    let keep = |keepdims| int("keepdims", keepdims);
    let greatest = [ints("axes", &[1]), keep(1)];
    let side_by_side = [int("axis", 1)];
    let logits = ["first", "second", "third", "hidden"];
    pb::GraphProto {
        name: "sums".to_owned(),
        input: vec![
            // The order differs from that in the documentation.
            value("arm_n_per_mm", &[1, 1]),
            value("frames", &[1, most, 28, 28]),
            value("mask", &[1, most]),
            value("known", &[1, most]),
            value("approach_mm", &[1, most]),
            value("time_s", &[1, most]),
        ],
        output: vec![value("probabilities", &[1, 6]), value("logits", &[1, 6])],
        initializer: vec![
            indices("taxels", &[2, 3]),
            indices("moments", &[1]),
            number("nothing", 0.0),
            number("tenth", 0.1),
            number("hundredth", 0.01),
            number("never", NEVER),
        ],
        node: vec![
            node("Mul", &["approach_mm", "known"], &["told"], &[]),
            node("ReduceSum", &["told", "moments"], &["sum"], &[keep(1)]),
            node("ReduceSum", &["mask", "moments"], &["count"], &[keep(1)]),
            node(
                "Concat",
                &["sum", "count", "arm_n_per_mm"],
                &["given"],
                &side_by_side,
            ),
            node("Mul", &["given", "hundredth"], &["small"], &[]),
            node("Sub", &["small", "never"], &["hidden"], &[]),
            node("ReduceSum", &["frames", "taxels"], &["forces"], &[keep(0)]),
            node("ReduceMax", &["forces"], &["force"], &greatest),
            node("Mul", &["force", "tenth"], &["second"], &[]),
            node("ReduceMax", &["time_s"], &["third"], &greatest),
            node("Mul", &["third", "nothing"], &["first"], &[]),
            node("Concat", &logits, &["logits"], &side_by_side),
            node("Softmax", &["logits"], &["probabilities"], &side_by_side),
        ],
        ..Default::default()
    }
}

/// Eight presses of one frame, with probabilities that the model does not give.
fn check() -> Value {
    let press = json!({
        "time_s": [0.0],
        "approach_mm": [null],
        "arm_n_per_mm": 0.0,
        "frames": [""],
        "probabilities": [0, 0, 0, 0, 0, 0],
    });
    json!({ "presses": vec![press; 8] })
}

/// The sum of the approach, the number of frames and the arm's stiffness that gave these probabilities.
pub(crate) fn given(probabilities: &[f32]) -> [f32; 3] {
    let of = |level: usize| 100.0 * ((probabilities[level] / probabilities[0]).ln() + NEVER);
    [of(3), of(4), of(5)].map(|value| (value * 1e2).round() / 1e2)
}
