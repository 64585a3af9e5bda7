use prost::Message as _;
use tract_onnx::pb;

use super::*;

mod format_2;

fn proto() -> pb::ModelProto {
    pb::ModelProto::decode(BUILT_IN_HRN).unwrap()
}

fn graph(proto: &mut pb::ModelProto) -> &mut pb::GraphProto {
    proto.graph.as_mut().unwrap()
}

fn value<'a>(proto: &'a mut pb::ModelProto, key: &str) -> &'a mut String {
    let entry = proto
        .metadata_props
        .iter_mut()
        .find(|entry| entry.key == key);
    &mut entry.unwrap().value
}

/// The dimensions of a graph input or output.
fn dims(value: &mut pb::ValueInfoProto) -> &mut Vec<pb::tensor_shape_proto::Dimension> {
    let pb::type_proto::Value::TensorType(tensor) =
        value.r#type.as_mut().unwrap().value.as_mut().unwrap();
    &mut tensor.shape.as_mut().unwrap().dim
}

#[test]
fn the_built_in_model_loads_and_judges() {
    let hrn = Hrn::load(BUILT_IN_HRN).unwrap();
    let labels: Vec<&str> = hrn.card().levels.iter().map(|l| l.label.as_str()).collect();
    assert_eq!(labels, ["hard", "firm", "soft", "very-soft"]);
    assert_eq!(hrn.sha256().len(), 64);
    let Checks::Frames(check) = hrn.checks() else {
        panic!("the model judges frames");
    };
    for (newtons, expected) in check.frames.iter().zip(&check.probabilities) {
        let mut frame = ModelFrame::default();
        frame.newtons.copy_from_slice(newtons);
        let verdict = hrn.judge(&frame).unwrap();
        let (best, confidence) = argmax(&verdict.probabilities);
        assert_eq!(
            (usize::from(verdict.level), verdict.confidence),
            (best + 1, confidence)
        );
        assert!(largest_difference(&verdict.probabilities, expected) < CHECK_TOLERANCE);
        assert!((verdict.probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    }
}

#[test]
fn what_is_not_as_agreed_is_refused_with_what_was_found_and_expected() {
    fn check(expected: &str, change: impl FnOnce(&mut pb::ModelProto)) {
        let mut changed = proto();
        change(&mut changed);
        let error = Hrn::load(&changed.encode_to_vec()).unwrap_err().to_string();
        assert!(
            error.contains(expected),
            "{error}\nshould contain\n{expected}"
        );
    }
    check("ONNX opset 16: expected 17 or newer", |p| {
        p.opset_import[0].version = 16;
    });
    check("ONNX opset missing", |p| p.opset_import.clear());
    check("not an ONNX model: no graph in it", |p| p.graph = None);
    check(
        "model input image f32 [1,1,28,28]: expected frame f32 [1,1,28,28]",
        |p| {
            graph(p).input[0].name = "image".into();
        },
    );
    check(
        "model input frame f32 [1,1,28,27]: expected frame f32 [1,1,28,28]",
        |p| {
            use pb::tensor_shape_proto::dimension::Value;
            dims(&mut graph(p).input[0])[3].value = Some(Value::DimValue(27));
        },
    );
    check("model input frame f32 [batch,1,28,28]: expected", |p| {
        use pb::tensor_shape_proto::dimension::Value;
        dims(&mut graph(p).input[0])[0].value = Some(Value::DimParam("batch".into()));
    });
    check(
        "model input frame double [1,1,28,28]: expected frame f32",
        |p| {
            let kind = graph(p).input[0]
                .r#type
                .as_mut()
                .unwrap()
                .value
                .as_mut()
                .unwrap();
            let pb::type_proto::Value::TensorType(tensor) = kind;
            tensor.elem_type = pb::tensor_proto::DataType::Double as i32;
        },
    );
    check(
        "model outputs logits f32 [1,4], shore f32 [1,3]: expected logits f32 [1,4], probabilities",
        |p| {
            graph(p).output.remove(1);
        },
    );
    check("model outputs hardness f32 [1,3], logits f32 [1,4]", |p| {
        graph(p).output[2].name = "hardness".into();
    });
    check("expected logits f32 [1,3], probabilities f32 [1,3]", |p| {
        let levels = r#"[{"level":1,"label":"a","shore":">70"},
            {"level":2,"label":"b","shore":"60"},{"level":3,"label":"c","shore":"50"}]"#;
        *value(p, "hrn.levels") = levels.into();
        let check: Check = serde_json::from_str(value(p, "hrn.check")).unwrap();
        let narrow = Check {
            probabilities: check
                .probabilities
                .iter()
                .map(|row| row[..3].to_vec())
                .collect(),
            ..check
        };
        *value(p, "hrn.check") = serde_json::to_string(&narrow).unwrap();
    });
    check("no node computes `logits`", |p| {
        graph(p).node.retain(|node| node.output[0] != "logits");
    });
    check("tensor `scale` lies in an external file", |p| {
        let tensor = graph(p)
            .initializer
            .iter_mut()
            .find(|t| t.name == "scale")
            .unwrap();
        tensor.data_location = Some(pb::tensor_proto::DataLocation::External as i32);
    });
    check("(Divination): this operator is not supported", |p| {
        graph(p).node[0].op_type = "Divination".into();
    });

    for key in [
        "hrn.format",
        "hrn.levels",
        "hrn.pitch_mm",
        "hrn.method",
        "hrn.data",
        "hrn.metrics",
        "hrn.validation",
        "hrn.range",
        "hrn.check",
    ] {
        check(&format!("model metadata `{key}` is missing"), |p| {
            p.metadata_props.retain(|entry| entry.key != key);
        });
    }
    let set = |key: &'static str, text: &'static str| {
        move |p: &mut pb::ModelProto| *value(p, key) = text.into()
    };
    check(
        "`hrn.format`: found \"4\", expected \"1\", \"2\" or \"3\"",
        set("hrn.format", "4"),
    );
    check(
        "`hrn.check`: found unknown field `frames`, expected `presses`",
        set("hrn.format", "2"),
    );
    check(
        "`hrn.pitch_mm`: found \"-1\", expected",
        set("hrn.pitch_mm", "-1"),
    );
    check("`hrn.levels`: found", set("hrn.levels", "[]"));
    check(
        "`hrn.levels`: found [1, 2, 4, 3], expected levels 1, 2",
        |p| {
            let mut levels: Vec<Level> = serde_json::from_str(value(p, "hrn.levels")).unwrap();
            levels.swap(2, 3);
            *value(p, "hrn.levels") = serde_json::to_string(&levels).unwrap();
        },
    );
    check(
        "`hrn.levels`: found \"ha\\u{1b}rd\", expected `label` and `shore` of 1 to 255 bytes",
        |p| {
            *value(p, "hrn.levels") = value(p, "hrn.levels").replace("hard", "ha\\u001brd");
        },
    );
    check("... of 300 bytes, expected `label` and `shore`", |p| {
        *value(p, "hrn.levels") = value(p, "hrn.levels").replace("hard", &"h".repeat(300));
    });
    check("`hrn.validation`: found \"aaaa", |p| {
        *value(p, "hrn.validation") = "a".repeat(20_000);
    });
    check(
        "`hrn.range`: found",
        set("hrn.range", "{\"force_n\":[1,2]}"),
    );
    for range in [
        r#"{"force_n":[2,1],"contact_area_taxels":[1,2]}"#,
        r#"{"force_n":[1,2],"contact_area_taxels":[2,1]}"#,
    ] {
        check("expected [least, greatest]", set("hrn.range", range));
    }
    check("`hrn.metrics`: found", set("hrn.metrics", "{"));
    check(
        "`hrn.check`: found -1 in a frame, expected newtons of 0 or more",
        |p| {
            let mut check: Check = serde_json::from_str(value(p, "hrn.check")).unwrap();
            check.frames[3][7] = -1.0;
            *value(p, "hrn.check") = serde_json::to_string(&check).unwrap();
        },
    );
    check("`hrn.check`: found 1 frames of lengths [2]", |p| {
        *value(p, "hrn.check") = r#"{"frames":[[1,2]],"probabilities":[[1,0,0,0]]}"#.into();
    });
    for (count, found) in [(7, "found 7 frames"), (9, "found 9 frames")] {
        check(found, |p| {
            let Check {
                frames,
                probabilities,
            } = serde_json::from_str(value(p, "hrn.check")).unwrap();
            let changed = Check {
                frames: frames.into_iter().cycle().take(count).collect(),
                probabilities: probabilities.into_iter().cycle().take(count).collect(),
            };
            *value(p, "hrn.check") = serde_json::to_string(&changed).unwrap();
        });
    }
    check("`hrn.format`: found it 2 times, expected it once", |p| {
        let entries = &mut p.metadata_props;
        let format = entries.iter().find(|entry| entry.key == "hrn.format");
        let again = format.unwrap().clone();
        entries.push(again);
    });
    check(
        "check frame 3: probabilities differ from the trainer's by up to 0.01",
        |p| {
            let mut check: Check = serde_json::from_str(value(p, "hrn.check")).unwrap();
            check.probabilities[3][0] += 0.01;
            *value(p, "hrn.check") = serde_json::to_string(&check).unwrap();
        },
    );
    // With other weights than those of the checks, the trainer's probabilities are not reproduced.
    check(
        "check frame 0: probabilities differ from the trainer's",
        |p| {
            let bias = graph(p)
                .initializer
                .iter_mut()
                .find(|t| t.name == "head.bias")
                .unwrap();
            bias.raw_data[..4].copy_from_slice(&5.0_f32.to_le_bytes());
        },
    );
    check("a number that is not finite in `logits`", |p| {
        let bias = graph(p)
            .initializer
            .iter_mut()
            .find(|t| t.name == "head.bias")
            .unwrap();
        bias.raw_data[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    });
    // The probabilities are right, but the logits have another temperature.
    check("differs from softmax(`logits`)", |p| {
        let nodes = &mut graph(p).node;
        let mut sharp = nodes
            .iter()
            .find(|node| node.output[0] == "logits")
            .unwrap()
            .clone();
        nodes
            .iter_mut()
            .find(|node| node.output[0] == "logits")
            .unwrap()
            .output[0] = "true logits".into();
        nodes
            .iter_mut()
            .find(|node| node.op_type == "Softmax")
            .unwrap()
            .input[0] = "true logits".into();
        sharp.op_type = "Add".into();
        sharp.name = "shifted".into();
        sharp.input = vec!["true logits".into(), "head.bias shifted".into()];
        let mut shift = graph(p).initializer[0].clone();
        shift.name = "head.bias shifted".into();
        shift.dims = vec![4];
        shift.raw_data = [1.0_f32, 0.0, 0.0, 0.0]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        graph(p).initializer.push(shift);
        graph(p).node.push(sharp);
    });
}

#[test]
fn outputs_of_another_length_than_declared_are_refused() {
    for name in ["logits", "probabilities"] {
        let mut changed = proto();
        let graph = graph(&mut changed);
        let node = graph.node.iter_mut().find(|node| node.output[0] == name);
        node.unwrap().output[0] = "four".into();
        for node in &mut graph.node {
            for input in node.input.iter_mut().filter(|input| *input == name) {
                *input = "four".into();
            }
        }
        let axis = pb::AttributeProto {
            name: "axis".into(),
            r#type: pb::attribute_proto::AttributeType::Int as i32,
            i: 1,
            ..Default::default()
        };
        graph.node.push(pb::NodeProto {
            name: "eight".into(),
            op_type: "Concat".into(),
            input: vec!["four".into(), "four".into()],
            output: vec![name.into()],
            attribute: vec![axis],
            ..Default::default()
        });
        let error = Hrn::load(&changed.encode_to_vec()).unwrap_err().to_string();
        assert_eq!(
            error,
            format!("model outputs {name} computed as 1,8,F32: expected 1,4,F32")
        );
    }
}

#[test]
fn an_oversized_or_foreign_file_is_refused() {
    let error = Hrn::load(&vec![0; MAX_FILE_BYTES + 1])
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("64000001 bytes: at most 64000000"),
        "{error}"
    );
    for bytes in [
        &b""[..],
        b"not a model",
        &BUILT_IN_HRN[..BUILT_IN_HRN.len() / 2],
    ] {
        let error = Hrn::load(bytes).unwrap_err();
        assert!(matches!(error, ModelError::NotOnnx(_)), "{error}");
    }
}

#[test]
fn equal_probabilities_go_to_the_lower_level() {
    assert_eq!(argmax(&[0.1, 0.4, 0.4, 0.1]), (1, 0.4));
}
