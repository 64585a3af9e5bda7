//! Operators that work along a sequence.

use tract_onnx::pb;

use super::problem::Problem;
use super::{Computed, Datum, Node, Value, Walk, quoted, tensor};

/// The most steps of a sequence.
const MOST_STEPS: usize = 1_024;

/// RNN, GRU and LSTM: `X` [steps, batch, inputs], `W` [directions, gates x hidden, inputs],
/// `R` [directions, gates x hidden, hidden], `B` [directions, 2 x gates x hidden].
pub(super) fn recurrent(node: &Node<'_>) -> Result<Computed, Problem> {
    let gates = match node.proto.op_type.as_str() {
        "RNN" => 1,
        "GRU" => 3,
        _ => 4,
    };
    let constant = |index: usize| match node.of(index, Datum::F32)? {
        value if value.constant => Ok(value),
        value => Err(Problem::NotConstant(index, value.into())),
    };
    let (x, w, r) = (node.of(0, Datum::F32)?, constant(1)?, constant(2)?);
    let (&[steps, batch, inputs], &[_, _, hidden]) = (x.shape.as_slice(), r.shape.as_slice())
    else {
        return Err(Problem::Weights(x.into(), w.into(), r.into()));
    };
    let directions = match node.text("direction") {
        Some("bidirectional") => 2,
        _ => 1,
    };
    let rows = hidden.saturating_mul(gates);
    let fits = w.shape == [directions, rows, inputs] && r.shape == [directions, rows, hidden];
    if !fits || node.int("hidden_size", hidden as i64) != hidden as i64 || steps > MOST_STEPS {
        return Err(Problem::Weights(x.into(), w.into(), r.into()));
    }
    if node.optional(3).is_some() && constant(3)?.shape != [directions, rows.saturating_mul(2)] {
        return Err(Problem::Bias(node.input(3)?.into()));
    }
    if node.optional(4).is_some() {
        return Err(Problem::Unsupported("lengths of sequences are"));
    }
    for index in 5..node.inputs.len() {
        if node.optional(index).is_some() {
            let start = node.of(index, Datum::F32)?;
            if start.shape != [directions, batch, hidden] {
                return Err(Problem::Start(start.into()));
            }
        }
    }
    usual_activations(node, gates, directions)?;
    let each = inputs.saturating_add(hidden).saturating_mul(rows) as u64;
    let times = (directions * steps) as u64;
    let last = Value::new(Datum::F32, vec![directions, batch, hidden]);
    let all = Value::new(Datum::F32, vec![steps, directions, batch, hidden]);
    Ok(Computed {
        values: vec![all, last.clone(), last],
        work: each.saturating_mul(times).saturating_mul(batch as u64),
    })
}

/// Checks the activations. The inference library supports only ONNX's default ones.
fn usual_activations(node: &Node<'_>, gates: usize, directions: usize) -> Result<(), Problem> {
    let Some(given) = node.attribute("activations") else {
        return Ok(());
    };
    let usual: &[&[u8]] = match gates {
        1 => &[b"Tanh"],
        3 => &[b"Sigmoid", b"Tanh"],
        _ => &[b"Sigmoid", b"Tanh", b"Tanh"],
    };
    let usual = usual.iter().copied().cycle().take(usual.len() * directions);
    if given.strings.iter().map(Vec::as_slice).eq(usual) {
        return Ok(());
    }
    Err(Problem::Unsupported(
        "other activations than ONNX's defaults are",
    ))
}

/// A loop over a sequence. Its body runs once for each step. It takes the current states and a
/// slice of each sequence, and returns the new states and a slice of each output.
pub(super) fn scan<'a>(node: &Node<'a>, walk: &mut Walk<'a>) -> Result<Computed, Problem> {
    if !walk.may_nest {
        return Err(Problem::Unsupported("a loop in a loop is"));
    }
    let scan = Scan::of(node)?;
    let mut inside = Walk::new(walk.opset);
    inside.values = walk.values.clone();
    inside.cost = walk.cost;
    inside.may_nest = false;
    let steps = scan.bind_inputs(node, &mut inside)?;
    inside.times = walk.times.saturating_mul(steps as u64);
    inside
        .tensors(scan.body)
        .and_then(|()| inside.nodes(scan.body))
        .map_err(|problem| Problem::InBody(Box::new(problem)))?;
    let values = scan.outputs(node, &inside, steps)?;
    walk.cost = inside.cost;
    Ok(Computed { values, work: 0 })
}

/// The body of a loop. Its inputs are the states, then a slice of each sequence. Its outputs are
/// the new states, then a slice of each output.
struct Scan<'a> {
    body: &'a pb::GraphProto,
    /// The number of states.
    states: usize,
    /// The axis of each sequence along which it is cut into slices.
    input_axes: Vec<usize>,
    /// The axis of each output along which its slices are joined.
    output_axes: Vec<usize>,
}

impl<'a> Scan<'a> {
    fn of(node: &Node<'a>) -> Result<Self, Problem> {
        let body: &'a pb::GraphProto = node
            .proto
            .attribute
            .iter()
            .find_map(|attribute| attribute.g.as_ref())
            .ok_or(Problem::NoBody)?;
        let sequences = node.int("num_scan_inputs", 0) as usize;
        let states = node
            .inputs
            .len()
            .checked_sub(sequences)
            .filter(|_| sequences > 0 && body.input.len() == node.inputs.len())
            .ok_or(Problem::LoopInputs {
                inputs: node.inputs.len(),
                body: body.input.len(),
                sequences,
            })?;
        let slices = body
            .output
            .len()
            .checked_sub(states)
            .filter(|_| node.proto.output.len() == body.output.len())
            .ok_or(Problem::LoopOutputs)?;
        let list = |name: &'static str, length: usize| match node.ints(name) {
            Some(ints) if ints.len() != length => Err(Problem::LoopAxes(name, length)),
            Some(ints) => Ok(ints.iter().map(|&int| int as usize).collect()),
            None => Ok(vec![0_usize; length]),
        };
        let input_axes = list("scan_input_axes", sequences)?;
        let output_axes = list("scan_output_axes", slices)?;
        list("scan_input_directions", sequences)?;
        list("scan_output_directions", slices)?;
        Ok(Self {
            body,
            states,
            input_axes,
            output_axes,
        })
    }

    /// Gives the body's inputs their values in `inside`, and returns the number of steps.
    fn bind_inputs(&self, node: &Node<'a>, inside: &mut Walk<'a>) -> Result<usize, Problem> {
        let mut steps = None;
        for (index, declared) in self.body.input.iter().enumerate() {
            let mut value = Value {
                constant: false,
                ints: None,
                ..node.input(index)?.clone()
            };
            if let Some(sequence) = index.checked_sub(self.states) {
                let axis = self.input_axes[sequence];
                if axis >= value.rank() {
                    return Err(Problem::SequenceAxis(axis, (&value).into()));
                }
                let length = value.shape.remove(axis);
                if *steps.get_or_insert(length) != length || length > MOST_STEPS {
                    return Err(Problem::Steps(length));
                }
            }
            if !tensor::declared(declared)?.same_as(&value) {
                let name = quoted(&declared.name);
                return Err(Problem::BodyInput(name, (&value).into()));
            }
            inside.bind(&declared.name, value)?;
        }
        Ok(steps.unwrap_or(1))
    }

    /// The outputs of the loop, from the values of its body.
    fn outputs(
        &self,
        node: &Node<'a>,
        inside: &Walk<'a>,
        steps: usize,
    ) -> Result<Vec<Value>, Problem> {
        let mut values = Vec::new();
        for (index, output) in self.body.output.iter().enumerate() {
            let name = quoted(&output.name);
            let mut nodes = self.body.node.iter();
            let is_computed_inside = nodes.any(|node| node.output.contains(&output.name));
            let Some(value) = inside
                .values
                .get(output.name.as_str())
                .filter(|_| is_computed_inside)
            else {
                return Err(Problem::BodyOutput(name));
            };
            let mut value = Value::new(value.datum, value.shape.clone());
            match index.checked_sub(self.states) {
                None if !value.same_as(node.input(index)?) => {
                    return Err(Problem::State(name, (&value).into()));
                }
                None => {}
                Some(slice) if self.output_axes[slice] <= value.rank() => {
                    value.shape.insert(self.output_axes[slice], steps);
                }
                Some(slice) => {
                    return Err(Problem::OutputAxis(
                        self.output_axes[slice],
                        (&value).into(),
                    ));
                }
            }
            values.push(value);
        }
        Ok(values)
    }
}
