//! What strangers send, at every door that bytes come in by: whatever the bytes, a door answers, never
//! panics, and takes no more than a bounded time. `PROPTEST_CASES=N` tries more; model files are tried in
//! `src/verdict/guard`.

#![allow(clippy::unwrap_used, reason = "a test")]

use std::io::Cursor;
use std::path::Path;

use hardnessd::daemon::config::Config;
use hardnessd::recording::{Reader, recover};
use hardnessd::wire::{Cell, Checksum, Decoder, HexBytes, Layout, LengthField, Order, Settings};
use proptest::prelude::*;

/// A recording of a daemon.
const RECORDING: &[u8] = include_bytes!("../fixtures/earlier.mcap");
/// The configuration with every key.
const CONFIGURATION: &str = include_str!("../config/hardnessd.toml");

/// Changes to bytes: where, and what comes there instead of how many.
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

/// What a decoder makes of bytes that come in chunks: frames and damaged candidates in order, and how many
/// bytes it has skipped.
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
                let mut frame = hardnessd::frame::RawFrame::default();
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
        // What is skipped and what is still pending may differ by less than a frame.
        let differ = one_skipped.abs_diff(many_skipped);
        prop_assert!(differ < layout.max_frame_bytes() as u64, "{}", differ);
    }

    #[test]
    fn a_damaged_configuration_is_refused_in_one_line_or_used(damage in damage()) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("hardnessd.toml");
        std::fs::write(&path, damaged(CONFIGURATION.as_bytes(), damage)).unwrap();
        if let Err(error) = Config::load(&path) {
            let line = error.to_string();
            let name = path.display().to_string();
            prop_assert!(line.starts_with(&name), "{}", line);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn a_damaged_recording_ends_and_what_is_saved_of_it_is_whole(damage in damage()) {
        let bytes = damaged(RECORDING, damage);
        // It ends with the first error.
        let read = Reader::new(bytes.as_slice()).filter(Result::is_ok).count();
        let (recovered, good) = recover(Cursor::new(&bytes), Vec::new()).unwrap();
        let whole: Result<Vec<_>, _> = Reader::new(good.as_slice()).collect();
        prop_assert!(whole.unwrap().len() >= read.min(1));
        prop_assert!(good.len() < 4 * RECORDING.len());
        drop(recovered);
    }

    #[test]
    fn bytes_that_are_no_file_of_ours_are_refused(
        bytes in prop::collection::vec(any::<u8>(), 0..4096),
    ) {
        prop_assert!(Reader::new(bytes.as_slice()).all(|found| found.is_err()));
        let (recovered, _) = recover(Cursor::new(&bytes), Vec::new()).unwrap();
        prop_assert_eq!(recovered.messages, 0);
        prop_assert!(Config::load(Path::new("/nonexistent")).is_err());
    }
}
