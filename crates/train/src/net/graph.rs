//! A network as a graph of ONNX nodes, from newtons to logits.
//!
//! In: nodes and constants, one by one. Out: the graph as tract's own ONNX types, so that the
//! exported file and the daemon's reader share one schema, or a plan that computes it in this
//! process.

use tract_onnx::pb;
use tract_onnx::prelude::*;

use hardnessd_core::frame::Array;
use hardnessd_core::verdict::{COLS, MIN_OPSET, ModelFrame, ROWS};

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
        self.raw(name, dims, pb::tensor_proto::DataType::Float, |raw| {
            raw.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        })
    }

    /// Adds an i64 vector, the form of shapes and axes, and returns its name.
    pub fn indices(&mut self, name: &str, values: &[i64]) -> String {
        self.raw(
            name,
            &[values.len()],
            pb::tensor_proto::DataType::Int64,
            |raw| {
                raw.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            },
        )
    }

    fn raw(
        &mut self,
        name: &str,
        dims: &[usize],
        data_type: pb::tensor_proto::DataType,
        fill: impl FnOnce(&mut Vec<u8>),
    ) -> String {
        let mut tensor = pb::TensorProto {
            name: name.to_owned(),
            dims: dims.iter().map(|&length| length as i64).collect(),
            data_type: data_type as i32,
            ..Default::default()
        };
        fill(&mut tensor.raw_data);
        self.constants.push(tensor);
        name.to_owned()
    }

    /// Adds a node with one output and returns the output's name.
    pub fn node(
        &mut self,
        op: &str,
        inputs: &[&str],
        output: &str,
        attributes: Vec<pb::AttributeProto>,
    ) -> String {
        self.nodes.push(pb::NodeProto {
            name: format!("{op}:{output}"),
            op_type: op.to_owned(),
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: vec![output.to_owned()],
            attribute: attributes,
            ..Default::default()
        });
        output.to_owned()
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

/// A graph that runs in this process, for values that training itself needs.
#[derive(Debug)]
pub struct Plan {
    plan: Arc<TypedRunnableModel>,
    shape: Vec<usize>,
}

impl Plan {
    /// Prepares `graph` to compute `output`, an f32 of shape `dims`.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library cannot run the graph.
    pub fn new(graph: Graph, output: &str, dims: &[usize]) -> anyhow::Result<Self> {
        let input = (INPUT, vec![1, 1, ROWS, COLS]);
        Self::over(graph, &input, &(output, dims.to_vec()))
    }

    /// Prepares a graph whose input is not a frame. `input` and `output` are a name and a shape.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library cannot run the graph.
    pub fn over(
        graph: Graph,
        input: &(&str, Vec<usize>),
        output: &(&str, Vec<usize>),
    ) -> anyhow::Result<Self> {
        let [inputs, outputs] = [input, output].map(|(name, dims)| vec![value_info(name, dims)]);
        let proto = model(graph, inputs, outputs, Vec::new());
        let plan = tract_onnx::onnx()
            .model_for_proto_model(&proto)?
            .with_input_fact(0, f32::fact(&input.1).into())?
            .into_optimized()?
            .into_runnable()?;
        Ok(Self {
            plan,
            shape: input.1.clone(),
        })
    }

    /// The output for one frame, row-major.
    ///
    /// # Errors
    ///
    /// Returns an error if the inference library fails.
    pub fn run(&self, frame: &ModelFrame) -> anyhow::Result<Vec<f32>> {
        self.run_on(&frame.newtons)
    }

    /// The output for the input's numbers, both row-major.
    ///
    /// # Errors
    ///
    /// Returns an error if the numbers are not as many as the input's shape says, or the inference
    /// library fails.
    pub fn run_on(&self, numbers: &[f32]) -> anyhow::Result<Vec<f32>> {
        let input = Tensor::from_shape(&self.shape, numbers)?;
        let outputs = self.plan.run(tvec!(input.into()))?;
        Ok(outputs[0].try_as_plain_ram()?.as_slice::<f32>()?.to_vec())
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

/// The input of a model that judges one frame.
pub(crate) fn frame_input() -> pb::ValueInfoProto {
    value_info(INPUT, &[1, 1, ROWS, COLS])
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
