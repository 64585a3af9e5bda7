//! A bad model file, with the real binary: `check` and a start refuse it in one line, and a running
//! daemon keeps its model. The unit tests of the core have every kind of bad file.

use hardnessd_core::tests::graph::{indices, node};
use hardnessd_core::verdict::{BUILT_IN, BUILT_IN_HRN};
use prost::Message as _;
use tract_onnx::pb;

use crate::bench::Bench;

/// The paper's network, with a constant larger than any memory added to its frame.
fn bad_file() -> Vec<u8> {
    let mut model = pb::ModelProto::decode(BUILT_IN_HRN).unwrap();
    let graph = model.graph.as_mut().unwrap();
    graph.initializer.push(indices("huge", &[1 << 62]));
    for node in &mut graph.node {
        for input in node.input.iter_mut().filter(|input| *input == "frame") {
            *input = "changed frame".to_owned();
        }
    }
    let added = [
        node("ConstantOfShape", &["huge"], &["zeros"], &[]),
        node("ReduceSum", &["zeros"], &["number"], &[]),
        node("Add", &["frame", "number"], &["changed frame"], &[]),
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
