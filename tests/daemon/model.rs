//! A bad model file, with the real binary: `check` and a start refuse it in one line, and a running
//! daemon keeps its model. The unit tests of the core have every kind of bad file.

use hardnessd_core::verdict::{BUILT_IN, BUILT_IN_HRN};
use prost::Message as _;
use tract_onnx::pb;
use tract_onnx::pb::tensor_proto::DataType;

use crate::bench::Bench;

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
    bench.write("hrn.onnx", BUILT_IN_HRN);
    let mut daemon = bench.daemon_with("[model]\npath = \"hrn.onnx\"\n");
    let model = || bench.subscriber().next().unwrap()["model"]["sha256"].clone();
    let old = model();
    bench.write("hrn.onnx", bad_file());
    let expected = "the inference library failed on it";
    for command in ["check", "run"] {
        let line = format!("{command} --config hardnessd.toml");
        bench.fails(&line, 78, &[expected]);
    }
    let line = daemon.reload("refused");
    // On a busy machine, the trial may take longer than a reload allows.
    let is_said = line.contains(expected) || line.contains("given up");
    assert!(is_said, "{line}");
    assert_eq!(model(), old);
    bench.write("hrn.onnx", BUILT_IN);
    bench.succeeds("check --config hardnessd.toml");
    daemon.reload("reloaded");
    assert_ne!(model(), old);
}
