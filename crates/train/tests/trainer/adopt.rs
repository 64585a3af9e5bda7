//! A model from elsewhere: the report of `hrn-train check-model`, and the result of `adopt`.

use std::fs;
use std::path::Path;
use std::process::Output;

use hardnessd_core::verdict::{Hrn, ModelFrame};
use hardnessd_simulator::Split;
use hrn_train::data::dataset::{Dataset, Sample};
use prost::Message;
use tract_onnx::pb;

use crate::{errors, few, hrn_train, write_data};

/// What `adopt` says of a foreign model.
fn adopt(foreign: &str, data: &str, out: &Path) -> Output {
    let _ = fs::remove_file(out);
    hrn_train(&[
        "adopt",
        foreign,
        "--data",
        data,
        "--out",
        out.to_str().unwrap(),
    ])
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
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

/// Gives a value numbers of another type, or texts.
fn of_type(value: &mut pb::ValueInfoProto, elem_type: pb::tensor_proto::DataType) {
    let pb::type_proto::Value::TensorType(tensor) =
        value.r#type.as_mut().unwrap().value.as_mut().unwrap();
    tensor.elem_type = elem_type as i32;
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

/// The linear model whose scores are called probabilities.
fn scores() -> pb::ModelProto {
    let mut scores = model("probabilities", 4, 17);
    let graph = scores.graph.as_mut().unwrap();
    graph.node[2].op_type = "Identity".to_owned();
    scores
}

fn write(directory: &Path, name: &str, model: &pb::ModelProto) -> String {
    let path = directory.join(name);
    fs::write(&path, model.encode_to_vec()).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_foreign_model_is_told_all_that_it_lacks_and_adopted() {
    let (directory, data) = few();
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
        assert!(adopted.status.success(), "{}", errors(&adopted));
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
        assert_linear(Path::new(out), data, [0, 1, 2, 3], f64::from);
    }
}

fn attribute(name: &str) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        ..Default::default()
    }
}

fn floats(name: &str, floats: Vec<f32>) -> pb::AttributeProto {
    pb::AttributeProto {
        r#type: pb::attribute_proto::AttributeType::Floats as i32,
        floats,
        ..attribute(name)
    }
}

fn text(name: &str, text: &str) -> pb::AttributeProto {
    pb::AttributeProto {
        r#type: pb::attribute_proto::AttributeType::String as i32,
        s: text.into(),
        ..attribute(name)
    }
}

/// The linear model as skl2onnx writes a pipeline of `StandardScaler` and `LogisticRegression` by
/// default, with these classes. It subtracts 0.01 N and multiplies by 2.
fn learner(classes: [&str; 4]) -> pb::ModelProto {
    let of_learners = |node: pb::NodeProto, attribute: Vec<pb::AttributeProto>| pb::NodeProto {
        domain: "ai.onnx.ml".to_owned(),
        attribute,
        ..node
    };
    let texts = |name: &str| pb::AttributeProto {
        r#type: pb::attribute_proto::AttributeType::Strings as i32,
        strings: classes.map(|class| class.as_bytes().to_vec()).to_vec(),
        ..attribute(name)
    };
    let weights = (0..4).flat_map(|level| (0..784).map(move |taxel| weight(taxel, level)));
    let mut classifier = node("LinearClassifier", &["variable"], "label");
    classifier.output.push("probability_tensor".to_owned());
    let nodes = vec![
        of_learners(
            node("Scaler", &["X"], "variable"),
            vec![
                floats("offset", vec![0.01; 784]),
                floats("scale", vec![2.0; 784]),
            ],
        ),
        of_learners(
            classifier,
            vec![
                floats("coefficients", weights.collect()),
                floats("intercepts", vec![0.0; 4]),
                text("post_transform", "SOFTMAX"),
                texts("classlabels_strings"),
            ],
        ),
        of_learners(
            node("Normalizer", &["probability_tensor"], "probabilities"),
            vec![text("norm", "L1")],
        ),
        of_learners(
            node("ZipMap", &["probabilities"], "output_probability"),
            vec![texts("classlabels_strings")],
        ),
    ];
    let mut model = model("logits", 4, 9);
    model.opset_import.push(pb::OperatorSetIdProto {
        domain: "ai.onnx.ml".to_owned(),
        version: 1,
    });
    let graph = model.graph.as_mut().unwrap();
    graph.node = nodes;
    graph.initializer.clear();
    graph.input = vec![value("X", &[0, 784])];
    let label = value("label", &[0]);
    let pairs = pb::ValueInfoProto {
        name: "output_probability".to_owned(),
        ..Default::default()
    };
    graph.output = vec![label, pairs];
    model
}

/// Asserts that an adopted file computes the linear model of `weight`, with these columns, of the
/// numbers that `of` makes of a taxel.
fn assert_linear(adopted: &Path, data: &str, columns: [usize; 4], of: impl Fn(f32) -> f64) {
    let hrn = Hrn::load(&fs::read(adopted).unwrap()).unwrap();
    let dataset = Dataset::read(Path::new(data)).unwrap();
    for index in dataset.labelled(Split::Test).unwrap() {
        let frame = &dataset.samples[index].frame;
        let scores = columns.map(|column| {
            let newtons = frame.newtons.iter().enumerate();
            newtons
                .map(|(taxel, &n)| of(n) * f64::from(weight(taxel, column)))
                .sum::<f64>()
        });
        let greatest = scores.into_iter().fold(f64::MIN, f64::max);
        let powers = scores.map(|score| (score - greatest).exp());
        let sum: f64 = powers.iter().sum();
        let verdict = hrn.judge(frame).unwrap();
        for (found, power) in verdict.probabilities.iter().zip(powers) {
            assert!((f64::from(*found) - power / sum).abs() < 1e-5);
        }
    }
}

#[test]
fn a_classifier_of_skl2onnx_is_adopted_as_it_is_written_by_default() {
    let (directory, data) = few();
    let data = data.to_str().unwrap();
    let out = directory.path().join("adopted.onnx");
    // scikit-learn sorts the classes, so its columns are in the order of these texts.
    for (classes, columns) in [
        (["1", "2", "3", "4"], [0, 1, 2, 3]),
        (["0", "1", "2", "3"], [0, 1, 2, 3]),
        (["firm", "hard", "soft", "very-soft"], [1, 0, 2, 3]),
    ] {
        let foreign = write(directory.path(), "foreign.onnx", &learner(classes));
        let lines = stdout(&hrn_train(&["check-model", &foreign]));
        for part in ["opset", "input", "outputs", "graph", "hrn.levels"] {
            assert!(lines.contains(&format!("adopt    {part}: ")), "{lines}");
        }
        assert!(
            lines.contains("hrn-train adopt") && !lines.contains("missing  "),
            "{lines}"
        );
        let adopted = adopt(&foreign, data, &out);
        assert!(adopted.status.success(), "{}", errors(&adopted));
        assert_linear(&out, data, columns, |n| (f64::from(n) - 0.01) * 2.0);
    }
}

/// The linear model as Keras and PyTorch write it: frames of the shape `dims`, a `Reshape` whose shape
/// is computed from the batch, and a softmax whose output has any name.
fn network(dims: &[i64]) -> pb::ModelProto {
    let mut model = model("logits", 4, 18);
    let graph = model.graph.as_mut().unwrap();
    let indices = |name: &str, values: &[i64]| pb::TensorProto {
        name: name.to_owned(),
        data_type: pb::tensor_proto::DataType::Int64 as i32,
        dims: vec![values.len() as i64],
        int64_data: values.to_vec(),
        ..Default::default()
    };
    graph.input = vec![value("frame", dims)];
    graph.output = vec![value("Identity:0", &[0, 4])];
    graph.initializer.push(indices("zero", &[0]));
    graph.initializer.push(indices("rest", &[784]));
    let mut shape = node("Concat", &["batch", "rest"], "shape");
    shape.attribute.push(pb::AttributeProto {
        r#type: pb::attribute_proto::AttributeType::Int as i32,
        ..attribute("axis")
    });
    graph.node = vec![
        node("Shape", &["frame"], "lengths"),
        node("Gather", &["lengths", "zero"], "batch"),
        shape,
        node("Reshape", &["frame", "shape"], "logits"),
        // A name that ours must not clash with.
        node("MatMul", &["logits", "w"], "probabilities"),
        node("Softmax", &["probabilities"], "softmax"),
        node("Identity", &["softmax"], "Identity:0"),
    ];
    model
}

#[test]
fn a_network_with_any_batch_and_shape_of_frames_is_adopted() {
    let (directory, data) = few();
    let data = data.to_str().unwrap();
    let out = directory.path().join("adopted.onnx");
    for dims in [
        &[0, 784][..],
        &[1, 784],
        &[0, 28, 28],
        &[0, 28, 28, 1],
        &[0, 1, 28, 28],
        &[1, 1, 28, 28],
    ] {
        let foreign = write(directory.path(), "foreign.onnx", &network(dims));
        let adopted = adopt(&foreign, data, &out);
        assert!(adopted.status.success(), "{dims:?}: {}", errors(&adopted));
        assert_linear(&out, data, [0, 1, 2, 3], f64::from);
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
    write_data(path, &samples, meta);
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
        let _ = fs::remove_file(&out);
        let [data, out] = [&data, &out].map(|path| path.to_str().unwrap());
        hrn_train(&["adopt", &of_three, "--data", data, "--out", out])
    };
    three_levels(&data, &levels);
    let adopted = adopt();
    assert!(adopted.status.success(), "{}", errors(&adopted));
    let hrn = Hrn::load(&fs::read(&out).unwrap()).unwrap();
    assert_eq!(serde_json::to_value(&hrn.card().levels).unwrap(), levels);

    three_levels(&data, &serde_json::json!(["stone", "fruit", "jelly"]));
    let refused = errors(&adopt());
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
        let refused = errors(&adopt());
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
    let (directory, data) = few();
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
    let message = errors(&adopted);
    assert_eq!(adopted.status.code(), Some(78), "{message}");
    assert!(
        message.contains("adopt takes models of one frame"),
        "{message}"
    );
}

#[test]
fn what_cannot_be_adopted_is_refused_in_a_line() {
    let (directory, data) = few();
    let data = data.to_str().unwrap();
    let out = directory.path().join("out.onnx");
    let mut two_inputs = model("logits", 4, 17);
    let graph = two_inputs.graph.as_mut().unwrap();
    graph.input.push(value("y", &[1]));
    let with_input = |dims: &[i64], elem_type: pb::tensor_proto::DataType| {
        let mut model = model("logits", 4, 17);
        let mut input = value("x", dims);
        of_type(&mut input, elem_type);
        model.graph.as_mut().unwrap().input = vec![input];
        model
    };
    let of_another_shape = with_input(&[0, 28, 27], pb::tensor_proto::DataType::Float);
    let of_doubles = with_input(&[0, 784], pb::tensor_proto::DataType::Double);
    let of_other_classes = learner(["hard", "firm", "soft", "wood"]);
    let mut of_texts = of_other_classes.clone();
    let graph = of_texts.graph.as_mut().unwrap();
    graph.node.pop();
    graph.output = vec![value("label", &[0]), value("probabilities", &[0, 4])];
    of_type(&mut graph.output[0], pb::tensor_proto::DataType::String);
    for (model, expected) in [
        (
            model("y", 4, 17),
            "outputs: found y f32 [N,4], expected `logits`",
        ),
        (model("logits", 3, 17), "found 3 levels, expected 4"),
        (
            model("probabilities", 4, 9),
            "opset 9: Softmax changed since: export with opset 17 (skl2onnx: `target_opset=17`",
        ),
        (
            two_inputs,
            "inputs: found x f32 [N,1,28,28], y f32 [1], expected one",
        ),
        (
            of_another_shape,
            "inputs: found x f32 [N,28,27], expected one, f32 [N,784], ",
        ),
        (
            of_doubles,
            "inputs: found x double [N,784], expected f32 (skl2onnx: `to_onnx(model, X[:1].astype(",
        ),
        (scores(), "expected 1: these are scores (scikit-learn: "),
        (
            of_other_classes,
            "found the classes hard, firm, soft, wood, expected 1 to 4, 0 to 3 or hard, firm, ",
        ),
        (
            of_texts,
            "their order is not in the file: export without the option `zipmap`",
        ),
    ] {
        let path = write(directory.path(), "foreign.onnx", &model);
        let output = adopt(&path, data, &out);
        let message = errors(&output);
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
    let old = write(directory.path(), "old.onnx", &model("probabilities", 4, 9));
    let checked = hrn_train(&["check-model", &old]);
    let lines = stdout(&checked);
    assert_eq!(checked.status.code(), Some(78), "{lines}");
    assert!(
        lines.contains("missing  opset: opset 9: Softmax changed since: export with opset 17 "),
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

    // What `adopt` mends in a part does not hide what it leaves there.
    let mut forbidden = learner(["1", "2", "3", "4"]);
    let nodes = &mut forbidden.graph.as_mut().unwrap().node;
    nodes[1].input = vec!["hardest".to_owned()];
    nodes.insert(1, node("Hardmax", &["variable"], "hardest"));
    let forbidden = write(directory.path(), "forbidden.onnx", &forbidden);
    let lines = stdout(&hrn_train(&["check-model", &forbidden]));
    assert!(
        lines.contains("missing  graph: ") && lines.contains("Hardmax"),
        "{lines}"
    );

    let scores = write(directory.path(), "scores.onnx", &scores());
    let lines = stdout(&hrn_train(&["check-model", &scores]));
    assert!(
        lines.contains("missing  outputs: `probabilities` of a check frame add up to "),
        "{lines}"
    );

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
