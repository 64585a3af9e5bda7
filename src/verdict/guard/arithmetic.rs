//! Operators that work number by number.

use super::{Computed, Datum, Node, Value, tensor};

/// The shape that values of these shapes have together, as numpy broadcasts them.
pub(super) fn broadcast(left: &[usize], right: &[usize]) -> Result<Vec<usize>, String> {
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
            _ => Err(format!("shapes {left:?} and {right:?} do not go together")),
        })
        .collect()
}

fn same(value: &Value) -> Value {
    Value::new(value.datum, value.shape.clone())
}

fn is_float(value: &Value) -> Result<&Value, String> {
    if value.datum.is_float() {
        return Ok(value);
    }
    Err(format!("found {value}, expected f32 or f64"))
}

fn is_number(value: &Value) -> Result<&Value, String> {
    match value.datum {
        Datum::F32 | Datum::F64 | Datum::I32 | Datum::I64 => Ok(value),
        Datum::U8 | Datum::Bool => Err(format!("found {value}, expected f32, f64, i32 or i64")),
    }
}

pub(super) fn float(node: &Node<'_>) -> Result<Computed, String> {
    Ok(same(is_float(node.input(0)?)?).into())
}

pub(super) fn signed(node: &Node<'_>) -> Result<Computed, String> {
    Ok(same(is_number(node.input(0)?)?).into())
}

pub(super) fn question(node: &Node<'_>) -> Result<Computed, String> {
    let value = is_float(node.input(0)?)?;
    Ok(Value::new(Datum::Bool, value.shape.clone()).into())
}

pub(super) fn not(node: &Node<'_>) -> Result<Computed, String> {
    Ok(same(node.of(0, Datum::Bool)?).into())
}

pub(super) fn cast(node: &Node<'_>) -> Result<Computed, String> {
    let value = node.input(0)?;
    let to = tensor::datum(node.int("to", 0) as i32)?;
    let ints = match to {
        // What becomes an integer of another size may become another integer.
        Datum::I64 => value.ints.clone(),
        _ => None,
    };
    let cast = Value::new(to, value.shape.clone());
    Ok(Value { ints, ..cast }.into())
}

/// Two values of one type.
fn pair<'a>(node: &'a Node<'_>) -> Result<(&'a Value, &'a Value, Vec<usize>), String> {
    let (left, right) = (node.input(0)?, node.input(1)?);
    if left.datum != right.datum {
        return Err(format!("{left} and {right} are of different types"));
    }
    Ok((left, right, broadcast(&left.shape, &right.shape)?))
}

pub(super) fn binary(node: &Node<'_>) -> Result<Computed, String> {
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
                .collect::<Result<Vec<i64>, String>>()?,
        ),
        (Some(left), Some(right)) if right.len() == 1 => Some(
            left.iter()
                .map(|&left| whole(operator, left, right[0]))
                .collect::<Result<Vec<i64>, String>>()?,
        ),
        (Some(left), Some(right)) if left.len() == 1 => Some(
            right
                .iter()
                .map(|&right| whole(operator, left[0], right))
                .collect::<Result<Vec<i64>, String>>()?,
        ),
        _ if operator == "Div" => {
            return Err("a quotient of integers that are not known".to_owned());
        }
        _ => None,
    };
    Ok(match ints {
        Some(ints) => Value::known(computed.datum, computed.shape, ints),
        None => computed,
    }
    .into())
}

/// One operation on integers that say a shape: they stay small.
fn whole(operator: &str, left: i64, right: i64) -> Result<i64, String> {
    let result = match operator {
        "Add" => left.checked_add(right),
        "Sub" => left.checked_sub(right),
        "Mul" => left.checked_mul(right),
        // ONNX rounds towards zero.
        "Div" => left.checked_div(right),
        _ => None,
    };
    let small = result.filter(|result| result.unsigned_abs() <= 1 << 31);
    small.ok_or_else(|| format!("{operator} of {left} and {right}"))
}

pub(super) fn several(node: &Node<'_>) -> Result<Computed, String> {
    let first = is_float(node.input(0)?)?;
    let mut shape = first.shape.clone();
    for value in node.all() {
        if value.datum != first.datum {
            return Err(format!("{first} and {value} are of different types"));
        }
        shape = broadcast(&shape, &value.shape)?;
    }
    Ok(Value::new(first.datum, shape).into())
}

pub(super) fn power(node: &Node<'_>) -> Result<Computed, String> {
    // The inference library panics on an exponent that it takes for a length.
    let (base, _, shape) = pair(node)?;
    Ok(Value::new(is_float(base)?.datum, shape).into())
}

pub(super) fn prelu(node: &Node<'_>) -> Result<Computed, String> {
    let (value, slope, shape) = pair(node)?;
    is_float(value)?;
    if shape != value.shape || slope.rank() > value.rank() {
        return Err(format!("slopes {slope} of values {value}"));
    }
    Ok(same(value).into())
}

pub(super) fn compare(node: &Node<'_>) -> Result<Computed, String> {
    let (left, _, shape) = pair(node)?;
    is_number(left)?;
    Ok(Value::new(Datum::Bool, shape).into())
}

pub(super) fn logic(node: &Node<'_>) -> Result<Computed, String> {
    let (_, _, shape) = pair(node)?;
    node.of(0, Datum::Bool)?;
    Ok(Value::new(Datum::Bool, shape).into())
}

pub(super) fn choose(node: &Node<'_>) -> Result<Computed, String> {
    let condition = node.of(0, Datum::Bool)?;
    let (yes, no) = (node.input(1)?, node.input(2)?);
    if yes.datum != no.datum {
        return Err(format!("{yes} and {no} are of different types"));
    }
    let shape = broadcast(&condition.shape, &broadcast(&yes.shape, &no.shape)?)?;
    Ok(Value::new(yes.datum, shape).into())
}

pub(super) fn clip(node: &Node<'_>) -> Result<Computed, String> {
    let value = is_float(node.input(0)?)?;
    for bound in [node.optional(1), node.optional(2)].into_iter().flatten() {
        if bound.datum != value.datum || bound.numbers() != Some(1) || bound.rank() > value.rank() {
            return Err(format!("a bound {bound} of values {value}"));
        }
    }
    Ok(same(value).into())
}
