use super::*;
use crate::CELL_MM;
use crate::press::Window;

const TAXELS: usize = ARRAY.taxels();

fn smooth_load() -> (Vec<f32>, f64) {
    let width = 48_usize;
    let pressure: Vec<f32> = (0..width * width)
        .map(|k: usize| {
            let r2 = (k / width).abs_diff(24).pow(2) + (k % width).abs_diff(21).pow(2);
            (1.0_f32 - r2 as f32 / 256.0).max(0.0).sqrt()
        })
        .collect();
    let force = pressure
        .iter()
        .map(|&p| f64::from(p) * CELL_MM * CELL_MM)
        .sum();
    (pressure, force)
}

fn jx255n(profile: SensorProfile, seed: u64) -> Sensor {
    Sensor::draw(Design::jx255n(profile), &Stream::new(seed, "sensor"))
}

/// The number of taxels that feel something.
fn felt(raw: &RawFrame) -> usize {
    raw.counts.iter().filter(|&&counts| counts > 0.0).count()
}

/// A raw sensor without activation thresholds.
fn without_thresholds(seed: u64) -> Sensor {
    let mut sensor = jx255n(SensorProfile::Raw, seed);
    sensor.threshold_n.fill(0.0);
    sensor
}

/// The smooth load's place on the sensor.
const WINDOW: Window = Window {
    corner: (30, 33),
    width: 48,
};

/// A JX255N with taxels of another pitch on the same area.
fn at_pitch(pitch_mm: f64) -> Design {
    let design = Design::jx255n(SensorProfile::Clean);
    let side = (28.0 * 3.5 / pitch_mm).round() as usize;
    Design {
        array: Array {
            rows: side,
            cols: side,
        },
        pitch_mm,
        active_mm: design.active_mm * pitch_mm / 3.5,
        ..design
    }
}

#[test]
fn taxel_forces_add_up_to_the_force_in_its_place_at_every_pitch() {
    let (pressure, force) = smooth_load();
    for pitch_mm in [1.75, 2.3, 2.9, 3.5, 4.4, 5.5, 7.0] {
        let grid = Grid::new(&at_pitch(pitch_mm));
        let taxels = grid.taxel_forces(&pressure, WINDOW);
        let (mut moment, mut sum) = (0.0, 0.0);
        for (k, &force) in taxels.iter().enumerate() {
            let row = k / grid.array.cols;
            let from_middle = row as f64 - 0.5 * (grid.array.rows - 1) as f64;
            moment += f64::from(force) * from_middle * pitch_mm;
            sum += f64::from(force);
        }
        // Cells have rounded places where they do not fit into the taxels.
        let slack = if pitch_mm == 3.5 { 2e-3 } else { 0.02 };
        assert!((sum / force - 1.0).abs() < slack, "{pitch_mm} mm: {sum} N");
        // The load's middle is cell 24 of the window.
        let expected = (30.0 + 24.5) * CELL_MM - 49.0;
        let found = moment / sum;
        assert!(
            (found - expected).abs() < 0.2,
            "{pitch_mm} mm: at {found}, not {expected}"
        );
    }
}

#[test]
fn an_unloading_taxel_reads_late_and_too_much() {
    let mut design = Design::jx255n(SensorProfile::Clean);
    design.creep = [(0.0, 1.0); 2];
    let read = |design: &Design, course: &[f32]| {
        let mut film = Film::new(design);
        let steps = course
            .iter()
            .map(|&force| film.advance(design, &[force; TAXELS], 0.02)[0]);
        steps.collect::<Vec<_>>()
    };
    let course = [1.0, 2.0, 2.0, 1.0, 0.0, 1.0];
    assert_eq!(read(&design, &course), course);
    design.hysteresis = 0.2;
    assert_eq!(read(&design, &course), [1.0, 2.0, 2.0, 1.1, 0.0, 1.0]);
    design.lag_s = 0.02;
    let late = read(&design, &course);
    assert!(late[0] < 0.7 && late[4] > 0.3, "{late:?}");
    let free = read(&design, &[&course[..], &[0.0; 10]].concat());
    assert_eq!(free[15], 0.0);
}

#[test]
fn a_point_load_draws_no_cross() {
    let mut forces = [0.0; TAXELS];
    forces[ARRAY.place(14, 14)] = 25.0;
    let sensor = without_thresholds(6);
    let raw = sensor.read(&forces, 1.0, &mut Stream::new(6, "noise"));
    assert_eq!(felt(&raw), 5, "itself and four");
}

#[test]
fn an_unloaded_sensor_reads_zero_even_after_long_load() {
    let sensor = without_thresholds(1);
    let mut film = Film::new(&sensor.design);
    let mut forces = [3.0; TAXELS];
    for _ in 0..100 {
        film.advance(&sensor.design, &forces, 0.1);
    }
    let crept = film.advance(&sensor.design, &forces, 0.1)[0] / 3.0;
    assert!((1.05..1.07).contains(&crept), "film creep {crept}");
    forces = [0.0; TAXELS];
    let crept = film.advance(&sensor.design, &forces, 0.01);
    let raw = sensor.read(&crept, 1.0, &mut Stream::new(2, "noise"));
    assert_eq!(raw, RawFrame::zero(ARRAY));
}

#[test]
fn a_restless_array_has_noise_on_every_taxel_and_is_tared_to_a_mean_of_zero() {
    let designs = (0..200).map(|k| Design::broad(1.0, &mut Stream::new(3, "restless").child(k)));
    let (restless, quiet): (Vec<_>, Vec<_>) = designs.partition(|design| design.rest.is_some());
    assert!(restless.len() > 70 && quiet.len() > 70, "{}", quiet.len());
    let unloaded = |design: &Design| {
        let sensor = Sensor::draw(design.clone(), &Stream::new(4, "sensor"));
        let none = vec![0.0; design.array.taxels()];
        let raw = sensor.read(&none, 1.0, &mut Stream::new(5, "noise"));
        (sensor.tared(&raw), raw, sensor)
    };
    let (_, raw, _) = unloaded(&quiet[0]);
    assert_eq!(raw, RawFrame::zero(quiet[0].array));
    for design in restless.iter().take(20) {
        let (frame, _, sensor) = unloaded(design);
        let count = frame.newtons.len() as f32;
        let mean_n = frame.newtons.iter().sum::<f32>() / count;
        let square: f32 = frame.newtons.iter().map(|n| n * n).sum();
        let sd_n = (square / count).sqrt();
        // Of a taxel near 0 the noise is cut off, and a mean of five frames has noise of its own.
        let noise_n = design.noise_n as f32 + 0.3 * design.count_n;
        assert!(sd_n < 1.3 * noise_n, "{sd_n} N of {noise_n}");
        assert!(mean_n.abs() < 5.0 * noise_n / count.sqrt(), "{mean_n} N");
        let Thresholds {
            contact_threshold_n,
            begin_area_taxels,
            ..
        } = sensor.thresholds();
        assert!(frame.contact_area_taxels(contact_threshold_n) < begin_area_taxels);
    }
    let noisy = restless
        .iter()
        .find(|design| design.noise_n > f64::from(2.0 * design.count_n));
    let (frame, ..) = unloaded(noisy.unwrap());
    let below = frame.newtons.iter().filter(|&&n| n < 0.0).count();
    let share = below as f64 / frame.newtons.len() as f64;
    assert!((0.35..0.65).contains(&share), "{share}");
}

#[test]
fn every_taxel_feels_the_guaranteed_load_and_full_scale_is_8_bits() {
    let sensor = jx255n(SensorProfile::Clean, 9);
    let mut noise = Stream::new(9, "noise");
    let dead = sensor.gain.iter().filter(|&&gain| gain == 0.0).count();
    let mut read = |force_n: f32| sensor.read(&[force_n; TAXELS], 1.0, &mut noise);
    assert_eq!(felt(&read(0.21)), TAXELS - dead);
    assert!(felt(&read(0.03)) < TAXELS / 2);
    let most = read(100.0).counts.into_iter().fold(0.0, f32::max);
    assert_eq!(most, 255.0);
}
