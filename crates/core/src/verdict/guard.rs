//! The check of a model's graph before the inference library sees it.
//!
//! In: the graph as ONNX's own messages. Out: the graph's cost, or the first thing in it that is
//! not allowed. The inference library trusts a graph: some graphs make it panic, fill the memory,
//! never end, or write outside an array. So only the operators of [`table`] may occur, each with
//! the attributes and sizes that it can have, and the shape of every value is computed here.
//! Nothing here runs the model. The only values computed are lists of integers that decide a shape.

mod arithmetic;
mod layers;
mod learners;
mod problem;
mod recurrent;
mod shapes;
mod table;
mod tensor;

use std::collections::HashMap;
use std::rc::Rc;

use tract_onnx::pb;
use tract_onnx::pb::attribute_proto::AttributeType;

use self::problem::{AttributeProblem, Form, Problem};
use self::table::{Allowed, Operator};
use super::ModelError;

/// The most nodes of a graph, including those of its subgraphs.
const MOST_NODES: u64 = 2_000;
/// The most tensors inside a graph.
const MOST_TENSORS: usize = 10_000;
/// The most dimensions of a value.
const MOST_RANK: usize = 8;
/// The most numbers in one value: as many as a file of the largest size holds.
const MOST_NUMBERS: u64 = 16_000_000;
/// The most numbers in all computed values.
const MOST_NUMBERS_IN_ALL: u64 = 64_000_000;
/// The most multiplications and additions of a verdict. The time of a verdict is measured later;
/// this number limits how long the measurement can take.
const MOST_WORK: u64 = 500_000_000;
/// The longest name of a node or a value, in bytes.
const MOST_NAME_BYTES: usize = 1_024;
/// The longest list of integers whose values are tracked here.
const MOST_KNOWN: usize = 65_536;

/// The cost of a graph.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Cost {
    /// The number of nodes, including those of subgraphs.
    pub(super) nodes: u64,
    /// The number of numbers in all computed values.
    pub(super) numbers: u64,
    /// The approximate number of multiplications and additions.
    pub(super) work: u64,
}

/// Checks a graph with its declared inputs and outputs.
///
/// # Errors
///
/// Returns a [`ModelError::Guard`] that names the node or tensor and the problem with it.
pub(super) fn check(proto: &pb::ModelProto, graph: &pb::GraphProto) -> Result<Cost, ModelError> {
    let unsupported = |what| guard("graph", &Problem::Unsupported(what));
    if !proto.functions.is_empty() {
        return Err(unsupported("functions are"));
    }
    if !proto.training_info.is_empty() {
        return Err(unsupported("training information is"));
    }
    let opset = proto
        .opset_import
        .iter()
        .find(|import| import.domain.is_empty() || import.domain == "ai.onnx")
        .map_or(0, |import| import.version);
    let mut walk = Walk::new(opset);
    walk.tensors(graph)?;
    for input in &graph.input {
        // Before ONNX IR 4, tensors inside the file are also listed among the inputs.
        if !graph.initializer.iter().any(|t| t.name == input.name) {
            tensor::declared(input)
                .and_then(|value| walk.bind(&input.name, value))
                .map_err(|problem| guard(format!("input {}", quoted(&input.name)), &problem))?;
        }
    }
    walk.nodes(graph)?;
    for output in &graph.output {
        tensor::declared(output)
            .and_then(|declared| match walk.values.get(output.name.as_str()) {
                Some(computed) if computed.same_as(&declared) => Ok(()),
                Some(computed) => Err(Problem::Found {
                    found: computed.into(),
                    expected: Form::from(&declared).to_string(),
                }),
                None => Err(Problem::NothingComputes((&declared).into())),
            })
            .map_err(|problem| guard(format!("output {}", quoted(&output.name)), &problem))?;
    }
    Ok(walk.cost)
}

fn guard(place: impl Into<String>, problem: &Problem) -> ModelError {
    ModelError::Guard {
        place: place.into(),
        problem: problem.to_string(),
    }
}

/// A name from a file, on one line and of a readable length.
fn quoted(name: &str) -> String {
    if name.chars().count() <= 60 {
        return format!("{name:?}");
    }
    let start: String = name.chars().take(60).collect();
    format!("{start:?}...")
}

/// The types of numbers that a graph may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Datum {
    F32,
    F64,
    I32,
    I64,
    U8,
    Bool,
}

impl Datum {
    fn is_float(self) -> bool {
        matches!(self, Datum::F32 | Datum::F64)
    }

    fn name(self) -> &'static str {
        match self {
            Datum::F32 => "f32",
            Datum::F64 => "f64",
            Datum::I32 => "i32",
            Datum::I64 => "i64",
            Datum::U8 => "u8",
            Datum::Bool => "bool",
        }
    }
}

/// The properties of a value that are known before anything runs.
#[derive(Debug, Clone)]
struct Value {
    datum: Datum,
    shape: Vec<usize>,
    /// The value's integers if they are known: shapes, axes and indices.
    ints: Option<Rc<[i64]>>,
    /// Whether the value depends on no input.
    constant: bool,
}

impl Value {
    fn new(datum: Datum, shape: Vec<usize>) -> Self {
        Self {
            datum,
            shape,
            ints: None,
            constant: false,
        }
    }

    fn known(datum: Datum, shape: Vec<usize>, ints: Vec<i64>) -> Self {
        Self {
            ints: (ints.len() <= MOST_KNOWN).then(|| ints.into()),
            ..Self::new(datum, shape)
        }
    }

    fn rank(&self) -> usize {
        self.shape.len()
    }

    /// The number of numbers, or `None` if it overflows.
    fn numbers(&self) -> Option<u64> {
        count(&self.shape)
    }

    fn same_as(&self, other: &Self) -> bool {
        self.datum == other.datum && self.shape == other.shape
    }
}

fn count(shape: &[usize]) -> Option<u64> {
    shape
        .iter()
        .try_fold(1_u64, |product, &length| product.checked_mul(length as u64))
}

/// The result of a rule for a node: its outputs, and the work beside reading and writing them.
struct Computed {
    values: Vec<Value>,
    work: u64,
}

impl From<Value> for Computed {
    fn from(value: Value) -> Self {
        Self {
            values: vec![value],
            work: 0,
        }
    }
}

/// A node with the known properties of its inputs. Its attributes were checked against the table.
struct Node<'a> {
    proto: &'a pb::NodeProto,
    inputs: Vec<Option<Value>>,
    opset: i64,
}

impl Node<'_> {
    fn input(&self, index: usize) -> Result<&Value, Problem> {
        self.optional(index).ok_or(Problem::Missing(index))
    }

    fn optional(&self, index: usize) -> Option<&Value> {
        self.inputs.get(index).and_then(Option::as_ref)
    }

    /// All inputs of a node without optional inputs.
    fn all(&self) -> impl Iterator<Item = &Value> {
        self.inputs.iter().flatten()
    }

    /// An input that has to be of this type.
    fn of(&self, index: usize, datum: Datum) -> Result<&Value, Problem> {
        let value = self.input(index)?;
        if value.datum == datum {
            return Ok(value);
        }
        Err(Problem::Input {
            index,
            found: value.into(),
            expected: datum.name(),
        })
    }

    /// The integers of an input that must be known before the model runs.
    fn known(&self, index: usize) -> Result<&[i64], Problem> {
        let value = self.input(index)?;
        let ints = value.ints.as_deref();
        ints.ok_or_else(|| Problem::Unknown(index, value.into()))
    }

    fn attribute(&self, name: &str) -> Option<&pb::AttributeProto> {
        let mut attributes = self.proto.attribute.iter();
        attributes.find(|attribute| attribute.name == name)
    }

    fn int(&self, name: &str, default: i64) -> i64 {
        self.attribute(name).map_or(default, |found| found.i)
    }

    fn ints(&self, name: &str) -> Option<&[i64]> {
        self.attribute(name).map(|found| found.ints.as_slice())
    }

    fn text(&self, name: &str) -> Option<&str> {
        let found = self.attribute(name)?;
        std::str::from_utf8(&found.s).ok()
    }

    /// The axis in an attribute, counted from the front.
    fn axis(&self, name: &str, default: i64, rank: usize) -> Result<usize, Problem> {
        axis(self.int(name, default), rank)
    }
}

/// An axis counted from the front.
fn axis(axis: i64, rank: usize) -> Result<usize, Problem> {
    let all = rank as i64;
    if (-all..all).contains(&axis) {
        return Ok(axis.rem_euclid(all) as usize);
    }
    Err(Problem::Axis { axis, rank })
}

/// Distinct axes counted from the front.
fn axes(given: &[i64], rank: usize) -> Result<Vec<usize>, Problem> {
    let mut found = Vec::with_capacity(given.len());
    for &one in given.iter().take(MOST_RANK + 1) {
        let one = axis(one, rank)?;
        if found.contains(&one) {
            return Err(Problem::AxisTwice(one));
        }
        found.push(one);
    }
    Ok(found)
}

/// The values of a graph up to now, node by node.
struct Walk<'a> {
    opset: i64,
    values: HashMap<&'a str, Value>,
    cost: Cost,
    /// How often each node runs. It is more than once in the body of a loop.
    times: u64,
    /// Whether a node may have a subgraph.
    may_nest: bool,
}

impl<'a> Walk<'a> {
    fn new(opset: i64) -> Self {
        Self {
            opset,
            values: HashMap::new(),
            cost: Cost::default(),
            times: 1,
            may_nest: true,
        }
    }

    /// Adds the tensors inside a graph.
    fn tensors(&mut self, graph: &'a pb::GraphProto) -> Result<(), ModelError> {
        if !graph.sparse_initializer.is_empty() {
            return Err(guard("graph", &Problem::Unsupported("sparse tensors are")));
        }
        if graph.initializer.len() > MOST_TENSORS {
            return Err(guard("graph", &Problem::Tensors(graph.initializer.len())));
        }
        for proto in &graph.initializer {
            tensor::value(proto)
                .and_then(|value| self.bind(&proto.name, value))
                .map_err(|problem| guard(format!("tensor {}", quoted(&proto.name)), &problem))?;
        }
        Ok(())
    }

    /// Adds a value under its name.
    fn bind(&mut self, name: &'a str, value: Value) -> Result<(), Problem> {
        if name.is_empty() || name.len() > MOST_NAME_BYTES {
            return Err(Problem::Name(name.len()));
        }
        if self.values.insert(name, value).is_some() {
            return Err(Problem::NameTwice);
        }
        Ok(())
    }

    /// Computes the outputs of every node.
    fn nodes(&mut self, graph: &'a pb::GraphProto) -> Result<(), ModelError> {
        for proto in &graph.node {
            self.node(proto).map_err(|problem| {
                let name = match (&proto.name, proto.output.first()) {
                    (name, Some(output)) if name.is_empty() => output,
                    (name, _) => name,
                };
                let operator = quoted(&proto.op_type);
                let operator = operator.trim_matches('"');
                guard(format!("node {} ({operator})", quoted(name)), &problem)
            })?;
        }
        Ok(())
    }

    fn node(&mut self, proto: &'a pb::NodeProto) -> Result<(), Problem> {
        self.cost.nodes += 1;
        if self.cost.nodes > MOST_NODES {
            return Err(Problem::Nodes);
        }
        if proto.name.len() > MOST_NAME_BYTES {
            return Err(Problem::Name(proto.name.len()));
        }
        let operator = table::find(&proto.domain, &proto.op_type)
            .ok_or(Problem::Unsupported("this operator is"))?;
        attributes(proto, operator)?;
        let inputs = self.inputs(proto, operator)?;
        let read: u64 = inputs.iter().flatten().filter_map(Value::numbers).sum();
        let constant = !proto
            .attribute
            .iter()
            .any(|attribute| attribute.g.is_some())
            && inputs.iter().flatten().all(|value| value.constant);
        let node = Node {
            proto,
            inputs,
            opset: self.opset,
        };
        let computed = match operator.rule {
            table::Rule::Of(rule) => rule(&node)?,
            table::Rule::Scan => recurrent::scan(&node, self)?,
        };
        let outputs = proto.output.iter().filter(|name| !name.is_empty()).count();
        let (least, most) = operator.outputs;
        let gaps = outputs < proto.output.len() && !operator.gaps;
        if outputs < least.max(1) || proto.output.len() > most.min(computed.values.len()) || gaps {
            return Err(Problem::Outputs(outputs));
        }
        let mut work = read.saturating_add(computed.work);
        for (name, value) in proto.output.iter().zip(computed.values) {
            if name.is_empty() {
                continue;
            }
            let numbers = self.may_hold(&value)?;
            work = work.saturating_add(numbers);
            self.cost.numbers = self.cost.numbers.saturating_add(numbers);
            let constant = constant || value.ints.is_some();
            self.bind(name, Value { constant, ..value })?;
        }
        if self.cost.numbers > MOST_NUMBERS_IN_ALL {
            return Err(Problem::NumbersInAll);
        }
        self.cost.work = self
            .cost
            .work
            .saturating_add(work.saturating_mul(self.times));
        if self.cost.work > MOST_WORK {
            return Err(Problem::Work);
        }
        Ok(())
    }

    fn inputs(
        &self,
        proto: &pb::NodeProto,
        operator: &Operator,
    ) -> Result<Vec<Option<Value>>, Problem> {
        let (least, most) = operator.inputs;
        let found = proto.input.len();
        if !(least..=most).contains(&found) {
            return Err(Problem::Inputs { found, least, most });
        }
        let value = |(index, name): (usize, &String)| match self.values.get(name.as_str()) {
            Some(value) => Ok(Some(value.clone())),
            None if name.is_empty() && operator.gaps && index >= least => Ok(None),
            None => Err(Problem::Uncomputed(quoted(name))),
        };
        proto.input.iter().enumerate().map(value).collect()
    }

    /// The number of numbers in a value, if the value is not too large.
    fn may_hold(&self, value: &Value) -> Result<u64, Problem> {
        if value.rank() > MOST_RANK {
            return Err(Problem::OutputRank(value.rank()));
        }
        let empty_list = value.ints.is_some() && value.rank() == 1;
        if value.shape.contains(&0) && !empty_list {
            return Err(Problem::EmptyOutput(value.into()));
        }
        match value.numbers() {
            Some(numbers) if numbers <= MOST_NUMBERS => Ok(numbers),
            _ => Err(Problem::LargeOutput(value.into())),
        }
    }
}

/// Checks each attribute against the table.
fn attributes(proto: &pb::NodeProto, operator: &Operator) -> Result<(), Problem> {
    for (index, attribute) in proto.attribute.iter().enumerate() {
        let name = attribute.name.as_str();
        let mut known = operator.attributes.iter();
        let Some((_, allowed)) = known.find(|(known, _)| *known == name) else {
            return Err(Problem::UnknownAttribute(quoted(name)));
        };
        let twice = proto.attribute[..index].iter().any(|a| a.name == name);
        let checked = if twice {
            Err(AttributeProblem::Twice)
        } else {
            allowed.check(attribute)
        };
        checked.map_err(|problem| Problem::Attribute {
            name: name.to_owned(),
            problem,
        })?;
    }
    Ok(())
}

impl Allowed {
    fn check(&self, attribute: &pb::AttributeProto) -> Result<(), AttributeProblem> {
        if !attribute.ref_attr_name.is_empty() {
            return Err(AttributeProblem::Reference);
        }
        if attribute.r#type != self.kind() as i32 {
            return Err(AttributeProblem::Kind(self.kind()));
        }
        let within = |found: i64, low: i64, high: i64| match (low..=high).contains(&found) {
            true => Ok(()),
            false => Err(AttributeProblem::Range { found, low, high }),
        };
        let most = |found: usize, most: usize| match found <= most {
            true => Ok(()),
            false => Err(AttributeProblem::Long { found, most }),
        };
        let known =
            |texts: &[&str], found: &[u8]| texts.iter().any(|text| text.as_bytes() == found);
        match *self {
            Allowed::Int(low, high) => within(attribute.i, low, high),
            Allowed::Ints(length, low, high) => {
                most(attribute.ints.len(), length)?;
                let mut ints = attribute.ints.iter();
                ints.try_for_each(|&value| within(value, low, high))
            }
            Allowed::Text(texts) if !known(texts, &attribute.s) => Err(AttributeProblem::Text {
                found: quoted(&String::from_utf8_lossy(&attribute.s)),
                expected: texts.join(", "),
            }),
            Allowed::Texts(length, texts) => {
                most(attribute.strings.len(), length)?;
                match attribute.strings.iter().all(|text| known(texts, text)) {
                    true => Ok(()),
                    false => Err(AttributeProblem::Texts(texts.join(", "))),
                }
            }
            Allowed::Floats(length) => most(attribute.floats.len(), length),
            Allowed::Tensor if attribute.t.is_none() => Err(AttributeProblem::NoTensor),
            Allowed::Graph if attribute.g.is_none() => Err(AttributeProblem::NoGraph),
            Allowed::Text(_) | Allowed::Float | Allowed::Tensor | Allowed::Graph => Ok(()),
        }
    }

    fn kind(&self) -> AttributeType {
        match self {
            Allowed::Int(..) => AttributeType::Int,
            Allowed::Ints(..) => AttributeType::Ints,
            Allowed::Float => AttributeType::Float,
            Allowed::Floats(_) => AttributeType::Floats,
            Allowed::Text(_) => AttributeType::String,
            Allowed::Texts(..) => AttributeType::Strings,
            Allowed::Tensor => AttributeType::Tensor,
            Allowed::Graph => AttributeType::Graph,
        }
    }
}

#[cfg(test)]
mod tests;
