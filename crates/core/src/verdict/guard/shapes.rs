//! Operators that rearrange numbers without computing any.

use super::arithmetic::broadcast;
use super::problem::Problem;
use super::{Computed, Datum, MOST_RANK, Node, Value, axes, count, tensor};

pub(super) fn identity(node: &Node<'_>) -> Result<Computed, Problem> {
    Ok(node.input(0)?.clone().into())
}

pub(super) fn dropout(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    if let Some(ratio) = node.optional(1)
        && ratio.rank() > 0
    {
        return Err(Problem::Ratio(ratio.into()));
    }
    if let Some(training) = node.optional(2)
        && (training.datum != Datum::Bool || training.ints.as_deref() != Some(&[0]))
    {
        return Err(Problem::Training);
    }
    let mask = Value::new(Datum::Bool, value.shape.clone());
    Ok(Computed {
        values: vec![value.clone(), mask],
        work: 0,
    })
}

pub(super) fn constant(node: &Node<'_>) -> Result<Computed, Problem> {
    let [attribute] = node.proto.attribute.as_slice() else {
        return Err(Problem::OneValue);
    };
    let value = match attribute.name.as_str() {
        "value" => tensor::value(attribute.t.as_ref().ok_or(Problem::NoTensor)?)?,
        "value_float" => Value::new(Datum::F32, Vec::new()),
        "value_floats" => Value::new(Datum::F32, vec![attribute.floats.len()]),
        "value_int" => Value::known(Datum::I64, Vec::new(), vec![attribute.i]),
        _ => Value::known(
            Datum::I64,
            vec![attribute.ints.len()],
            attribute.ints.clone(),
        ),
    };
    Ok(value.into())
}

pub(super) fn constant_of_shape(node: &Node<'_>) -> Result<Computed, Problem> {
    let shape = lengths(node.known(0)?)?;
    let datum = match node.attribute("value").and_then(|value| value.t.as_ref()) {
        None => Datum::F32,
        Some(proto) => {
            let value = tensor::value(proto)?;
            if value.numbers() != Some(1) {
                return Err(Problem::FillValue((&value).into()));
            }
            value.datum
        }
    };
    Ok(Value::new(datum, shape).into())
}

/// Integers as a shape. None of them may be 0 or less.
fn lengths(ints: &[i64]) -> Result<Vec<usize>, Problem> {
    if ints.len() > MOST_RANK {
        return Err(Problem::ShapeRank(ints.len()));
    }
    let length = |&int: &i64| match usize::try_from(int) {
        Ok(length) if length > 0 => Ok(length),
        _ => Err(Problem::Shape(ints.to_vec())),
    };
    ints.iter().map(length).collect()
}

pub(super) fn shape(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let rank = value.rank() as i64;
    let clamp = |place: i64| (if place < 0 { place + rank } else { place }).clamp(0, rank);
    let (start, end) = (clamp(node.int("start", 0)), clamp(node.int("end", rank)));
    if start >= end {
        return Err(Problem::NoLength);
    }
    let lengths = &value.shape[start as usize..end as usize];
    let ints = lengths.iter().map(|&length| length as i64).collect();
    Ok(Value::known(Datum::I64, vec![lengths.len()], ints).into())
}

/// The same numbers in another shape.
fn reshaped(value: &Value, shape: Vec<usize>) -> Result<Computed, Problem> {
    if count(&shape) != value.numbers() {
        let shape = shape.iter().map(|&length| length as i64).collect();
        return Err(Problem::Fill(value.into(), shape));
    }
    let ints = value.ints.clone();
    let reshaped = Value::new(value.datum, shape);
    Ok(Value { ints, ..reshaped }.into())
}

pub(super) fn reshape(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, given) = (node.input(0)?, node.known(1)?);
    let copies = node.int("allowzero", 0) == 0;
    let mut shape = Vec::new();
    let mut open = None;
    if given.len() > MOST_RANK {
        return Err(Problem::ShapeRank(given.len()));
    }
    for (axis, &length) in given.iter().enumerate() {
        shape.push(match length {
            -1 if open.is_none() => {
                open = Some(axis);
                1
            }
            0 if copies && axis < value.rank() => value.shape[axis],
            length if length > 0 => length as usize,
            _ => return Err(Problem::Shape(given.to_vec())),
        });
    }
    if let Some(axis) = open {
        let (all, rest) = (value.numbers().unwrap_or(0), count(&shape).unwrap_or(0));
        if rest == 0 || all % rest != 0 {
            return Err(Problem::Fill(value.into(), given.to_vec()));
        }
        shape[axis] = (all / rest) as usize;
    }
    reshaped(value, shape)
}

pub(super) fn flatten(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let rank = value.rank() as i64;
    let axis = node.int("axis", 1);
    if !(-rank..=rank).contains(&axis) {
        let rank = value.rank();
        return Err(Problem::Axis { axis, rank });
    }
    let axis = if axis < 0 { axis + rank } else { axis } as usize;
    let (before, after) = value.shape.split_at(axis);
    reshaped(value, vec![before.iter().product(), after.iter().product()])
}

pub(super) fn transpose(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let order = match node.ints("perm") {
        Some(perm) if perm.len() == value.rank() => axes(perm, value.rank())?,
        Some(perm) => return Err(Problem::Order(perm.to_vec(), value.into())),
        None => (0..value.rank()).rev().collect(),
    };
    let shape = order.iter().map(|&axis| value.shape[axis]).collect();
    Ok(Value::new(value.datum, shape).into())
}

pub(super) fn squeeze(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let gone = match node.optional(1) {
        Some(_) => axes(node.known(1)?, value.rank())?,
        None => (0..value.rank()).filter(|&a| value.shape[a] == 1).collect(),
    };
    if gone.iter().any(|&axis| value.shape[axis] != 1) {
        return Err(Problem::LongAxes(gone, value.into()));
    }
    let left = (0..value.rank()).filter(|axis| !gone.contains(axis));
    reshaped(value, left.map(|axis| value.shape[axis]).collect())
}

pub(super) fn unsqueeze(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let given = node.known(1)?;
    let rank = value.rank() + given.len();
    if rank > MOST_RANK {
        return Err(Problem::OutputRank(rank));
    }
    let new = axes(given, rank)?;
    let mut old = value.shape.iter();
    let shape = (0..rank)
        .map(|axis| match new.contains(&axis) {
            true => 1,
            false => old.next().copied().unwrap_or(1),
        })
        .collect();
    reshaped(value, shape)
}

pub(super) fn concat(node: &Node<'_>) -> Result<Computed, Problem> {
    let first = node.input(0)?;
    if node.attribute("axis").is_none() {
        return Err(Problem::NoAxis);
    }
    let axis = node.axis("axis", 0, first.rank())?;
    let mut shape = first.shape.clone();
    shape[axis] = 0;
    let mut ints = Some(Vec::new());
    for value in node.all() {
        let fits = value.datum == first.datum
            && value.rank() == first.rank()
            && (0..shape.len()).all(|a| a == axis || value.shape[a] == first.shape[a]);
        if !fits {
            return Err(Problem::Together(first.into(), value.into()));
        }
        shape[axis] = shape[axis].saturating_add(value.shape[axis]);
        ints = match (ints, &value.ints) {
            (Some(mut ints), Some(more)) if shape.len() == 1 => {
                ints.extend_from_slice(more);
                Some(ints)
            }
            _ => None,
        };
    }
    Ok(match ints {
        Some(ints) => Value::known(first.datum, shape, ints),
        None => Value::new(first.datum, shape),
    }
    .into())
}

pub(super) fn split(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let axis = node.axis("axis", 0, value.rank())?;
    let (length, parts) = (value.shape[axis], node.proto.output.len());
    let sizes: Vec<usize> = match node.optional(1) {
        Some(_) if node.attribute("num_outputs").is_some() => {
            return Err(Problem::Both("split", "num_outputs"));
        }
        Some(sizes) if sizes.shape == [parts] => {
            let known = node.known(1)?.iter();
            let sizes = known.map(|&size| usize::try_from(size).unwrap_or(0));
            sizes.collect()
        }
        None if node.int("num_outputs", parts as i64) == parts as i64 && length % parts == 0 => {
            vec![length / parts; parts]
        }
        _ => return Err(Problem::Parts(value.into(), parts)),
    };
    let sum = sizes
        .iter()
        .try_fold(0_usize, |sum, &size| sum.checked_add(size));
    if sum != Some(length) || sizes.contains(&0) {
        return Err(Problem::PartLengths(value.into()));
    }
    let part = |size: usize| {
        let mut shape = value.shape.clone();
        shape[axis] = size;
        Value::new(value.datum, shape)
    };
    Ok(Computed {
        values: sizes.into_iter().map(part).collect(),
        work: 0,
    })
}

pub(super) fn slice(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let (starts, ends) = (node.known(1)?, node.known(2)?);
    let along = match node.optional(3) {
        Some(_) => axes(node.known(3)?, value.rank())?,
        None => (0..starts.len()).collect(),
    };
    let steps = match node.optional(4) {
        Some(_) => node.known(4)?.to_vec(),
        None => vec![1; starts.len()],
    };
    let lengths = [ends.len(), along.len(), steps.len()];
    let mut lists = (1..=4).filter_map(|index| node.optional(index));
    if lengths.iter().any(|&length| length != starts.len())
        || starts.len() > value.rank()
        || lists.any(|list| list.rank() != 1)
    {
        return Err(Problem::SliceLists);
    }
    let mut shape = value.shape.clone();
    let mut ints = value.ints.as_deref().filter(|_| value.rank() == 1);
    let mut picked = None;
    for (index, &axis) in along.iter().enumerate() {
        let places = places(value.shape[axis], starts[index], ends[index], steps[index])?;
        shape[axis] = places.len();
        let at = |ints: &[i64]| {
            places
                .iter()
                .map(|&place| ints[place])
                .collect::<Vec<i64>>()
        };
        picked = ints.take().map(at);
    }
    Ok(match picked {
        Some(ints) => Value::known(value.datum, shape, ints),
        None => Value::new(value.datum, shape),
    }
    .into())
}

/// The places that `start..end` by `step` selects from `length` places. There has to be at least
/// one.
fn places(length: usize, start: i64, end: i64, step: i64) -> Result<Vec<usize>, Problem> {
    let long = length as i64;
    // Exporters write "to the end" as the largest or the smallest integer.
    let last = [i64::MAX, i64::MIN, i64::MIN + 1].contains(&end) || end.unsigned_abs() < 1 << 31;
    let first = (-long..=long).contains(&start) || (step < 0 && start == i64::MAX);
    let stride = step != 0 && step.unsigned_abs() <= 1 << 16;
    let from_front = |place: i64| {
        let place = if place < 0 {
            place.saturating_add(long)
        } else {
            place
        };
        match step > 0 {
            true => place.clamp(0, long),
            false => place.clamp(-1, long - 1),
        }
    };
    let mut places = Vec::new();
    if first && last && stride {
        let (mut place, end) = (from_front(start), from_front(end));
        while (step > 0 && place < end) || (step < 0 && place > end) {
            places.push(place as usize);
            place += step;
        }
    }
    if places.is_empty() {
        return Err(Problem::Slice {
            start,
            end,
            step,
            length,
        });
    }
    Ok(places)
}

pub(super) fn gather(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, indices) = (node.input(0)?, node.input(1)?);
    if !matches!(indices.datum, Datum::I32 | Datum::I64) {
        return Err(Problem::Indices(indices.into()));
    }
    let axis = node.axis("axis", 0, value.rank())?;
    let length = value.shape[axis] as i64;
    let picked = node.known(1)?;
    let outside = |index: &&i64| !(-length..length).contains(*index);
    if let Some(index) = picked.iter().find(outside) {
        let (index, value) = (*index, value.into());
        return Err(Problem::Index { index, axis, value });
    }
    let (before, after) = (&value.shape[..axis], &value.shape[axis + 1..]);
    let shape = [before, &indices.shape, after].concat();
    Ok(match value.ints.as_deref().filter(|_| value.rank() == 1) {
        Some(ints) => {
            let at = |&index: &i64| ints[index.rem_euclid(length) as usize];
            Value::known(value.datum, shape, picked.iter().map(at).collect())
        }
        None => Value::new(value.datum, shape),
    }
    .into())
}

pub(super) fn pad(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    if let Some(fill) = node.optional(2)
        && (fill.rank() > 0 || fill.datum != value.datum || !fill.constant)
    {
        return Err(Problem::PadFill(fill.into()));
    }
    let along = match node.optional(3) {
        Some(_) => axes(node.known(3)?, value.rank())?,
        None => (0..value.rank()).collect(),
    };
    let pads = node.known(1)?;
    if pads.len() != 2 * along.len() || node.input(1)?.rank() != 1 {
        return Err(Problem::Pads(pads.len(), value.into()));
    }
    let mirrored = node.text("mode") == Some("reflect");
    let mut shape = value.shape.clone();
    for (index, &axis) in along.iter().enumerate() {
        let most = if mirrored {
            value.shape[axis] - 1
        } else {
            4096
        };
        for pad in [pads[index], pads[index + along.len()]] {
            match usize::try_from(pad) {
                Ok(pad) if pad <= most => shape[axis] += pad,
                _ => {
                    let value = value.into();
                    return Err(Problem::Pad { pad, axis, value });
                }
            }
        }
    }
    Ok(Value::new(value.datum, shape).into())
}

pub(super) fn expand(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let shape = broadcast(&value.shape, &lengths(node.known(1)?)?)?;
    Ok(Value::new(value.datum, shape).into())
}

pub(super) fn tile(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let repeats = lengths(node.known(1)?)?;
    if repeats.len() != value.rank() {
        return Err(Problem::Repeats(repeats, value.into()));
    }
    let lengths = value.shape.iter().zip(&repeats);
    let shape = lengths.map(|(length, times)| length.saturating_mul(*times));
    Ok(Value::new(value.datum, shape.collect()).into())
}
