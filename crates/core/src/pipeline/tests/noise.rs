//! Tests that noise is no force: an array of 16x32 taxels of 12 bits that rests anywhere.

use super::*;
use crate::tests::support::hrn;
use crate::tests::support::noisy_array::{COUNT_N, NoisyArray, foot, noisy_sensor};

/// The noise of the taxels, in counts.
const NOISES: [f64; 5] = [0.0, 2.0, 4.0, 6.0, 8.0];

/// The events of frames with these forces of the foot.
fn feel(array: &mut NoisyArray, newtons_per_count: f32, forces_n: &[f64]) -> Vec<Event> {
    let sensor = noisy_sensor(newtons_per_count);
    let mut pipeline = Pipeline::new(sensor, hrn(), Clock::Arrival);
    let frames = forces_n.iter().map(|&force_n| array.read(&foot(force_n)));
    feed(&mut pipeline, 0, &frames.collect::<Vec<_>>())
}

#[test]
fn an_array_at_rest_has_no_force_and_no_press_whatever_its_noise() {
    for noise in NOISES {
        let mut array = NoisyArray::new(7, 300.0, noise);
        let events = feel(&mut array, COUNT_N as f32, &[0.0; 40]);
        let presses = events
            .iter()
            .filter(|event| matches!(event, Event::Press(_)));
        assert_eq!(presses.count(), 0, "{noise}");
        let tared: Vec<&FrameEvent> = shown(&events).filter(|frame| frame.tared).collect();
        assert_eq!(tared.len(), 35, "{noise}");
        assert!(
            tared.iter().all(|frame| frame.force_n == Some(0.0)),
            "{noise}"
        );
        // The sum of all taxels is as often negative as positive. Of noise that is clipped at 0, it
        // would be 0.4 of its standard deviation a taxel: 2.1 N with 8 counts.
        let sum = |frame: &&FrameEvent| frame.newtons.iter().map(|&n| f64::from(n)).sum::<f64>();
        let mean_n = tared.iter().map(sum).sum::<f64>() / tared.len() as f64;
        assert!(mean_n.abs() < 0.04 * noise + 1e-6, "{noise}: {mean_n}");
    }
}

#[test]
fn the_force_of_a_press_is_right_whatever_the_noise() {
    for noise in NOISES {
        for force_n in [5.0, 20.0] {
            let mut array = NoisyArray::new(11, 300.0, noise);
            let forces_n = [&[0.0; 5][..], &[force_n; 20], &[0.0; 3]].concat();
            let events = feel(&mut array, COUNT_N as f32, &forces_n);
            let mut found = verdicts(events.clone());
            found.retain(|verdict| verdict.phase == Phase::Final);
            assert_eq!(found.len(), 1, "{noise}, {force_n} N");
            let off = found[0].force_n / force_n - 1.0;
            assert!(off.abs() < 0.05, "{noise}, {force_n} N: {off}");
            let held = shown(&events).filter_map(|frame| frame.force_n);
            let held: Vec<f64> = held.filter(|&n| n > 0.5 * force_n).collect();
            let off = held.iter().sum::<f64>() / (20.0 * force_n) - 1.0;
            assert!(off.abs() < 0.02, "{noise}, {force_n} N: {off} on average");
        }
    }
}
