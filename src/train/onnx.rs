//! Writes a recogniser as an ONNX file and takes it only if the daemon would.
//!
//! In: a [`Graph`] from newtons to logits, the temperature, the card, and check frames with the
//! trainer's probabilities. Out: the bytes of the file, already read back through
//! [`verdict::Hrn`](crate::verdict::Hrn), which reproduces the check frames or refuses. The file
//! is built from tract's own ONNX types, so writer and reader share one schema.

use anyhow::{Context as _, ensure};
use prost::Message as _;
use tract_onnx::pb;
use tract_onnx::prelude::*;

use crate::frame::{COLS, Frame, ROWS};
use crate::verdict::{Card, Check, Hrn, MIN_OPSET};

/// The name of the graph's input: newtons a taxel, `[1, 1, 28, 28]`.
pub const INPUT: &str = "frame";
/// The IR version that goes with opset 17.
const IR_VERSION: i64 = 8;

/// The nodes and constants of a graph under construction. A value is known by its name.
#[derive(Debug, Clone, Default)]
pub struct Graph {
    nodes: Vec<pb::NodeProto>,
    constants: Vec<pb::TensorProto>,
}

impl Graph {
    /// Adds an f32 constant and gives its name back.
    pub fn constant(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        debug_assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}");
        self.raw(name, dims, pb::tensor_proto::DataType::Float, |raw| {
            raw.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        })
    }

    /// Adds an i64 vector, as shapes and axes are given, and gives its name back.
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

    /// Adds a node with one output, which it gives back.
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

/// A number as an attribute.
pub fn number(name: &str, value: f32) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: pb::attribute_proto::AttributeType::Float as i32,
        f: value,
        ..Default::default()
    }
}

/// Writes the file: `raw_logits` (`[1, L]`) over `temperature`, their softmax, and the metadata.
///
/// # Errors
///
/// If the daemon's loader refuses the file, or reads another card from it.
pub fn write(
    mut graph: Graph,
    raw_logits: &str,
    temperature: f32,
    card: &Card,
    check: &Check,
) -> anyhow::Result<Vec<u8>> {
    ensure!(
        temperature.is_finite() && temperature > 0.0,
        "temperature {temperature}: above 0"
    );
    let temperature = graph.constant("temperature", &[], &[temperature]);
    graph.node("Div", &[raw_logits, &temperature], "logits", Vec::new());
    graph.node(
        "Softmax",
        &["logits"],
        "probabilities",
        vec![integer("axis", 1)],
    );

    let levels = card.levels.len();
    let output = vec![
        value_info("logits", &[1, levels]),
        value_info("probabilities", &[1, levels]),
    ];
    let proto = model(graph, output, metadata(card, check)?);
    let bytes = proto.encode_to_vec();
    let read_back = Hrn::load(&bytes).context("the exported model does not pass the daemon's")?;
    ensure!(
        read_back.card() == card,
        "the exported model's card does not read back the same"
    );
    Ok(bytes)
}

/// A graph that runs here and now, for what training itself needs from it.
#[derive(Debug)]
pub struct Plan(Arc<TypedRunnableModel>);

impl Plan {
    /// Prepares `graph` to compute `output`, an f32 of shape `dims`.
    ///
    /// # Errors
    ///
    /// If the inference library cannot run it.
    pub fn new(graph: Graph, output: &str, dims: &[usize]) -> anyhow::Result<Self> {
        let proto = model(graph, vec![value_info(output, dims)], Vec::new());
        let plan = tract_onnx::onnx()
            .model_for_proto_model(&proto)?
            .with_input_fact(0, f32::fact([1, 1, ROWS, COLS]).into())?
            .into_optimized()?
            .into_runnable()?;
        Ok(Self(plan))
    }

    /// The output for one frame, row-major.
    ///
    /// # Errors
    ///
    /// If the inference library fails.
    pub fn run(&self, frame: &Frame) -> anyhow::Result<Vec<f32>> {
        let input = Tensor::from_shape(&[1, 1, ROWS, COLS], &frame.newtons)?;
        let outputs = self.0.run(tvec!(input.into()))?;
        Ok(outputs[0].try_as_plain_ram()?.as_slice::<f32>()?.to_vec())
    }
}

fn model(
    graph: Graph,
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
            input: vec![value_info(INPUT, &[1, 1, ROWS, COLS])],
            output,
            ..Default::default()
        }),
        metadata_props,
        ..Default::default()
    }
}

fn value_info(name: &str, dims: &[usize]) -> pb::ValueInfoProto {
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

fn metadata(card: &Card, check: &Check) -> anyhow::Result<Vec<pb::StringStringEntryProto>> {
    let entries = [
        ("hrn.format", card.format.clone()),
        ("hrn.levels", serde_json::to_string(&card.levels)?),
        ("hrn.pitch_mm", card.pitch_mm.to_string()),
        ("hrn.method", card.method.clone()),
        ("hrn.data", card.data.clone()),
        ("hrn.metrics", serde_json::to_string(&card.metrics)?),
        ("hrn.validation", card.validation.clone()),
        ("hrn.range", serde_json::to_string(&card.range)?),
        ("hrn.check", serde_json::to_string(check)?),
    ];
    let entry = |(key, value): (&str, String)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value,
    };
    Ok(entries.into_iter().map(entry).collect())
}
