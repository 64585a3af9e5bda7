//! A model of format 2 whose outputs tell its inputs.
//!
//! The value of `shore` is the sum of the known approach. Its low is that sum less the number of
//! frames, and its high is the sum plus the arm's stiffness. The logits of levels 1 to 3 are 0, a
//! tenth of the greatest force of a frame, and the last time in seconds. Level 4 is never likely.

use prost::Message as _;
use serde_json::{Value, json};
use tract_onnx::pb;

use crate::verdict::ModelFrame;
use crate::verdict::{CheckedCourse, Course, CourseCheck, CourseMoment};

/// The file for presses of `most` frames. `more` adds or replaces metadata.
pub fn course_model(most: usize, more: &[(&str, Value)]) -> Vec<u8> {
    encoded(most, more, |_| {})
}

/// The same file, changed by a closure.
pub fn encoded(
    most: usize,
    more: &[(&str, Value)],
    change: impl FnOnce(&mut pb::ModelProto),
) -> Vec<u8> {
    let mut metadata = vec![
        ("hrn.format", json!("2")),
        ("hrn.pitch_mm", json!("3.5")),
        ("hrn.method", json!("sums")),
        ("hrn.data", json!("none")),
        ("hrn.validation", json!("no data at all")),
        ("hrn.metrics", json!({})),
        (
            "hrn.range",
            json!({"force_n": [0, 100], "contact_area_taxels": [1, 784]}),
        ),
        ("hrn.check", json!(check(most))),
        (
            "hrn.levels",
            json!([
                {"level": 1, "label": "hard", "shore": ">70"},
                {"level": 2, "label": "firm", "shore": "61-70"},
                {"level": 3, "label": "soft", "shore": "51-60"},
                {"level": 4, "label": "very-soft", "shore": "<=50"},
            ]),
        ),
    ];
    metadata.retain(|(key, _)| !more.iter().any(|(other, _)| other == key));
    metadata.extend(more.iter().cloned());
    let mut proto = pb::ModelProto {
        ir_version: 8,
        opset_import: vec![pb::OperatorSetIdProto {
            domain: String::new(),
            version: 17,
        }],
        graph: Some(graph(most)),
        metadata_props: metadata
            .into_iter()
            .map(|(key, value)| pb::StringStringEntryProto {
                key: key.to_owned(),
                value: value
                    .as_str()
                    .map_or_else(|| value.to_string(), str::to_owned),
            })
            .collect(),
        ..Default::default()
    };
    change(&mut proto);
    proto.encode_to_vec()
}

fn graph(most: usize) -> pb::GraphProto {
    let all = &[1, most][..];
    let mut graph = pb::GraphProto {
        name: "sums".to_owned(),
        input: vec![
            // The order differs from that in the documentation.
            value("arm_n_per_mm", &[1, 1]),
            value("frames", &[1, most, 28, 28]),
            value("mask", all),
            value("known", all),
            value("approach_mm", all),
            value("time_s", all),
        ],
        output: vec![
            value("shore", &[1, 3]),
            value("probabilities", &[1, 4]),
            value("logits", &[1, 4]),
        ],
        initializer: vec![
            ints("taxels", &[2, 3]),
            ints("moments", &[1]),
            floats("tenth", &[0.1]),
            floats("nothing", &[0.0]),
            floats("never", &[-50.0]),
        ],
        ..Default::default()
    };
    let mut node = |op: &str, inputs: &[&str], output: &str, attributes: &[(&str, i64)]| {
        graph.node.push(pb::NodeProto {
            op_type: op.to_owned(),
            name: output.to_owned(),
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: vec![output.to_owned()],
            attribute: attributes
                .iter()
                .map(|&(name, i)| attribute(op, name, i))
                .collect(),
            ..Default::default()
        });
    };
    node("Mul", &["approach_mm", "known"], "told", &[]);
    node("ReduceSum", &["told", "moments"], "way", &[("keepdims", 1)]);
    node(
        "ReduceSum",
        &["mask", "moments"],
        "count",
        &[("keepdims", 1)],
    );
    node("Sub", &["way", "count"], "low", &[]);
    node("Add", &["way", "arm_n_per_mm"], "high", &[]);
    node("Concat", &["way", "low", "high"], "shore", &[("axis", 1)]);
    node(
        "ReduceSum",
        &["frames", "taxels"],
        "forces",
        &[("keepdims", 0)],
    );
    node(
        "ReduceMax",
        &["forces"],
        "force",
        &[("axes", 1), ("keepdims", 1)],
    );
    node("Mul", &["force", "tenth"], "second", &[]);
    node(
        "ReduceMax",
        &["time_s"],
        "third",
        &[("axes", 1), ("keepdims", 1)],
    );
    node("Mul", &["third", "nothing"], "first", &[]);
    node("Add", &["first", "never"], "fourth", &[]);
    let logits = ["first", "second", "third", "fourth"];
    node("Concat", &logits, "logits", &[("axis", 1)]);
    node("Softmax", &["logits"], "probabilities", &[("axis", 1)]);
    graph
}

fn attribute(op: &str, name: &str, i: i64) -> pb::AttributeProto {
    use pb::attribute_proto::AttributeType::{Int, Ints};
    let is_list = name == "axes";
    assert!(!is_list || op == "ReduceMax");
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: if is_list { Ints } else { Int } as i32,
        i: if is_list { 0 } else { i },
        ints: if is_list { vec![i] } else { vec![] },
        ..Default::default()
    }
}

fn value(name: &str, dims: &[usize]) -> pb::ValueInfoProto {
    use pb::tensor_shape_proto::{Dimension, dimension};
    let dim = dims
        .iter()
        .map(|&length| Dimension {
            value: Some(dimension::Value::DimValue(length as i64)),
            ..Default::default()
        })
        .collect();
    pb::ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(pb::TypeProto {
            value: Some(pb::type_proto::Value::TensorType(pb::type_proto::Tensor {
                elem_type: pb::tensor_proto::DataType::Float as i32,
                shape: Some(pb::TensorShapeProto { dim }),
            })),
            ..Default::default()
        }),
        ..Default::default()
    }
}

fn ints(name: &str, values: &[i64]) -> pb::TensorProto {
    pb::TensorProto {
        name: name.to_owned(),
        dims: vec![values.len() as i64],
        data_type: pb::tensor_proto::DataType::Int64 as i32,
        raw_data: values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect(),
        ..Default::default()
    }
}

fn floats(name: &str, values: &[f32]) -> pb::TensorProto {
    pb::TensorProto {
        data_type: pb::tensor_proto::DataType::Float as i32,
        raw_data: values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect(),
        ..ints(name, &vec![0; values.len()])
    }
}

/// Eight presses of 1 to `most` frames, with and without a known approach.
fn check(most: usize) -> CourseCheck {
    let press = |number: usize| {
        let length = 1 + number * (most - 1) / 7;
        let moments = (0..length).map(|place| {
            let mut frame = ModelFrame::default();
            frame.newtons[300..300 + number].fill(0.1 + 0.05 * place as f32);
            CourseMoment {
                time_s: 0.05 * place as f32,
                approach_mm: number.is_multiple_of(2).then_some(0.2 * place as f32),
                frame,
            }
        });
        let course = Course {
            moments: moments.collect(),
            arm_n_per_mm: 3.0 * (number % 3) as f32,
        };
        let (probabilities, shore) = judged(&course);
        CheckedCourse {
            course,
            probabilities,
            shore: shore.into(),
            identified: false,
        }
    };
    CourseCheck {
        presses: (0..8).map(press).collect(),
        references: Vec::new(),
    }
}

/// The outputs of the model, computed without it.
pub fn judged(course: &Course) -> (Vec<f32>, [f32; 3]) {
    let moments = &course.moments;
    let way: f32 = moments.iter().filter_map(|moment| moment.approach_mm).sum();
    let forces = moments.iter().map(|moment| moment.frame.force_n() as f32);
    let last = moments
        .iter()
        .map(|moment| moment.time_s)
        .fold(0.0, f32::max);
    let logits = [0.0, 0.1 * forces.fold(0.0, f32::max), last, -50.0];
    let odds = logits.map(f32::exp);
    let sum: f32 = odds.iter().sum();
    let shore = [way, way - moments.len() as f32, way + course.arm_n_per_mm];
    (odds.iter().map(|odds| odds / sum).collect(), shore)
}
