//! The cost of one press from bytes to verdict, and of its parts: `cargo bench --bench pipeline`.
//!
//! The bytes are a recording of two presses on foam at 5 frames/s, 41 frames. Only compare lines of one
//! run with each other, not with those of another day.

use std::path::Path;
use std::sync::Arc;

use divan::Bencher;
use divan::counter::{BytesCount, ItemsCount};
use hardnessd_core::event::{Event, Phase};
use hardnessd_core::frame::Stamp;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
use hardnessd_core::wire::{self, Decoder, Layout};

/// The approximate size of one read of a serial port at 115,200 baud.
const CHUNK_BYTES: usize = 64;

fn main() {
    divan::main();
}

fn recording() -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/foam.5hz.bin");
    std::fs::read(path).expect("the fixture lies in the repository")
}

fn layout() -> Layout {
    Layout::new(&wire::Settings::default()).expect("the default is a layout")
}

fn hrn() -> Arc<Model> {
    Arc::new(Model::load(BUILT_IN_HRN).expect("the model in the binary is one"))
}

fn pipeline(hrn: &Arc<Model>) -> Pipeline {
    let sensor = Sensor::new(Description::default()).expect("the default is a sensor");
    Pipeline::new(sensor, Arc::clone(hrn), Clock::FrameRate)
}

/// Measures bytes to frames.
#[divan::bench(args = [1, CHUNK_BYTES, 4096])]
fn decode(bencher: Bencher, chunk_bytes: usize) {
    let bytes = recording();
    bencher
        .counter(BytesCount::new(bytes.len()))
        .with_inputs(|| Decoder::new(layout()))
        .bench_local_refs(|decoder| {
            let mut frames = 0;
            for chunk in bytes.chunks(chunk_bytes) {
                decoder.push(chunk);
                while let Some(found) = decoder.next_frame() {
                    frames += usize::from(found.is_ok());
                }
            }
            frames
        });
}

/// Measures bytes to events, with an early and a final verdict for each press. An item is a press.
#[divan::bench]
fn bytes_to_events(bencher: Bencher) {
    let (bytes, hrn) = (recording(), hrn());
    let at = Stamp {
        mono: std::time::Duration::ZERO,
        wall: jiff::Timestamp::UNIX_EPOCH,
    };
    let events = |pipeline: &mut Pipeline| {
        let mut take = |input| pipeline.take(input, at).expect("bytes are taken");
        let mut events = take(Input::Opened);
        for chunk in bytes.chunks(CHUNK_BYTES) {
            events.extend(take(Input::Bytes(chunk.into())));
        }
        events.extend(pipeline.end_of_recording(None));
        events
    };
    let finals =
        |event: &Event| matches!(event, Event::Hardness(verdict) if verdict.phase == Phase::Final);
    let presses = events(&mut pipeline(&hrn))
        .iter()
        .filter(|event| finals(event))
        .count();
    assert_eq!(presses, 2, "the recording has two presses");
    bencher
        .counter(ItemsCount::new(presses))
        .with_inputs(|| pipeline(&hrn))
        .bench_local_refs(|pipeline| {
            let lines = events(pipeline)
                .into_iter()
                .map(|event| event.to_line().len());
            lines.sum::<usize>()
        });
}

/// Measures a frame to a verdict.
#[divan::bench]
fn judge(bencher: Bencher) {
    let hrn = hrn();
    bencher.bench_local(|| hrn.judge_check(2));
}

/// Measures loading a model file, including its check frames. Start and reload do this.
#[divan::bench]
fn load_model() -> Arc<Model> {
    hrn()
}
