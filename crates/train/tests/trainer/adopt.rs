//! A model from elsewhere: the report of `hrn-train check-model`, and the result of `adopt`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use hardnessd_core::verdict::{Hrn, ModelFrame};
use hardnessd_simulator::Split;
use hrn_train::data::dataset::{self, Dataset, Sample};
use prost::Message;
use tract_onnx::pb;

fn hrn_train(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(arguments)
        .output()
        .unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// A directory with a small data set.
fn data() -> (tempfile::TempDir, PathBuf) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("data.npz");
    let output = hrn_train(&[
        "simulate",
        "--out",
        path.to_str().unwrap(),
        "--objects",
        "2",
        "--test-objects",
        "1",
        "--presses",
        "6",
    ]);
    assert!(output.status.success(), "{}", stderr(&output));
    (directory, path)
}

/// The linear model's weight of `taxel` for `level`.
fn weight(taxel: usize, level: usize) -> f32 {
    ((taxel * 7 + level * 13) % 29) as f32 / 290.0 - 0.05
}

fn value(name: &str, dims: &[i64]) -> pb::ValueInfoProto {
    use pb::tensor_shape_proto::{Dimension, dimension::Value};
    let dim = |&length: &i64| Dimension {
        value: Some(match length {
            0 => Value::DimParam("N".to_owned()),
            _ => Value::DimValue(length),
        }),
        ..Default::default()
    };
    pb::ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(pb::TypeProto {
            value: Some(pb::type_proto::Value::TensorType(pb::type_proto::Tensor {
                elem_type: pb::tensor_proto::DataType::Float as i32,
                shape: Some(pb::TensorShapeProto {
                    dim: dims.iter().map(dim).collect(),
                }),
            })),
            ..Default::default()
        }),
        ..Default::default()
    }
}

fn node(operator: &str, inputs: &[&str], output: &str) -> pb::NodeProto {
    pb::NodeProto {
        op_type: operator.to_owned(),
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        ..Default::default()
    }
}

/// The linear model as a framework may write it: an input `x` with any batch, and `output` of
/// `levels`.
fn model(output: &str, levels: usize, opset: i64) -> pb::ModelProto {
    let weights: Vec<f32> = (0..784)
        .flat_map(|taxel| (0..levels).map(move |level| weight(taxel, level)))
        .collect();
    let mut nodes = vec![
        node("Flatten", &["x"], "taxels"),
        node("MatMul", &["taxels", "w"], "scores"),
    ];
    nodes.push(match output {
        "probabilities" => node("Softmax", &["scores"], output),
        _ => node("Identity", &["scores"], output),
    });
    pb::ModelProto {
        ir_version: 8,
        opset_import: vec![pb::OperatorSetIdProto {
            domain: String::new(),
            version: opset,
        }],
        graph: Some(pb::GraphProto {
            name: "linear".to_owned(),
            node: nodes,
            initializer: vec![pb::TensorProto {
                name: "w".to_owned(),
                data_type: pb::tensor_proto::DataType::Float as i32,
                dims: vec![784, levels as i64],
                float_data: weights,
                ..Default::default()
            }],
            input: vec![value("x", &[0, 1, 28, 28])],
            output: vec![value(output, &[0, levels as i64])],
            ..Default::default()
        }),
        ..Default::default()
    }
}

fn write(directory: &Path, name: &str, model: &pb::ModelProto) -> String {
    let path = directory.join(name);
    fs::write(&path, model.encode_to_vec()).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_foreign_model_is_told_all_that_it_lacks_and_adopted() {
    let (directory, data) = data();
    let data = data.to_str().unwrap();
    for output in ["logits", "probabilities"] {
        let foreign = write(directory.path(), "foreign.onnx", &model(output, 4, 17));
        let checked = hrn_train(&["check-model", &foreign]);
        let lines = stdout(&checked);
        assert_eq!(checked.status.code(), Some(78), "{lines}");
        for part in ["file", "opset", "data inside the file", "graph"] {
            assert!(lines.contains(&format!("ok       {part}\n")), "{lines}");
        }
        for part in [
            "input",
            "outputs",
            "hrn.format",
            "hrn.levels",
            "hrn.pitch_mm",
            "hrn.method",
            "hrn.data",
            "hrn.validation",
            "hrn.metrics",
            "hrn.range",
            "hrn.check",
        ] {
            assert!(
                lines.contains(&format!("adopt    {part}: ")),
                "{part}: {lines}"
            );
        }
        assert!(lines.contains("hrn-train adopt"), "{lines}");

        let out = directory.path().join("adopted.onnx");
        let out = out.to_str().unwrap();
        let _ = fs::remove_file(out);
        let method = ["--method", "by hand"];
        let adopted = hrn_train(
            &[
                &["adopt", &foreign, "--data", data, "--out", out][..],
                &method,
            ]
            .concat(),
        );
        assert!(adopted.status.success(), "{}", stderr(&adopted));
        assert!(
            stdout(&adopted).contains("changed  input \"x\""),
            "{}",
            stdout(&adopted)
        );
        let checked = hrn_train(&["check-model", out]);
        let lines = stdout(&checked);
        assert_eq!(checked.status.code(), Some(0), "{lines}");
        assert_eq!(
            lines.lines().filter(|line| line.starts_with("ok ")).count(),
            16,
            "{lines}"
        );
        // `adopt` measured the same as `evaluate` measures on the file.
        let evaluated = hrn_train(&["evaluate", "--model", out, "--data", data]);
        assert!(
            stdout(&adopted).ends_with(&stdout(&evaluated)),
            "{}",
            stdout(&adopted)
        );

        let hrn = Hrn::load(&fs::read(out).unwrap()).unwrap();
        assert_eq!(
            (hrn.card().method.as_str(), hrn.card().levels.len()),
            ("by hand", 4)
        );
        assert_eq!(hrn.card().validation, "simulated data only");
        let dataset = Dataset::read(Path::new(data)).unwrap();
        for index in dataset.labelled(Split::Test).unwrap() {
            let frame = &dataset.samples[index].frame;
            let scores: Vec<f64> = (0..4)
                .map(|level| {
                    let newtons = frame.newtons.iter().enumerate();
                    newtons
                        .map(|(taxel, n)| f64::from(n * weight(taxel, level)))
                        .sum()
                })
                .collect();
            let sum: f64 = scores.iter().map(|score| score.exp()).sum();
            let verdict = hrn.judge(frame).unwrap();
            for (found, score) in verdict.probabilities.iter().zip(&scores) {
                assert!((f64::from(*found) - score.exp() / sum).abs() < 1e-5);
            }
        }
    }
}

/// Writes a data set with four presses of three levels, whose `meta` states these levels.
fn three_levels(path: &Path, levels: &serde_json::Value) {
    three_levels_of(path, &serde_json::json!({ "levels": levels }));
}

/// The same with this `meta`.
fn three_levels_of(path: &Path, meta: &serde_json::Value) {
    let sample = |level: u8| Sample {
        frame: ModelFrame {
            newtons: [0.1 * f32::from(level); 784],
        },
        level,
        object: Some(u32::from(level)),
        material: None,
        force_n: None,
        split: Split::Train,
        shore: None,
        source: 0,
    };
    let samples: Vec<Sample> = [1, 2, 3, 3].into_iter().map(sample).collect();
    dataset::write(fs::File::create(path).unwrap(), &samples, meta).unwrap();
}

#[test]
fn the_levels_of_an_adopted_model_are_those_of_its_data() {
    let directory = tempfile::tempdir().unwrap();
    let [data, out] = ["data.npz", "out.onnx"].map(|name| directory.path().join(name));
    let of_three = write(directory.path(), "three.onnx", &model("logits", 3, 17));
    let levels = serde_json::json!([
        {"level": 1, "label": "stone", "shore": ">80"},
        {"level": 2, "label": "fruit", "shore": "40-80"},
        {"level": 3, "label": "jelly", "shore": "<40"},
    ]);
    let adopt = || {
        let [data, out] = [&data, &out].map(|path| path.to_str().unwrap());
        hrn_train(&["adopt", &of_three, "--data", data, "--out", out])
    };
    three_levels(&data, &levels);
    let adopted = adopt();
    assert!(adopted.status.success(), "{}", stderr(&adopted));
    let hrn = Hrn::load(&fs::read(&out).unwrap()).unwrap();
    assert_eq!(serde_json::to_value(&hrn.card().levels).unwrap(), levels);

    three_levels(&data, &serde_json::json!(["stone", "fruit", "jelly"]));
    let refused = stderr(&adopt());
    assert!(
        refused.contains("expected `level`, `label` and `shore`"),
        "{refused}"
    );
    // Data that state no levels have the four of the paper.
    for meta in [
        serde_json::json!({ "levels": null }),
        serde_json::json!([]),
        serde_json::json!("x"),
    ] {
        three_levels_of(&data, &meta);
        let refused = stderr(&adopt());
        assert!(refused.contains("found 3 levels, expected 4"), "{refused}");
    }
}

#[test]
fn a_model_of_presses_is_checked_against_its_own_format() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("models");
    let shipped = models.join("course.onnx");
    let checked = hrn_train(&["check-model", shipped.to_str().unwrap()]);
    let lines = stdout(&checked);
    assert_eq!(checked.status.code(), Some(0), "{lines}");
    let ok = lines.lines().filter(|line| line.starts_with("ok "));
    assert_eq!(ok.count(), 17, "{lines}");

    let mut proto = pb::ModelProto::decode(&fs::read(&shipped).unwrap()[..]).unwrap();
    for entry in &mut proto.metadata_props {
        if entry.key == "hrn.conformal" {
            entry.value = r#"{"alpha":0.1,"threshold":2}"#.to_owned();
        }
    }
    let (directory, data) = data();
    let changed = write(directory.path(), "changed.onnx", &proto);
    let checked = hrn_train(&["check-model", &changed]);
    let lines = stdout(&checked);
    assert_eq!(checked.status.code(), Some(78), "{lines}");
    assert!(
        lines.contains("missing  hrn.conformal: model metadata `hrn.conformal`: found "),
        "{lines}"
    );
    assert!(
        lines.contains("ok       graph\n") && !lines.contains("not looked at"),
        "{lines}"
    );
    assert!(lines.contains("takes models of one frame only"), "{lines}");

    let out = directory.path().join("out.onnx");
    let [data, out] = [&data, &out].map(|path| path.to_str().unwrap());
    let adopted = hrn_train(&["adopt", &changed, "--data", data, "--out", out]);
    let message = stderr(&adopted);
    assert_eq!(adopted.status.code(), Some(78), "{message}");
    assert!(
        message.contains("adopt takes models of one frame"),
        "{message}"
    );
}

#[test]
fn what_cannot_be_adopted_is_refused_in_a_line() {
    let (directory, data) = data();
    let data = data.to_str().unwrap();
    let out = directory.path().join("out.onnx");
    let mut two_inputs = model("logits", 4, 17);
    let graph = two_inputs.graph.as_mut().unwrap();
    graph.input.push(value("y", &[1]));
    let mut of_another_shape = model("logits", 4, 17);
    of_another_shape.graph.as_mut().unwrap().input = vec![value("x", &[1, 784])];
    for (model, expected) in [
        (
            model("y", 4, 17),
            "outputs: found y f32 [N,4], expected `logits`",
        ),
        (model("logits", 3, 17), "found 3 levels, expected 4"),
        (model("logits", 4, 9), "ONNX opset 9: expected 17 or newer"),
        (
            two_inputs,
            "inputs: found x f32 [N,1,28,28], y f32 [1], expected one",
        ),
        (
            of_another_shape,
            "inputs: found x f32 [1,784], expected one",
        ),
    ] {
        let path = write(directory.path(), "foreign.onnx", &model);
        let output = hrn_train(&[
            "adopt",
            &path,
            "--data",
            data,
            "--out",
            out.to_str().unwrap(),
        ]);
        let message = stderr(&output);
        assert!(message.contains(expected), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
        assert!(
            [Some(1), Some(78)].contains(&output.status.code()),
            "{message}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn a_file_that_adopt_cannot_mend_is_said_to_be_one() {
    let directory = tempfile::tempdir().unwrap();
    let old = write(directory.path(), "old.onnx", &model("logits", 4, 9));
    let checked = hrn_train(&["check-model", &old]);
    let lines = stdout(&checked);
    assert_eq!(checked.status.code(), Some(78), "{lines}");
    assert!(
        lines.contains("missing  opset: ONNX opset 9: expected 17 or newer\n"),
        "{lines}"
    );
    // One problem hides no other one.
    assert!(lines.contains("ok       graph\n"), "{lines}");
    assert!(
        lines.contains("adopt    hrn.levels: ") && !lines.contains("unseen"),
        "{lines}"
    );
    assert!(!lines.contains("hrn-train adopt"), "{lines}");

    let text = directory.path().join("text.onnx");
    std::fs::write(&text, "no model").unwrap();
    let checked = hrn_train(&["check-model", text.to_str().unwrap()]);
    let lines = stdout(&checked);
    assert!(
        lines.contains("missing  file: not an ONNX model"),
        "{lines}"
    );
    assert!(lines.contains("unseen   graph: not looked at"), "{lines}");

    let mut forbidden = model("logits", 4, 17);
    forbidden.graph.as_mut().unwrap().node[0].op_type = "Hardmax".to_owned();
    let forbidden = write(directory.path(), "forbidden.onnx", &forbidden);
    let lines = stdout(&hrn_train(&["check-model", &forbidden]));
    assert!(
        lines.contains("missing  graph: ") && lines.contains("Hardmax"),
        "{lines}"
    );
    assert!(lines.contains("adopt    hrn.check: "), "{lines}");

    // The inference library panics on a tensor of texts.
    let mut panicking = model("logits", 4, 17);
    let tensor = &mut panicking.graph.as_mut().unwrap().initializer[0];
    tensor.data_type = pb::tensor_proto::DataType::String as i32;
    tensor.raw_data = vec![0; 8];
    let panicking = write(directory.path(), "panicking.onnx", &panicking);
    let lines = stdout(&hrn_train(&["check-model", &panicking]));
    assert!(
        lines.contains("missing  graph: model: the inference library failed on it: "),
        "{lines}"
    );
    let missing = directory.path().join("missing.onnx");
    let output = hrn_train(&["check-model", missing.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(66));
}
