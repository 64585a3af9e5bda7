use tract_onnx::prelude::*;

use super::*;
use crate::net::graph::{Graph, model, number, value_info};
use hardnessd_core::verdict::MIN_OPSET;

fn floats_attribute(name: &str, values: &[f32]) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Floats as i32,
        floats: values.to_vec(),
        ..Default::default()
    }
}

fn text_attribute(name: &str, value: &str) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::String as i32,
        s: value.into(),
        ..Default::default()
    }
}

fn texts_attribute(name: &str, values: &[&str]) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Strings as i32,
        strings: values.iter().map(|&value| value.into()).collect(),
        ..Default::default()
    }
}

/// A node of `ai.onnx.ml` from `x` to `y`.
fn learner(operator: &str, outputs: &[&str], attribute: Vec<pb::AttributeProto>) -> pb::NodeProto {
    pb::NodeProto {
        op_type: operator.to_owned(),
        domain: LEARNERS.to_owned(),
        input: vec!["x".to_owned()],
        output: outputs.iter().map(|&output| output.to_owned()).collect(),
        attribute,
        ..Default::default()
    }
}

/// What the inference library computes for `y` of length `length` once `nodes` are replaced. The
/// constants are `t`, numbers, `which`, indices, and `upright`, a shape.
fn run(nodes: &[pb::NodeProto], opset: i64, x: &[f32], length: usize) -> Vec<f32> {
    let mut graph = Graph::default();
    graph.constant("t", &[3], &[0.1, 0.7, 0.2]);
    graph.indices("which", &[2, 0]);
    graph.indices("upright", &[-1, 1]);
    for node in nodes {
        graph.push(node.clone());
    }
    let inputs = vec![value_info("x", &[1, x.len()])];
    let outputs = vec![value_info("y", &[1, length])];
    let mut proto = model(graph, inputs, outputs, Vec::new());
    proto.opset_import[0].version = opset;
    replace(proto.graph.as_mut().unwrap(), opset).unwrap();
    let plan = tract_onnx::onnx()
        .model_for_proto_model(&proto)
        .and_then(|model| model.with_input_fact(0, f32::fact([1, x.len()]).into()))
        .and_then(InferenceModelExt::into_optimized)
        .and_then(IntoRunnable::into_runnable)
        .unwrap();
    let input = Tensor::from_shape(&[1, x.len()], x).unwrap();
    let outputs = plan.run(tvec!(input.into())).unwrap();
    assert_eq!(outputs[0].shape(), [1, length]);
    let output = outputs[0].try_as_plain_ram().unwrap();
    output.as_slice::<f32>().unwrap().to_vec()
}

fn assert_near(found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (found_one, expected_one) in found.iter().zip(expected) {
        let difference = (f64::from(*found_one) - expected_one).abs();
        assert!(difference < 1e-5, "{found:?}, {expected:?}");
    }
}

#[test]
fn simple_steps_compute_what_onnxruntime_does() {
    let x = [-4.0, 0.5, 2.0];
    let scaler = [
        floats_attribute("offset", &[1.0]),
        floats_attribute("scale", &[2.0, 3.0, 4.0]),
    ];
    let of_columns = |which: &str| pb::NodeProto {
        input: vec!["x".to_owned(), which.to_owned()],
        ..learner("ArrayFeatureExtractor", &["y"], Vec::new())
    };
    for opset in [MIN_OPSET, 18] {
        for (node, expected) in [
            (
                learner("Scaler", &["y"], scaler.to_vec()),
                &[-10.0, -1.5, 4.0][..],
            ),
            (
                learner("Binarizer", &["y"], vec![number("threshold", 0.5)]),
                &[0.0, 0.0, 1.0],
            ),
            // The greatest number, not the greatest absolute one.
            (
                learner("Normalizer", &["y"], vec![text_attribute("norm", "MAX")]),
                &[-2.0, 0.25, 1.0],
            ),
            (of_columns("which"), &[2.0, -4.0]),
        ] {
            assert_near(&run(&[node], opset, &x, expected.len()), expected);
        }
    }
    assert_near(
        &run(
            &[learner(
                "Normalizer",
                &["y"],
                vec![text_attribute("norm", "MAX")],
            )],
            MIN_OPSET,
            &[0.0, -1.0, -2.0],
            3,
        ),
        &[0.0, -1.0, -2.0],
    );
}

#[test]
fn a_sum_of_powers_neither_overflows_nor_vanishes() {
    let node = pb::NodeProto {
        op_type: "ReduceLogSumExp".to_owned(),
        input: vec!["x".to_owned()],
        output: vec!["y".to_owned()],
        attribute: vec![integers("axes", &[1]), integer("keepdims", 1)],
        ..Default::default()
    };
    for shift in [-1000.0_f32, 0.0, 1000.0] {
        let x = [shift, shift + 1.0];
        let expected = f64::from(shift) + (1.0 + 1_f64.exp()).ln();
        let found = run(std::slice::from_ref(&node), MIN_OPSET, &x, 1)[0];
        assert!(
            (f64::from(found) - expected).abs() < 1e-4,
            "{found}, {expected}"
        );
    }
}

#[test]
fn probabilities_of_large_logarithms_add_up_to_one() {
    let node = |operator: &str, inputs: &[&str], output: &str, attribute| pb::NodeProto {
        op_type: operator.to_owned(),
        input: inputs.iter().map(|&input| input.to_owned()).collect(),
        output: vec![output.to_owned()],
        attribute,
        ..Default::default()
    };
    let axes = vec![integers("axes", &[1]), integer("keepdims", 0)];
    let nodes = [
        node("ReduceLogSumExp", &["x"], "sum", axes),
        node("Reshape", &["sum", "upright"], "column", Vec::new()),
        node("Sub", &["x", "column"], "logarithms", Vec::new()),
        node("Exp", &["logarithms"], "y", Vec::new()),
    ];
    let first = 1.0 / (1.0 + 0.5_f64.exp());
    for shift in [-1e5, 0.0, 6124.0] {
        let found = run(&nodes, MIN_OPSET, &[shift, shift + 0.5], 2);
        assert_near(&found, &[first, 1.0 - first]);
    }
}

#[test]
fn an_index_that_depends_on_the_input_becomes_a_product() {
    let least = pb::NodeProto {
        op_type: "ArgMin".to_owned(),
        input: vec!["x".to_owned()],
        output: vec!["at".to_owned()],
        attribute: vec![integer("axis", 1)],
        ..Default::default()
    };
    let found = pb::NodeProto {
        input: vec!["t".to_owned(), "at".to_owned()],
        ..learner("ArrayFeatureExtractor", &["y"], Vec::new())
    };
    let nodes = [least, found];
    for (x, expected) in [
        ([1.0, 2.0, 3.0], 0.1),
        ([1.0, 0.0, 3.0], 0.7),
        ([1.0, 2.0, 0.0], 0.2),
    ] {
        assert_near(&run(&nodes, MIN_OPSET, &x, 1), &[expected]);
    }
}

/// A small SVC of three classes with two, one and two support vectors of two numbers.
fn svc(kernel: &str, probabilities: bool) -> Vec<pb::AttributeProto> {
    let mut attributes = vec![
        integers("vectors_per_class", &[2, 1, 2]),
        floats_attribute("support_vectors", &SUPPORT),
        floats_attribute("coefficients", &COEFFICIENTS),
        floats_attribute("rho", &RHO),
        floats_attribute("kernel_params", &[0.5, 0.25, 3.0]),
        text_attribute("kernel_type", kernel),
        integers("classlabels_ints", &[1, 2, 3]),
    ];
    if probabilities {
        attributes.push(floats_attribute("prob_a", &PROB_A));
        attributes.push(floats_attribute("prob_b", &PROB_B));
    }
    attributes
}

const SUPPORT: [f32; 10] = [0.0, 1.0, 1.0, 0.5, -1.0, 0.25, 2.0, -1.0, 0.5, 0.75];
const COEFFICIENTS: [f32; 10] = [1.0, 0.5, -1.5, -0.5, -0.75, 0.25, 1.0, 0.5, -1.0, -0.25];
const RHO: [f32; 3] = [0.1, -0.2, 0.3];
const PROB_A: [f32; 3] = [-2.0, -1.5, -0.5];
const PROB_B: [f32; 3] = [0.1, 0.2, -0.3];

/// The scores of the pairs 0-1, 0-2 and 1-2, as libsvm defines them.
fn scores(kernel: &str, x: [f32; 2]) -> [f64; 3] {
    let kernels: Vec<f64> = SUPPORT
        .chunks(2)
        .map(|vector| {
            let terms = x
                .iter()
                .zip(vector)
                .map(|(&x, &v)| (f64::from(x), f64::from(v)));
            let product: f64 = terms.clone().map(|(x, v)| x * v).sum();
            match kernel {
                "RBF" => (-0.5 * terms.map(|(x, v)| (x - v).powi(2)).sum::<f64>()).exp(),
                "POLY" => (0.5 * product + 0.25).powi(3),
                "SIGMOID" => (0.5 * product + 0.25).tanh(),
                _ => product,
            }
        })
        .collect();
    let of_class = [0..2, 2..3, 3..5];
    [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| {
        let weighted = |row: usize, class: usize| -> f64 {
            let vectors = of_class[class].clone();
            let weighted = vectors.map(|m| f64::from(COEFFICIENTS[row * 5 + m]) * kernels[m]);
            weighted.sum()
        };
        weighted(j - 1, i) + weighted(i, j) + f64::from(RHO[i + j - 1])
    })
}

#[test]
fn an_svc_scores_its_pairs_as_libsvm() {
    for kernel in ["LINEAR", "POLY", "RBF", "SIGMOID"] {
        for x in [[0.0, 0.0], [1.5, -0.5], [-2.0, 3.0]] {
            let node = learner("SVMClassifier", &["label", "y"], svc(kernel, false));
            assert_near(&run(&[node], MIN_OPSET, &x, 3), &scores(kernel, x));
        }
    }
}

/// libsvm's coupling of the probabilities of pairs, with its stop.
fn coupled(of_pairs: [f64; 3]) -> [f64; 3] {
    let mut r = [[0.0; 3]; 3];
    for ((i, j), value) in [(0, 1), (0, 2), (1, 2)].into_iter().zip(of_pairs) {
        r[i][j] = value.clamp(1e-7, 1.0 - 1e-7);
        r[j][i] = 1.0 - r[i][j];
    }
    let mut q = [[0.0; 3]; 3];
    for t in 0..3 {
        for j in (0..3).filter(|&j| j != t) {
            q[t][t] += r[j][t] * r[j][t];
            q[t][j] = -r[j][t] * r[t][j];
        }
    }
    let mut p = [1.0 / 3.0; 3];
    for _ in 0..100 {
        let qp = q.map(|row| row.iter().zip(p).map(|(q, p)| q * p).sum::<f64>());
        let pqp: f64 = p.iter().zip(qp).map(|(p, qp)| p * qp).sum();
        if qp.iter().all(|qp| (qp - pqp).abs() < 0.005 / 3.0) {
            break;
        }
        for t in 0..3 {
            let qp_t: f64 = q[t].iter().zip(p).map(|(q, p)| q * p).sum();
            let pqp: f64 = (0..3)
                .map(|i| p[i] * q[i].iter().zip(p).map(|(q, p)| q * p).sum::<f64>())
                .sum();
            p[t] += (pqp - qp_t) / q[t][t];
            let sum: f64 = p.iter().sum();
            p = p.map(|p| p / sum);
        }
    }
    p
}

#[test]
fn an_svc_couples_the_probabilities_of_its_pairs_as_libsvm() {
    for opset in [MIN_OPSET, 18] {
        for x in [[0.0, 0.0], [1.5, -0.5], [-2.0, 3.0], [9.0, 9.0]] {
            let node = learner("SVMClassifier", &["label", "y"], svc("LINEAR", true));
            let mut of_pairs = scores("LINEAR", x);
            for (pair, value) in of_pairs.iter_mut().enumerate() {
                let steep = *value * f64::from(PROB_A[pair]) + f64::from(PROB_B[pair]);
                *value = 1.0 / (1.0 + steep.exp());
            }
            assert_near(&run(&[node], opset, &x, 3), &coupled(of_pairs));
        }
    }
}

#[test]
fn a_broken_learner_is_refused_or_left_as_it_is() {
    let replaced = |node: pb::NodeProto| {
        let mut graph = pb::GraphProto {
            node: vec![node],
            ..Default::default()
        };
        replace(&mut graph, MIN_OPSET).map_err(|error| error.to_string())
    };
    let without_input = pb::NodeProto {
        input: Vec::new(),
        ..learner("Scaler", &["y"], Vec::new())
    };
    assert_eq!(replaced(without_input), Ok(Vec::new()));
    let svc_with = |changed: pb::AttributeProto| {
        let mut attributes = svc("RBF", true);
        attributes.retain(|found| found.name != changed.name);
        attributes.push(changed);
        replaced(learner("SVMClassifier", &["label", "y"], attributes)).unwrap_err()
    };
    for changed in [
        integers("vectors_per_class", &[]),
        integers("vectors_per_class", &[i64::MAX, i64::MAX, 1]),
        integers("vectors_per_class", &[-1, 4, 2]),
        floats_attribute("support_vectors", &[1.0]),
        floats_attribute("coefficients", &[]),
        floats_attribute("prob_a", &[1.0]),
    ] {
        let found = svc_with(changed);
        assert_eq!(found, "operator SVMClassifier: its lists differ in length");
    }
    let many = svc_with(integers("vectors_per_class", &[1; 33]));
    assert!(many.contains("more than 32 classes"), "{many}");
    let kernel = svc_with(text_attribute("kernel_type", "COSINE"));
    assert!(kernel.contains("`kernel_type`"), "{kernel}");
}

/// One tree of two leaves that votes for one score of two classes.
fn two_classes(post_transform: &str, weights: [f32; 2], base: &[f32]) -> pb::NodeProto {
    let attributes = vec![
        integers("nodes_treeids", &[0, 0, 0]),
        integers("nodes_nodeids", &[0, 1, 2]),
        integers("nodes_featureids", &[0, 0, 0]),
        integers("nodes_truenodeids", &[1, 0, 0]),
        integers("nodes_falsenodeids", &[2, 0, 0]),
        floats_attribute("nodes_values", &[0.5, 0.0, 0.0]),
        texts_attribute("nodes_modes", &["BRANCH_LEQ", "LEAF", "LEAF"]),
        integers("class_treeids", &[0, 0]),
        integers("class_nodeids", &[1, 2]),
        integers("class_ids", &[0, 0]),
        floats_attribute("class_weights", &weights),
        floats_attribute("base_values", base),
        texts_attribute("classlabels_strings", &["hard", "soft"]),
        text_attribute("post_transform", post_transform),
    ];
    learner("TreeEnsembleClassifier", &["label", "y"], attributes)
}

#[test]
fn trees_of_two_classes_with_texts_share_a_score() {
    let logistic = |score: f64| 1.0 / (1.0 + (-score).exp());
    for (x, score) in [(0.0, 0.25 - 2.0), (1.0, 0.25 + 3.0)] {
        let found = run(
            &[two_classes("LOGISTIC", [-2.0, 3.0], &[0.25])],
            MIN_OPSET,
            &[x],
            2,
        );
        assert_near(&found, &[logistic(-score), logistic(score)]);
    }
    let found = run(
        &[two_classes("NONE", [0.25, 0.75], &[0.0])],
        MIN_OPSET,
        &[1.0],
        2,
    );
    assert_near(&found, &[0.25, 0.75]);
    for (transform, weights, base) in [
        ("LOGISTIC", [2.0, 3.0], &[0.25][..]),
        ("LOGISTIC", [-2.0, 3.0], &[0.25, 0.25]),
        ("NONE", [-0.25, 0.75], &[]),
        ("SOFTMAX", [-0.25, 0.75], &[]),
    ] {
        let mut graph = pb::GraphProto {
            node: vec![two_classes(transform, weights, base)],
            ..Default::default()
        };
        let refused = replace(&mut graph, MIN_OPSET).unwrap_err().to_string();
        assert!(refused.contains("runtimes disagree"), "{refused}");
    }
}
