//! Tests of models of format 2.

use serde_json::{Value, json};

use super::*;

use crate::test_support::course_model::{course_model, encoded, judged};

fn course(length: usize, approach: bool) -> Course {
    let moments = (0..length).map(|place| {
        let mut frame = ModelFrame::default();
        frame.newtons[500..510].fill(0.3 * (1 + place) as f32);
        CourseMoment {
            time_s: 0.2 * place as f32,
            approach_mm: approach.then_some(place as f32),
            frame,
        }
    });
    Course {
        moments: moments.collect(),
        arm_n_per_mm: 7.5,
    }
}

#[test]
fn the_inputs_are_those_of_the_course() {
    for most in [3, 20, 48] {
        let hrn = Hrn::load(&course_model(most, &[])).unwrap();
        assert_eq!(hrn.format(), Format::Course { most_frames: most });
        assert_eq!(hrn.checks().count(), 8);
        for (length, approach) in [(1, true), (2, false), (3, true), (most, true)] {
            let course = course(length, approach);
            let verdict = hrn.judge_course(&course).unwrap();
            let (probabilities, shore) = judged(&course);
            assert!(largest_difference(&verdict.probabilities, &probabilities) < 1e-5);
            let found: [f32; 3] = verdict.shore.unwrap().into();
            assert!(
                largest_difference(&found, &shore) < 1e-4,
                "{found:?} {shore:?}"
            );
            assert_eq!(verdict.levels, None);
        }
    }
}

#[test]
fn a_frame_alone_is_a_press_of_which_nothing_else_is_known() {
    let hrn = Hrn::load(&course_model(8, &[])).unwrap();
    let frame = course(1, false).moments[0].frame;
    let verdict = hrn.judge(&frame).unwrap();
    assert_eq!(<[f32; 3]>::from(verdict.shore.unwrap()), [0.0, -1.0, 0.0]);
    // A model of frames judges the last frame of a course.
    let hrn = Hrn::load(BUILT_IN_HRN).unwrap();
    let course = course(4, true);
    let last = hrn.judge(&course.moments[3].frame).unwrap();
    assert_eq!(hrn.judge_course(&course).unwrap(), last);
    assert!(last.shore.is_some() && last.levels.is_none(), "{last:?}");
}

#[test]
fn a_conformal_set_holds_what_is_likely_enough_and_the_likeliest() {
    let set = |threshold, probabilities: &[f32]| {
        let alpha = 0.1;
        Conformal { alpha, threshold }.set(probabilities)
    };
    assert_eq!(set(0.2, &[0.5, 0.2, 0.1, 0.2]), [1, 2, 4]);
    assert_eq!(set(0.9, &[0.3, 0.4, 0.3]), [2]);
    assert_eq!(set(0.0, &[1.0, 0.0]), [1, 2]);
    let more = [("hrn.conformal", json!({"alpha": 0.1, "threshold": 0.25}))];
    let hrn = Hrn::load(&course_model(8, &more)).unwrap();
    let verdict = hrn.judge_course(&course(1, true)).unwrap();
    assert_eq!(verdict.levels, Some(vec![1, 2, 3]));
    let verdict = hrn.judge_course(&course(8, true)).unwrap();
    assert_eq!(verdict.levels, Some(vec![2, 3]));
}

#[test]
fn what_is_not_as_agreed_is_refused() {
    fn check(expected: &str, change: impl FnOnce(&mut pb::ModelProto)) {
        let error = Hrn::load(&encoded(8, &[], change)).unwrap_err().to_string();
        assert!(
            error.contains(expected),
            "{error}\nshould contain\n{expected}"
        );
    }
    let agreed = "expected frames f32 [1,T,28,28], time_s f32 [1,T], approach_mm f32 [1,T], \
                  known f32 [1,T], mask f32 [1,T], arm_n_per_mm f32 [1,1], T 3 to 48";
    check(agreed, |p| {
        graph(p).input.pop();
    });
    check(agreed, |p| graph(p).input[5].name = "seconds".into());
    check(agreed, |p| {
        use pb::tensor_shape_proto::dimension::Value;
        dims(&mut graph(p).input[5])[1].value = Some(Value::DimValue(9));
    });
    check(agreed, |p| {
        let again = graph(p).input[2].clone();
        graph(p).input.push(again);
    });
    check(
        "outputs logits f32 [1,4], probabilities f32 [1,4]: expected",
        |p| {
            graph(p).output.remove(0);
        },
    );
    check(
        "expected logits f32 [1,4], probabilities f32 [1,4], shore f32 [1,3]",
        |p| {
            use pb::tensor_shape_proto::dimension::Value;
            dims(&mut graph(p).output[0])[1].value = Some(Value::DimValue(2));
        },
    );
    let change = |change: fn(&mut Value)| {
        move |p: &mut pb::ModelProto| {
            let mut check = serde_json::from_str(value(p, "hrn.check")).unwrap();
            change(&mut check);
            *value(p, "hrn.check") = check.to_string();
        }
    };
    for (expected, changed) in [
        (
            "found 7 presses, expected 8, or two a level",
            change(|c| drop(c["presses"].as_array_mut().unwrap().pop())),
        ),
        (
            "found 2 times, 1 positions and 2 frames in a press: as many of each, 1 to 48",
            change(|c| drop(c["presses"][1]["approach_mm"].as_array_mut().unwrap().pop())),
        ),
        (
            "frame 1 of a press: found 3 bytes, expected 6 a taxel",
            change(|c| c["presses"][1]["frames"][1] = "AAAA".into()),
        ),
        (
            "found 3 probabilities of a press, expected 4",
            change(|c| {
                let probabilities = c["presses"][1]["probabilities"].as_array_mut();
                probabilities.unwrap().pop();
            }),
        ),
        (
            "found another number in a press, expected finite times",
            change(|c| c["presses"][1]["arm_n_per_mm"] = (-1.0).into()),
        ),
        (
            "check frame 2: probabilities differ from the trainer's by up to 0.2",
            change(|c| c["presses"][2]["probabilities"][3] = 0.25.into()),
        ),
        (
            "check press 0: `shore` differs from the trainer's by up to 0.5",
            change(|c| c["presses"][0]["shore"] = json!([0.0, -1.5, 0.0])),
        ),
    ] {
        check(expected, changed);
    }
    let longer = course_model(9, &[]);
    let longer = pb::ModelProto::decode(&longer[..]).unwrap();
    let entry = longer
        .metadata_props
        .iter()
        .find(|entry| entry.key == "hrn.check");
    let longer = entry.unwrap().value.clone();
    check("found a press of 9 frames, expected at most 8", |p| {
        *value(p, "hrn.check") = longer;
    });
    for conformal in [
        json!({"alpha": 0.1}),
        json!({"alpha": 0.0, "threshold": 0.1}),
        json!({"alpha": 0.1, "threshold": 1.5}),
    ] {
        let error = Hrn::load(&course_model(8, &[("hrn.conformal", conformal)])).unwrap_err();
        let expected = "expected `alpha` between 0 and 1, and `threshold`, 0 to 1";
        assert!(error.to_string().contains(expected), "{error}");
    }
}

fn with_range(format: &str, key: &str, range: &Value) -> Result<Hrn, ModelError> {
    let mut of = json!({"force_n": [0, 100], "contact_area_taxels": [1, 784]});
    of[key] = range.clone();
    if format == "2" {
        return Hrn::load(&course_model(8, &[("hrn.range", of)]));
    }
    let mut changed = proto();
    *value(&mut changed, "hrn.range") = of.to_string();
    Hrn::load(&changed.encode_to_vec())
}

const OF_PRESSES: [&str; 5] = [
    "duration_s",
    "frame_period_s",
    "speed_mm_s",
    "approach_mm",
    "arm_n_per_mm",
];

#[test]
fn the_range_of_presses_is_optional_and_checked() {
    let hrn = Hrn::load(&course_model(8, &[])).unwrap();
    assert_eq!(hrn.card().range.of_presses(), [None; 5]);
    for (place, key) in OF_PRESSES.into_iter().enumerate() {
        let hrn = with_range("2", key, &json!([0.5, 2])).unwrap();
        let mut expected = [None; 5];
        expected[place] = Some([0.5, 2.0]);
        assert_eq!(hrn.card().range.of_presses(), expected);
        let written = serde_json::to_value(hrn.card().range).unwrap();
        assert_eq!(written[key], json!([0.5, 2.0]));
        assert_eq!(written.as_object().unwrap().len(), 3, "{written}");
        for refused in [
            json!([2, 0.5]),
            json!([-1, 2]),
            json!([1]),
            json!([0, 1e39]),
            json!("fast"),
        ] {
            let error = with_range("2", key, &refused).unwrap_err().to_string();
            assert!(error.contains("`hrn.range`: found"), "{key}: {error}");
        }
        let error = with_range("1", key, &json!([0.5, 2])).unwrap_err();
        let error = error.to_string();
        assert!(error.contains("the others are of format 2"), "{error}");
    }
    let error = with_range("2", "speed", &json!([0.5, 2])).unwrap_err();
    assert!(error.to_string().contains("unknown field"), "{error}");
}

#[test]
fn a_press_is_held_by_the_range_that_it_lies_in() {
    // Four frames at 0, 0.2, 0.4 and 0.6 s. The arm goes 1 mm in each 0.2 s, and is of 7.5 N/mm.
    let known = course(4, true);
    let numbers = [0.6, 0.2, 5.0, 3.0, 7.5];
    for ((key, number), place) in OF_PRESSES.into_iter().zip(numbers).zip(0..) {
        let [low, high] = known.extents()[place].unwrap();
        assert!((low / number - 1.0).abs() < 1e-5 && low == high, "{key}");
        for (range, is_held) in [([0.5, 1.5], true), ([1.1, 1.5], false), ([0.5, 0.9], false)] {
            let range = range.map(|part: f32| part * number);
            let hrn = with_range("2", key, &json!(range)).unwrap();
            assert_eq!(hrn.card().range.holds(&known), is_held, "{key} {range:?}");
            // Where nothing is known of the arm, its ranges exclude nothing.
            let mut unknown = course(4, false);
            unknown.arm_n_per_mm = 0.0;
            let held = hrn.card().range.holds(&unknown);
            assert_eq!(held, is_held || place > 1, "{key} {range:?}");
        }
    }
}

#[test]
fn an_approach_that_ends_before_the_second_frame_may_have_been_faster() {
    let speed = |way: &[f32]| {
        let mut course = course(way.len(), true);
        for (moment, &mm) in course.moments.iter_mut().zip(way) {
            moment.approach_mm = Some(mm);
        }
        course.extents()[2]
    };
    assert_eq!(speed(&[0.0, 1.0, 1.0]), Some([5.0, f32::INFINITY]));
    let [low, high] = speed(&[0.0, 1.0, 2.0, 2.0]).unwrap();
    assert!((low - 5.0).abs() < 1e-5 && low == high);
    // An arm that stands still, or is known at the first frame alone, has no speed.
    assert_eq!(speed(&[0.0, 0.0]), None);
    assert_eq!(speed(&[0.0]), None);
}

/// A network with the nodes of a trained one: convolutions over each frame and over time, and a
/// GRU. The weights of its last layer are 0, so its outputs are known.
fn network(most: usize) -> Vec<u8> {
    encoded(most, &[], |proto| {
        let graph = proto.graph.as_mut().unwrap();
        graph.node.clear();
        let t = most as i64;
        for (name, dims) in [
            ("kernels", &[4_usize, 1, 3, 3][..]),
            ("time kernels", &[6, 8, 3]),
            ("input weights", &[1, 15, 6]),
            ("recurrent weights", &[1, 15, 5]),
            ("last weights", &[5, 4]),
            ("shore weights", &[5, 3]),
        ] {
            let count = dims.iter().product::<usize>();
            let number = |n: usize| {
                if name.contains("last") || name.contains("shore") {
                    0.0
                } else {
                    0.01 * n as f32
                }
            };
            graph.initializer.push(pb::TensorProto {
                name: name.to_owned(),
                dims: dims.iter().map(|&length| length as i64).collect(),
                data_type: pb::tensor_proto::DataType::Float as i32,
                float_data: (0..count).map(number).collect(),
                ..Default::default()
            });
        }
        let mut ints = |name: &str, values: &[i64]| {
            graph.initializer.push(pb::TensorProto {
                name: name.to_owned(),
                dims: vec![values.len() as i64],
                data_type: pb::tensor_proto::DataType::Int64 as i32,
                int64_data: values.to_vec(),
                ..Default::default()
            });
        };
        ints("one by one", &[t, 1, 28, 28]);
        ints("by time", &[1, t, 4]);
        ints("front", &[0]);
        ints("end", &[1]);
        ints("two", &[2]);
        let mut node = |op: &str, inputs: &[&str], outputs: &[&str], ints: &[(&str, &[i64])]| {
            use pb::attribute_proto::AttributeType;
            let attribute = |&(name, values): &(&str, &[i64])| pb::AttributeProto {
                name: name.to_owned(),
                r#type: if ["axis", "hidden_size"].contains(&name) {
                    AttributeType::Int
                } else {
                    AttributeType::Ints
                } as i32,
                i: values[0],
                ints: if ["axis", "hidden_size"].contains(&name) {
                    vec![]
                } else {
                    values.to_vec()
                },
                ..Default::default()
            };
            graph.node.push(pb::NodeProto {
                op_type: op.to_owned(),
                name: format!("{op} {}", outputs.join(" ")),
                input: inputs.iter().map(|&name| name.to_owned()).collect(),
                output: outputs.iter().map(|&name| name.to_owned()).collect(),
                attribute: ints.iter().map(attribute).collect(),
                ..Default::default()
            });
        };
        node("Reshape", &["frames", "one by one"], &["single"], &[]);
        node(
            "Conv",
            &["single", "kernels"],
            &["convolved"],
            &[("strides", &[2, 2])],
        );
        node("Relu", &["convolved"], &["positive"], &[]);
        node(
            "ReduceMax",
            &["positive"],
            &["pooled"],
            &[("axes", &[2, 3])],
        );
        node("Reshape", &["pooled", "by time"], &["features"], &[]);
        for (input, output) in [
            ("time_s", "t"),
            ("approach_mm", "a"),
            ("known", "k"),
            ("mask", "m"),
        ] {
            node("Unsqueeze", &[input, "two"], &[output], &[]);
        }
        node(
            "Concat",
            &["features", "t", "a", "k", "m"],
            &["all"],
            &[("axis", &[2])],
        );
        node(
            "Transpose",
            &["all"],
            &["channels"],
            &[("perm", &[0, 2, 1])],
        );
        node(
            "Conv",
            &["channels", "time kernels"],
            &["temporal"],
            &[("pads", &[1, 1]), ("kernel_shape", &[3])],
        );
        node(
            "Transpose",
            &["temporal"],
            &["sequence"],
            &[("perm", &[2, 0, 1])],
        );
        let gru = ["sequence", "input weights", "recurrent weights"];
        node("GRU", &gru, &["", "hidden"], &[("hidden_size", &[5])]);
        node("Squeeze", &["hidden", "front"], &["last"], &[]);
        node("MatMul", &["last", "last weights"], &["logits"], &[]);
        node(
            "Softmax",
            &["logits"],
            &["probabilities"],
            &[("axis", &[1])],
        );
        node("MatMul", &["last", "shore weights"], &["shore"], &[]);
        let mut check: CourseCheck = serde_json::from_str(value(proto, "hrn.check")).unwrap();
        for press in &mut check.presses {
            press.probabilities = vec![0.25; 4];
            press.shore = [0.0; 3].into();
        }
        *value(proto, "hrn.check") = serde_json::to_string(&check).unwrap();
    })
}

#[test]
fn a_network_of_convolutions_and_a_gru_is_admitted_and_runs() {
    for most in [3, 48] {
        let hrn = Hrn::load(&network(most)).unwrap();
        let verdict = hrn.judge_course(&course(most, true)).unwrap();
        assert_eq!(verdict.probabilities, [0.25; 4]);
    }
}
