use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;
use tract_onnx::pb::{AttributeProto, GraphProto, NodeProto, TensorProto};

use super::*;

fn node(domain: &str, operator: &str, inputs: &[&str], outputs: &[&str]) -> NodeProto {
    let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    NodeProto {
        domain: domain.to_owned(),
        op_type: operator.to_owned(),
        input: owned(inputs),
        output: owned(outputs),
        ..Default::default()
    }
}

fn int(name: &str, value: i64) -> AttributeProto {
    AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Int as i32,
        i: value,
        ..Default::default()
    }
}

fn texts(name: &str, texts: &[&str]) -> AttributeProto {
    AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Strings as i32,
        strings: texts.iter().map(|text| text.as_bytes().to_vec()).collect(),
        ..Default::default()
    }
}

fn cast(input: &str, to: DataType, output: &str) -> NodeProto {
    let mut cast = node("", "Cast", &[input], &[output]);
    cast.attribute.push(int("to", to as i64));
    cast
}

fn value(name: &str) -> pb::ValueInfoProto {
    use pb::tensor_shape_proto::{Dimension, dimension::Value};
    let dim = |length| Dimension {
        value: Some(Value::DimValue(length)),
        ..Default::default()
    };
    let tensor = pb::type_proto::Tensor {
        elem_type: DataType::Float as i32,
        shape: Some(pb::TensorShapeProto {
            dim: vec![dim(1), dim(4)],
        }),
    };
    pb::ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(pb::TypeProto {
            value: Some(pb::type_proto::Value::TensorType(tensor)),
            ..Default::default()
        }),
        ..Default::default()
    }
}

/// A graph from `x`, f32 [1, 4], to `y`. `i0` and `i4` are the integers 0 and 4.
fn graph(nodes: &[NodeProto]) -> GraphProto {
    let ints = |name: &str, int: i64| TensorProto {
        name: name.to_owned(),
        dims: vec![1],
        data_type: DataType::Int64 as i32,
        int64_data: vec![int],
        ..Default::default()
    };
    GraphProto {
        node: nodes.to_vec(),
        initializer: vec![ints("i0", 0), ints("i4", 4)],
        input: vec![value("x")],
        output: vec![pb::ValueInfoProto {
            name: "y".to_owned(),
            ..Default::default()
        }],
        ..Default::default()
    }
}

/// Checks a graph as [`super::super::Hrn::read`] does.
fn check(graph: GraphProto) -> Result<(), ModelError> {
    check_operators(&graph)?;
    let proto = pb::ModelProto {
        ir_version: 8,
        opset_import: vec![pb::OperatorSetIdProto {
            version: 17,
            ..Default::default()
        }],
        graph: Some(graph),
        ..Default::default()
    };
    let onnx = tract_onnx::onnx().with_ignore_value_info(true);
    let model = onnx.model_for_proto_model(&proto).unwrap();
    check_values(&model.into_typed().unwrap().into_decluttered().unwrap())
}

#[test]
fn every_operator_of_the_list_is_in_the_inference_library_and_on_the_page() {
    let known = tract_onnx::onnx().op_register.0;
    for (_, operator) in OPERATORS {
        assert!(known.contains_key(*operator), "{operator}");
    }
    let page = include_str!("../../../../../docs/formats.md");
    let (_, page) = page.split_once("that a graph may use:").unwrap();
    let (page, _) = page.split_once("From PyTorch").unwrap();
    let (of_onnx, of_learners) = page.split_once("and of `ai.onnx.ml`: `").unwrap();
    let names = |text: &'static str| {
        let is_between = |char: char| !char.is_ascii_alphanumeric();
        text.split(is_between)
            .filter(|name| !name.is_empty() && *name != "text")
    };
    let listed = names(of_onnx).map(|name| ("", name));
    let listed = listed.chain(names(of_learners).map(|name| (LEARNERS, name)));
    assert_eq!(listed.collect::<Vec<_>>(), OPERATORS);
}

#[test]
fn integers_that_depend_on_an_input_are_no_indices_or_divisors() {
    let divided = [
        cast("x", DataType::Int64, "whole"),
        node("", "Div", &["i4", "whole"], &["share"]),
        cast("share", DataType::Float, "y"),
    ];
    let picked = [
        node("", "ArgMax", &["x"], &["most"]),
        node("", "Gather", &["x", "most"], &["y"]),
    ];
    let in_a_loop = {
        let mut body = graph(&divided);
        body.input[0].name = "x".to_owned();
        body.output = vec![value("y")];
        let mut scan = node("", "Scan", &["xs"], &["y"]);
        scan.attribute = vec![
            int("num_scan_inputs", 1),
            AttributeProto {
                name: "body".to_owned(),
                r#type: AttributeType::Graph as i32,
                g: Some(body),
                ..Default::default()
            },
        ];
        let mut stacked = node("", "Concat", &["first", "second"], &["xs"]);
        stacked.attribute.push(int("axis", 0));
        [
            node("", "Unsqueeze", &["x", "i0"], &["first"]),
            node("", "Exp", &["first"], &["second"]),
            stacked,
            scan,
        ]
    };
    for nodes in [&divided[..], &picked, &in_a_loop] {
        let error = check(graph(nodes)).unwrap_err().to_string();
        let expected = "it takes integers that depend on an input of the model";
        assert!(error.contains(expected), "{error}");
    }
    // Integers may be compared, and what depends on no input may be anything.
    let compared = [
        node("", "ArgMax", &["x"], &["most"]),
        node("", "Equal", &["most", "i4"], &["is"]),
        cast("is", DataType::Float, "y"),
    ];
    let of_a_shape = [
        node("", "Shape", &["x"], &["shape"]),
        node("", "Div", &["shape", "i4"], &["indices"]),
        node("", "Gather", &["x", "i0"], &["first"]),
        node("", "Reshape", &["first", "shape"], &["y"]),
    ];
    for nodes in [&compared[..], &of_a_shape] {
        check(graph(nodes)).unwrap();
    }
}

#[test]
fn a_shape_that_is_open_is_refused() {
    let mut model = TypedModel::default();
    let length = model.symbols.sym("n");
    let fact = f32::fact([TDim::from(length)]);
    model.add_source("x", fact).unwrap();
    let error = check_values(&model).unwrap_err().to_string();
    let expected = "the shape of its output depends on an input of the model";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn a_graph_of_too_many_numbers_is_refused() {
    let twice = |number: usize| {
        let [from, to] = [number, number + 1].map(|number| match number {
            0 => "x".to_owned(),
            24 => "y".to_owned(),
            number => format!("value {number}"),
        });
        let mut concat = node("", "Concat", &[&from, &from], &[&to]);
        concat.attribute.push(int("axis", 0));
        concat
    };
    let nodes: Vec<NodeProto> = (0..24).map(twice).collect();
    let error = check(graph(&nodes)).unwrap_err().to_string();
    assert!(error.contains("more than 64000000 numbers"), "{error}");
}

#[test]
fn what_the_inference_library_would_ignore_is_refused() {
    let check = |operator: &str, attribute: AttributeProto| {
        let mut node = node("", operator, &[], &["y"]);
        node.attribute.push(attribute);
        check_operator(&node)
    };
    let usual = ["Sigmoid", "Tanh"];
    for activations in [&usual[..], &["Sigmoid", "Tanh", "Sigmoid", "Tanh"]] {
        check("GRU", texts("activations", activations)).unwrap();
    }
    check("LSTM", int("input_forget", 0)).unwrap();
    for (operator, attribute) in [
        ("LSTM", texts("activations", &usual)),
        ("GRU", texts("activations", &["HardSigmoid", "Tanh"])),
        ("RNN", texts("activations", &["Tanh", "Relu"])),
        ("GRU", int("clip", 1)),
        ("LSTM", int("input_forget", 1)),
        ("BatchNormalization", int("training_mode", 1)),
    ] {
        let name = attribute.name.clone();
        let problem = check(operator, attribute).unwrap_err().to_string();
        assert!(problem.contains(&name), "{operator}: {problem}");
    }
}

#[test]
fn an_operator_of_another_domain_is_named_with_it() {
    for (domain, operator, expected) in [
        ("", "Loop", "model node \"y\" (Loop): this operator is not"),
        ("com.microsoft", "Relu", "\"y\" (com.microsoft.Relu): this"),
        ("", "Normalizer", "\"y\" (Normalizer): this operator"),
    ] {
        let nodes = [node(domain, operator, &["x"], &["y"])];
        let error = check(graph(&nodes)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    check(graph(&[node("ai.onnx", "Relu", &["x"], &["y"])])).unwrap();
}

/// A node of two trees over three features and two classes.
fn forest() -> NodeProto {
    let list = |name: &str, ints: &[i64]| AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Ints as i32,
        ints: ints.to_vec(),
        ..Default::default()
    };
    let numbers = |name: &str, count: usize| AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Floats as i32,
        floats: vec![0.5; count],
        ..Default::default()
    };
    let mut trees = node(LEARNERS, "TreeEnsembleClassifier", &["x"], &["label", "y"]);
    let branch = ["BRANCH_LEQ", "LEAF", "LEAF"];
    trees.attribute = vec![
        list("nodes_treeids", &[0, 0, 0, 1, 1, 1]),
        list("nodes_nodeids", &[0, 1, 2, 0, 1, 2]),
        list("nodes_featureids", &[0, 0, 0, 2, 0, 0]),
        list("nodes_truenodeids", &[1, 0, 0, 1, 0, 0]),
        list("nodes_falsenodeids", &[2, 0, 0, 2, 0, 0]),
        texts("nodes_modes", &[branch, branch].concat()),
        numbers("nodes_values", 6),
        list("class_treeids", &[0, 0, 1, 1]),
        list("class_nodeids", &[1, 2, 1, 2]),
        list("class_ids", &[0, 1, 0, 1]),
        numbers("class_weights", 4),
        list("classlabels_int64s", &[0, 1]),
    ];
    trees
}

#[test]
fn every_place_that_a_tree_names_exists() {
    check(graph(&[forest()])).unwrap();
    let refused = |change: &dyn Fn(&mut AttributeProto), name: &str| {
        let mut trees = forest();
        let mut attributes = trees.attribute.iter_mut();
        change(attributes.find(|list| list.name == name).unwrap());
        check_operator(&trees).unwrap_err().to_string()
    };
    for (name, place, value, expected) in [
        ("nodes_truenodeids", 0, 0, "leads nowhere"),
        ("nodes_falsenodeids", 3, 3, "leads nowhere"),
        ("nodes_nodeids", 1, 5, "node 5 of tree 0 is out of order"),
        ("nodes_treeids", 3, 2, "node 1 of tree 1 is out of order"),
        ("class_ids", 3, 2, "a vote for class 2"),
        ("class_ids", 3, -1, "a vote for class -1"),
        ("class_nodeids", 0, 0, "at node 0 of tree 0"),
        ("class_treeids", 3, 7, "at node 2 of tree 7"),
    ] {
        let problem = refused(&|list| list.ints[place] = value, name);
        assert!(problem.contains(expected), "{name}: {problem}");
    }
    for name in [
        "nodes_treeids",
        "nodes_nodeids",
        "nodes_truenodeids",
        "nodes_falsenodeids",
        "nodes_modes",
        "class_treeids",
        "class_nodeids",
        "class_ids",
    ] {
        let problem = refused(&|list| list.name.clear(), name);
        assert!(problem.contains("differ in length"), "{name}: {problem}");
    }
    let taken_for_a_leaf = |list: &mut AttributeProto| list.strings[0] = b"BRANCH_GTE".to_vec();
    let problem = refused(&taken_for_a_leaf, "nodes_modes");
    assert!(problem.contains("`nodes_modes`"), "{problem}");
}
