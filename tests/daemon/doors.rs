//! Bytes from strangers, at every input of the programs. Whatever the bytes are, the program
//! answers, never panics, and takes a bounded time. `doors/properties.rs` has the properties.
//! `fuzz/` searches for bytes that break them, guided by coverage. `crates/core/src/verdict/guard` also tries
//! model files.

use std::io::Cursor;
use std::path::Path;
use std::time::{Duration, Instant};

use hardnessd_core::recording::{Reader, recover};
use hardnessd_core::wire::{
    Cell, Checksum, Decoder, HexBytes, Layout, LengthField, Order, Settings,
};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

/// A recording from a daemon.
const RECORDING: &[u8] = include_bytes!("../../fixtures/earlier.mcap");

/// Changes to bytes: the place, the new bytes, and the number of bytes that they replace.
type Damage = Vec<(prop::sample::Index, Vec<u8>, usize)>;

fn damage() -> impl Strategy<Value = Damage> {
    let change = (
        any::<prop::sample::Index>(),
        prop::collection::vec(any::<u8>(), 0..12),
        0_usize..12,
    );
    prop::collection::vec(change, 1..6)
}

fn damaged(bytes: &[u8], damage: Damage) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for (place, new, gone) in damage {
        let start = place.index(bytes.len().max(1)).min(bytes.len());
        let end = (start + gone).min(bytes.len());
        bytes.splice(start..end, new);
    }
    bytes
}

/// Any layout that the keys of `[sensor.frame]` can describe.
fn layout() -> impl Strategy<Value = Layout> {
    let hex = || prop::collection::vec(any::<u8>(), 0..5).prop_map(HexBytes);
    let cells = [Cell::U8, Cell::U16le, Cell::U16be];
    let lengths = [
        LengthField::None,
        LengthField::U8,
        LengthField::U16le,
        LengthField::U16be,
    ];
    let orders = [Order::RowMajor, Order::ColumnMajor, Order::Serpentine];
    let checksums = [
        Checksum::None,
        Checksum::Sum8,
        Checksum::Xor8,
        Checksum::Crc16Modbus,
        Checksum::Crc16Ccitt,
    ];
    let parts = (
        hex(),
        hex(),
        prop::sample::select(lengths.to_vec()),
        prop::sample::select(cells.to_vec()),
        prop::sample::select(checksums.to_vec()),
        prop::sample::select(orders.to_vec()),
        (1_usize..5, 1_usize..5),
    );
    parts.prop_filter_map("a layout that can be used", |parts| {
        let (sync, tail, length, cell, checksum, order, (rows, cols)) = parts;
        let settings = Settings {
            sync: Some(sync),
            tail: Some(tail),
            length: Some(length),
            cell: Some(cell),
            checksum: Some(checksum),
            order: Some(order),
            rows: Some(rows),
            cols: Some(cols),
            ..Settings::default()
        };
        Layout::new(&settings).ok()
    })
}

/// The output of a decoder for bytes in chunks: frames and damaged candidates in order, and the
/// number of skipped bytes.
fn decoded<'a>(layout: &Layout, chunks: impl Iterator<Item = &'a [u8]>) -> (Vec<String>, u64) {
    let mut decoder = Decoder::new(layout.clone());
    let mut found = Vec::new();
    for chunk in chunks {
        decoder.push(chunk);
        while let Some(frame) = decoder.next_frame() {
            found.push(format!("{frame:?}"));
        }
    }
    (found, decoder.skipped())
}

proptest! {
    #[test]
    fn any_chunking_of_any_layout_gives_what_one_chunk_gives(
        layout in layout(),
        pieces in prop::collection::vec((any::<bool>(), prop::collection::vec(any::<u8>(), 0..40)), 1..20),
        sizes in prop::collection::vec(1_usize..50, 1..20),
    ) {
        let mut bytes = Vec::new();
        for (is_frame, piece) in pieces {
            if is_frame {
                let mut frame = hardnessd_core::frame::RawFrame::default();
                for (count, byte) in frame.counts.iter_mut().zip(&piece) {
                    *count = u16::from(*byte);
                }
                layout.encode(&frame, &mut bytes);
            } else {
                bytes.extend(piece);
            }
        }
        let mut rest = bytes.as_slice();
        let mut chunks = Vec::new();
        for size in sizes.iter().cycle() {
            if rest.is_empty() {
                break;
            }
            let (chunk, after) = rest.split_at((*size).min(rest.len()));
            chunks.push(chunk);
            rest = after;
        }
        let (one, one_skipped) = decoded(&layout, [bytes.as_slice()].into_iter());
        let (many, many_skipped) = decoded(&layout, chunks.into_iter());
        prop_assert_eq!(one, many);
        // The numbers of skipped bytes may differ by less than a frame, because some bytes are
        // still pending.
        let differ = one_skipped.abs_diff(many_skipped);
        prop_assert!(differ < layout.max_frame_bytes() as u64, "{}", differ);
    }
}

/// The seconds for changes to the kept bytes. `HARDNESSD_DOORS_SECONDS` sets another number, for CI
/// and for longer searches.
fn seconds() -> u64 {
    let told = std::env::var("HARDNESSD_DOORS_SECONDS").ok();
    told.map_or(3, |told| told.parse().expect("seconds"))
}

/// The bytes that the fuzzer kept for a door, and a whole recording.
fn kept(door: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("fuzz/corpus")
        .join(door);
    let files = std::fs::read_dir(&folder).expect("a corpus for each door");
    let mut kept: Vec<Vec<u8>> = files
        .map(|file| std::fs::read(file.unwrap().path()).unwrap())
        .collect();
    assert!(!kept.is_empty(), "{door}");
    if ["recording", "recover"].contains(&door) {
        kept.push(RECORDING.to_vec());
    }
    kept
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn of_a_damaged_recording_what_could_be_read_is_saved(damage in damage()) {
        let bytes = damaged(RECORDING, damage);
        // The reader ends with the first error.
        let read = Reader::new(bytes.as_slice()).filter(Result::is_ok).count();
        let (_, good) = recover(Cursor::new(&bytes), Vec::new()).unwrap();
        prop_assert!(Reader::new(good.as_slice()).count() >= read.min(1));
    }
}

#[test]
fn every_property_holds_of_what_the_fuzzer_kept() {
    for (door, property) in crate::properties::ALL {
        for bytes in kept(door) {
            property(&bytes);
        }
    }
}

#[test]
fn every_property_holds_of_changes_to_what_the_fuzzer_kept() {
    let end = Instant::now() + Duration::from_secs(seconds());
    let mut tried = 0;
    while Instant::now() < end {
        for (door, property) in crate::properties::ALL {
            let kept = kept(door);
            let config = ProptestConfig {
                cases: 8,
                // Bytes that break a property are added to the corpus by hand.
                failure_persistence: None,
                ..ProptestConfig::default()
            };
            let inputs = (any::<prop::sample::Index>(), damage());
            let ran = TestRunner::new(config).run(&inputs, |(which, damage)| {
                let which = which.index(kept.len());
                property(&damaged(&kept[which], damage));
                Ok(())
            });
            ran.unwrap_or_else(|error| panic!("{door}: {error}"));
            tried += 8;
        }
    }
    println!("{tried} changed inputs");
}
