use std::sync::mpsc::Receiver;

use super::*;
use hardnessd_core::frame::RawFrame;
use hardnessd_core::pipeline::Clock;
use hardnessd_core::recording::Ring;
use hardnessd_core::tests::support::{self, at};

/// A recorder with room for so many bytes.
fn recorder(sender: Sender<Queued>, bytes: usize) -> (SensorRecorder, Pipeline) {
    let pipeline = Pipeline::new(support::sensor(), support::hrn(), Clock::Arrival);
    let recorder = SensorRecorder {
        jobs: Jobs::new(sender, bytes),
        index: 0,
        labels: Labels::new(),
        noted: None,
        was_busy: false,
        bytes: 0,
    };
    (recorder, pipeline)
}

/// The count of the recorded inputs, and the numbers of those that follow a gap without a state
/// between.
fn drained(inbox: &Receiver<Queued>) -> (usize, Vec<u64>) {
    let (mut count, mut bad) = (0, Vec::new());
    let mut next = None;
    for (job, _) in inbox {
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
    let (sender, inbox) = channel();
    // There is room for a state and some inputs, so the first ones are recorded in any order of the threads.
    let (mut recorder, pipeline) = recorder(sender, 160 << 10);
    // The reader takes jobs as fast as they come, so room appears at any moment.
    let reader = std::thread::spawn(move || drained(&inbox));
    for number in 0..20_000_u64 {
        let bytes = number.to_le_bytes().to_vec();
        recorder.note(&pipeline, &Input::Bytes(bytes), at(number));
    }
    drop(recorder);
    let (count, bad) = reader.join().unwrap();
    assert!(count > 0);
    assert_eq!(bad, [0; 0], "of {count} told");
}

#[test]
fn a_recorder_that_starts_in_a_press_waits_for_the_next_rest() {
    let (sender, inbox) = channel();
    let (mut recorder, mut pipeline) = recorder(sender, QUEUED_BYTES);
    // The first five frames are the zero, and the recorder starts with the second one of a press.
    let counts = [&[0.0; 5][..], &[60.0; 2], &[0.0; 3]].concat();
    for (frame, counts) in (0..).zip(counts) {
        let mut raw = RawFrame::default();
        raw.counts[400..409].fill(counts);
        let mut bytes = Vec::new();
        pipeline.sensor().layout().encode(&raw, &mut bytes);
        let (input, at) = (Input::Bytes(bytes), at(200 * frame));
        if frame >= 6 {
            assert_eq!(pipeline.is_at_rest(), frame == 9, "frame {frame}");
            recorder.note(&pipeline, &input, at);
        }
        pipeline.take(input, at).unwrap();
    }
    drop(recorder);
    let entries: Vec<Entry> = inbox
        .into_iter()
        .map(|(job, _)| match job {
            Job::Entry { entry, .. } => entry,
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(
        matches!(entries[..], [Entry::State(_), Entry::Input(_)]),
        "{entries:?}"
    );
}

#[test]
fn a_flood_is_bounded_in_the_black_box() {
    // The context takes less than 1 KiB as text, but 100 objects in memory.
    let context = serde_json::json!({ "tags": vec![serde_json::json!({ "": 0 }); 100] });
    assert!(context.to_string().len() < 1024);
    for flood in [
        Input::Bytes(vec![0; 1 << 16]),
        Input::Context(Some(context)),
    ] {
        assert!(Entry::Input(flood.to_owned()).weight() > 60_000);
        let (sender, inbox) = channel();
        let (mut recorder, pipeline) = recorder(sender, usize::MAX >> 3);
        for _ in 0..1000 {
            recorder.note(&pipeline, &flood, at(0));
        }
        drop(recorder);
        let mut ring = Ring::default();
        for (job, _) in inbox {
            let Job::Entry { at, entry, .. } = job else {
                panic!("{job:?}");
            };
            ring.push(at, entry);
        }
        let kept: usize = ring.all().map(|(_, entry)| entry.weight()).sum();
        assert!((28 << 20..=36 << 20).contains(&kept), "{kept} bytes");
    }
}
