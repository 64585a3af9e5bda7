//! Bad model files, with the real binary: `check` and a start refuse each with one line, and a running
//! daemon keeps its model.

use std::fs;
use std::path::PathBuf;

use hardnessd_core::verdict::BUILT_IN_HRN;
use prost::Message as _;
use rustix::process::Signal;
use serde_json::json;
use tract_onnx::pb;
use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;

use crate::bench::{Bench, Daemon, hardnessd};

/// Changes the built-in model.
fn changed(change: impl FnOnce(&mut pb::GraphProto)) -> Vec<u8> {
    let mut model = pb::ModelProto::decode(BUILT_IN_HRN).unwrap();
    change(model.graph.as_mut().unwrap());
    model.encode_to_vec()
}

fn node<'a>(graph: &'a mut pb::GraphProto, operator: &str) -> &'a mut pb::NodeProto {
    let mut nodes = graph.node.iter_mut();
    nodes.find(|node| node.op_type == operator).unwrap()
}

fn ints(name: &str, ints: &[i64]) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Ints as i32,
        ints: ints.to_vec(),
        ..Default::default()
    }
}

fn tensor(name: &str, dims: &[i64], data_type: DataType, raw_data: Vec<u8>) -> pb::TensorProto {
    pb::TensorProto {
        name: name.to_owned(),
        dims: dims.to_vec(),
        data_type: data_type as i32,
        raw_data,
        ..Default::default()
    }
}

fn floats(name: &str, dims: &[i64], value: f32) -> pb::TensorProto {
    let count = dims.iter().product::<i64>() as usize;
    let raw = value.to_le_bytes().repeat(count);
    tensor(name, dims, DataType::Float, raw)
}

/// Adds `count` convolutions of `channels` channels. Their result, which is 0 everywhere, is added
/// to the image, so the verdicts stay the same.
fn convolutions(graph: &mut pb::GraphProto, count: usize, channels: i64) {
    let mut first = graph.node.remove(0);
    let mut last = "plain image".to_owned();
    let image = std::mem::replace(&mut first.output[0], last.clone());
    let mut nodes = vec![first];
    for number in 0..count {
        let (inputs, outputs, value) = match number {
            0 => (1, channels, 0.01),
            number if number + 1 == count => (channels, 1, 0.0),
            _ => (channels, channels, 0.01),
        };
        let kernel = format!("kernel {number}");
        graph
            .initializer
            .push(floats(&kernel, &[outputs, inputs, 3, 3], value));
        let output = format!("convolved {number}");
        nodes.push(pb::NodeProto {
            op_type: "Conv".to_owned(),
            input: vec![last, kernel],
            output: vec![output.clone()],
            attribute: vec![ints("pads", &[1, 1, 1, 1])],
            ..Default::default()
        });
        last = output;
    }
    nodes.push(pb::NodeProto {
        op_type: "Add".to_owned(),
        input: vec!["plain image".to_owned(), last],
        output: vec![image],
        ..Default::default()
    });
    nodes.append(&mut graph.node);
    graph.node = nodes;
}

/// Adds a number to each taxel of the frame. `nodes` compute the number as `number`.
fn added(graph: &mut pb::GraphProto, nodes: Vec<pb::NodeProto>) {
    for node in &mut graph.node {
        for input in node.input.iter_mut().filter(|input| *input == "frame") {
            *input = "changed frame".to_owned();
        }
    }
    let add = operator("Add", &["frame", "number"], "changed frame");
    graph.node.splice(0..0, nodes.into_iter().chain([add]));
}

fn operator(name: &str, inputs: &[&str], output: &str) -> pb::NodeProto {
    pb::NodeProto {
        op_type: name.to_owned(),
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        ..Default::default()
    }
}

/// Files that killed the daemon, stopped it or made it slow, and a part of the message for each.
fn bad_files() -> Vec<(&'static str, Vec<u8>, &'static str)> {
    vec![
        (
            "an axis far outside",
            changed(|graph| {
                let reshape = node(graph, "Reshape");
                reshape.op_type = "Flatten".to_owned();
                reshape.input.truncate(1);
                reshape.attribute = vec![pb::AttributeProto {
                    name: "axis".to_owned(),
                    r#type: AttributeType::Int as i32,
                    i: 2_147_483_647,
                    ..Default::default()
                }];
            }),
            "the inference library failed on it",
        ),
        (
            "a constant larger than any memory",
            changed(|graph| {
                let shape = (1_i64 << 62).to_le_bytes().to_vec();
                graph
                    .initializer
                    .push(tensor("huge", &[1], DataType::Int64, shape));
                let zeros = operator("ConstantOfShape", &["huge"], "zeros");
                added(
                    graph,
                    vec![zeros, operator("ReduceSum", &["zeros"], "number")],
                );
            }),
            "the inference library failed on it",
        ),
        (
            "an operator that runs a graph as its input says",
            changed(|graph| node(graph, "Conv").op_type = "Loop".to_owned()),
            "(Loop): an operator that runs a graph",
        ),
        (
            "a verdict that keeps the sensors waiting",
            changed(|graph| convolutions(graph, 60, 30)),
            "ms for a verdict: expected at most 5.0 ms",
        ),
    ]
}

/// A configuration whose line is fast enough for its frames, with a model beside it.
fn configure(bench: &Bench) -> PathBuf {
    let table = "[model]\npath = \"hrn.onnx\"\n";
    let path = bench.configure("hardnessd.toml", "events.sock", table);
    let text = fs::read_to_string(&path).unwrap();
    let rate = "frame_rate_hz = 20.0\n";
    assert!(text.contains(rate), "{text}");
    fs::write(&path, text.replace(rate, &format!("{rate}baud = 921600\n"))).unwrap();
    path
}

#[test]
fn a_bad_file_is_refused_by_check_and_at_a_start_in_one_line() {
    let bench = Bench::new();
    let config = configure(&bench);
    let with = |command: &str| hardnessd(&[command, "--config", config.to_str().unwrap()]);
    for (what, bytes, expected) in bad_files() {
        fs::write(bench.path("hrn.onnx"), bytes).unwrap();
        for command in ["check", "run"] {
            let output = with(command);
            let line = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(78), "{what}: {line}");
            assert!(line.contains(expected), "{what}: {line}");
            assert_eq!(line.lines().count(), 1, "{what}: {line}");
        }
    }
    // The same changes within bounds do not make a file bad.
    let few = changed(|graph| convolutions(graph, 3, 4));
    for bytes in [BUILT_IN_HRN, &few] {
        fs::write(bench.path("hrn.onnx"), bytes).unwrap();
        let output = with("check");
        assert_eq!(output.status.code(), Some(0), "{output:?}");
    }
}

#[test]
fn a_running_daemon_survives_every_bad_file() {
    let bench = Bench::new();
    let config = configure(&bench);
    fs::write(bench.path("hrn.onnx"), BUILT_IN_HRN).unwrap();
    let mut daemon = Daemon::start(&config);
    let old = bench.subscriber().next().unwrap()["model"]["sha256"].clone();
    for (what, bytes, expected) in bad_files() {
        fs::write(bench.path("hrn.onnx"), bytes).unwrap();
        daemon.process.signal(Signal::HUP);
        let line = daemon.logged("refused");
        // On a busy machine, the trial may take longer than a reload allows.
        let refused = line.contains(expected) || line.contains("given up");
        assert!(refused, "{what}: {line}");
        let hello = bench.subscriber().next().unwrap();
        assert_eq!(hello["model"]["sha256"], old, "{what}");
    }
    let good = changed(|graph| convolutions(graph, 3, 4));
    fs::write(bench.path("hrn.onnx"), good).unwrap();
    daemon.process.signal(Signal::HUP);
    daemon.logged("reloaded");
    let hello = bench.subscriber().next().unwrap();
    assert_eq!(hello["type"], json!("hello"));
    assert_ne!(hello["model"]["sha256"], old);
}
