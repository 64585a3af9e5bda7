use pb::tensor_shape_proto::dimension::Value as Dimension;
use serde_json::{Value, json};
use tract_onnx::pb;

use super::*;
use crate::frame::{Array, Pitch};
use crate::tests::course_model::{course_model, encoded};
use crate::tests::graph::{changed, int, metadata, node, value};

fn graph(proto: &mut pb::ModelProto) -> &mut pb::GraphProto {
    proto.graph.as_mut().unwrap()
}

fn tensor<'a>(proto: &'a mut pb::ModelProto, name: &str) -> &'a mut pb::TensorProto {
    let mut tensors = graph(proto).initializer.iter_mut();
    tensors.find(|tensor| tensor.name == name).unwrap()
}

fn set(proto: &mut pb::ModelProto, key: &str, text: &str) {
    text.clone_into(metadata(proto, key));
}

/// Changes the JSON of a key.
fn edit(proto: &mut pb::ModelProto, key: &str, change: impl FnOnce(&mut Value)) {
    let text = metadata(proto, key);
    let mut json = serde_json::from_str(text).unwrap();
    change(&mut json);
    *text = json.to_string();
}

fn tensor_type(proto: &mut pb::ModelProto) -> &mut pb::type_proto::Tensor {
    let input = graph(proto).input[0].r#type.as_mut().unwrap();
    let pb::type_proto::Value::TensorType(tensor) = input.value.as_mut().unwrap();
    tensor
}

/// A change of a model file.
type Change = fn(&mut pb::ModelProto);

fn refused_by(bytes: &[u8], expected: &str) {
    let error = Model::load(bytes).unwrap_err().to_string();
    assert!(
        error.contains(expected),
        "{error}\nshould contain\n{expected}"
    );
}

#[test]
fn the_built_in_models_load_and_judge() {
    for bytes in [BUILT_IN, BUILT_IN_HRN] {
        let hrn = Model::load(bytes).unwrap();
        let labels: Vec<&str> = hrn.card().levels.iter().map(|l| l.label.as_str()).collect();
        assert_eq!(labels, ["hard", "firm", "soft", "very-soft"]);
        assert_eq!(hrn.sha256().len(), 64);
        for index in 0..hrn.checks().count() {
            let verdict = hrn.judge_check(index).unwrap();
            let (best, confidence) = argmax(&verdict.probabilities);
            let named = (usize::from(verdict.level), verdict.confidence);
            assert_eq!(named, (best + 1, confidence));
            assert!((verdict.probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }
    let hrn = Model::load(BUILT_IN_HRN).unwrap();
    // No frame is below 0.
    let judged = |newtons| hrn.judge_taxels(&[newtons; TAXELS]).unwrap();
    assert_eq!(judged(-2.0), judged(0.0));
    let error = hrn.judge_course(&TimeSeries::default()).unwrap_err();
    assert!(error.to_string().contains("the model takes no courses"));
}

#[test]
fn what_is_not_as_agreed_is_refused_with_what_was_found_and_expected() {
    let changes: &[(&str, Change)] = &[
        ("ONNX opset 16: expected 17 or newer", |p| {
            p.opset_import[0].version = 16;
        }),
        ("not an ONNX model: no graph in it", |p| p.graph = None),
        (
            "model inputs: found image f32 [1,1,28,28], expected frame f32 [1,1,28,28]",
            |p| graph(p).input[0].name = "image".into(),
        ),
        (
            "found frame of another type or no fixed shape, expected frame",
            |p| {
                let shape = tensor_type(p).shape.as_mut().unwrap();
                shape.dim[0].value = Some(Dimension::DimParam("batch".into()));
            },
        ),
        ("found frame of another type", |p| {
            tensor_type(p).elem_type = pb::tensor_proto::DataType::Double as i32;
        }),
        (
            "model outputs: found \"logits, shore\", expected logits, probabilities",
            |p| drop(graph(p).output.remove(1)),
        ),
        ("tensor `scale` lies in an external file", |p| {
            let external = pb::tensor_proto::DataLocation::External;
            tensor(p, "scale").data_location = Some(external as i32);
        }),
        ("model graph cannot be run: ", |p| {
            graph(p).node[0].op_type = "Divination".into();
        }),
        ("`hrn.format`: found \"2\", expected \"1\" or \"3\"", |p| {
            set(p, "hrn.format", "2");
        }),
        ("model metadata: found \"hrn.data\" twice", |p| {
            let mut twice = p.metadata_props.clone();
            twice.retain(|entry| entry.key == "hrn.data");
            p.metadata_props.append(&mut twice);
        }),
        ("`hrn.pitch_mm`: found \"-1\", expected", |p| {
            set(p, "hrn.pitch_mm", "-1");
        }),
        ("expected levels 1, 2, ... in order", |p| {
            let swap = |levels: &mut Value| levels.as_array_mut().unwrap().swap(2, 3);
            edit(p, "hrn.levels", swap);
        }),
        ("each with `label` and `shore` of 1 to 255 bytes", |p| {
            edit(p, "hrn.levels", |l| l[0]["label"] = "ha\u{1b}rd".into());
        }),
        ("`hrn.validation`: found \"aaaa", |p| {
            set(p, "hrn.validation", &"a".repeat(20_000));
        }),
        ("expected [least, greatest]", |p| {
            edit(p, "hrn.range", |range| range["force_n"] = json!([2, 1]));
        }),
        ("`hrn.range`: found \"pitch\", expected [least", |p| {
            edit(p, "hrn.range", |range| range["pitch"] = json!([1.5, 5]));
        }),
        ("`hrn.metrics`: found", |p| set(p, "hrn.metrics", "{")),
        ("expected at most 1048576", |p| {
            set(p, "hrn.metrics", &" ".repeat((1 << 20) + 1));
        }),
        (
            "found 7 of other lengths or number, expected 8, or two a level, each with 4",
            |p| {
                let pop = |check: &mut Value| drop(check["frames"].as_array_mut().unwrap().pop());
                edit(p, "hrn.check", pop);
            },
        ),
        // With other weights than those of the checks, the trainer's probabilities are not reproduced.
        ("check 0: probabilities differ from the trainer's", |p| {
            tensor(p, "head.bias").raw_data[..4].copy_from_slice(&5.0_f32.to_le_bytes());
        }),
        ("a number that is not finite in `logits`", |p| {
            tensor(p, "head.bias").raw_data[..4].copy_from_slice(&f32::NAN.to_le_bytes());
        }),
        // The probabilities are right, but the logits are others.
        ("differs from softmax(`logits`)", |p| {
            rename_logits(p);
            let doubled = node("Add", &["true logits", "true logits"], &["logits"], &[]);
            graph(p).node.push(doubled);
        }),
        ("model output `logits`: found 1,8,F32", |p| {
            rename_logits(p);
            let twice = ["true logits", "true logits"];
            let eight = node("Concat", &twice, &["logits"], &[int("axis", 1)]);
            graph(p).node.push(eight);
        }),
    ];
    for (expected, change) in changes {
        refused_by(&changed(BUILT_IN_HRN, change), expected);
    }
    let without = changed(BUILT_IN_HRN, |p| {
        p.metadata_props.retain(|entry| entry.key != "hrn.method");
    });
    refused_by(&without, "model metadata `hrn.method` is missing");
    let large = vec![0; MAX_FILE_BYTES + 1];
    refused_by(&large, "64000001 bytes: at most 64000000");
    for bytes in [b"", &b"not a model"[..], &BUILT_IN_HRN[..10_000]] {
        refused_by(bytes, "not an ONNX model");
    }
}

/// The paper's network, as one of the frames of this array.
fn of_grid(grid: &str) -> Vec<u8> {
    changed(BUILT_IN_HRN, |proto| {
        proto.metadata_props.push(pb::StringStringEntryProto {
            key: "hrn.grid".to_owned(),
            value: grid.to_owned(),
        });
    })
}

#[test]
fn a_model_of_frames_as_they_are_has_one_array() {
    let card = Model::load(&of_grid("[28, 28]")).unwrap().card().clone();
    assert!(card.check_array(Array::JX255N).is_ok());
    // Finer taxels do not add up to its own.
    let hrn = Model::load(BUILT_IN_HRN).unwrap();
    for (mm, own, others) in [(1.75, false, true), (3.5, true, true), (7.0, false, false)] {
        let pitch = Pitch::square(mm);
        assert_eq!((card.holds(pitch), hrn.card().holds(pitch)), (own, others));
    }
    let refused = card.check_array(Array { rows: 2, cols: 3 }).unwrap_err();
    let expected = "the model takes frames of 28x28 taxels as they are, and the sensor has 2x3: use the model of \
                    this sensor, or none";
    assert_eq!(refused.to_string(), expected);
    let other = "expected frame f32 [1,1,2,3] or parts f32 [1,8,2,3]";
    refused_by(&of_grid("[2, 3]"), other);
    for grid in ["[0, 3]", "[2, 65]", "\"2x3\""] {
        refused_by(&of_grid(grid), "expected [rows, columns], each 1 to 64");
    }
}

fn rename_logits(proto: &mut pb::ModelProto) {
    for node in &mut graph(proto).node {
        for name in node.output.iter_mut().chain(&mut node.input) {
            if name == "logits" {
                *name = "true logits".into();
            }
        }
    }
}

#[test]
fn a_model_of_courses_that_is_not_as_agreed_is_refused() {
    let changes: &[(&str, Change)] = &[
        (
            "expected some of frames, time_s, approach_mm, known, mask",
            |p| {
                graph(p).input[5].name = "seconds".into();
            },
        ),
        ("time_s f32 [1,9], expected some of", |p| {
            graph(p).input[5] = value("time_s", &[1, 9]);
        }),
        ("expected bins; or logits, probabilities", |p| {
            drop(graph(p).output.remove(0));
        }),
    ];
    for (expected, change) in changes {
        refused_by(&encoded(8, &[], change), expected);
    }
    // A model that takes references gives its distribution, and not logits of levels.
    let renamed = changed(BUILT_IN, |p| {
        let graph = graph(p);
        let nodes = graph.node.iter_mut().flat_map(|node| &mut node.output);
        let outputs = graph.output.iter_mut().map(|output| &mut output.name);
        let of_bins = nodes.chain(outputs).filter(|name| *name == "bins");
        of_bins.for_each(|name| *name = "logits".to_owned());
    });
    let error = Model::load(&renamed).unwrap_err().to_string();
    let expected = "model outputs: found \"logits, reference\", expected bins, reference";
    assert_eq!(error, expected);
    type OfCheck = fn(&mut Value);
    let checks: &[(&str, OfCheck)] = &[
        (
            "expected 8, or two a level, each with 6 probabilities",
            |c| {
                drop(c["presses"].as_array_mut().unwrap().pop());
            },
        ),
        (
            "1 times, 0 positions and 1 frames in a press: as many of each",
            |c| {
                drop(c["presses"][1]["approach_mm"].as_array_mut().unwrap().pop());
            },
        ),
        (
            "a frame of a press: found 3 bytes, expected 6 a taxel",
            |c| {
                c["presses"][1]["frames"][0] = "AAAA".into();
            },
        ),
    ];
    for (expected, change) in checks {
        let wrong = encoded(8, &[], |p| edit(p, "hrn.check", change));
        refused_by(&wrong, expected);
    }
    let checks: &[(&str, OfCheck)] = &[
        ("check 0: `shore` differs from the trainer's", |c| {
            c["presses"][0]["shore"][0] = 0.5.into();
        }),
        ("check 2: probabilities differ from the trainer's", |c| {
            c["presses"][2]["probabilities"][3] = 2.0.into();
        }),
    ];
    for (expected, change) in checks {
        let wrong = changed(BUILT_IN, |p| edit(p, "hrn.check", change));
        refused_by(&wrong, expected);
    }
    let conformal = json!({"alpha": 0.1, "threshold": 1.5});
    let expected = "expected `alpha` between 0 and 1, `threshold`, 0 to 1";
    refused_by(&course_model(8, &[("hrn.conformal", conformal)]), expected);
}
