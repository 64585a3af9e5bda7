//! Measures what a controller gains that withdraws at the early verdict, as
//! `examples/gentle_press.py` does, beside one that always presses to 15 N.
//!
//!     cargo run --release --example gentle_presses -- MODEL [--fps F] [--seed S]
//!
//! Each object is pressed once for each row of the table that it prints, with the same noise. Time is
//! simulated: a frame reaches the daemon after the scan and the line, and the arm obeys after
//! [`REACTION_S`].

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::ScopedJoinHandle;
use std::time::Duration;

use clap::Parser;
use hardnessd_core::event::{Event, Hardness, Phase};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Point;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::{ARM_N_PER_MM, Material, Rig, SequenceSettings};

#[derive(Parser)]
struct Args {
    /// The model that judges
    model: PathBuf,
    /// Frames per second, 20 to 1000
    #[arg(long, default_value_t = 100.0)]
    fps: f64,
    #[arg(long, default_value_t = 62)]
    seed: u64,
    #[arg(long, default_value_t = 400)]
    presses: u32,
}

/// The controller withdraws at this force, as the sensor reads it.
const LIMIT_N: f64 = 15.0;
const SPEED_MM_S: f64 = 5.0;
/// The rest before the arm moves, for the tare.
const REST_S: f64 = 0.5;
/// The time between the moment of a frame and its first byte, and the part of a period that its bytes
/// take, as `hardnessd simulate --arm` has them at 921,600 baud and 100 frames/s.
const SCAN_S: f64 = 0.01;
const LINE_PERIODS: f64 = 0.86;
/// From an event to the arm: two sockets and the controller.
const REACTION_S: f64 = 0.01;
/// A press that takes longer has failed.
const LONGEST_S: f64 = 20.0;

/// `early_confidence` and `early_min_force_n` of the daemon.
const EARLY_CONFIDENCE: f32 = 0.9;
const EARLY_MIN_FORCE_N: f64 = 3.0;

/// What a press came to.
#[derive(Default)]
struct Press {
    level: u8,
    /// The most probable level of the final verdict.
    found: u8,
    /// Whether the final verdict names a level, and does not reject the press.
    is_named: bool,
    /// Whether the arm withdrew at an early verdict.
    is_early: bool,
    /// The greatest true force on the object.
    greatest_n: f64,
    /// From the touch to the release.
    contact_s: f64,
}

fn main() {
    let args = Args::parse();
    let model = std::fs::read(&args.model).expect("the model is readable");
    let hrn = Arc::new(Hrn::load(&model).expect("the model is one"));
    let threads = std::thread::available_parallelism().map_or(1, usize::from) as u32;
    let presses = |withdraws: bool| -> Vec<Press> {
        let work = |thread: u32| {
            let mut rig = Rig::new(SequenceSettings {
                seed: args.seed,
                materials: Material::ALL[4..].to_vec(),
                ..SequenceSettings::default()
            });
            let objects = (1..=args.presses).filter(|object| object % threads == thread);
            let pressed = objects.map(|object| press(&mut rig, object, &hrn, args.fps, withdraws));
            pressed.collect::<Vec<_>>()
        };
        std::thread::scope(|scope| {
            let parts = (0..threads).map(|thread| scope.spawn(move || work(thread)));
            let parts: Vec<_> = parts.collect();
            let done = parts.into_iter().map(ScopedJoinHandle::join);
            done.flat_map(|part| part.expect("no press panics"))
                .collect()
        })
    };
    let (seed, fps, model) = (args.seed, args.fps, args.model.display());
    println!(
        "{} presses, seed {seed}, {fps} frames/s, {model}\n",
        args.presses
    );
    println!(
        "| Withdraws at | Right | Named | Greatest force, mean | In contact | At an early verdict |"
    );
    println!("|---|---|---|---|---|---|");
    row("15 N", &presses(false));
    row("an early verdict, or 15 N", &presses(true));
}

/// Presses an object. Unless the controller `withdraws` at an early verdict, it does so at [`LIMIT_N`] only.
fn press(rig: &mut Rig, object: u32, hrn: &Arc<Hrn>, fps: f64, withdraws: bool) -> Press {
    let delay_s = SCAN_S + LINE_PERIODS / fps;
    let mut described = Description::default();
    described.sensor.frame_rate_hz = fps;
    described.sensor.arm.stiffness_n_per_mm = Some(ARM_N_PER_MM);
    described.sensor.arm.delay_ms = 1e3 * delay_s;
    described.model.early_confidence = EARLY_CONFIDENCE;
    described.press.early_min_force_n = EARLY_MIN_FORCE_N;
    let sensor = Sensor::new(described).expect("a sensor may be like this");
    let layout = sensor.layout().clone();
    let mut pipeline = Pipeline::new(sensor, Arc::clone(hrn), Clock::Arrival);
    rig.place(object);
    let level = rig.touched().material.level();
    let mut bytes = Vec::new();
    // The time at which the arm turns back.
    let mut turn_s = f64::INFINITY;
    let mut is_early = false;
    let (mut touched_s, mut released_s) = (None, 0.0);
    for number in 0.. {
        let time_s = f64::from(number) / fps;
        if time_s > LONGEST_S {
            break;
        }
        let forth_mm = SPEED_MM_S * (time_s.min(turn_s) - REST_S).max(0.0);
        let back_mm = SPEED_MM_S * (time_s - turn_s).max(0.0);
        let mm = (forth_mm - back_mm).max(0.0);
        rig.move_to(mm, 1.0 / fps);
        if rig.touched().force_n > 0.0 {
            touched_s = touched_s.or(Some(time_s));
            released_s = time_s;
        }
        let at_ns = (1e9 * time_s) as i64;
        bytes.clear();
        layout.encode(&rig.read(), &mut bytes);
        let arrived_s = time_s + delay_s;
        let at = Stamp {
            mono: Duration::from_secs_f64(arrived_s),
            wall: jiff::Timestamp::UNIX_EPOCH,
        };
        let position = vec![Point { at_ns, mm }];
        pipeline
            .take(Input::Motion(position), at)
            .expect("time goes on");
        for event in pipeline
            .take(Input::Bytes(bytes.clone()), at)
            .expect("bytes are taken")
        {
            let is_enough = match event {
                Event::Frame(frame) => frame.force_n.is_some_and(|force_n| force_n >= LIMIT_N),
                Event::Hardness(verdict) if verdict.phase == Phase::Final => {
                    return Press {
                        level,
                        found: most_probable(&verdict),
                        is_named: verdict.level.is_some(),
                        is_early,
                        greatest_n: rig.touched().greatest_n,
                        contact_s: released_s - touched_s.expect("a verdict is on a contact"),
                    };
                }
                Event::Hardness(_) => {
                    is_early |= withdraws && turn_s.is_infinite();
                    is_early
                }
                _ => false,
            };
            if is_enough {
                turn_s = turn_s.min(arrived_s + REACTION_S);
            }
        }
    }
    Press {
        level,
        ..Press::default()
    }
}

fn most_probable(verdict: &Hardness) -> u8 {
    let levels = (1..).zip(&verdict.probabilities);
    let most = levels.max_by(|(_, a), (_, b)| a.total_cmp(b));
    most.map_or(0, |(level, _)| level)
}

fn row(name: &str, presses: &[Press]) {
    let median = |of: fn(&Press) -> f64, presses: &[&Press]| {
        let mut values: Vec<f64> = presses.iter().map(|press| of(press)).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let percent = |is: fn(&Press) -> bool| {
        100.0 * presses.iter().filter(|press| is(press)).count() as f64 / presses.len() as f64
    };
    let right = |press: &Press| press.found == press.level;
    println!(
        "| {name} | {:.1} % | {:.1} % | {:.1} N | {:.2} s | {:.1} % |",
        percent(right),
        percent(|press| press.is_named),
        presses.iter().map(|press| press.greatest_n).sum::<f64>() / presses.len() as f64,
        median(|press| press.contact_s, &presses.iter().collect::<Vec<_>>()),
        percent(|press| press.is_early),
    );
    let of_level = |level: u8| {
        let own: Vec<&Press> = presses
            .iter()
            .filter(|press| press.level == level)
            .collect();
        let count = |is: fn(&Press) -> bool| own.iter().filter(|press| is(press)).count();
        let median_n = median(|press| press.greatest_n, &own);
        format!(
            "level {level}: {} of {}, {median_n:.1} N, {} early",
            count(right),
            own.len(),
            count(|press| press.is_early)
        )
    };
    let levels: Vec<String> = (1..=4).map(of_level).collect();
    eprintln!("{name}: {}", levels.join("; "));
}
