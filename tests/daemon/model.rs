//! A bad model file, with the real binary: `check` and a start refuse it in one line, and a running
//! daemon keeps its model. The unit tests of the core have every kind of bad file.

use std::fs;

use hardnessd_core::verdict::BUILT_IN_HRN;
use prost::Message as _;
use rustix::process::Signal;
use tract_onnx::pb;
use tract_onnx::pb::tensor_proto::DataType;

use crate::bench::{Bench, Daemon, fails, run};

/// The paper's network, with a constant larger than any memory added to its frame.
fn bad_file() -> Vec<u8> {
    let mut model = pb::ModelProto::decode(BUILT_IN_HRN).unwrap();
    let graph = model.graph.as_mut().unwrap();
    graph.initializer.push(pb::TensorProto {
        name: "huge".to_owned(),
        dims: vec![1],
        data_type: DataType::Int64 as i32,
        raw_data: (1_i64 << 62).to_le_bytes().to_vec(),
        ..Default::default()
    });
    for node in &mut graph.node {
        for input in node.input.iter_mut().filter(|input| *input == "frame") {
            *input = "changed frame".to_owned();
        }
    }
    let operator = |name: &str, inputs: &[&str], output: &str| pb::NodeProto {
        op_type: name.to_owned(),
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        ..Default::default()
    };
    let added = [
        operator("ConstantOfShape", &["huge"], "zeros"),
        operator("ReduceSum", &["zeros"], "number"),
        operator("Add", &["frame", "number"], "changed frame"),
    ];
    graph.node.splice(0..0, added);
    model.encode_to_vec()
}

#[test]
fn a_bad_file_is_refused_in_one_line_and_a_running_daemon_keeps_its_model() {
    let bench = Bench::new();
    let table = "[model]\npath = \"hrn.onnx\"\n";
    let config = bench.configure("hardnessd.toml", "events.sock", table);
    let file = bench.path("hrn.onnx");
    fs::write(&file, BUILT_IN_HRN).unwrap();
    let mut daemon = Daemon::start(&config);
    let model = || bench.subscriber().next().unwrap()["model"]["sha256"].clone();
    let old = model();
    fs::write(&file, bad_file()).unwrap();
    let config = config.to_str().unwrap();
    let expected = "the inference library failed on it";
    for command in ["check", "run"] {
        fails(&[command, "--config", config], 78, &[expected]);
    }
    daemon.process.signal(Signal::HUP);
    let line = daemon.logged("refused");
    // On a busy machine, the trial may take longer than a reload allows.
    assert!(
        line.contains(expected) || line.contains("given up"),
        "{line}"
    );
    assert_eq!(model(), old);
    let good = concat!(env!("CARGO_MANIFEST_DIR"), "/models/course.onnx");
    fs::copy(good, &file).unwrap();
    assert_eq!(run(&["check", "--config", config]).0, 0);
    daemon.process.signal(Signal::HUP);
    daemon.logged("reloaded");
    assert_ne!(model(), old);
}
