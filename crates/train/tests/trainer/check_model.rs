//! `hrn-train check-model`: what the daemon would refuse in a model file, all at once.

use hardnessd_core::tests::graph::node;
use hardnessd_core::verdict::BUILT_IN_HRN;
use prost::Message as _;
use tract_onnx::pb;

use crate::{Desk, MODELS};

#[test]
fn the_built_in_models_pass() {
    let expected = "a model that hardnessd loads, for sensors of up to 5 frames/s";
    for name in ["hrn.onnx", "course.onnx"] {
        let said = Desk::new().succeeds(&format!("check-model {MODELS}/{name} --fps 5"));
        assert!(said.contains(expected), "{said}");
    }
}

/// The built-in model of one frame with two convolutions of 128 channels beside it, whose result is nothing.
fn slow() -> Vec<u8> {
    const CHANNELS: usize = 128;
    let mut model = pb::ModelProto::decode(BUILT_IN_HRN).unwrap();
    let graph = model.graph.as_mut().unwrap();
    for (name, dims, value) in [
        ("first", &[CHANNELS, 1, 5, 5][..], 0.01_f32),
        ("second", &[CHANNELS, CHANNELS, 5, 5], 0.0),
        ("nothing", &[CHANNELS, 4], 0.0),
    ] {
        graph.initializer.push(pb::TensorProto {
            name: name.to_owned(),
            dims: dims.iter().map(|&length| length as i64).collect(),
            data_type: pb::tensor_proto::DataType::Float as i32,
            raw_data: value.to_le_bytes().repeat(dims.iter().product()),
            ..Default::default()
        });
    }
    let logits = graph.node.iter_mut();
    for node in logits.filter(|node| node.output[0] == "logits") {
        node.output[0] = "fast".to_owned();
    }
    let beside = [
        node("Conv", &["frame", "first"], &["wide"], &[]),
        node("Conv", &["wide", "second"], &["deep"], &[]),
        node("GlobalAveragePool", &["deep"], &["mean"], &[]),
        node("Flatten", &["mean"], &["flat"], &[]),
        node("MatMul", &["flat", "nothing"], &["zero"], &[]),
    ];
    graph.node.splice(0..0, beside);
    let place = graph.node.iter().position(|node| node.output[0] == "fast");
    let sum = node("Add", &["fast", "zero"], &["logits"], &[]);
    graph.node.insert(place.unwrap() + 1, sum);
    model.encode_to_vec()
}

#[test]
fn a_slow_model_passes_for_a_slow_sensor_alone() {
    let desk = Desk::new();
    desk.write("slow.onnx", slow());
    desk.succeeds("check-model slow.onnx --fps 5");
    let expected =
        "ms for a verdict: expected at most 1.0 ms, a tenth of the fastest sensor's frame period";
    desk.fails("check-model slow.onnx --fps 1000", 78, expected);
}

#[test]
fn all_errors_of_a_file_are_said_at_once() {
    let desk = Desk::new();
    let mut model = pb::ModelProto::decode(BUILT_IN_HRN).unwrap();
    model
        .metadata_props
        .retain(|entry| entry.key != "hrn.pitch_mm");
    for entry in &mut model.metadata_props {
        if entry.key == "hrn.range" {
            entry.value = "four".to_owned();
        }
    }
    let graph = model.graph.as_mut().unwrap();
    graph.input[0].name = "image".to_owned();
    graph.output[0].name = "result".to_owned();
    desk.write("m.onnx", model.encode_to_vec());
    let error = desk.fails("check-model m.onnx", 78, "hardnessd.adopt");
    for part in ["pitch_mm", "hrn.range", "image", "result"] {
        assert!(error.contains(part), "no {part} in\n{error}");
    }

    desk.write("m.onnx", "not a model");
    desk.fails("check-model m.onnx", 78, "m.onnx: not an ONNX model");
    desk.fails("check-model none.onnx", 66, "none.onnx");
}
