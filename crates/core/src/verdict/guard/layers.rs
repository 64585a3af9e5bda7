//! Operators that combine many numbers into one.

use super::arithmetic::broadcast;
use super::problem::Problem;
use super::{Computed, Datum, Node, Value, axes, count};

fn f32(shape: Vec<usize>) -> Value {
    Value::new(Datum::F32, shape)
}

/// A result of this shape, in which each number is a sum of `each` products.
fn products(shape: Vec<usize>, each: usize) -> Computed {
    let work = count(&shape).map_or(u64::MAX, |numbers| numbers.saturating_mul(each as u64));
    Computed {
        values: vec![f32(shape)],
        work,
    }
}

/// Weights: a constant input of type f32.
fn weights<'a>(node: &'a Node<'_>, index: usize) -> Result<&'a Value, Problem> {
    let value = node.of(index, Datum::F32)?;
    if value.constant {
        return Ok(value);
    }
    Err(Problem::NotConstant(index, value.into()))
}

/// Checks that an input is weights with one number for each channel.
fn per_channel(node: &Node<'_>, index: usize, channels: usize) -> Result<(), Problem> {
    let value = weights(node, index)?;
    if value.shape == [channels] {
        return Ok(());
    }
    Err(Problem::PerChannel {
        index,
        found: value.into(),
        channels,
    })
}

pub(super) fn matmul(node: &Node<'_>) -> Result<Computed, Problem> {
    let (left, right) = (node.of(0, Datum::F32)?, node.of(1, Datum::F32)?);
    if left.rank() < 2 || right.rank() < 2 {
        return Err(Problem::ProductRank(left.into(), right.into()));
    }
    let (left_batch, left_matrix) = left.shape.split_at(left.rank() - 2);
    let (right_batch, right_matrix) = right.shape.split_at(right.rank() - 2);
    let inner = left_matrix[1];
    if inner != right_matrix[0] {
        return Err(Problem::Product(left.into(), right.into()));
    }
    let mut shape = broadcast(left_batch, right_batch)?;
    shape.extend([left_matrix[0], right_matrix[1]]);
    Ok(products(shape, inner))
}

pub(super) fn gemm(node: &Node<'_>) -> Result<Computed, Problem> {
    let matrix = |index: usize, transposed: &str| {
        let value = node.of(index, Datum::F32)?;
        match (value.shape.as_slice(), node.int(transposed, 0)) {
            (&[rows, columns], 0) => Ok((rows, columns)),
            (&[rows, columns], _) => Ok((columns, rows)),
            _ => Err(Problem::Input {
                index,
                found: value.into(),
                expected: "a matrix",
            }),
        }
    };
    let ((rows, inner), (right_inner, columns)) = (matrix(0, "transA")?, matrix(1, "transB")?);
    if inner != right_inner {
        let (left, right) = (node.input(0)?, node.input(1)?);
        return Err(Problem::Product(left.into(), right.into()));
    }
    let shape = vec![rows, columns];
    if node.optional(2).is_some() {
        let bias = node.of(2, Datum::F32)?;
        if bias.rank() > 2 || broadcast(&bias.shape, &shape).ok().as_ref() != Some(&shape) {
            let bias = bias.into();
            return Err(Problem::MatrixBias {
                bias,
                rows,
                columns,
            });
        }
    }
    Ok(products(shape, inner))
}

/// The lengths that a convolution or a pool leaves of `spatial` lengths.
fn windows(node: &Node<'_>, spatial: &[usize], kernel: &[usize]) -> Result<Vec<usize>, Problem> {
    let rank = spatial.len();
    let list = |name: &'static str, length: usize, default: i64| {
        let found = node
            .ints(name)
            .map_or(vec![default; length], <[i64]>::to_vec);
        if found.len() == length {
            return Ok(found.into_iter().map(|int| int as usize).collect());
        }
        Err(Problem::Values {
            name,
            found,
            expected: length,
        })
    };
    let strides: Vec<usize> = list("strides", rank, 1)?;
    let dilations: Vec<usize> = list("dilations", rank, 1)?;
    let pads: Vec<usize> = list("pads", 2 * rank, 0)?;
    let auto = node.text("auto_pad").unwrap_or("NOTSET");
    if auto != "NOTSET" && node.ints("pads").is_some() {
        return Err(Problem::Both("auto_pad", "pads"));
    }
    let is_pool = node.proto.op_type != "Conv";
    let window = |axis: usize| {
        let span = dilations[axis] * (kernel[axis] - 1) + 1;
        let (stride, length) = (strides[axis], spatial[axis]);
        if auto.starts_with("SAME") {
            return Ok(length.div_ceil(stride));
        }
        let (before, after) = (pads[axis], pads[axis + rank]);
        let padded = length + before + after;
        // In a pool, a window of padding alone has no largest number.
        let empty = is_pool && (before >= span || after >= span);
        if padded < span || empty || span > length.max(1) + before + after {
            return Err(Problem::Window {
                span,
                length,
                before,
                after,
            });
        }
        let steps = padded - span;
        Ok(1 + match node.int("ceil_mode", 0) {
            0 => steps / stride,
            _ => steps.div_ceil(stride),
        })
    };
    (0..rank).map(window).collect()
}

pub(super) fn conv(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, kernels) = (node.of(0, Datum::F32)?, weights(node, 1)?);
    if !(3..=4).contains(&value.rank()) || kernels.rank() != value.rank() {
        return Err(Problem::Kernels(value.into(), kernels.into()));
    }
    let (outputs, inputs_each) = (kernels.shape[0], kernels.shape[1]);
    let kernel = &kernels.shape[2..];
    let groups = node.int("group", 1) as usize;
    let (batch, channels) = (value.shape[0], value.shape[1]);
    let said = node.ints("kernel_shape");
    let as_said = |said: &[i64]| {
        said.len() == kernel.len() && said.iter().zip(kernel).all(|(s, k)| *s == *k as i64)
    };
    if inputs_each.checked_mul(groups) != Some(channels)
        || outputs % groups != 0
        || !said.is_none_or(as_said)
        || kernel.iter().any(|&length| length > 64)
    {
        return Err(Problem::Groups(value.into(), kernels.into(), groups));
    }
    if node.optional(2).is_some() {
        per_channel(node, 2, outputs)?;
    }
    let mut shape = vec![batch, outputs];
    shape.extend(windows(node, &value.shape[2..], kernel)?);
    let each = inputs_each.saturating_mul(kernel.iter().product());
    Ok(products(shape, each))
}

pub(super) fn pool(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    let kernel = node.ints("kernel_shape").unwrap_or_default();
    let kernel: Vec<usize> = kernel.iter().map(|&length| length as usize).collect();
    if kernel.is_empty() || value.rank() != 2 + kernel.len() {
        return Err(Problem::Pool(value.into(), kernel));
    }
    let mut shape = value.shape[..2].to_vec();
    shape.extend(windows(node, &value.shape[2..], &kernel)?);
    Ok(products(shape, kernel.iter().product()))
}

pub(super) fn global_pool(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    if value.rank() < 3 {
        return Err(Problem::LowRank(value.into(), 3));
    }
    let mut shape = vec![1; value.rank()];
    shape[..2].copy_from_slice(&value.shape[..2]);
    Ok(f32(shape).into())
}

/// An input whose second axis is its channels, and the number of channels.
fn channels<'a>(node: &'a Node<'_>, least: usize) -> Result<(&'a Value, usize), Problem> {
    let value = node.of(0, Datum::F32)?;
    match value.shape.get(1) {
        Some(&channels) if value.rank() >= least => Ok((value, channels)),
        _ => Err(Problem::LowRank(value.into(), least)),
    }
}

pub(super) fn batch_norm(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, channels) = channels(node, 2)?;
    for index in 1..=4 {
        per_channel(node, index, channels)?;
    }
    Ok(f32(value.shape.clone()).into())
}

pub(super) fn instance_norm(node: &Node<'_>) -> Result<Computed, Problem> {
    let (value, channels) = channels(node, 3)?;
    per_channel(node, 1, channels)?;
    per_channel(node, 2, channels)?;
    Ok(f32(value.shape.clone()).into())
}

pub(super) fn layer_norm(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    let axis = node.axis("axis", -1, value.rank())?;
    for index in 1..node.inputs.len() {
        let scale = weights(node, index)?;
        if scale.shape != value.shape[axis..] {
            let (scale, value) = (scale.into(), value.into());
            return Err(Problem::Scale {
                index,
                scale,
                value,
            });
        }
    }
    Ok(f32(value.shape.clone()).into())
}

pub(super) fn softmax(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    node.axis("axis", -1, value.rank())?;
    Ok(f32(value.shape.clone()).into())
}

/// The shape after axes are reduced to one number each.
fn reduced(shape: &[usize], gone: &[usize], keep: bool) -> Vec<usize> {
    let lengths = shape.iter().enumerate();
    lengths
        .filter_map(|(axis, &length)| match gone.contains(&axis) {
            true => keep.then_some(1),
            false => Some(length),
        })
        .collect()
}

pub(super) fn reduce(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.input(0)?;
    let operator = node.proto.op_type.as_str();
    let whole = matches!(value.datum, Datum::I32 | Datum::I64);
    let of_whole = ["ReduceSum", "ReduceMax", "ReduceMin"].contains(&operator);
    if value.datum != Datum::F32 && !(whole && of_whole) {
        return Err(Problem::Of(value.into()));
    }
    // ONNX moved the axes from an attribute to an input: for sums with opset 13, for others with
    // 18.
    let by_input = operator == "ReduceSum" || node.opset >= 18;
    let given = match (node.optional(1), node.ints("axes")) {
        (None, None) => None,
        (Some(_), None) if by_input => Some(node.known(1)?),
        (None, Some(axes)) if !by_input => Some(axes),
        _ => {
            let place = if by_input { "an input" } else { "an attribute" };
            let opset = node.opset;
            return Err(Problem::Axes { opset, place });
        }
    };
    let noop = by_input && node.int("noop_with_empty_axes", 0) == 1;
    let gone = match given {
        Some([]) | None if noop => Vec::new(),
        Some([]) | None => (0..value.rank()).collect(),
        Some(given) => axes(given, value.rank())?,
    };
    let shape = reduced(&value.shape, &gone, node.int("keepdims", 1) == 1);
    Ok(Value::new(value.datum, shape).into())
}

pub(super) fn arg(node: &Node<'_>) -> Result<Computed, Problem> {
    let value = node.of(0, Datum::F32)?;
    let axis = node.axis("axis", 0, value.rank())?;
    let shape = reduced(&value.shape, &[axis], node.int("keepdims", 1) == 1);
    Ok(Value::new(Datum::I64, shape).into())
}
