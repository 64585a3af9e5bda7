//! Layouts are found in the bytes of the generator, or left open, and never taken for others.

use std::path::Path;

use super::find::find;
use super::found::{Failure, Found, Known};
use super::generator::{case, frames};
use super::toml;
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Cell, Decoder, HexBytes, Layout, Preset, Settings};
use hardnessd_simulator::random::Stream;

fn decoded(settings: &Settings, bytes: &[u8]) -> Vec<RawFrame> {
    let mut decoder = Decoder::new(Layout::new(settings).unwrap());
    decoder.push(bytes);
    decoder.settle();
    std::iter::from_fn(|| decoder.next_frame())
        .filter_map(|item| item.ok().map(|decoded| decoded.frame))
        .collect()
}

/// The number of frames in `of` that are outside the longest sequence of frames that `of` and
/// `among` have in common.
fn missing(of: &[RawFrame], among: &[RawFrame]) -> usize {
    let mut common = vec![0; among.len() + 1];
    for frame in of {
        let mut before = 0;
        for (index, other) in among.iter().enumerate() {
            let longest = common[index + 1];
            common[index + 1] = if frame == other {
                before + 1
            } else {
                longest.max(common[index])
            };
            before = longest;
        }
    }
    of.len() - common[among.len()]
}

/// Frames that may differ: those at the ends of the stream, and beside damage.
const LOST: usize = 6;

/// Searches the streams of these seeds. Returns how many were found and left open.
fn search(seeds: std::ops::Range<u64>) -> (usize, usize) {
    let (mut found, mut open) = (0, 0);
    for seed in seeds {
        let case = case(seed);
        let Ok(outcome) = find(&case.bytes, Known::default()) else {
            continue;
        };
        let proposal = &outcome.best.proposal;
        if !outcome.is_sure() || proposal.doubt.is_some() {
            open += 1;
            continue;
        }
        found += 1;
        let frames = decoded(&proposal.settings, &case.bytes);
        let lost = missing(&frames, &case.frames).max(missing(&case.frames, &frames));
        let settings = &proposal.settings;
        assert!(lost <= LOST, "seed {seed}, {}: {settings:?}", case.words);
    }
    (found, open)
}

#[test]
fn layouts_are_found_or_left_open_and_never_taken_for_others() {
    // These seeds were not used to choose a constant.
    let halves =
        [600_000..600_108, 600_108..600_216].map(|seeds| std::thread::spawn(|| search(seeds)));
    let counts = halves.map(|half| half.join().expect("each layout is right"));
    let [(found, open), (more_found, more_open)] = counts;
    let (found, open) = (found + more_found, open + more_open);
    assert!(
        found >= 172 && found + open >= 210,
        "{found} found, {open} open"
    );
}

/// The frames of several presses, and their bytes. Taxels at rest read 0.
fn played(layout: &Layout) -> (Vec<RawFrame>, Vec<u8>) {
    let mut played =
        (0..).map(|seed| frames(layout.array(), 250, &mut Stream::new(seed, "played")));
    let (frames, _) = played
        .find(|(_, rest)| *rest == 0)
        .expect("the seeds do not end");
    let mut bytes = Vec::new();
    for frame in &frames {
        layout.encode(frame, &mut bytes);
    }
    (frames, bytes)
}

fn preset(preset: Preset) -> Settings {
    Settings {
        preset,
        ..Settings::default()
    }
}

#[test]
fn presets_are_named() {
    let presets = [
        Preset::Jx255n,
        Preset::Jx255nU16,
        Preset::Jq,
        Preset::JqTail,
        Preset::JqU16,
        Preset::JqGlove,
        Preset::Flexitac,
        Preset::M1616,
        Preset::FfTail,
        Preset::Ascii,
        Preset::Csv,
        Preset::ZeroRun,
    ];
    for settings in presets.map(preset) {
        let (_, bytes) = played(&Layout::new(&settings).unwrap());
        let found = find(&bytes, Known::default()).map(|found| found.best.proposal.settings);
        assert_eq!(found.as_ref(), Ok(&settings));
    }
}

fn words(found: &Found) -> String {
    toml(Path::new("x\n[y].bin"), 1, found)
}

#[test]
fn the_toml_has_the_fewest_keys_and_says_what_is_left_open() {
    let settings = Settings {
        sync: Some(HexBytes(vec![0xA5, 0x5A])),
        ..Settings::default()
    };
    let (_, bytes) = played(&Layout::new(&settings).unwrap());
    let message = words(&find(&bytes, Known::default()).unwrap());
    assert!(message.starts_with("# x\\n[y].bin: 1 bytes\n"), "{message}");
    assert!(
        message.contains("\n# 28x28 u8: its picture is "),
        "{message}"
    );
    let end = "[sensor.frame]\npreset = \"jx255n\"\nsync = \"A5 5A\"\n";
    assert!(message.ends_with(end), "{message}");
    assert!(!message.contains("switched on"), "{message}");
    // Without a checksum, a header and a tail look the same in the middle of a stream.
    let (_, bytes) = played(&Layout::new(&preset(Preset::JqTail)).unwrap());
    let message = words(&find(&bytes[300..], Known::default()).unwrap());
    assert!(
        message.contains("switched on") && message.ends_with("preset = \"jq\"\n"),
        "{message}"
    );
}

#[test]
fn a_clock_after_the_cells_is_said_and_skipped() {
    let layout = Layout::new(&preset(Preset::M1616)).unwrap();
    let (frames, _) = played(&layout);
    let mut bytes = Vec::new();
    for (frame, time) in frames.iter().zip(0_u32..) {
        layout.encode(frame, &mut bytes);
        let end = bytes.len();
        bytes[end - 4..].copy_from_slice(&(32 * time).to_le_bytes());
    }
    let message = words(&find(&bytes, Known::default()).unwrap());
    assert!(
        message.contains(" grows by about 32 a frame: a clock"),
        "{message}"
    );
    assert!(
        message.ends_with("[sensor.frame]\npreset = \"m1616\"\n"),
        "{message}"
    );
}

#[test]
fn what_the_user_knows_decides() {
    // One press of one taxel shows no shape.
    let settings = Settings {
        rows: Some(12),
        cols: Some(8),
        ..preset(Preset::Jq)
    };
    let layout = Layout::new(&settings).unwrap();
    let mut bytes = Vec::new();
    for time in 0..60 {
        let mut frame = RawFrame::zero(layout.array());
        frame.counts[43] = if (20..40).contains(&time) { 100 } else { 0 };
        layout.encode(&frame, &mut bytes);
    }
    let open = find(&bytes, Known::default());
    assert!(open.is_err() || open.is_ok_and(|found| !found.is_sure()));
    let (rows, cols, cell) = (Some(12), Some(8), Some(Cell::U8));
    let found = find(&bytes, Known { rows, cols, cell }).unwrap();
    assert!(found.is_sure());
    assert_eq!(found.best.proposal.settings, settings);
}

#[test]
fn each_failure_has_its_own_message() {
    let check = |bytes: &[u8], part: &str| {
        let failure = find(bytes, Known::default()).unwrap_err();
        let message = failure.to_string();
        assert!(
            message.contains(part) && !message.contains('\n'),
            "{message}"
        );
    };
    check(b"", "nothing arrives");
    check(
        "boot ok\nwaiting for a host\n".repeat(50).as_bytes(),
        "text, but no array",
    );
    let lines: String = (0..400)
        .map(|line| format!("{} {} 0 9 7\n", line % 4 * 50, line % 4))
        .collect();
    check(lines.as_bytes(), "empty line after each frame");
    let mut stream = Stream::new(1, "noise");
    let noise: Vec<u8> = (0..200_000).map(|_| stream.next_u64() as u8).collect();
    for bytes in [
        &noise,
        &noise[..20_000],
        &[0; 50_000],
        &[0x55; 50_000],
        b"x",
    ] {
        check(bytes, "nothing recurs");
    }
    // Frames of other sensors than arrays.
    let telemetry = noise
        .chunks(16)
        .flat_map(|bytes| [&[0xAA, 0x55], bytes].concat());
    check(&telemetry.collect::<Vec<u8>>(), "no array");
    let quiet = [&[0xAA, 0x55][..], &[0; 96]].concat();
    check(&quiet.repeat(60), "nothing presses");
    let array = Array { rows: 8, cols: 8 };
    let (pressed, _) = frames(array, 250, &mut Stream::new(3, "packets"));
    let rows = pressed
        .iter()
        .flat_map(|frame| frame.counts.chunks(8).zip(0..));
    let packets = rows.flat_map(|(row, number)| {
        let cells = row.iter().map(|&count| count as u8);
        [0xFE, 0xFD, number].into_iter().chain(cells)
    });
    check(
        &packets.collect::<Vec<u8>>(),
        "a number from 0 to 7 that begins again",
    );
    let array = Array { rows: 80, cols: 80 };
    let (frames, _) = frames(array, 250, &mut Stream::new(3, "large"));
    let large = frames.iter().flat_map(|frame| {
        let cells = frame.counts.iter().map(|&count| count as u8);
        [0xFE, 0xFD, 0xFC].into_iter().chain(cells)
    });
    let failure = find(&large.collect::<Vec<u8>>(), Known::default()).unwrap_err();
    assert_eq!(failure, Failure::TooLarge(array));
}
