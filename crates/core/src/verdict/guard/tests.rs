use std::panic::{AssertUnwindSafe, catch_unwind};

use prost::Message as _;
use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;
use tract_onnx::pb::{AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto};

use super::table::OPERATORS;
use super::*;
use crate::verdict::{BUILT_IN, Hrn};

/// Random numbers from a seed (SplitMix64).
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, most: usize) -> usize {
        (self.next() % most as u64) as usize
    }

    fn one<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }

    fn often(&mut self) -> bool {
        self.below(4) > 0
    }
}

/// Whole numbers that often make programs fail.
const WHOLE: [i64; 20] = [
    0,
    1,
    2,
    3,
    4,
    5,
    7,
    8,
    28,
    64,
    -1,
    -2,
    -9,
    784,
    1 << 20,
    1 << 31,
    (1 << 31) - 1,
    1 << 40,
    i64::MAX,
    i64::MIN,
];

fn model() -> ModelProto {
    ModelProto::decode(BUILT_IN).unwrap()
}

fn floats(name: &str, dims: &[i64]) -> TensorProto {
    let count = dims.iter().product::<i64>();
    TensorProto {
        name: name.to_owned(),
        dims: dims.to_vec(),
        data_type: DataType::Float as i32,
        float_data: (0..count).map(|n| n as f32 * 0.01 - 0.3).collect(),
        ..Default::default()
    }
}

fn ints(name: &str, ints: &[i64]) -> TensorProto {
    TensorProto {
        name: name.to_owned(),
        dims: vec![ints.len() as i64],
        data_type: DataType::Int64 as i32,
        int64_data: ints.to_vec(),
        ..Default::default()
    }
}

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

/// An attribute that the table allows, mostly near its bounds.
fn attribute(name: &str, allowed: Allowed, dice: &mut Dice) -> AttributeProto {
    let mut attribute = AttributeProto {
        name: name.to_owned(),
        r#type: allowed.kind() as i32,
        ..Default::default()
    };
    let mut int = |low: i64, high: i64| {
        let near = low.saturating_add(dice.below(4) as i64);
        let (near, far) = (near.min(high), if dice.often() { near } else { high });
        if dice.often() { near } else { far }
    };
    match allowed {
        Allowed::Int(low, high) => attribute.i = int(low.max(-4), high),
        Allowed::Ints(_, low, high) => {
            let length = [1, 2, 2, 4][(int(0, 3)) as usize];
            attribute.ints = (0..length).map(|_| int(low.max(-4), high)).collect();
        }
        Allowed::Float => attribute.f = [0.0, 1.0, 0.1, -1.0, f32::MAX, f32::NAN][dice.below(6)],
        Allowed::Floats(_) => attribute.floats = vec![0.5; dice.below(5)],
        Allowed::Text(texts) => attribute.s = dice.one(texts).as_bytes().to_vec(),
        Allowed::Texts(_, texts) => {
            attribute.strings = vec![dice.one(texts).as_bytes().to_vec(); 1 + dice.below(3)];
        }
        Allowed::Tensor => attribute.t = Some(ints("", &[1])),
        Allowed::Graph => {}
    }
    attribute
}

/// A graph of nodes that the guard accepts one by one, from the frame to probabilities.
fn accepted(seed: u64) -> GraphProto {
    let mut dice = Dice(seed);
    let mut graph = model().graph.unwrap();
    graph.node.clear();
    graph.initializer = vec![
        floats("f0", &[]),
        floats("f1", &[1]),
        floats("f4", &[4]),
        floats("f28", &[28]),
        floats("f1111", &[1, 1, 1, 1]),
        floats("frame-like", &[1, 1, 28, 28]),
        floats("kernel1", &[2, 1, 3, 3]),
        floats("kernel2", &[4, 2, 3, 3]),
        floats("kernel4", &[4, 1, 2, 2]),
        floats("square", &[28, 28]),
        floats("wide", &[784, 4]),
        floats("f2", &[2]),
        floats("w", &[1, 84, 28]),
        floats("r", &[1, 84, 28]),
        floats("b", &[1, 168]),
        ints("i0", &[0]),
        ints("i1", &[1]),
        ints("i2", &[2]),
        ints("i3", &[3]),
        ints("in1", &[-1]),
        ints("i23", &[2, 3]),
        ints("i01", &[0, 1]),
        ints("i1n1", &[1, -1]),
        ints("i14", &[14, 14]),
        ints("imax", &[i64::MAX]),
        ints("shape3", &[28, 1, 28]),
        ints("shape4", &[1, 1, 28, 28]),
        ints("pads", &[0, 0, 1, 1, 0, 0, 2, 1]),
        ints("ones", &[1, 1, 1, 1]),
        ints("none", &[]),
    ];
    // The values of the walk borrow the nodes, so the nodes are leaked.
    let base: &'static GraphProto = Box::leak(Box::new(graph.clone()));
    let mut walk = Walk::new(17 + dice.below(3) as i64);
    walk.tensors(base).unwrap();
    walk.bind("frame", tensor::declared(&base.input[0]).unwrap())
        .unwrap();
    let mut names: Vec<String> = base.initializer.iter().map(|t| t.name.clone()).collect();
    let mut last = "frame".to_owned();
    for number in 0..400 {
        if graph.node.len() >= 8 {
            break;
        }
        let operator = dice.one(OPERATORS);
        let name = *dice.one(operator.names);
        let (least, most) = operator.inputs;
        let count = least + dice.below(most.min(5).max(least) - least + 1);
        let inputs: Vec<&str> = (0..count)
            .map(|index| match index {
                0 if dice.often() => last.as_str(),
                _ if operator.gaps && index >= least && dice.below(3) == 0 => "",
                _ => dice.one(&names).as_str(),
            })
            .collect();
        let output = format!("value {number}");
        let mut outputs = vec![output.as_str()];
        let second = format!("second {number}");
        if operator.outputs.0 > 1 || (operator.outputs.1 > 1 && !dice.often()) {
            outputs.push(&second);
        }
        let mut made = node(operator.domain, name, &inputs, &outputs);
        for &(name, allowed) in operator.attributes {
            if dice.below(3) > 0 {
                made.attribute.push(attribute(name, allowed, &mut dice));
            }
        }
        let kept: &'static NodeProto = Box::leak(Box::new(made));
        let before = walk.cost;
        if walk.node(kept).is_ok() {
            graph.node.push(kept.clone());
            names.push(output.clone());
            if walk.values[output.as_str()].datum == Datum::F32 {
                last = output;
            }
        } else {
            walk.cost = before;
        }
    }
    // Turn the last value, whatever it is, into four numbers.
    graph.initializer.push(floats("four", &[1, 4]));
    graph.initializer.push(ints("one by one", &[1, 1]));
    let mut mean = node("", "ReduceSum", &[&last], &["mean"]);
    mean.attribute.push(AttributeProto {
        name: "keepdims".to_owned(),
        r#type: AttributeType::Int as i32,
        ..Default::default()
    });
    graph.node.extend([
        mean,
        node("", "Reshape", &["mean", "one by one"], &["matrix"]),
        node("", "MatMul", &["matrix", "four"], &["logits"]),
        node("", "Softmax", &["logits"], &["probabilities"]),
    ]);
    graph
}

/// Loads a file as a trial does. An error is the message of a panic.
fn load(bytes: &[u8]) -> Result<String, String> {
    let loaded = catch_unwind(AssertUnwindSafe(|| match Hrn::load(bytes) {
        Ok(_) => "good".to_owned(),
        Err(ModelError::Guard { .. }) => "guard".to_owned(),
        Err(ModelError::Graph(problem)) => format!("graph: {problem}"),
        Err(other) => other.to_string(),
    }));
    loaded.map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        text.or_else(|| panic.downcast_ref::<&str>().map(|&text| text.to_owned()))
            .unwrap_or_default()
    })
}

/// How many graphs a test tries. `HARDNESSD_GRAPHS` sets more, to search for gaps in the guard.
fn tries(usual: u64) -> u64 {
    let wanted = std::env::var("HARDNESSD_GRAPHS").ok();
    wanted.map_or(usual, |wanted| wanted.parse().unwrap())
}

fn report(panics: &[(u64, String)], reached: u64, tries: u64) {
    eprintln!("{reached} of {tries} graphs reached the inference library");
    let seen: Vec<String> = panics
        .iter()
        .take(40)
        .map(|(seed, panic)| format!("{seed}: {panic:.300}"))
        .collect();
    assert!(panics.is_empty(), "{} panics: {seen:#?}", panics.len());
}

#[test]
fn no_graph_that_the_guard_accepts_makes_the_inference_library_panic() {
    let (mut panics, mut reached) = (Vec::new(), 0);
    let tries = tries(150);
    for seed in 0..tries {
        let mut model = model();
        model.graph = Some(accepted(seed));
        model.opset_import[0].version = 17 + Dice(seed).below(3) as i64;
        match load(&model.encode_to_vec()) {
            Ok(came) => reached += u64::from(came != "guard"),
            Err(panic) => {
                let operators: Vec<String> = model
                    .graph
                    .unwrap()
                    .node
                    .iter()
                    .map(|node| node.op_type.clone())
                    .collect();
                panics.push((seed, format!("{} {panic}", operators.join(","))));
            }
        }
    }
    assert!(reached * 4 > tries, "only {reached} of {tries} were tried");
    report(&panics, reached, tries);
}

#[test]
fn no_damage_to_the_graph_makes_the_inference_library_panic() {
    let (mut panics, mut reached) = (Vec::new(), 0);
    let tries = tries(300);
    for seed in 0..tries {
        let mut dice = Dice(seed);
        let mut model = model();
        if seed % 2 == 1 {
            model.graph = Some(accepted(seed));
        }
        for _ in 0..=dice.below(3) {
            damage(model.graph.as_mut().unwrap(), &mut dice);
        }
        match load(&model.encode_to_vec()) {
            Ok(came) => reached += u64::from(came != "guard"),
            Err(panic) => panics.push((seed, panic)),
        }
    }
    report(&panics, reached, tries);
}

/// Changes one field of a graph.
fn damage(graph: &mut GraphProto, dice: &mut Dice) {
    let (nodes, tensors) = (graph.node.len(), graph.initializer.len());
    let names: Vec<String> = graph
        .node
        .iter()
        .flat_map(|node| node.output.clone())
        .chain(graph.initializer.iter().map(|t| t.name.clone()))
        .collect();
    let node = &mut graph.node[dice.below(nodes)];
    let tensor = &mut graph.initializer[dice.below(tensors)];
    match dice.below(12) {
        0 => {
            let names = dice_names(dice);
            node.op_type = (*dice.one(names)).to_owned();
        }
        1 if !node.input.is_empty() => {
            let place = dice.below(node.input.len());
            node.input[place] = dice.one(&names).clone();
        }
        2 => node.input.push(dice.one(&names).clone()),
        3 => drop(node.input.pop()),
        4 => node.attribute.clear(),
        5 if !node.attribute.is_empty() => {
            let place = dice.below(node.attribute.len());
            let attribute = &mut node.attribute[place];
            attribute.i = *dice.one(&WHOLE);
            for int in &mut attribute.ints {
                *int = *dice.one(&WHOLE);
            }
        }
        6 if !node.attribute.is_empty() => {
            let place = dice.below(node.attribute.len());
            node.attribute[place].ints.push(*dice.one(&WHOLE));
        }
        7 if !tensor.dims.is_empty() => {
            let place = dice.below(tensor.dims.len());
            tensor.dims[place] = *dice.one(&WHOLE);
        }
        8 => tensor.dims.reverse(),
        9 => tensor.data_type = dice.below(24) as i32,
        10 => {
            for int in &mut tensor.int64_data {
                *int = *dice.one(&WHOLE);
            }
            tensor.raw_data.truncate(dice.below(64));
        }
        _ => {
            let places = (dice.below(nodes), dice.below(nodes));
            graph.node.swap(places.0, places.1);
        }
    }
}

/// The names of the operators in a random line of the table.
fn dice_names(dice: &mut Dice) -> &'static [&'static str] {
    dice.one(OPERATORS).names
}

#[test]
fn the_built_in_model_costs_what_its_layers_do() {
    let model = model();
    let cost = check(&model, model.graph.as_ref().unwrap()).unwrap();
    assert!((1_000_000..1_500_000).contains(&cost.work), "{cost:?}");
    assert!(cost.nodes < 160 && cost.numbers < 50_000, "{cost:?}");
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
    let texts = |name: &str, texts: &[&str]| AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Strings as i32,
        strings: texts.iter().map(|text| text.as_bytes().to_vec()).collect(),
        ..Default::default()
    };
    let mut trees = node(
        "ai.onnx.ml",
        "TreeEnsembleClassifier",
        &["features"],
        &["label", "scores"],
    );
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
    let check = |change: &dyn Fn(&mut NodeProto)| {
        let mut trees = forest();
        change(&mut trees);
        let mut walk = Walk::new(17);
        let features = Value::new(Datum::F32, vec![1, 3]);
        walk.bind("features", features).unwrap();
        walk.node(Box::leak(Box::new(trees)))
    };
    check(&|_| {}).unwrap();
    let set = |name: &'static str, place: usize, value: i64| {
        move |trees: &mut NodeProto| {
            let mut attributes = trees.attribute.iter_mut();
            let list = attributes.find(|list| list.name == name).unwrap();
            list.ints[place] = value;
        }
    };
    for (name, place, value, expected) in [
        ("nodes_featureids", 3, 3, "asks for feature 3 of 3"),
        ("nodes_truenodeids", 0, 0, "leads nowhere"),
        ("nodes_falsenodeids", 3, 3, "leads nowhere"),
        ("nodes_nodeids", 1, 5, "node 5 of tree 0 is out of order"),
        ("nodes_treeids", 3, 2, "node 0 of tree 2 is out of order"),
        ("class_ids", 3, 2, "a vote for class 2"),
        ("class_nodeids", 0, 0, "at node 0 of tree 0"),
        ("class_treeids", 3, 7, "at node 2 of tree 7"),
    ] {
        let problem = check(&set(name, place, value)).unwrap_err().to_string();
        assert!(problem.contains(expected), "{name}: {problem}");
    }
    let without = |name: &'static str| {
        move |trees: &mut NodeProto| trees.attribute.retain(|list| list.name != name)
    };
    for list in forest().attribute {
        let name: &'static str = list.name.leak();
        assert!(check(&without(name)).is_err(), "{name}");
    }
}
