//! The second head: Shore hardness with the ends of a 90 % interval, beside the levels.
//!
//! A network's outputs are `[batch, L + 3]`: logits, then the median and the two ends. A unit of
//! the last three is 25 Shore OO.

use burn::tensor::{Tensor, TensorData, activation};

use crate::net::builder::Builder;
use crate::net::hrn;
use crate::net::network::numbers;

/// Outputs beside the levels: Shore OO, and the low and high end of its interval.
pub const OUTPUTS: usize = 3;
/// The quantiles of the outputs.
const QUANTILES: [f32; OUTPUTS] = [0.5, 0.05, 0.95];
/// Shore OO of an output of 0.
const MIDDLE: f32 = 55.0;
/// Shore OO per unit of an output.
const UNIT: f32 = 25.0;

/// Weight of the intervals' loss relative to the levels' loss.
const WEIGHT: f32 = 1.5;

/// Logits and Shore OO (value, low, high) of each press, from the outputs `[batch, levels + 3]`.
/// `below` and `above` widen the interval. An end on the wrong side of the value is moved to the
/// value, as the daemon does, because a network that has learnt little may put the ends anywhere.
pub fn of_outputs(
    outputs: &Tensor<2>,
    levels: usize,
    [below, above]: [f32; 2],
) -> Vec<(Vec<f32>, [f32; OUTPUTS])> {
    let of_press = |row: &[f32]| {
        let of = |place: usize| row[levels + place] * UNIT + MIDDLE;
        let [value, low, high] =
            [of(0), of(1) - below, of(2) + above].map(|shore| shore.clamp(0.0, 100.0));
        let shore = [value, low.min(value), high.max(value)];
        (row[..levels].to_vec(), shore)
    };
    numbers(outputs)
        .chunks(levels + OUTPUTS)
        .map(of_press)
        .collect()
}

/// The loss of both heads: Eq. (9) of the levels, and the loss of the intervals where the hardness
/// was `measured`. Also returns the logits, row by row. `targets` is `[batch, L]`.
pub fn loss(
    outputs: Tensor<2>,
    targets: Tensor<2>,
    measured: &[Option<f32>],
) -> (Tensor<1>, Vec<f32>) {
    let [batch, levels] = targets.dims();
    let device = targets.device();
    let column = |value: fn(Option<f32>) -> f32| {
        let values: Vec<f32> = measured.iter().map(|&shore| value(shore)).collect();
        Tensor::<2>::from_data(TensorData::new(values, [batch, 1]), &device)
    };
    let known = column(|shore| f32::from(u8::from(shore.is_some())));
    let on_scale = column(|shore| shore.map_or(0.0, |shore| (shore - MIDDLE) / UNIT));
    let logits = outputs.clone().slice([0..batch, 0..levels]);
    let of_shore = outputs.slice([0..batch, levels..levels + OUTPUTS]);
    let judged = numbers(&logits);
    let of_intervals = interval_loss(of_shore, on_scale, known).mul_scalar(WEIGHT);
    (
        hrn::cross_entropy(logits, targets).add(of_intervals),
        judged,
    )
}

/// Pinball losses of the median and of the ends of a 90 % interval, summed and averaged over
/// presses. `outputs` is `[batch, 3]`. `shore` is `[batch, 1]` on the same scale, and `known` is 1
/// where it was measured.
fn interval_loss(outputs: Tensor<2>, shore: Tensor<2>, known: Tensor<2>) -> Tensor<1> {
    let batch = outputs.dims()[0] as f32;
    let quantiles = Tensor::<1>::from_floats(QUANTILES, &outputs.device()).reshape([1, OUTPUTS]);
    let error = shore.sub(outputs);
    let above = activation::relu(error.clone()).mul(quantiles.clone());
    let below = activation::relu(error.neg()).mul(quantiles.neg().add_scalar(1.0));
    above.add(below).mul(known).sum().div_scalar(batch)
}

/// Adds the nodes from a network's outputs `[1, levels + 3]` to raw logits `[1, levels]` and Shore
/// OO `[1, 3]`, and returns the names of both.
pub(super) fn nodes(
    b: &mut Builder,
    outputs: &str,
    levels: usize,
    [below, above]: [f32; 2],
) -> (String, String) {
    let ends = [0, levels, levels + OUTPUTS].map(|end| end as i64);
    let [zero, first, last] = ends.map(|end| b.0.indices(&format!("output {end}"), &[end]));
    let axis = b.0.indices("output axis", &[1]);
    let raw_logits = b.node("Slice", &[outputs, &zero, &first, &axis], "raw_logits");
    let raw = b.node("Slice", &[outputs, &first, &last, &axis], "raw shore");
    let unit = b.scalar("shore unit", UNIT);
    let middles = [MIDDLE, MIDDLE - below, MIDDLE + above];
    let middles = b.0.constant("shore middles", &[1, OUTPUTS], &middles);
    let scaled = b.node("Mul", &[&raw, &unit], "shore scaled");
    let moved = b.node("Add", &[&scaled, &middles], "shore moved");
    let (least, most) = (b.scalar("least shore", 0.0), b.scalar("most shore", 100.0));
    let shore = b.node("Clip", &[&moved, &least, &most], "shore");
    (raw_logits, shore)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn an_interval_holds_its_value() {
        let row = |outputs: [f32; 4]| {
            let data = TensorData::new(outputs.to_vec(), [1, 4]);
            let outputs = Tensor::<2>::from_data(data, &Device::flex());
            of_outputs(&outputs, 1, [1.0, 2.0])[0].clone()
        };
        let inside = row([7.0, 0.0, -1.0, 1.0]);
        assert_eq!(inside, (vec![7.0], [55.0, 29.0, 82.0]));
        // The ends are on the wrong sides, and then also beyond the scale.
        assert_eq!(row([7.0, 0.0, 1.0, -1.0]).1, [55.0, 55.0, 55.0]);
        assert_eq!(row([7.0, 9.0, -9.0, 9.0]).1, [100.0, 0.0, 100.0]);
    }

    #[test]
    fn the_loss_is_least_at_the_quantiles_and_counts_only_what_was_measured() {
        let device = Device::flex();
        let column = |values: &[f32]| {
            let data = TensorData::new(values.to_vec(), [values.len(), 1]);
            Tensor::<2>::from_data(data, &device)
        };
        // Twenty presses have 0, 0.05, ..., 0.95, and one was not measured.
        let mut shore: Vec<f32> = (0..20_u8).map(|n| f32::from(n) / 20.0).collect();
        let mut known = vec![1.0; 20];
        shore.push(50.0);
        known.push(0.0);
        let loss = |outputs: [f32; OUTPUTS]| {
            let rows = TensorData::new(outputs.repeat(21), [21, OUTPUTS]);
            let rows = Tensor::<2>::from_data(rows, &device);
            numbers(&interval_loss(rows, column(&shore), column(&known)))[0]
        };
        let best = loss([0.475, 0.025, 0.925]);
        for (place, moved) in [
            (0, 0.1),
            (0, -0.1),
            (1, 0.1),
            (1, -0.1),
            (2, 0.1),
            (2, -0.1),
        ] {
            let mut outputs = [0.475, 0.025, 0.925];
            outputs[place] += moved;
            assert!(loss(outputs) > best + 1e-4, "{place} {moved}");
        }
    }
}
