//! A network as a graph of ONNX nodes, from newtons to logits.
//!
//! In: formulas, one a line. Out: the graph as tract's own ONNX types, so that the
//! exported file and the daemon's reader share one schema.

use tract_onnx::pb;
use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;

use super::network::{Weights, numbers};
use hardnessd_core::frame::Array;

/// The name of the graph's input: newtons per taxel, `[1, 1, 28, 28]`.
pub const INPUT: &str = "frame";
/// The name of the logits, before temperature.
pub const RAW: &str = "raw";

/// What a model takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Inputs {
    /// One frame.
    Frame,
    /// The press in parts of its time, on the grid of this array.
    Parts(Array),
    /// The features of a press.
    Features,
    /// The features of a press and references of its sensor.
    References,
}

/// The nodes and constants of a graph under construction. A name identifies each value.
#[derive(Debug, Clone)]
pub struct Graph {
    /// What the graph takes.
    pub inputs: Inputs,
    weights: Weights,
    /// The nodes.
    pub(crate) nodes: Vec<pb::NodeProto>,
    /// The constants.
    pub(crate) constants: Vec<pb::TensorProto>,
    /// The number of values without a name of their own.
    values: usize,
}

impl Graph {
    /// A graph of a network with these weights.
    pub fn of(weights: &Weights, inputs: Inputs) -> Self {
        Self {
            inputs,
            weights: weights.clone(),
            nodes: Vec::new(),
            constants: Vec::new(),
            values: 0,
        }
    }

    /// Adds an f32 constant.
    pub fn constant(&mut self, name: &str, dims: &[usize], values: &[f32]) {
        debug_assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}");
        let raw = values.iter().flat_map(|value| value.to_le_bytes());
        self.raw(name, dims, DataType::Float, raw.collect());
    }

    fn raw(&mut self, name: &str, dims: &[usize], data_type: DataType, raw_data: Vec<u8>) {
        self.constants.push(pb::TensorProto {
            name: name.to_owned(),
            dims: dims.iter().map(|&length| length as i64).collect(),
            data_type: data_type as i32,
            raw_data,
            ..Default::default()
        });
    }

    /// Adds nodes, one or more a line: `output = Op(input, ..., attribute=value, ...)`.
    ///
    /// An input is the name of a value or of a weight, which is added; a number, such as `0.5`; a list
    /// of whole numbers, such as `[1x64]`, which an attribute has without brackets; or another `Op(...)`.
    /// `Dense(x, name)` passes x through the layer of that name.
    ///
    /// # Panics
    ///
    /// Panics if a line is none of these. Networks write their formulas themselves.
    pub fn add(&mut self, formulas: &str) {
        let lines = formulas.lines().map(str::trim);
        for line in lines.filter(|line| !line.is_empty()) {
            let (output, call) = line.split_once(" = ").expect("output = Op(...)");
            self.call(call, output.to_owned());
        }
    }

    /// Adds the node of a call, and those of its inputs.
    fn call(&mut self, call: &str, output: String) -> String {
        let (op, parts) = call.split_once('(').expect("Op(...)");
        let parts = arguments(parts.strip_suffix(')').expect("Op(...)"));
        let (attributes, inputs): (Vec<&str>, Vec<&str>) =
            parts.partition(|part| !part.contains('(') && part.contains('='));
        let (op_type, inputs) = match (op, inputs.as_slice()) {
            ("Dense", [x, layer]) => {
                let weights = ["matrix", "bias"].map(|part| format!("{layer}.{part}"));
                ("Gemm", [vec![(*x).to_owned()], weights.to_vec()].concat())
            }
            _ => (op, inputs.into_iter().map(str::to_owned).collect()),
        };
        let input = inputs.iter().map(|input| self.value(input)).collect();
        self.nodes.push(pb::NodeProto {
            name: format!("{op}:{output}"),
            op_type: op_type.to_owned(),
            input,
            output: vec![output.clone()],
            attribute: attributes.into_iter().map(attribute).collect(),
            ..Default::default()
        });
        output
    }

    /// The name of an input, after adding what it needs.
    fn value(&mut self, text: &str) -> String {
        if text.ends_with(')') {
            self.values += 1;
            return self.call(text, format!("value {}", self.values));
        }
        let mut constants = self.constants.iter();
        if constants.any(|constant| constant.name == text) {
            return text.to_owned();
        }
        if let Some(list) = text.strip_prefix('[') {
            let numbers = whole_numbers(list.trim_end_matches(']'));
            let raw = numbers.iter().flat_map(|number| number.to_le_bytes());
            self.raw(text, &[numbers.len()], DataType::Int64, raw.collect());
        } else if let Ok(number) = text.parse() {
            self.constant(text, &[], &[number]);
        } else if let Some(weight) = self.weights.entries.iter().find(|of| of.name == text) {
            let (dims, values) = (weight.dims.clone(), numbers(&weight.values));
            self.constant(text, &dims, &values);
        }
        text.to_owned()
    }
}

/// The arguments of a call, which commas outside of brackets separate.
fn arguments(text: &str) -> impl Iterator<Item = &str> {
    let mut depth = 0;
    let parts = text.split(move |letter| {
        depth += i32::from(letter == '(') - i32::from(letter == ')');
        letter == ',' && depth == 0
    });
    parts.map(str::trim)
}

/// `4x4` as a list.
fn whole_numbers(list: &str) -> Vec<i64> {
    let numbers = list.split('x').map(str::parse);
    numbers.collect::<Result<_, _>>().expect("whole numbers")
}

/// An attribute: `axis=1`, `strides=2x2` or `alpha=0.2`.
fn attribute(text: &str) -> pb::AttributeProto {
    let (name, value) = text.split_once('=').expect("name=value");
    let mut attribute = pb::AttributeProto {
        name: name.to_owned(),
        ..Default::default()
    };
    if value.contains('x') {
        attribute.set_type(AttributeType::Ints);
        attribute.ints = whole_numbers(value);
    } else if value.contains('.') {
        attribute.set_type(AttributeType::Float);
        attribute.f = value.parse().expect("a number");
    } else {
        attribute.set_type(AttributeType::Int);
        attribute.i = value.parse().expect("a whole number");
    }
    attribute
}

/// The type of an f32 tensor in a model.
pub(crate) fn value_info(name: &str, dims: &[usize]) -> pb::ValueInfoProto {
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
