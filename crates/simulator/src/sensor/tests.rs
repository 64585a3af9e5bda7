use super::design::{FOIL_MM, Response, ranges};
use super::*;
use crate::press::{CELL_MM, Window};

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

/// A raw sensor without activation thresholds.
fn without_thresholds(seed: u64) -> Sensor {
    let mut sensor = Sensor::new(SensorProfile::Raw, &Stream::new(seed, "sensor"));
    sensor.threshold_n.fill(0.0);
    sensor
}

/// The smooth load's place on the sensor.
const WINDOW: Window = Window {
    corner: (30, 33),
    width: 48,
};

#[test]
fn taxel_forces_add_up_to_the_force_at_every_pitch() {
    let (pressure, force) = smooth_load();
    for pitch_mm in [1.75, 2.0, 2.9, 3.5, 4.4, 5.0, 7.0] {
        let design = Design::jx255n(SensorProfile::Clean).at_pitch(pitch_mm);
        let taxels = Grid::new(&design).taxel_forces(&pressure, WINDOW);
        let sum: f64 = taxels.iter().map(|&f| f64::from(f)).sum();
        // Cells have rounded places where they do not fit into the taxels.
        let slack = if pitch_mm == 3.5 { 2e-3 } else { 0.02 };
        assert!(
            (sum / force - 1.0).abs() < slack,
            "{pitch_mm} mm: {sum} N of {force} N"
        );
    }
}

#[test]
fn a_load_stays_at_its_place_at_every_pitch() {
    let (pressure, _) = smooth_load();
    for pitch_mm in [1.75, 2.3, 3.5, 5.5, 7.0] {
        let grid = Grid::new(&Design::jx255n(SensorProfile::Clean).at_pitch(pitch_mm));
        let taxels = grid.taxel_forces(&pressure, WINDOW);
        let (mut moment, mut sum) = (0.0, 0.0);
        for (k, &force) in taxels.iter().enumerate() {
            let row = k / grid.array.cols;
            let from_middle = row as f64 - 0.5 * (grid.array.rows - 1) as f64;
            moment += f64::from(force) * from_middle * pitch_mm;
            sum += f64::from(force);
        }
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
fn responses_are_as_they_are_named() {
    let read = |response: Response, forces: [f32; 4]| forces.map(|force| response.of(force));
    assert_eq!(
        read(Response::Linear, [0.0, 1.0, 3.0, 9.0]),
        [0.0, 1.0, 3.0, 9.0]
    );
    let power = Response::Power {
        exponent: 0.5,
        unit_n: 4.0,
    };
    assert_eq!(read(power, [0.0, 1.0, 4.0, 16.0]), [0.0, 2.0, 4.0, 8.0]);
    let levels = read(Response::Levels { most_n: 3.0 }, [0.0, 3.0, 30.0, 3e6]);
    assert!(levels.is_sorted() && levels[1] == 1.5 && (2.99..=3.0).contains(&levels[3]));
    let falls = read(Response::Falls { most_n: 3.0 }, [0.3, 3.0, 6.0, 12.0]);
    assert!(
        falls[..3].is_sorted() && falls[2] == 3.0 && falls[3] < 2.5,
        "{falls:?}"
    );
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
fn broad_designs_draw_every_property_within_its_range() {
    let cover_mm = 2.0;
    let designs: Vec<Design> = (0..2000)
        .map(|k| Design::broad(cover_mm, &mut Stream::new(3, "designs").child(k)))
        .collect();
    type Property = (&'static str, [f64; 2], fn(&Design) -> Option<f64>);
    let properties: [Property; 22] = [
        ("pitch", ranges::PITCH_MM, |d| Some(d.pitch_mm)),
        ("active", ranges::ACTIVE_SHARE, |d| {
            Some(d.active_mm / d.pitch_mm)
        }),
        ("depth", ranges::DEPTH, |d| {
            Some((d.depth_mm - FOIL_MM) / 2.0)
        }),
        ("exponent", ranges::EXPONENT, |d| match d.response {
            Response::Power { exponent, .. } => Some(exponent.into()),
            _ => None,
        }),
        ("levels", ranges::MOST_N, |d| match d.response {
            Response::Levels { most_n } => Some(of_area(d, most_n.into())),
            _ => None,
        }),
        ("falls", ranges::MOST_N, |d| match d.response {
            Response::Falls { most_n } => Some(of_area(d, most_n.into())),
            _ => None,
        }),
        ("threshold", ranges::THRESHOLD_N, |d| {
            Some(of_area(d, d.threshold_median_n))
        }),
        ("count", ranges::COUNT_N, |d| {
            Some(of_area(d, d.count_n.into()))
        }),
        ("lag", ranges::LAG_S, |d| Some(d.lag_s.into())),
        ("hysteresis", ranges::HYSTERESIS, |d| {
            Some(d.hysteresis.into())
        }),
        ("neighbour", ranges::NEIGHBOUR, |d| {
            Some(d.crosstalk_neighbour.into())
        }),
        ("line", ranges::LINE, |d| Some(d.crosstalk_line.into())),
        ("creep", ranges::CREEP[0], |d| Some(d.creep[0].0.into())),
        ("slow creep", ranges::CREEP[1], |d| {
            Some(d.creep[1].0.into())
        }),
        ("noise", ranges::NOISE, |d| Some(d.noise_ratio)),
        ("noise in N", ranges::NOISE_N, |d| {
            Some(of_area(d, d.noise_n))
        }),
        ("rest", ranges::REST, |d| {
            Some(d.rest?.counts / f64::from(d.full_scale_counts))
        }),
        ("dead", ranges::DEAD, |d| Some(d.dead_share)),
        ("taxel", ranges::TAXEL, |d| Some(d.spread.taxel)),
        ("row", ranges::ROW, |d| Some(d.spread.row)),
        ("column", ranges::ROW, |d| Some(d.spread.column)),
        ("press", ranges::PRESS, |d| Some(d.spread.press)),
    ];
    for (name, [low, high], of) in properties {
        let found: Vec<f64> = designs.iter().filter_map(of).collect();
        let least = found.iter().copied().fold(f64::INFINITY, f64::min);
        let most = found.iter().copied().fold(0.0, f64::max);
        let slack = 1e-4 * high;
        assert!(
            least >= low - slack && most <= high + slack,
            "{name}: {least} to {most}"
        );
        let near = 0.1 * (high - low);
        assert!(
            least < low + near && most > high - near,
            "{name}: {least} to {most}"
        );
    }
    for design in &designs {
        let side = design.array.rows;
        let width_mm = side as f64 * design.pitch_mm;
        assert!((7..=49).contains(&side) && (45.0..=102.0).contains(&width_mm));
    }
}

/// A force on a taxel as on one of 3.5 mm.
fn of_area(design: &Design, newtons: f64) -> f64 {
    newtons / (design.pitch_mm / 3.5).powi(2)
}

#[test]
fn readings_follow_the_force_within_the_sensors_spread() {
    let (pressure, force) = smooth_load();
    let taxels = Grid::jx255n().taxel_forces(&pressure, WINDOW);
    let taxels: Vec<f32> = taxels.iter().map(|f| f * 0.1).collect();
    let sensor = Sensor::new(SensorProfile::Clean, &Stream::new(5, "sensor"));
    let raw = sensor.read(&taxels, 1.0, &mut Stream::new(5, "noise"));
    let read: f64 = raw
        .counts
        .iter()
        .map(|&c| f64::from(c) * f64::from(sensor.newtons_per_count))
        .sum();
    // Where a taxel is above its threshold, crosstalk adds up to 4 x 1.5 % + 54 x 0.4 %.
    assert!(
        (0.97..1.25).contains(&(read / (0.1 * force))),
        "{read} N of {} N",
        0.1 * force
    );
}

#[test]
fn a_point_load_draws_no_cross() {
    let mut forces = [0.0; TAXELS];
    forces[ARRAY.place(14, 14)] = 25.0;
    let sensor = without_thresholds(6);
    let raw = sensor.read(&forces, 1.0, &mut Stream::new(6, "noise"));
    assert_eq!(
        raw.counts.iter().filter(|&&counts| counts > 0.0).count(),
        5,
        "itself and four"
    );
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
    let raw = sensor.read(
        &film.advance(&sensor.design, &forces, 0.01),
        1.0,
        &mut Stream::new(2, "noise"),
    );
    assert_eq!(raw, RawFrame::zero(ARRAY));
}

#[test]
fn a_restless_array_has_noise_on_every_taxel_and_is_tared_to_a_mean_of_zero() {
    let designs = (0..200).map(|k| Design::broad(1.0, &mut Stream::new(3, "restless").child(k)));
    let (restless, quiet): (Vec<_>, Vec<_>) = designs.partition(|design| design.rest.is_some());
    assert!(restless.len() > 70 && quiet.len() > 70, "{}", quiet.len());
    let unloaded = |design: &Design| {
        let sensor = Sensor::draw(design.clone(), &Stream::new(4, "sensor"));
        let raw = sensor.read(
            &vec![0.0; design.array.taxels()],
            1.0,
            &mut Stream::new(5, "noise"),
        );
        (sensor.tared(&raw), raw, sensor)
    };
    assert!(
        unloaded(&quiet[0])
            .1
            .counts
            .iter()
            .all(|&counts| counts == 0.0)
    );
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
    assert!(
        (0.35..0.65).contains(&(below as f64 / frame.newtons.len() as f64)),
        "{below}"
    );
}

#[test]
fn every_taxel_feels_the_guaranteed_load_and_full_scale_is_8_bits() {
    let sensor = Sensor::new(SensorProfile::Clean, &Stream::new(9, "sensor"));
    let mut noise = Stream::new(9, "noise");
    let dead = sensor.gain.iter().filter(|&&gain| gain == 0.0).count();
    let felt = |raw: RawFrame| raw.counts.iter().filter(|&&c| c > 0.0).count();
    assert_eq!(
        felt(sensor.read(&[0.21; TAXELS], 1.0, &mut noise)),
        TAXELS - dead
    );
    assert!(felt(sensor.read(&[0.03; TAXELS], 1.0, &mut noise)) < TAXELS / 2);
    let most = sensor
        .read(&[100.0; TAXELS], 1.0, &mut noise)
        .counts
        .into_iter()
        .fold(0.0, f32::max);
    assert_eq!(most, 255.0);
}
