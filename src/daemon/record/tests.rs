use std::sync::mpsc::Receiver;

use super::*;
use hardnessd_core::frame::Pitch;
use hardnessd_core::pipeline::Clock;
use hardnessd_core::recording::Ring;
use hardnessd_core::test_support;

fn recorder(sender: SyncSender<Job>) -> (SensorRecorder, Pipeline) {
    let pipeline = Pipeline::new(test_support::sensor(), test_support::hrn(), Clock::Arrival);
    let active = Active {
        jobs: Jobs {
            sender,
            dropped: Arc::default(),
        },
        index: 0,
        labels: Labels::new(),
        noted: None,
        bytes: 0,
        counted: (0, 0),
    };
    let recorder = SensorRecorder {
        active: Some(Box::new(active)),
        viewers: None,
    };
    (recorder, pipeline)
}

fn at(ms: u64) -> Stamp {
    Stamp {
        mono: Duration::from_millis(ms),
        wall: jiff::Timestamp::UNIX_EPOCH,
    }
}

/// The count of the recorded inputs, and the numbers of those that follow a gap without a state
/// between.
fn drained(inbox: &Receiver<Job>) -> (usize, Vec<u64>) {
    let (mut count, mut bad) = (0, Vec::new());
    let mut next = None;
    for job in inbox {
        match job {
            Job::Entry {
                entry: Entry::State(_),
                ..
            } => next = None,
            Job::Entry {
                entry: Entry::Input(Input::Bytes(bytes)),
                ..
            } => {
                let number = u64::from_le_bytes(bytes[..].try_into().unwrap());
                if next.is_some_and(|next| next != number) {
                    bad.push(number);
                }
                next = Some(number + 1);
                count += 1;
            }
            other => panic!("{other:?}"),
        }
    }
    (count, bad)
}

#[test]
fn after_a_gap_comes_a_state() {
    // There is room for a state and inputs, so the first ones are recorded in any order of the
    // threads.
    let (sender, inbox) = sync_channel(4);
    let (mut recorder, pipeline) = recorder(sender);
    // The reader takes jobs as fast as they come, so room appears at any moment.
    let reader = std::thread::spawn(move || drained(&inbox));
    for number in 0..20_000_u64 {
        let bytes = number.to_le_bytes().to_vec();
        recorder.note(&pipeline, &Input::Bytes(bytes.into()), at(number));
    }
    drop(recorder);
    let (count, bad) = reader.join().unwrap();
    assert!(count > 0);
    assert_eq!(bad, [0; 0], "of {count} told");
}

#[test]
fn a_flood_is_bounded_in_the_black_box() {
    // The context takes less than 1 KiB as text, but 100 objects in memory.
    let context = serde_json::json!({ "tags": vec![serde_json::json!({ "": 0 }); 100] });
    assert!(context.to_string().len() < 1024);
    for flood in [
        Input::Bytes(vec![0; 1 << 16].into()),
        Input::Context(Some(context)),
    ] {
        assert!(Entry::Input(flood.to_owned()).weight() > 60_000);
        let (sender, inbox) = sync_channel(4096);
        let (mut recorder, pipeline) = recorder(sender);
        for _ in 0..1000 {
            recorder.note(&pipeline, &flood, at(0));
        }
        drop(recorder);
        let mut ring = Ring::default();
        for job in inbox {
            let Job::Entry { at, entry, .. } = job else {
                panic!("{job:?}");
            };
            ring.push(at, entry);
        }
        let kept: usize = ring.all().map(|(_, entry)| entry.weight()).sum();
        assert!((28 << 20..=36 << 20).contains(&kept), "{kept} bytes");
    }
}

#[test]
fn viewers_get_the_positions_of_the_arm_also_without_a_recording() {
    let pipeline = Pipeline::new(test_support::sensor(), test_support::hrn(), Clock::Arrival);
    let (viewers, mut shown) = mpsc::channel(1);
    let mut recorder = SensorRecorder::default().with_viewers(Some(viewers));
    let point = hardnessd_core::motion::Point {
        at_ns: 5_000_000,
        mm: 1.5,
    };
    let motion = Input::Motion(vec![point].into());
    recorder.note(&pipeline, &Input::Tick, at(6));
    recorder.note(&pipeline, &motion, at(7));
    // There is no room for another line, and nothing waits for it.
    recorder.note(&pipeline, &motion, at(8));
    let found = shown.try_recv().unwrap();
    assert_eq!((found.sensor.as_str(), found.at), ("forearm", at(7)));
    assert_eq!(found.entry, Entry::Input(motion.to_owned()));
    assert!(shown.try_recv().is_err());
}

#[test]
fn viewers_get_the_settings_after_a_reload() {
    let pipeline = Pipeline::new(test_support::sensor(), test_support::hrn(), Clock::Arrival);
    let (viewers, mut shown) = mpsc::channel(1);
    let mut recorder = SensorRecorder::default().with_viewers(Some(viewers));
    let mut description = test_support::sensor().description().clone();
    description.calibration.pitch_mm = Pitch::square(2.0);
    let changed = Sensor::new(description).unwrap();
    recorder.reload(&pipeline, &changed, &test_support::hrn(), at(7));
    let Entry::Settings(settings) = shown.try_recv().unwrap().entry else {
        panic!("no settings");
    };
    assert_eq!(
        settings.description.calibration.pitch_mm,
        Pitch::square(2.0)
    );
}
