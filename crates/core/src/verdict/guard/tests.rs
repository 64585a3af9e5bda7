use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;
use tract_onnx::pb::{AttributeProto, GraphProto, NodeProto};

use super::super::forest;
use super::*;
use crate::tests::graph::{indices, int, ints, node, value};

fn texts(name: &str, texts: &[&str]) -> AttributeProto {
    AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Strings as i32,
        strings: texts.iter().map(|text| text.as_bytes().to_vec()).collect(),
        ..Default::default()
    }
}

fn body(graph: GraphProto) -> AttributeProto {
    AttributeProto {
        name: "body".to_owned(),
        r#type: AttributeType::Graph as i32,
        g: Some(graph),
        ..Default::default()
    }
}

fn cast(input: &str, to: DataType, output: &str) -> NodeProto {
    node("Cast", &[input], &[output], &[int("to", to as i64)])
}

fn plain(operator: &str, inputs: &[&str], output: &str) -> NodeProto {
    node(operator, inputs, &[output], &[])
}

/// A graph from `x`, f32 [1, 4], to `y`. `i0` and `i4` are the integers 0 and 4.
fn graph(nodes: &[NodeProto]) -> GraphProto {
    GraphProto {
        node: nodes.to_vec(),
        initializer: vec![indices("i0", &[0]), indices("i4", &[4])],
        input: vec![value("x", &[1, 4])],
        output: vec![pb::ValueInfoProto {
            name: "y".to_owned(),
            ..Default::default()
        }],
        ..Default::default()
    }
}

/// Checks a graph as [`super::super::Model::read`] does.
fn check(graph: GraphProto) -> Result<(), ModelError> {
    check_operators(&graph)?;
    check_values(&typed(graph))
}

/// A graph as the inference library reads it.
fn typed(graph: GraphProto) -> TypedModel {
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
    model.into_typed().unwrap().into_decluttered().unwrap()
}

#[test]
fn integers_that_depend_on_an_input_are_no_indices_or_divisors() {
    let divided = [
        cast("x", DataType::Int64, "whole"),
        plain("Div", &["i4", "whole"], "share"),
        cast("share", DataType::Float, "y"),
    ];
    let picked = [
        plain("ArgMax", &["x"], "most"),
        plain("Gather", &["x", "most"], "y"),
    ];
    for nodes in [&divided[..], &picked] {
        let error = check(graph(nodes)).unwrap_err().to_string();
        let expected = "it takes integers that depend on an input of the model";
        assert!(error.contains(expected), "{error}");
    }
    // Integers may be compared, and what depends on no input may be anything.
    let compared = [
        plain("ArgMax", &["x"], "most"),
        plain("Equal", &["most", "i4"], "is"),
        cast("is", DataType::Float, "y"),
    ];
    let of_a_shape = [
        plain("Shape", &["x"], "shape"),
        plain("Div", &["shape", "i4"], "indices"),
        plain("Gather", &["x", "i0"], "first"),
        plain("Reshape", &["first", "shape"], "y"),
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
fn a_graph_that_an_input_chooses_is_refused() {
    let inner = graph(&[plain("Loop", &["x"], "y")]);
    let scan = node("Scan", &["x"], &["y"], &[body(inner)]);
    for nodes in [[plain("If", &["x"], "y")], [scan]] {
        let error = check(graph(&nodes)).unwrap_err().to_string();
        assert!(error.contains("that runs a graph as an input"), "{error}");
    }
}

/// A node of two trees over three features and two classes.
fn forest() -> NodeProto {
    let numbers = |name: &str, count: usize| AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Floats as i32,
        floats: vec![0.5; count],
        ..Default::default()
    };
    let branch = ["BRANCH_LEQ", "LEAF", "LEAF"];
    let attributes = [
        ints("nodes_treeids", &[0, 0, 0, 1, 1, 1]),
        ints("nodes_nodeids", &[0, 1, 2, 0, 1, 2]),
        ints("nodes_featureids", &[0, 0, 0, 2, 0, 0]),
        ints("nodes_truenodeids", &[1, 0, 0, 1, 0, 0]),
        ints("nodes_falsenodeids", &[2, 0, 0, 2, 0, 0]),
        texts("nodes_modes", &[branch, branch].concat()),
        numbers("nodes_values", 6),
        ints("class_treeids", &[0, 0, 1, 1]),
        ints("class_nodeids", &[1, 2, 1, 2]),
        ints("class_ids", &[0, 1, 0, 1]),
        numbers("class_weights", 4),
        ints("classlabels_int64s", &[0, 1]),
    ];
    NodeProto {
        domain: "ai.onnx.ml".to_owned(),
        ..node(
            "TreeEnsembleClassifier",
            &["x"],
            &["label", "y"],
            &attributes,
        )
    }
}

#[test]
fn a_quick_forest_votes_as_that_of_the_library() {
    let library = typed(graph(&[forest()]));
    let mut quick = library.clone();
    forest::quicken(&mut quick);
    let names = quick.nodes().iter().map(|node| node.op.name());
    assert!(names.into_iter().any(|name| name == "Forest"));
    let plans = [library, quick].map(|model| model.into_runnable().unwrap());
    let values = [-1.0, 0.5, 0.75, f32::NAN];
    for (first, third) in values
        .iter()
        .flat_map(|a| values.iter().map(move |b| (*a, *b)))
    {
        let [expected, found] = plans.each_ref().map(|plan| {
            let x = Tensor::from_shape(&[1, 4], &[first, 9.0, third, 9.0]).unwrap();
            let y = plan.run(tvec!(x.into())).unwrap().remove(0);
            y.to_plain_array_view::<f32>()
                .unwrap()
                .as_slice()
                .unwrap()
                .to_vec()
        });
        assert_eq!(found, expected, "{first} {third}");
    }
}

#[test]
fn every_place_that_a_tree_names_exists() {
    check(graph(&[forest()])).unwrap();
    let refused = |change: &dyn Fn(&mut AttributeProto), name: &str| {
        let mut trees = forest();
        let mut attributes = trees.attribute.iter_mut();
        change(attributes.find(|list| list.name == name).unwrap());
        check_trees(&trees).unwrap_err()
    };
    for (name, place, value, expected) in [
        ("nodes_truenodeids", 0, 0, "to no later node"),
        ("nodes_falsenodeids", 3, 3, "to no later node"),
        ("nodes_nodeids", 1, 5, "not in order"),
        ("class_ids", 3, 2, "a vote is for"),
        ("class_ids", 3, -1, "a vote is for"),
        ("class_nodeids", 0, 0, "a vote is for"),
        ("class_treeids", 3, 7, "a vote is for"),
    ] {
        let problem = refused(&|list| list.ints[place] = value, name);
        assert!(problem.contains(expected), "{name}: {problem}");
    }
    for name in ["nodes_treeids", "nodes_falsenodeids", "class_ids"] {
        let problem = refused(&|list| list.ints.clear(), name);
        assert!(problem.contains("differ in length"), "{name}: {problem}");
    }
}
