use std::path::Path;
use std::sync::Arc;

use super::super::{gather, plain};
use super::*;
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, SensorProfile, Sequence, SequenceSettings};

/// Round, smooth presses on every taxel in turn, as an array of `gains` reads them, with noise. The
/// taxel in the middle of a press has 4 N.
fn domes(array: Array, gains: impl Fn(usize, usize) -> f32) -> Vec<Plain> {
    let mut noise = Stream::new(4, "noise");
    let mut presses = Vec::new();
    for centre in 0..array.taxels() {
        let (row, col) = array.position(centre);
        let mut frame = vec![0.0; array.taxels()];
        for (place, newtons) in frame.iter_mut().enumerate() {
            let (r, c) = array.position(place);
            let square = r.abs_diff(row).pow(2) + c.abs_diff(col).pow(2);
            let pressed_n =
                4.0 * (-(square as f32) / 12.0).exp() * (1.0 + 0.01 * noise.normal() as f32);
            *newtons = pressed_n * gains(r, c);
        }
        presses.push(Plain {
            frames: vec![frame.clone(), frame],
        });
    }
    presses
}

fn uneven(row: usize, col: usize) -> f32 {
    let mut own = Stream::new(5, "gains").child((100 * row + col) as u64);
    (1.0 + 0.15 * own.normal()) as f32
}

#[test]
fn gains_are_found_from_presses_at_many_places() {
    let array = Array { rows: 12, cols: 10 };
    let fit = Fit::of(&domes(array, uneven), array, &[]).unwrap();
    assert_eq!(fit.even, 0);
    let left: Vec<f64> = (0..120)
        .filter(|&k| fit.presses[k] > 1)
        .map(|k| f64::from(fit.gains[k] * uneven(k / 10, k % 10)).ln())
        .collect();
    assert!(left.len() > 100, "{}", left.len());
    let left = deviation(left.iter().copied());
    assert!(left < 0.08, "{left} of 0.15 are left");
    assert!((0.1..0.2).contains(&fit.spread), "{}", fit.spread);
    assert!(
        fit.error > 1e-4 && fit.error < left,
        "{} said, {left} true",
        fit.error
    );
}

#[test]
fn an_even_pressure_says_all_gains_but_those_of_dead_taxels() {
    let array = Array { rows: 12, cols: 10 };
    let dead = [[3, 4], [7, 7]];
    let frame = |level: f32| {
        let mut frame = vec![0.0; array.taxels()];
        for (place, newtons) in frame.iter_mut().enumerate() {
            let (row, col) = array.position(place);
            *newtons = if dead.contains(&[row, col]) {
                0.0
            } else {
                level * uneven(row, col)
            };
        }
        frame
    };
    let press = || Plain {
        frames: vec![frame(1.0), frame(2.0)],
    };
    let presses: Vec<Plain> = (0..6).map(|_| press()).collect();
    let known = [dead[1]];
    let fit = Fit::of(&presses, array, &known).unwrap();
    assert_eq!(fit.even, 6);
    let live = (0..120).filter(|k| !dead.contains(&[k / 10, k % 10]));
    let left = live.map(|k| f64::from(fit.gains[k] * uneven(k / 10, k % 10)).ln());
    let left = deviation(left.collect::<Vec<_>>().into_iter());
    assert!(left < 0.01, "{left}");
    assert!(
        dead.iter()
            .all(|[row, col]| fit.gains[10 * row + col] == 1.0)
    );
}

#[test]
fn too_few_presses_say_nothing() {
    let array = Array { rows: 12, cols: 10 };
    let presses = &domes(array, uneven)[..1];
    let Err(error) = Fit::of(presses, array, &[]) else {
        panic!("one press says no gains");
    };
    let error = error.to_string();
    assert!(
        error.contains("only 0 of 120 taxels") && error.contains("(1 presses found)"),
        "{error}"
    );
}

/// Correlation of the gains found with the true ones, over the taxels that were measured.
fn correlation(fit: &Fit, truth: &[f32]) -> f64 {
    let pairs: Vec<(f64, f64)> = (0..784)
        .filter(|&k| fit.presses[k] > 1 && truth[k] > 0.0)
        .map(|k| (-f64::from(fit.gains[k]).ln(), f64::from(truth[k]).ln()))
        .collect();
    let count = pairs.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let sum = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>();
    let squares = sum(&|p| (p.0 - x).powi(2)) * sum(&|p| (p.1 - y).powi(2));
    sum(&|p| (p.0 - x) * (p.1 - y)) / squares.sqrt()
}

#[test]
fn gains_of_a_raw_simulated_sensor_are_found_from_its_presses() {
    let mut described = Description::default();
    described.sensor.frame_rate_hz = 20.0;
    // The sensor needs no tare: it reads 0 at rest.
    described.sensor.calibration.tare_frames = 0;
    let sensor = Sensor::new(described).unwrap();
    let sequence = Sequence::new(SequenceSettings {
        seed: 7,
        materials: Material::ALL.to_vec(),
        presses: Some(300),
        frame_rate_hz: 20.0,
        profile: SensorProfile::Raw,
        ..SequenceSettings::default()
    });
    let gains = sequence.gains().to_vec();
    let mut bytes = Vec::new();
    for frame in sequence {
        sensor.layout().encode(&frame.raw, &mut bytes);
    }
    let hrn = Arc::new(Hrn::load(BUILT_IN_HRN).unwrap());
    let presses = gather::presses(bytes.as_slice(), Path::new("x"), &sensor, hrn, false).unwrap();
    let plain: Vec<Plain> = presses.iter().map(plain).collect();
    let fit = Fit::of(&plain, Array::JX255N, &[]).unwrap();
    let correlation = correlation(&fit, &gains);
    assert!(correlation > 0.7, "{correlation}");
}
