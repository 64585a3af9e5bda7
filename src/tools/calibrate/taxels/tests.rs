use std::sync::Arc;

use super::super::{gather, plain};
use super::*;
use hardnessd_core::event::{Event, Phase};
use hardnessd_core::motion::Point;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{ARM_N_PER_MM, Material, SensorProfile, Sequence, SequenceSettings};

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
    assert_eq!((fit.even, fit.dead.len()), (0, 0));
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
fn an_even_pressure_says_all_gains_and_the_dead_taxels() {
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
    assert_eq!((fit.even, fit.dead.as_slice()), (6, &dead[..1]));
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

/// The bytes of presses on one simulated sensor: first `for_gains` presses, then the others, with
/// the arm's position at each frame, the levels of the others and the true gains.
struct Played {
    first: Vec<u8>,
    then: Vec<(Vec<u8>, f64)>,
    levels: Vec<u8>,
    gains: Vec<f32>,
}

/// The frame rate at which models/course.md has the figures of the course model.
const RATE_HZ: f64 = 20.0;

fn sensor(gains: Option<Gains>, dead_taxels: Vec<[usize; 2]>) -> Sensor {
    let mut described = Description {
        frame_rate_hz: RATE_HZ,
        ..Description::default()
    };
    described.arm.stiffness_n_per_mm = Some(ARM_N_PER_MM);
    // The sensor needs no tare: it reads 0 at rest, and the bytes may begin with a press.
    described.calibration.tare_frames = 0;
    described.calibration.gains = gains;
    described.calibration.dead_taxels = dead_taxels;
    Sensor::new(described).unwrap()
}

fn play(seed: u64, for_gains: u32, for_verdicts: u32, profile: SensorProfile) -> Played {
    let layout = sensor(None, Vec::new());
    let settings = SequenceSettings {
        seed,
        materials: Material::ALL.to_vec(),
        presses: Some(for_gains + for_verdicts),
        frame_rate_hz: RATE_HZ,
        profile,
        ..SequenceSettings::default()
    };
    let sequence = Sequence::new(settings);
    let mut played = Played {
        first: Vec::new(),
        then: Vec::new(),
        levels: Vec::new(),
        gains: sequence.gains().to_vec(),
    };
    let mut last = 0;
    for (number, frame) in sequence.enumerate() {
        if frame.press <= for_gains {
            layout.layout().encode(&frame.raw, &mut played.first);
            continue;
        }
        let mut bytes = Vec::new();
        layout.layout().encode(&frame.raw, &mut bytes);
        let mm = frame.approach.mm(number as f64 / RATE_HZ);
        played.then.push((bytes, mm));
        if frame.press != last {
            last = frame.press;
            played.levels.push(frame.material.unwrap().level());
        }
    }
    played
}

/// The share of right verdicts, on test materials alone. The model is told how the arm moves.
fn right(played: &Played, sensor: Sensor, hrn: &Arc<Hrn>) -> f64 {
    let mut pipeline = Pipeline::new(sensor, hrn.clone(), Clock::FrameRate);
    let start = hardnessd_core::frame::Stamp {
        mono: std::time::Duration::ZERO,
        wall: jiff::Timestamp::UNIX_EPOCH,
    };
    let mut events = Vec::new();
    for (number, (bytes, mm)) in played.then.iter().enumerate() {
        let at_ns = (number as f64 / RATE_HZ * 1e9).round() as i64;
        pipeline.tell(&[Point { at_ns, mm: *mm }]).unwrap();
        events.extend(pipeline.push(bytes, start));
    }
    events.extend(pipeline.end_of_recording(None));
    let (mut right, mut all) = (0, 0);
    for event in events {
        if let Event::Hardness(verdict) = event
            && verdict.phase == Phase::Final
        {
            let number = verdict.press as usize - 1;
            // Four materials to train on and four to test on take turns.
            if number % 8 >= 4 {
                all += 1;
                right += u32::from(verdict.level == Some(played.levels[number]));
            }
        }
    }
    f64::from(right) / f64::from(all)
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

fn fitted(played: &Played, hrn: &Arc<Hrn>) -> Fit {
    let plain_sensor = sensor(None, Vec::new());
    let presses =
        gather::presses(played.first.as_slice(), &plain_sensor, hrn.clone(), false).unwrap();
    let plain: Vec<Plain> = presses.iter().map(plain).collect();
    Fit::of(&plain, Array::JX255N, &[]).unwrap()
}

#[test]
fn gains_of_a_raw_simulated_sensor_are_found_from_its_presses() {
    let hrn = Arc::new(Hrn::load(BUILT_IN_HRN).unwrap());
    let played = play(7, 300, 0, SensorProfile::Raw);
    let fit = fitted(&played, &hrn);
    let correlation = correlation(&fit, &played.gains);
    assert!(correlation > 0.7, "{correlation}");
    let are_dead = fit
        .dead
        .iter()
        .all(|[row, col]| played.gains[28 * row + col] < 0.3);
    assert!(are_dead, "{:?}", fit.dead);
}

/// Prints how much the calibration improves the verdicts. docs/your-array.md names the gain.
#[test]
#[ignore = "minutes: cargo test --lib worth_of_gains -- --ignored --nocapture"]
fn print_the_worth_of_gains() {
    let course = std::fs::read("models/course.onnx").unwrap();
    let models = [BUILT_IN_HRN, &course].map(|bytes| Arc::new(Hrn::load(bytes).unwrap()));
    let rows = |gains: &[f32]| {
        Some(Gains::Taxels(
            gains.chunks(28).map(<[f32]>::to_vec).collect(),
        ))
    };
    for presses in [100, 1000] {
        let (mut lines, sensors) = (Vec::new(), 3);
        for seed in 0..sensors {
            let played = play(100 + seed, presses, 800, SensorProfile::Raw);
            let clean = play(100 + seed, presses, 800, SensorProfile::Clean);
            let fit = fitted(&played, &models[0]);
            let truth: Vec<f32> = played
                .gains
                .iter()
                .map(|g| if *g > 0.1 { 1.0 / g } else { 1.0 })
                .collect();
            let dead = (0..784)
                .filter(|&k| played.gains[k] < 0.1)
                .map(|k| [k / 28, k % 28]);
            let sensors = [
                (&played, sensor(None, Vec::new())),
                (&played, sensor(rows(&fit.gains), fit.dead.clone())),
                (&played, sensor(rows(&truth), dead.collect())),
                (&clean, sensor(None, Vec::new())),
            ];
            let verdicts = models.iter().flat_map(|hrn| {
                let of = |(played, sensor): &(&Played, Sensor)| right(played, sensor.clone(), hrn);
                sensors.iter().map(of).collect::<Vec<_>>()
            });
            let taxels = fit.presses.iter().filter(|&&n| n > 1).count() as f64;
            let about = [taxels, correlation(&fit, &played.gains), fit.error];
            lines.push(about.into_iter().chain(verdicts).collect::<Vec<_>>());
        }
        let mean = |at: usize| lines.iter().map(|line| line[at]).sum::<f64>() / sensors as f64;
        println!(
            "{presses} presses: {:.0} taxels, correlation {:.2}, error {:.3}",
            mean(0),
            mean(1),
            mean(2),
        );
        for (name, first) in [("one frame", 3), ("course", 7)] {
            println!(
                "  {name}: right without {:.3}, with {:.3}, with the true gains {:.3}, clean {:.3}",
                mean(first),
                mean(first + 1),
                mean(first + 2),
                mean(first + 3),
            );
        }
    }
}
