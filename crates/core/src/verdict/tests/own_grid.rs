//! Tests of models that take the frames of an array as they are.

use super::*;
use crate::tests::graph::{indices, value};

/// A model of two levels on an array of 2x3 taxels. Its logits are the newtons of the first taxels, one by
/// one.
fn model(input: &str, frames: usize, more: &[(&str, Value)]) -> Vec<u8> {
    let length = frames * 6;
    let mut first = vec![0.0; length];
    first[0] = 1.0;
    let odds = [1_f32.exp(), 1.0].map(|odds| odds / (1_f32.exp() + 1.0));
    let mut metadata = vec![
        ("hrn.format", json!("1")),
        ("hrn.grid", json!([2, 3])),
        (
            "hrn.levels",
            json!([
                {"level": 1, "label": "hard", "shore": "-"},
                {"level": 2, "label": "soft", "shore": "-"},
            ]),
        ),
        (
            "hrn.check",
            json!({"frames": vec![first; 4], "probabilities": vec![odds; 4]}),
        ),
    ];
    metadata.retain(|(key, _)| !more.iter().any(|(other, _)| other == key));
    metadata.extend(more.iter().filter(|(_, value)| !value.is_null()).cloned());
    encoded(3, &metadata, |proto| {
        proto.graph = Some(pb::GraphProto {
            name: "first taxels".to_owned(),
            input: vec![value(input, &[1, frames, 2, 3])],
            output: vec![value("probabilities", &[1, 2]), value("logits", &[1, 2])],
            initializer: vec![
                indices("from", &[0]),
                indices("to", &[2]),
                indices("along", &[1]),
                indices("flat", &[1, length as i64]),
            ],
            node: vec![
                node("Reshape", &[input, "flat"], &["taxels"], &[]),
                node(
                    "Slice",
                    &["taxels", "from", "to", "along"],
                    &["logits"],
                    &[],
                ),
                node("Softmax", &["logits"], &["probabilities"], &[]),
            ],
            ..Default::default()
        });
    })
}

#[test]
fn frames_and_parts_go_in_as_they_are() {
    let frame = Hrn::load(&model("frame", 1, &[])).unwrap();
    assert_eq!(frame.format(), Format::Frame);
    let verdict = frame
        .judge_taxels(&[0.5, -2.0, 0.0, 0.0, 0.0, 0.0])
        .unwrap();
    assert_eq!(verdict.logits, [0.5, 0.0], "a frame is of 0 or more");

    let parts = Hrn::load(&model("parts", 8, &[])).unwrap();
    assert_eq!(parts.format(), Format::Parts);
    let mut taxels = [0.0; 48];
    taxels[1] = -2.0;
    let verdict = parts.judge_taxels(&taxels).unwrap();
    assert_eq!(verdict.logits, [0.0, -2.0], "parts keep the sign");
}

#[test]
fn another_array_is_refused() {
    let hrn = Hrn::load(&model("parts", 8, &[])).unwrap();
    assert!(hrn.card().check_array(Array { rows: 2, cols: 3 }).is_ok());
    let refused = hrn.judge(&ModelFrame::default()).unwrap_err();
    let expected = "the model takes frames of 2x3 taxels as they are, and the sensor has 28x28: use the model of \
                    this sensor, or none";
    assert_eq!(refused.to_string(), expected);
}

#[test]
fn a_grid_that_breaks_the_format_is_refused() {
    let sides = "expected [rows, columns], each 1 to 64";
    for grid in [json!([0, 3]), json!([2, 65]), json!("2x3")] {
        refused_by(&model("parts", 8, &[("hrn.grid", grid)]), sides);
    }
    let expected = "found parts f32 [1,8,2,3], expected frame f32 [1,1,28,28]";
    refused_by(&model("parts", 8, &[("hrn.grid", Value::Null)]), expected);
    let other = "expected frame f32 [1,1,4,3] or parts f32 [1,8,4,3]";
    refused_by(&model("parts", 8, &[("hrn.grid", json!([4, 3]))]), other);
}
