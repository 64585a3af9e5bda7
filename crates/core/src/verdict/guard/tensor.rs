//! Tensors inside a file, and the types that the file declares.

use tract_onnx::pb;
use tract_onnx::pb::tensor_proto::DataType;

use super::problem::Problem;
use super::{Datum, MOST_NUMBERS, MOST_RANK, Value, count};

/// The properties of a tensor, if its data is whole.
pub(super) fn value(proto: &pb::TensorProto) -> Result<Value, Problem> {
    let datum = datum(proto.data_type)?;
    let shape = proto
        .dims
        .iter()
        .map(|&length| usize::try_from(length).map_err(|_| Problem::Length(length)))
        .collect::<Result<Vec<usize>, Problem>>()?;
    if shape.len() > MOST_RANK {
        return Err(Problem::Rank(shape.len()));
    }
    let numbers = count(&shape).filter(|numbers| *numbers <= MOST_NUMBERS);
    let numbers = numbers.ok_or(Problem::LargeTensor)? as usize;
    if numbers == 0 && !(datum == Datum::I64 && shape.len() == 1) {
        return Err(Problem::EmptyTensor);
    }
    let lists = [
        proto.float_data.len(),
        proto.double_data.len(),
        proto.int32_data.len(),
        proto.int64_data.len(),
        proto.string_data.len(),
        proto.uint64_data.len(),
    ];
    let (place, bytes_each) = match datum {
        Datum::F32 => (0, 4),
        Datum::F64 => (1, 8),
        Datum::I32 => (2, 4),
        Datum::U8 | Datum::Bool => (2, 1),
        Datum::I64 => (3, 8),
    };
    let raw = proto.raw_data.len();
    let others = lists.iter().sum::<usize>() - lists[place];
    let whole = match raw {
        0 => lists[place] == numbers,
        raw => lists[place] == 0 && raw == numbers * bytes_each,
    };
    if !whole || others > 0 {
        let found = if raw > 0 { raw } else { lists[place] };
        let unit = if raw > 0 { "bytes" } else { "numbers" };
        return Err(Problem::Data {
            found,
            unit,
            numbers,
        });
    }
    let ints: Option<Vec<i64>> = match (datum, raw) {
        (Datum::I64, 0) => Some(proto.int64_data.clone()),
        (Datum::I32 | Datum::U8 | Datum::Bool, 0) => {
            Some(proto.int32_data.iter().map(|&int| i64::from(int)).collect())
        }
        (Datum::I64, _) => {
            let (words, _) = proto.raw_data.as_chunks::<8>();
            Some(words.iter().map(|word| i64::from_le_bytes(*word)).collect())
        }
        (Datum::I32, _) => {
            let (words, _) = proto.raw_data.as_chunks::<4>();
            let int = |word: &[u8; 4]| i64::from(i32::from_le_bytes(*word));
            Some(words.iter().map(int).collect())
        }
        (Datum::U8 | Datum::Bool, _) => {
            Some(proto.raw_data.iter().map(|&byte| i64::from(byte)).collect())
        }
        (Datum::F32 | Datum::F64, _) => None,
    };
    let value = match ints {
        Some(ints) => Value::known(datum, shape, ints),
        None => Value::new(datum, shape),
    };
    Ok(Value {
        constant: true,
        ..value
    })
}

/// The type with this number, if a graph may use it.
pub(super) fn datum(data_type: i32) -> Result<Datum, Problem> {
    match DataType::try_from(data_type) {
        Ok(DataType::Float) => Ok(Datum::F32),
        Ok(DataType::Double) => Ok(Datum::F64),
        Ok(DataType::Int32) => Ok(Datum::I32),
        Ok(DataType::Int64) => Ok(Datum::I64),
        Ok(DataType::Uint8) => Ok(Datum::U8),
        Ok(DataType::Bool) => Ok(Datum::Bool),
        Ok(other) => Err(Problem::Numbers(format!("{other:?}"))),
        Err(_) => Err(Problem::Numbers(data_type.to_string())),
    }
}

/// A graph's input or output as declared. Every length must be a number.
pub(super) fn declared(info: &pb::ValueInfoProto) -> Result<Value, Problem> {
    use pb::tensor_shape_proto::dimension::Value as Length;
    use pb::type_proto::Value as Type;
    let Some(Type::TensorType(tensor)) = info.r#type.as_ref().and_then(|t| t.value.as_ref()) else {
        return Err(Problem::NoTensor);
    };
    let datum = datum(tensor.elem_type)?;
    let dims = tensor.shape.iter().flat_map(|shape| &shape.dim);
    let shape = dims
        .map(|dim| match dim.value {
            Some(Length::DimValue(length)) if (1..=1 << 24).contains(&length) => {
                Ok(length as usize)
            }
            _ => Err(Problem::OpenLength),
        })
        .collect::<Result<Vec<usize>, Problem>>()?;
    if shape.len() > MOST_RANK {
        return Err(Problem::Rank(shape.len()));
    }
    Ok(Value::new(datum, shape))
}
