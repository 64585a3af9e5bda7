//! The parts of an ONNX graph, and changes of a model file, for tests.

use tract_onnx::pb;
use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;

/// A node of this operator. It has the name of its first output.
pub fn node(
    op: &str,
    inputs: &[&str],
    outputs: &[&str],
    attributes: &[pb::AttributeProto],
) -> pb::NodeProto {
    let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    pb::NodeProto {
        op_type: op.to_owned(),
        name: outputs[0].to_owned(),
        input: owned(inputs),
        output: owned(outputs),
        attribute: attributes.to_vec(),
        ..Default::default()
    }
}

/// An attribute with one integer.
pub fn int(name: &str, value: i64) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Int as i32,
        i: value,
        ..Default::default()
    }
}

/// An attribute with a list of integers.
pub fn ints(name: &str, values: &[i64]) -> pb::AttributeProto {
    pb::AttributeProto {
        name: name.to_owned(),
        r#type: AttributeType::Ints as i32,
        ints: values.to_vec(),
        ..Default::default()
    }
}

/// An f32 input or output of this shape.
pub fn value(name: &str, shape: &[usize]) -> pb::ValueInfoProto {
    use pb::tensor_shape_proto::{Dimension, dimension};
    let dim = shape.iter().map(|&length| Dimension {
        value: Some(dimension::Value::DimValue(length as i64)),
        ..Default::default()
    });
    let shape = pb::TensorShapeProto { dim: dim.collect() };
    let tensor = pb::type_proto::Tensor {
        elem_type: DataType::Float as i32,
        shape: Some(shape),
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

/// A constant list of integers.
pub fn indices(name: &str, values: &[i64]) -> pb::TensorProto {
    pb::TensorProto {
        name: name.to_owned(),
        dims: vec![values.len() as i64],
        data_type: DataType::Int64 as i32,
        int64_data: values.to_vec(),
        ..Default::default()
    }
}

/// A constant number.
pub fn number(name: &str, value: f32) -> pb::TensorProto {
    pb::TensorProto {
        name: name.to_owned(),
        dims: vec![1],
        data_type: DataType::Float as i32,
        float_data: vec![value],
        ..Default::default()
    }
}

/// A model file, changed by a closure.
#[cfg(test)]
pub(crate) fn changed(bytes: &[u8], change: impl FnOnce(&mut pb::ModelProto)) -> Vec<u8> {
    use prost::Message as _;
    let mut proto = pb::ModelProto::decode(bytes).unwrap();
    change(&mut proto);
    proto.encode_to_vec()
}

/// The text of a key of a model's metadata.
#[cfg(test)]
pub(crate) fn metadata<'a>(proto: &'a mut pb::ModelProto, key: &str) -> &'a mut String {
    let mut entries = proto.metadata_props.iter_mut();
    &mut entries.find(|entry| entry.key == key).unwrap().value
}
