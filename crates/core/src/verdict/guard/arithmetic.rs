//! Operators that work on each number separately.

use super::problem::Problem;
use super::{Computed, Datum, Node, Value, tensor};

/// The common shape of values with these shapes, as numpy broadcasts them.
pub(super) fn broadcast(left: &[usize], right: &[usize]) -> Result<Vec<usize>, Problem> {
    let rank = left.len().max(right.len());
    let length = |shape: &[usize], axis: usize| {
        let missing = rank - shape.len();
        if axis < missing {
            1
        } else {
            shape[axis - missing]
        }
    };
    (0..rank)
        .map(|axis| match (length(left, axis), length(right, axis)) {
            (left, right) if left == right => Ok(left),
            (1, other) | (other, 1) => Ok(other),
            _ => Err(Problem::Shapes(left.to_vec(), right.to_vec())),
        })
        .collect()
}

fn same(value: &Value) -> Value {
    Value::new(value.datum, value.shape.clone())
}

fn is_float(value: &Value) -> Result<&Value, Problem> {
    if value.datum.is_float() {
        return Ok(value);
    }
    Err(Problem::Found {
        found: value.into(),
        expected: "f32 or f64".to_owned(),
    })
}

fn is_number(value: &Value) -> Result<&Value, Problem> {
    match value.datum {
        Datum::F32 | Datum::F64 | Datum::I32 | Datum::I64 => Ok(value),
        Datum::U8 | Datum::Bool => Err(Problem::Found {
            found: value.into(),
            expected: "f32, f64, i32 or i64".to_owned(),
        }),
    }
}

pub(super) fn float(node: &Node<'_>) -> Result<Computed, Problem> {
    Ok(same(is_float(node.input(0)?)?).into())
}

pub(super) fn signed(node: &Node<'_>) -> Result<Computed, Problem> {
    Ok(same(is_number(node.input(0)?)?).into())
}

pub(super) fn question(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = is_float(node.input(0)?)?;
    Ok(Value::new(Datum::Bool, value.shape.clone()).into())
}

pub(super) fn not(node: &Node<'_>) -> Result<Computed, Problem> {
    Ok(same(node.of(0, Datum::Bool)?).into())
}

pub(super) fn cast(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let to = tensor::datum(node.int("to", 0) as i32)?;
    let ints = match to {
        // A cast to an integer of another size may change the value, so only i64 keeps its
        // integers.
        Datum::I64 => value.ints.clone(),
        _ => None,
    };
    let cast = Value::new(to, value.shape.clone());
    Ok(Value { ints, ..cast }.into())
}

/// The two inputs, which have to be of one type, and their common shape.
fn pair<'a>(node: &'a Node<'_>) -> Result<(&'a Value, &'a Value, Vec<usize>), Problem> {
    let (left, right) = (node.input(0)?, node.input(1)?);
    if left.datum != right.datum {
        return Err(Problem::Types(left.into(), right.into()));
    }
    Ok((left, right, broadcast(&left.shape, &right.shape)?))
}

pub(super) fn binary(node: &Node<'_>) -> Result<Computed, Problem> {
    let (left, right, shape) = pair(node)?;
    is_number(left)?;
    let computed = Value::new(left.datum, shape);
    if left.datum.is_float() {
        return Ok(computed.into());
    }
    let operator = node.proto.op_type.as_str();
    let ints = match (&left.ints, &right.ints) {
        (Some(left), Some(right)) if left.len() == right.len() => Some(
            left.iter()
                .zip(right.iter())
                .map(|(&left, &right)| whole(operator, left, right))
                .collect::<Result<Vec<i64>, Problem>>()?,
        ),
        (Some(left), Some(right)) if right.len() == 1 => Some(
            left.iter()
                .map(|&left| whole(operator, left, right[0]))
                .collect::<Result<Vec<i64>, Problem>>()?,
        ),
        (Some(left), Some(right)) if left.len() == 1 => Some(
            right
                .iter()
                .map(|&right| whole(operator, left[0], right))
                .collect::<Result<Vec<i64>, Problem>>()?,
        ),
        _ if operator == "Div" => {
            return Err(Problem::Quotient);
        }
        _ => None,
    };
    Ok(match ints {
        Some(ints) => Value::known(computed.datum, computed.shape, ints),
        None => computed,
    }
    .into())
}

/// One operation on integers that decide a shape. They have to stay small.
fn whole(operator: &str, left: i64, right: i64) -> Result<i64, Problem> {
    let result = match operator {
        "Add" => left.checked_add(right),
        "Sub" => left.checked_sub(right),
        "Mul" => left.checked_mul(right),
        // ONNX rounds towards zero.
        "Div" => left.checked_div(right),
        _ => None,
    };
    let small = result.filter(|result| result.unsigned_abs() <= 1 << 31);
    small.ok_or_else(|| Problem::Integers {
        operator: operator.to_owned(),
        left,
        right,
    })
}

pub(super) fn several(node: &Node<'_>) -> Result<Computed, Problem> {
    let first = is_float(node.input(0)?)?;
    let mut shape = first.shape.clone();
    for value in node.all() {
        if value.datum != first.datum {
            return Err(Problem::Types(first.into(), value.into()));
        }
        shape = broadcast(&shape, &value.shape)?;
    }
    Ok(Value::new(first.datum, shape).into())
}

pub(super) fn power(node: &Node<'_>) -> Result<Computed, Problem> {
    // The exponent must have the base's type: the inference library panics on an integer exponent
    // that it takes for a length.
    let (base, _, shape) = pair(node)?;
    Ok(Value::new(is_float(base)?.datum, shape).into())
}

pub(super) fn prelu(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, slope, shape) = pair(node)?;
    is_float(value)?;
    if shape != value.shape || slope.rank() > value.rank() {
        return Err(Problem::Slopes(slope.into(), value.into()));
    }
    Ok(same(value).into())
}

pub(super) fn compare(node: &Node<'_>) -> Result<Computed, Problem> {
    let (left, _, shape) = pair(node)?;
    is_number(left)?;
    Ok(Value::new(Datum::Bool, shape).into())
}

pub(super) fn logic(node: &Node<'_>) -> Result<Computed, Problem> {
    let (_, _, shape) = pair(node)?;
    node.of(0, Datum::Bool)?;
    Ok(Value::new(Datum::Bool, shape).into())
}

pub(super) fn choose(node: &Node<'_>) -> Result<Computed, Problem> {
    let condition = node.of(0, Datum::Bool)?;
    let (yes, no) = (node.input(1)?, node.input(2)?);
    if yes.datum != no.datum {
        return Err(Problem::Types(yes.into(), no.into()));
    }
    let shape = broadcast(&condition.shape, &broadcast(&yes.shape, &no.shape)?)?;
    Ok(Value::new(yes.datum, shape).into())
}

pub(super) fn clip(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = is_float(node.input(0)?)?;
    for bound in [node.optional(1), node.optional(2)].into_iter().flatten() {
        if bound.datum != value.datum || bound.numbers() != Some(1) || bound.rank() > value.rank() {
            return Err(Problem::Bound(bound.into(), value.into()));
        }
    }
    Ok(same(value).into())
}
