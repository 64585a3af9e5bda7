//! Measures early verdicts on simulated presses: how many presses have one, how often its level is
//! that of the final verdict, and how much sooner it comes.
//!
//!     cargo run --release --example early_verdicts -- [PRESSES]
//!
//! It plays PRESSES (default 200, some minutes) of each material at 5, 20 and 100 frames/s, with
//! the built-in settings and model. It prints the table of `docs/results.md`, and the number of
//! early verdicts before the press had reached 95 % of its greatest force. That number should be 0.

use std::sync::Arc;
use std::time::Duration;

use hardnessd_core::event::{Event, Hardness, Phase, PressState};
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
use hardnessd_simulator::{Material, Sequence, SequenceSettings};

const SEED: u64 = 1;
/// The share of a press's greatest force from which on the force no longer counts as rising.
const RISEN: f32 = 0.95;

fn main() {
    let presses = std::env::args().nth(1);
    let presses = presses.map_or(200, |text| text.parse().expect("a number of presses"));
    let hrn = Arc::new(Hrn::load(BUILT_IN_HRN).expect("the model in the binary is one"));
    println!("| material | 5 frames/s | 20 frames/s | 100 frames/s |");
    println!("|---|---|---|---|");
    let mut rising = 0;
    for material in Material::ALL {
        print!("| {material} |");
        for frame_rate_hz in [5.0, 20.0, 100.0] {
            let sequence = Sequence::new(SequenceSettings {
                seed: SEED,
                frame_rate_hz,
                materials: vec![material],
                presses: Some(presses),
                ..SequenceSettings::default()
            });
            let presses = measure(sequence, frame_rate_hz, &hrn);
            print!(" {} |", cell(&presses));
            rising += presses
                .iter()
                .filter(|press| press.is_judged_rising())
                .count();
        }
        println!();
    }
    println!("\nwhile the load was rising: {rising}");
}

/// A press and its verdicts.
#[derive(Default)]
struct Press {
    /// The total force of each of its frames, in newtons.
    forces_n: Vec<f32>,
    /// Its early verdict, the time of that verdict, and the number of frames until then.
    early: Option<(Hardness, Duration, usize)>,
    /// Its final verdict, and the time of that verdict.
    last: Option<(Hardness, Duration)>,
}

impl Press {
    /// Whether the early verdict came while the load was still rising.
    fn is_judged_rising(&self) -> bool {
        let greatest_n = |forces_n: &[f32]| forces_n.iter().copied().fold(0.0, f32::max);
        self.early.as_ref().is_some_and(|(_, _, frames)| {
            greatest_n(&self.forces_n[..*frames]) < RISEN * greatest_n(&self.forces_n)
        })
    }
}

fn measure(sequence: Sequence, frame_rate_hz: f64, hrn: &Arc<Hrn>) -> Vec<Press> {
    let described = Description {
        frame_rate_hz,
        ..Description::default()
    };
    let sensor = Sensor::new(described).expect("a sensor may have such a rate");
    let layout = sensor.layout().clone();
    let mut pipeline = Pipeline::new(sensor, Arc::clone(hrn), Clock::FrameRate);
    let mut presses: Vec<Press> = Vec::new();
    let mut bytes = Vec::new();
    for (index, frame) in sequence.enumerate() {
        bytes.clear();
        layout.encode(&frame.raw, &mut bytes);
        let mono = Duration::from_secs_f64(index as f64 / frame_rate_hz);
        let at = Stamp {
            mono,
            wall: jiff::Timestamp::UNIX_EPOCH,
        };
        for event in pipeline.push(&bytes, at) {
            match (event, presses.last_mut()) {
                (Event::Press(press), _) if press.state == PressState::Begin => {
                    presses.push(Press::default());
                }
                (Event::Frame(frame), Some(press)) if press.last.is_none() => {
                    press.forces_n.push(frame.newtons.iter().sum());
                }
                (Event::Hardness(verdict), Some(press)) => match verdict.phase {
                    Phase::Early => press.early = Some((verdict, mono, press.forces_n.len())),
                    Phase::Final => press.last = Some((verdict, mono)),
                },
                _ => {}
            }
        }
    }
    presses
}

/// The share of presses with an early verdict, the share of these with the level of the final
/// verdict, and how much sooner they came (median).
fn cell(presses: &[Press]) -> String {
    let mut sooner_s = Vec::new();
    let mut same = 0;
    for press in presses {
        if let (Some((early, at, _)), Some((last, end))) = (&press.early, &press.last) {
            same += usize::from(early.level == last.level);
            sooner_s.push((*end - *at).as_secs_f64());
        }
    }
    sooner_s.sort_by(f64::total_cmp);
    let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole as f64;
    let came = percent(sooner_s.len(), presses.len());
    sooner_s
        .get(sooner_s.len() / 2)
        .map_or("none".to_owned(), |median_s| {
            let same = percent(same, sooner_s.len());
            format!("{came:.1} %, {same:.1} %, {median_s:.2} s")
        })
}
