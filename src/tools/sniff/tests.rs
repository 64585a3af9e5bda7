//! Each layout is found again in the bytes that it has encoded.

use super::proposal::propose;
use super::toml;
use crate::tools::faults::middle;
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{
    Cell, Checksum, Decoder, HexBytes, Layout, LengthField, Preset, Settings,
};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, Sequence, SequenceSettings};

/// Rest, a press and rest on the array of `layout`: 20 to 50 frames.
fn frames(layout: &Layout, seed: u64) -> Vec<RawFrame> {
    let settings = SequenceSettings {
        seed,
        materials: vec![Material::ALL[4 + seed as usize % 4]],
        presses: Some(1),
        ..SequenceSettings::default()
    };
    let sequence = Sequence::new(settings);
    let frames: Vec<RawFrame> = sequence
        .map(|frame| middle(&frame.raw, layout.array()))
        .collect();
    assert!((20..=50).contains(&frames.len()), "{} frames", frames.len());
    frames
}

/// The bytes of `frames` as a line would deliver them. They begin anywhere in the first frame and
/// end anywhere in the last. One frame lacks a byte, and one has a flipped bit.
fn line(layout: &Layout, frames: &[RawFrame], stream: &mut Stream) -> Vec<u8> {
    let dropped = frames.len() / 3 + stream.below(3);
    let flipped = 2 * frames.len() / 3 + stream.below(3);
    let mut bytes = Vec::new();
    for (index, frame) in frames.iter().enumerate() {
        let start = bytes.len();
        layout.encode(frame, &mut bytes);
        let at = start + stream.below(bytes.len() - start);
        if index == dropped {
            bytes.remove(at);
        } else if index == flipped {
            bytes[at] ^= 1 << stream.below(8);
        }
    }
    let frame_bytes = bytes.len() / frames.len();
    bytes.truncate(bytes.len() - stream.below(frame_bytes));
    bytes.split_off(stream.below(frame_bytes))
}

fn decoded(layout: Layout, bytes: &[u8]) -> Vec<RawFrame> {
    let mut decoder = Decoder::new(layout);
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

/// The proposed layout must be the layout of `settings`. Without a checksum, it may be another one
/// if at most three frames differ, those at the ends and beside damage.
fn check(settings: &Settings, seed: u64) -> Result<(), String> {
    let layout = Layout::new(settings).unwrap();
    let mut stream = Stream::new(seed, "line");
    let bytes = line(&layout, &frames(&layout, seed), &mut stream);
    let proposals = propose(&bytes);
    let Some(best) = proposals.first() else {
        return Err(format!("no proposal for {settings:?}, seed {seed}"));
    };
    let proposed = Layout::new(&best.settings).unwrap();
    let words = toml(
        std::path::Path::new("x.bin"),
        bytes.len(),
        best,
        proposals.get(1),
    );
    if proposed == layout {
        return Ok(());
    }
    let is_checked = Layout::new(&Settings {
        checksum: Some(Checksum::None),
        ..settings.clone()
    }) != Ok(layout.clone());
    let (ours, theirs) = (decoded(proposed, &bytes), decoded(layout, &bytes));
    let lost = missing(&theirs, &ours).max(missing(&ours, &theirs));
    if is_checked || lost > 3 {
        return Err(format!(
            "{settings:?}, seed {seed}: {lost} frames differ: {words}"
        ));
    }
    Ok(())
}

/// Checks all cases, and reports all failures at once.
fn check_all(cases: impl Iterator<Item = (Settings, u64)>) {
    let failed: Vec<String> = cases
        .filter_map(|(settings, seed)| check(&settings, seed).err())
        .collect();
    assert!(failed.is_empty(), "{}", failed.join("\n"));
}

#[test]
fn presets_are_found() {
    let presets = [
        Preset::Jx255n,
        Preset::Jx255nU16,
        Preset::Jq,
        Preset::JqTail,
        Preset::JqU16,
        Preset::FfTail,
        Preset::Ascii,
        Preset::ZeroRun,
    ];
    check_all(presets.into_iter().flat_map(|preset| {
        let settings = Settings {
            preset,
            ..Settings::default()
        };
        (0..2).map(move |seed| (settings.clone(), seed))
    }));
}

#[test]
fn texts_and_packed_frames_of_any_array_are_found() {
    let texts = [(16, 16), (8, 8), (10, 24)].map(|array| (Preset::Ascii, array));
    let packed = [(16, 16), (20, 20)].map(|array| (Preset::ZeroRun, array));
    let cases: Vec<_> = texts.into_iter().chain(packed).collect();
    check_all(cases.iter().map(|&(preset, (rows, cols))| {
        let settings = Settings {
            preset,
            rows: Some(rows),
            cols: Some(cols),
            ..Settings::default()
        };
        (settings, 1)
    }));
}

#[test]
fn frames_without_a_zero_are_not_taken_for_packed_ones() {
    let layout = Layout::new(&Settings {
        preset: Preset::FfTail,
        ..Settings::default()
    })
    .unwrap();
    let mut frames = frames(&layout, 1);
    for frame in &mut frames {
        for count in &mut frame.counts {
            *count += 1;
        }
    }
    let proposals = propose(&line(&layout, &frames, &mut Stream::new(1, "line")));
    assert_eq!(proposals[0].settings.preset, Preset::FfTail);
}

#[test]
fn free_layouts_are_found() {
    check_all((0..20).map(|seed| {
        let mut stream = Stream::new(seed, "layouts");
        let mark = |stream: &mut Stream, least| {
            let length = least + stream.below(3);
            // A zero at the edge of a mark would look like a taxel at rest.
            HexBytes((0..length).map(|_| 1 + stream.below(255) as u8).collect())
        };
        let checksums = [
            Checksum::None,
            Checksum::Sum8,
            Checksum::Xor8,
            Checksum::Crc16Modbus,
            Checksum::Crc16Ccitt,
        ];
        let lengths = [LengthField::None, LengthField::U16le, LengthField::U16be];
        let cells = [Cell::U8, Cell::U16le, Cell::U16be];
        let side = [28, 28, 28, 16, 10][stream.below(5)];
        let tail = stream.below(2) == 0;
        let settings = Settings {
            sync: Some(mark(&mut stream, 2)),
            tail: tail.then(|| mark(&mut stream, 1)),
            length: Some(lengths[stream.below(3)]),
            cell: Some(cells[stream.below(3)]),
            checksum: Some(checksums[stream.below(5)]),
            rows: Some(side),
            cols: Some(side),
            ..Settings::default()
        };
        (settings, seed)
    }));
}

#[test]
fn marks_of_one_byte_are_found_around_small_arrays() {
    let shapes = [(1, 0), (0, 1), (1, 1), (2, 0), (1, 2)];
    let cells = [Cell::U8, Cell::U16le];
    let checksums = [Checksum::None, Checksum::Sum8, Checksum::Crc16Modbus];
    let sides = [5, 6, 8, 10, 12, 16, 20];
    check_all((0..70).map(|seed| {
        let mut stream = Stream::new(seed, "small");
        let (sync, tail) = shapes[seed as usize % shapes.len()];
        let mut mark =
            |length| HexBytes((0..length).map(|_| 1 + stream.below(255) as u8).collect());
        let (sync, tail) = (mark(sync), mark(tail));
        let side = sides[seed as usize % sides.len()];
        let settings = Settings {
            sync: Some(sync),
            tail: Some(tail),
            length: Some(LengthField::None),
            cell: Some(cells[stream.below(2)]),
            checksum: Some(checksums[stream.below(3)]),
            rows: Some(side),
            cols: Some(side),
            ..Settings::default()
        };
        (settings, seed)
    }));
}

#[test]
fn presets_of_small_arrays_are_found() {
    let presets = [
        Preset::Jx255n,
        Preset::Jx255nU16,
        Preset::Jq,
        Preset::JqU16,
        Preset::FfTail,
    ];
    let cases = presets
        .into_iter()
        .flat_map(|preset| [5, 8, 12, 16].map(|side| (preset, side)));
    for (preset, side) in cases {
        let settings = Settings {
            preset,
            rows: Some(side),
            cols: Some(side),
            ..Settings::default()
        };
        let layout = Layout::new(&settings).unwrap();
        let bytes = line(&layout, &frames(&layout, 1), &mut Stream::new(1, "line"));
        let proposals = propose(&bytes);
        assert_eq!(proposals[0].settings, settings, "{preset:?} {side}");
    }
}

#[test]
fn the_simplest_settings_are_proposed() {
    let layout = |settings: &Settings| Layout::new(settings).unwrap();
    let settings = Settings {
        sync: Some(HexBytes(vec![0xA5, 0x5A])),
        ..Settings::default()
    };
    let bytes = line(
        &layout(&settings),
        &frames(&layout(&settings), 1),
        &mut Stream::new(1, "line"),
    );
    let proposals = propose(&bytes);
    assert_eq!(proposals[0].settings, settings);
    let words = toml(
        std::path::Path::new("x\n[y].bin"),
        bytes.len(),
        &proposals[0],
        None,
    );
    assert!(words.starts_with("# x\\n[y].bin: "), "{words}");
    let end = "[sensor.frame]\npreset = \"jx255n\"\nsync = \"A5 5A\"\n";
    assert!(words.ends_with(end), "{words}");
}

#[test]
fn noise_and_silence_are_not_explained() {
    let mut stream = Stream::new(1, "noise");
    let noise: Vec<u8> = (0..200_000).map(|_| stream.next_u64() as u8).collect();
    for bytes in [
        &noise[..],
        &noise[..20_000],
        &[0; 50_000],
        &[0x55; 50_000],
        b"",
        b"x",
    ] {
        assert!(propose(bytes).is_empty(), "{} bytes", bytes.len());
    }
}

#[test]
fn a_header_that_the_bytes_begin_with_is_no_tail() {
    for seed in 0..8 {
        let mut stream = Stream::new(seed, "headed");
        let mark = HexBytes((0..4).map(|_| 1 + stream.below(255) as u8).collect());
        let settings = Settings {
            preset: Preset::Jq,
            sync: Some(mark.clone()),
            ..Settings::default()
        };
        let layout = Layout::new(&settings).unwrap();
        let mut bytes = Vec::new();
        for frame in frames(&layout, seed) {
            layout.encode(&frame, &mut bytes);
        }
        // A stream that was cut off makes a tail more likely, because its last frame has none.
        bytes.truncate(bytes.len() - 400);
        let best = &propose(&bytes)[0];
        assert_eq!(
            best.settings.sync.as_ref(),
            Some(&mark),
            "{:?}",
            best.settings
        );
    }
}

#[test]
fn why_one_is_preferred_is_said_without_a_negative_lead() {
    let layout = Layout::new(&Settings::default()).unwrap();
    let bytes = line(&layout, &frames(&layout, 1), &mut Stream::new(1, "line"));
    let proposals = propose(&bytes);
    assert!(proposals.len() > 1);
    for pair in proposals.windows(2) {
        let Some(reason) = pair[0].reason(&pair[1]) else {
            continue;
        };
        let words = toml(std::path::Path::new("x.bin"), 1, &pair[0], Some(&pair[1]));
        let said = format!("# preferred to the next because {reason}\n");
        assert!(words.contains(&said), "{words}");
    }
    assert_eq!(
        proposals[0].reason(&proposals[1]),
        Some("its checksum fits frames that change")
    );
}

#[test]
fn a_layout_without_a_checksum_is_not_preferred_for_one() {
    for preset in [Preset::Ascii, Preset::ZeroRun] {
        let settings = |side| Settings {
            preset,
            rows: Some(side),
            cols: Some(side),
            ..Settings::default()
        };
        let layout = Layout::new(&settings(16)).unwrap();
        let bytes = line(&layout, &frames(&layout, 1), &mut Stream::new(1, "line"));
        let best = &propose(&bytes)[0];
        assert_eq!(best.settings, settings(16));
        let plain = Layout::new(&Settings::default()).unwrap();
        let other = &propose(&line(
            &plain,
            &frames(&plain, 1),
            &mut Stream::new(1, "line"),
        ))[1];
        let reason = "every byte of its frames is in order";
        assert_eq!(best.reason(other), Some(reason));
    }
}

#[test]
fn a_tail_in_the_middle_of_a_stream_cannot_be_told_from_a_header() {
    let layout = Layout::new(&Settings {
        preset: Preset::JqTail,
        ..Settings::default()
    })
    .unwrap();
    let mut bytes = Vec::new();
    for frame in frames(&layout, 1) {
        layout.encode(&frame, &mut bytes);
    }
    let said = |bytes: &[u8]| {
        let proposals = propose(bytes);
        let path = std::path::Path::new("x.bin");
        toml(path, bytes.len(), &proposals[0], proposals.get(1))
    };
    let cut = said(&bytes[300..bytes.len() - 300]);
    let remark = "# cannot be told from the next, because a header and a tail look the same here: \
                  record from the moment the sensor is switched on, or read its data sheet\n";
    assert!(cut.contains(remark), "{cut}");
    // The remedy works: the first frame is whole only with its tail.
    let whole = said(&bytes[..bytes.len() - 300]);
    assert!(whole.ends_with("preset = \"jq-tail\"\n"), "{whole}");
    assert!(whole.contains("# preferred to the next because"), "{whole}");
}
