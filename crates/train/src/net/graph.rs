//! A network as a graph of ONNX nodes, from newtons to logits.
//!
//! In: nodes and constants, one by one. Out: the graph as tract's own ONNX types, so that the
//! exported file and the daemon's reader share one schema.

use tract_onnx::pb;

use super::network::Weights;
use hardnessd_core::frame::Array;
use hardnessd_core::verdict::MIN_OPSET;

/// The name of the graph's input: newtons per taxel, `[1, 1, 28, 28]`.
pub const INPUT: &str = "frame";
/// The IR version that goes with opset 17.
const IR_VERSION: i64 = 8;

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
#[derive(Debug, Clone, Default)]
pub struct Graph {
    nodes: Vec<pb::NodeProto>,
    constants: Vec<pb::TensorProto>,
}

impl Graph {
    /// Adds an f32 constant and returns its name.
    pub fn constant(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        debug_assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}");
        let raw = values.iter().flat_map(|value| value.to_le_bytes());
        self.raw(name, dims, pb::tensor_proto::DataType::Float, raw.collect())
    }

    /// Adds a constant of one number and returns its name.
    pub fn scalar(&mut self, name: &str, value: f32) -> String {
        self.constant(&format!("{name} as a number"), &[], &[value])
    }

    /// Adds an i64 vector, the form of shapes and axes, and returns its name.
    pub fn indices(&mut self, name: &str, values: &[i64]) -> String {
        let raw = values.iter().flat_map(|value| value.to_le_bytes());
        let dims = [values.len()];
        self.raw(
            name,
            &dims,
            pb::tensor_proto::DataType::Int64,
            raw.collect(),
        )
    }

    fn raw(
        &mut self,
        name: &str,
        dims: &[usize],
        data_type: pb::tensor_proto::DataType,
        raw_data: Vec<u8>,
    ) -> String {
        self.constants.push(pb::TensorProto {
            name: name.to_owned(),
            dims: dims.iter().map(|&length| length as i64).collect(),
            data_type: data_type as i32,
            raw_data,
            ..Default::default()
        });
        name.to_owned()
    }

    /// Adds a node with one output and returns the output's name.
    pub fn node(&mut self, op: &str, inputs: &[&str], output: &str) -> String {
        self.with(op, inputs, output, Vec::new())
    }

    /// The same with attributes.
    pub fn with(
        &mut self,
        op: &str,
        inputs: &[&str],
        output: &str,
        attribute: Vec<pb::AttributeProto>,
    ) -> String {
        self.nodes.push(pb::NodeProto {
            name: format!("{op}:{output}"),
            op_type: op.to_owned(),
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: vec![output.to_owned()],
            attribute,
            ..Default::default()
        });
        output.to_owned()
    }

    /// Adds the nodes of `x` in another shape.
    pub fn reshaped(&mut self, x: &str, dims: &[usize], output: &str) -> String {
        let dims: Vec<i64> = dims.iter().map(|&length| length as i64).collect();
        let shape = self.indices(&format!("shape of {output}"), &dims);
        self.node("Reshape", &[x, &shape], output)
    }

    /// Adds the nodes of log(1 + x).
    pub fn logarithm_of(&mut self, x: &str) -> String {
        let one = self.scalar(&format!("added to {x}"), 1.0);
        let raised = self.node("Add", &[x, &one], &format!("{x} raised"));
        self.node("Log", &[&raised], &format!("log of {x}"))
    }

    /// Adds the node that joins values along their columns.
    pub fn joined(&mut self, parts: &[&str], output: &str) -> String {
        self.with("Concat", parts, output, vec![integer("axis", 1)])
    }

    /// Adds the weight `name` as a constant.
    pub fn weight(&mut self, weights: &Weights, name: &str) -> String {
        self.constant(name, weights.dims(name), &weights.numbers(name))
    }

    /// Passes `x` `[rows, inputs]` through the layer `name`.
    pub fn dense(&mut self, weights: &Weights, name: &str, x: &str) -> String {
        let matrix = self.weight(weights, &format!("{name}.matrix"));
        let bias = self.weight(weights, &format!("{name}.bias"));
        self.node("Gemm", &[x, &matrix, &bias], &format!("{name}.sum"))
    }
}

/// An integer attribute.
pub fn integer(name: &str, value: i64) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Int as i32,
        i: value,
        ..Default::default()
    }
}

/// A list of integers as an attribute.
pub fn integers(name: &str, values: &[i64]) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Ints as i32,
        ints: values.to_vec(),
        ..Default::default()
    }
}

/// A floating-point number as an attribute.
pub fn number(name: &str, value: f32) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Float as i32,
        f: value,
        ..Default::default()
    }
}

/// The graph as an ONNX model.
pub(crate) fn model(
    graph: Graph,
    input: Vec<pb::ValueInfoProto>,
    output: Vec<pb::ValueInfoProto>,
    metadata_props: Vec<pb::StringStringEntryProto>,
) -> pb::ModelProto {
    pb::ModelProto {
        ir_version: IR_VERSION,
        opset_import: vec![pb::OperatorSetIdProto {
            domain: String::new(),
            version: MIN_OPSET,
        }],
        producer_name: "hrn-train".to_owned(),
        producer_version: env!("CARGO_PKG_VERSION").to_owned(),
        graph: Some(pb::GraphProto {
            name: "hrn".to_owned(),
            node: graph.nodes,
            initializer: graph.constants,
            input,
            output,
            ..Default::default()
        }),
        metadata_props,
        ..Default::default()
    }
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
