//! Any chunking gives the same frames, noise never panics, and damage loses only the damaged frame.

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Decoder, Layout, Settings};
use proptest::prelude::*;
use rustix::time::{ClockId, clock_gettime};

/// A layout of each kind: all presets, and layouts that override them.
const LAYOUTS: [&str; 24] = [
    "preset = 'jx255n'",
    "preset = 'jx255n-u16'",
    "preset = 'jq'",
    "preset = 'jq-tail'",
    "preset = 'jq-u16'",
    "preset = 'flexitac'\nrows = 64\ncols = 64",
    "preset = 'jq-glove'",
    "preset = 'm1616'",
    "preset = 'csv'",
    "preset = 'csv'\nrows = 12\ncols = 6",
    "preset = 'jx255n'\nheader_bytes = 3\nfooter_bytes = 5\nchecksum = 'crc32'",
    "preset = 'm1616'\nfooter_bytes = 0\nchecksum = 'crc32-be'\nchecksum_over = 'cells'",
    "preset = 'jq-glove'\nchecksum = 'crc16-modbus-be'\ntail = '0D 0A'",
    "preset = 'jq-glove'\nrows = 8\ncols = 12\nheader_bytes = 6\nlength = 'u8'\n\
     footer_bytes = 1\npackets = { count = 3, number_at = 5, first = 250 }",
    "preset = 'jq-tail'\nheader_bytes = 2\nfooter_bytes = 4\nchecksum = 'crc16-ccitt-be'",
    "preset = 'jq-tail'\nrows = 10\ncols = 10\nchecksum = 'sum8'\ntail = '0A'",
    "sync = 'AA 56'\nrows = 12\ncols = 9\nheader_bytes = 3\nstride_bytes = 3\nchecksum = 'lrc8'",
    "sync = 'AA 56'\nrows = 4\ncols = 5\ncell = 'f32le'\nstride_bytes = 16\nheader_bytes = 12\n\
     checksum = 'crc16-xmodem'\nchecksum_over = 'after-sync'",
    "sync = 'A5'\nrows = 9\ncols = 7\ncell = 'i32be'\nstride_bytes = 5\ntail = '0D 0A'\nchecksum = 'crc8'",
    "sync = 'A5 5A'\nrows = 8\ncols = 8\ncell = 'i16le'\nheader_bytes = 3\nchecksum = 'sum16-be'\n\
     packets = { count = 8, number_at = 1, number = 'u16be', first = 0, step = 8 }",
    "framing = 'slip'\nrows = 8\ncols = 16\ncell = 'u16le'",
    "framing = 'cobs'\nrows = 16\ncols = 16\nsync = '01'\nchecksum = 'crc16-ccitt'",
    "preset = 'csv'\nrows = 4\ncols = 6\nheading = 'Sensor 2'",
    "preset = 'none'\nrows = 16\ncols = 32\nrequest = '52'",
];

fn layout(text: &str) -> Layout {
    Layout::new(&toml::from_str(text).unwrap()).unwrap()
}

fn layouts() -> impl Iterator<Item = (&'static str, Layout)> {
    LAYOUTS.into_iter().map(|text| (text, layout(text)))
}

/// The most bytes of a mark of these layouts.
const MARK_BYTES: usize = 5;

/// Press-like frames: mostly zeros, some counts up to 250.
fn frames(layout: &Layout, seed: u64, count: usize) -> Vec<RawFrame> {
    // Knuth's linear congruential generator.
    let mut state = seed;
    let mut next = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        state >> 33
    };
    let mut frame = || {
        let mut frame = RawFrame::zero(layout.array());
        for count in &mut frame.counts {
            if next() % 10 < 3 {
                *count = (next() % 251) as f32;
            }
        }
        frame
    };
    (0..count).map(|_| frame()).collect()
}

fn encode(layout: &Layout, frames: &[RawFrame]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for frame in frames {
        layout.encode(frame, &mut bytes);
    }
    bytes
}

/// The output of one decoder: frames and the number of damaged candidates. Its counts must add up.
fn decode<'a>(layout: &Layout, chunks: impl IntoIterator<Item = &'a [u8]>) -> (Vec<RawFrame>, u64) {
    decode_after_pauses(layout, [chunks])
}

/// The same with a pause after each of several parts.
fn decode_after_pauses<'a, C: IntoIterator<Item = &'a [u8]>>(
    layout: &Layout,
    parts: impl IntoIterator<Item = C>,
) -> (Vec<RawFrame>, u64) {
    let mut decoder = Decoder::new(layout.clone());
    let (mut whole, mut damaged, mut total) = (Vec::new(), 0, 0);
    let mut last_end = 0;
    let mut drain = |decoder: &mut Decoder| loop {
        let before = (decoder.pending().len(), decoder.skipped());
        match decoder.next_frame() {
            None => break,
            Some(Err(_)) => damaged += 1,
            Some(Ok(decoded)) => {
                let skipped = (decoder.skipped() - before.1) as usize;
                let frame_bytes = before.0 - decoder.pending().len() - skipped;
                assert!((1..=layout.most_pending_bytes()).contains(&frame_bytes));
                assert!(
                    decoded.end >= last_end + frame_bytes as u64,
                    "frames do not overlap"
                );
                last_end = decoded.end;
                whole.push((decoded.frame, frame_bytes));
            }
        }
    };
    for chunks in parts {
        for chunk in chunks {
            decoder.push(chunk);
            total += chunk.len();
            drain(&mut decoder);
        }
        decoder.settle();
        drain(&mut decoder);
    }
    let frame_bytes: usize = whole.iter().map(|&(_, bytes)| bytes).sum();
    assert_eq!(decoder.received(), total as u64);
    assert_eq!(
        total,
        frame_bytes + decoder.skipped() as usize + decoder.pending().len(),
        "bytes in = whole frames + skipped + pending"
    );
    assert!(
        decoder.pending().len() <= layout.most_pending_bytes(),
        "at most one frame and the mark after it are pending"
    );
    (whole.into_iter().map(|(frame, _)| frame).collect(), damaged)
}

#[test]
fn every_layout_gives_back_what_it_encodes_and_a_damaged_frame_costs_itself_alone() {
    // One byte is lost in the middle frame, at every place.
    for (preset, layout) in layouts() {
        let mut sent = frames(&layout, 5, 3);
        // The tail of jq-u16 ends with 0. If that 0 is lost and the next frame begins with 0, no
        // reader can tell which frame lost it.
        sent[2].counts[layout.array().place(0, 0)] = 1.0;
        let whole = encode(&layout, &sent);
        let found = decode(&layout, [whole.as_slice()]);
        assert_eq!(found, (sent.clone(), 0), "{preset:?}");
        // A frame without marks is found again after a pause alone.
        if preset.contains("request") {
            continue;
        }
        let first = encode(&layout, &sent[..1]).len();
        let middle = encode(&layout, &sent[1..2]).len();
        for lost in (0..middle).step_by(7) {
            let mut bytes = whole.clone();
            bytes.remove(first + lost);
            let (found, _) = decode(&layout, [bytes.as_slice()]);
            // The mark may be what makes the frame before it whole.
            let has_first = lost < MARK_BYTES || found.contains(&sent[0]);
            let has_both = has_first && found.contains(&sent[2]);
            assert!(has_both && found.len() <= 3, "{preset:?} byte {lost}");
        }
    }
}

#[test]
fn flipped_bits_are_caught_and_counted_where_there_is_a_checksum() {
    let layout = layout("preset = 'jx255n'");
    let sent = frames(&layout, 6, 3);
    let whole = encode(&layout, &sent);
    for bit in 0..790 * 8 {
        let mut bytes = whole.clone();
        bytes[790 + bit / 8] ^= 1 << (bit % 8);
        let (found, damaged) = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, [sent[0].clone(), sent[2].clone()], "bit {bit}");
        // A frame with a broken sync is not a candidate.
        assert_eq!(damaged, u64::from(bit >= 16), "bit {bit}");
    }
}

#[test]
fn a_header_in_the_data_of_jq_costs_no_frame_in_sync_and_none_after_damage_unless_another_follows()
{
    let layout = layout("preset = 'jq'");
    let mut sent = frames(&layout, 8, 6);
    let header = [0xAA_u8, 0x55, 0x03, 0x99].map(f32::from);
    sent[1].counts[300..304].copy_from_slice(&header);
    let whole = encode(&layout, &sent);
    assert_eq!(decode(&layout, [whole.as_slice()]), (sent.clone(), 0));
    for lost in (788 + 4..2 * 788).step_by(5) {
        let mut bytes = whole.clone();
        bytes.remove(lost);
        let (found, _) = decode(&layout, [bytes.as_slice()]);
        let expected: Vec<_> = [&sent[..1], &sent[2..]].concat();
        assert_eq!(found, expected, "byte {lost} lost");
    }
}

#[test]
fn after_a_restart_nothing_is_made_of_the_bytes_before() {
    for (preset, layout) in layouts() {
        let whole = encode(&layout, &frames(&layout, 12, 5));
        let mut bytes = whole.clone();
        bytes.remove(100);
        let found = |mut decoder: Decoder| {
            decoder.push(&bytes);
            decoder.settle();
            let items = std::iter::from_fn(|| decoder.next_frame());
            let items = items.map(|item| item.map(|decoded| decoded.frame));
            items.collect::<Vec<_>>()
        };
        let mut restarted = Decoder::new(layout.clone());
        restarted.push(&whole[..whole.len() / 3]);
        while restarted.next_frame().is_some() {}
        restarted.restart();
        assert!(restarted.pending().is_empty());
        assert_eq!(found(restarted), found(Decoder::new(layout)), "{preset:?}");
    }
}

/// The frames as text with a row on each line, and `end` after the last row.
fn in_rows(frames: &[RawFrame], end: &str) -> Vec<u8> {
    let mut text = String::new();
    for frame in frames {
        for row in frame.counts.chunks(frame.array.cols) {
            let row: Vec<String> = row.iter().map(f32::to_string).collect();
            text += &(row.join(" ") + "\n");
        }
        text += end;
    }
    text.into_bytes()
}

#[test]
fn every_part_of_a_frame_stands_where_it_should() {
    // Two rows of three cells: the sensor's first row is 1 2 3, and its second is 4 5 6.
    let mut frame = RawFrame::zero(Array { rows: 2, cols: 3 });
    let counts = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    frame.counts.copy_from_slice(&counts);
    for (text, expected) in [
        ("order = 'serpentine'", &[1, 2, 3, 6, 5, 4][..]),
        ("order = 'column-major'", &[1, 4, 2, 5, 3, 6]),
        ("length = 'u8'", &[6, 1, 2, 3, 4, 5, 6]),
        ("length = 'u16le'", &[6, 0, 1, 2, 3, 4, 5, 6]),
        ("length = 'u16be'", &[0, 6, 1, 2, 3, 4, 5, 6]),
        ("cell = 'u16be'", &[0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6]),
        // The checksum includes the sync: A5 + 21.
        ("checksum = 'sum8'", &[1, 2, 3, 4, 5, 6, 0xBA]),
        (
            "length = 'u8'\nheader_bytes = 1\nfooter_bytes = 1",
            &[6, 0, 1, 2, 3, 4, 5, 6, 0],
        ),
        // The checksum of these bytes by zlib.
        (
            "footer_bytes = 1\nchecksum = 'crc32'\nchecksum_over = 'cells'",
            &[1, 2, 3, 4, 5, 6, 0, 0x24, 0x77, 0xF6, 0x81],
        ),
        (
            "header_bytes = 2\nfooter_bytes = 1\nchecksum = 'sum8'\nchecksum_over = 'cells'\n\
             packets = { count = 2, number_at = 1, first = 7 }",
            &[0, 7, 1, 2, 3, 6, 0xA5, 0, 8, 4, 5, 6, 0, 15],
        ),
    ] {
        let layout = layout(&format!(
            "preset = 'jq'\nsync = 'A5'\nrows = 2\ncols = 3\n{text}"
        ));
        let bytes = encode(&layout, &[frame.clone()]);
        assert_eq!(bytes, [&[0xA5], expected].concat(), "{text}");
        let found = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, (vec![frame.clone()], 0), "{text}");
    }
    let wide = encode(&layout("preset = 'jx255n-u16'"), &[RawFrame::default()]);
    assert_eq!(wide[..4], [0xBB, 0xAA, 0x20, 0x06]);
}

#[test]
fn a_layout_that_cannot_work_is_refused_with_its_key() {
    // The keys of the layout, and what is said of them.
    let cases = "
        rows = 65 | rows: found 65, expected 1 to 64
        length = 'u8' | length: found 784 payload bytes, expected at most 255
        mask = 0x1FF | mask: found 511, expected 1 to 255
        preset = 'csv', mask = 0x1000000 | mask: found 16777216, expected 1 to 16777215
        preset = 'csv', tail = 'FF' | tail: found a value, expected none: frames of preset csv have no such part
        header_bytes = 8193 | header_bytes: found 8193, expected 0 to 8192
        preset = 'jx255n', heading = 'Frame' | heading: found a value, expected none: frames of preset jx255n have no such part
        preset = 'none', sync = 'AA', rows = 8, cols = 8, header_bytes = 8192, packets.count = 64 | header_bytes: found a frame of
        preset = 'jq-glove', sync = '', tail = 'AA' | packets: found no sync, or framing, expected sync
        preset = 'jq-glove', packets.count = 3 | packets.count: found 3, expected 1 to 256 that divides the 256 cells evenly
        packets.count = 2 | packets.number_at: found 0, expected a place
        header_bytes = 1, packets.count = 2, packets.step = 0 | packets.step: found 0, expected at least 1
        header_bytes = 1, packets.count = 2, packets.first = 255 | packets.first: found 255, and 256 for the last packet, expected at most 255
        preset = 'jq-tail', length = 'u16le' | length: found a length field without sync";
    for case in cases.trim().lines() {
        let (keys, expected) = case.trim().split_once(" | ").unwrap();
        let settings = toml::from_str(&keys.replace(", ", "\n")).unwrap();
        let error = Layout::new(&settings).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{keys}: {error}");
    }
    let error = toml::from_str::<Settings>("sync = 'B'").unwrap_err();
    assert!(error.to_string().contains("pairs of hex digits"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_in_any_chunks_never_panic_and_balance(
        seed in any::<u64>(),
        noise in proptest::collection::vec(any::<u8>(), 0..6000),
        damage in proptest::collection::vec((0.0..1.0_f64, 0_usize..40, proptest::collection::vec(any::<u8>(), 0..40)), 0..4),
        chunk in 1_usize..2000,
        index in 0..LAYOUTS.len(),
    ) {
        let layout = layout(LAYOUTS[index]);
        let mut bytes = encode(&layout, &frames(&layout, seed, 5));
        for (place, lost, added) in damage {
            let at = (place * bytes.len() as f64) as usize;
            let end = (at + lost).min(bytes.len());
            bytes.splice(at..end, added);
        }
        bytes.extend(noise);
        let whole = decode(&layout, [bytes.as_slice()]);
        prop_assert_eq!(decode(&layout, bytes.chunks(chunk)), whole);
    }

    #[test]
    fn with_a_crc32_any_damage_costs_its_frame_alone_and_makes_no_other(
        seed in any::<u64>(),
        place in 0.0..1.0_f64,
        lost in 0_usize..900,
        added in proptest::collection::vec(any::<u8>(), 0..900),
        text in proptest::sample::select(vec![
            "preset = 'jx255n'\nheader_bytes = 3\nfooter_bytes = 5\nchecksum = 'crc32'",
            "preset = 'm1616'\nchecksum = 'crc32-be'\nchecksum_over = 'cells'",
            "preset = 'jq-glove'\nchecksum = 'crc32'\ntail = '0D 0A'",
            "preset = 'jq-tail'\nheader_bytes = 2\nchecksum = 'crc32-be'",
        ]),
    ) {
        let layout = layout(text);
        let sent = frames(&layout, seed, 3);
        let frame_bytes = layout.max_frame_bytes();
        let mut bytes = encode(&layout, &sent);
        let at = frame_bytes + (place * frame_bytes as f64) as usize;
        bytes.splice(at..(at + lost).min(2 * frame_bytes), added);
        let (found, _) = decode(&layout, [bytes.as_slice()]);
        prop_assert!(found.first() == Some(&sent[0]) && found.last() == Some(&sent[2]));
        prop_assert!(found.len() == 2 || found == sent);
    }

    #[test]
    fn any_words_end_a_frame_in_rows_in_any_chunks(
        words in "[^\n0-9]{0,60}",
        noise in "[ 0-9a-z\n]{0,80}",
        seed in any::<u64>(),
        chunk in 1_usize..100,
    ) {
        let layout = layout("preset = 'csv'\nrows = 5\ncols = 7");
        let sent = frames(&layout, seed, 2);
        let mut bytes = in_rows(&sent[..1], &words);
        bytes.push(b'\n');
        bytes.extend(noise.as_bytes());
        bytes.push(b'\n');
        bytes.extend(in_rows(&sent[1..], "\n"));
        let found = decode(&layout, bytes.chunks(chunk));
        prop_assert_eq!(&found, &decode(&layout, [bytes.as_slice()]));
        prop_assert_eq!(found.0.last(), Some(&sent[1]));
        // The longest frame has room for these words.
        if words.len() <= 40 {
            prop_assert_eq!(found.0.first(), Some(&sent[0]));
        }
    }
}

#[test]
fn a_missing_packet_costs_its_frame_alone_and_counts_as_damage_once() {
    for text in [
        "preset = 'jq-glove'",
        "preset = 'jq-glove'\nfooter_bytes = 16\npackets = { count = 4 }\nchecksum = 'sum8'",
    ] {
        let layout = layout(text);
        let sent = frames(&layout, 13, 4);
        // One packet for each piece between two marks.
        let whole = encode(&layout, &sent);
        let marks: Vec<usize> = (0..whole.len())
            .filter(|&at| whole[at..].starts_with(&[0xAA, 0x55, 0x03, 0x99]))
            .collect();
        let of_frame = marks.len() / sent.len();
        for missing in of_frame..marks.len() - of_frame {
            let mut bytes = whole.clone();
            bytes.drain(marks[missing]..marks[missing + 1]);
            let mut expected = sent.clone();
            expected.remove(missing / of_frame);
            for chunk in [1, bytes.len()] {
                let found = decode(&layout, bytes.chunks(chunk));
                assert_eq!(found, (expected.clone(), 1), "{text}: packet {missing}");
            }
        }
        // Packets in a wrong order are no frame.
        let mut bytes = whole.clone();
        let length = marks[of_frame + 1] - marks[of_frame];
        bytes[marks[of_frame]..marks[of_frame + 2]].rotate_left(length);
        let (found, damaged) = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, [0, 2, 3].map(|at| sent[at].clone()), "{text}");
        assert!(damaged > 0, "{text}");
    }
}

#[test]
fn a_damaged_line_is_counted_and_costs_no_other() {
    let layout = layout("preset = 'csv'\nrows = 2\ncols = 3");
    for (damaged, count) in [
        ("1,2,3,4,5\n", 1),
        ("1,2,3,4,5,x\n", 1),
        ("1,2,3,45,6\n", 1),
        ("1,2,3,4,7e99,6\n", 1),
        // The LF is lost.
        ("1,2,3,4,5,6,", 1),
        ("1,2,3,4,5,6", 1),
        // So little of a line might be other words.
        ("1,2,3\n", 0),
    ] {
        let text = format!("7,7,7,7,7,7\n{damaged}8,8,8,8,8,8\n");
        for chunk in [1, 5, text.len()] {
            let (found, damaged) = decode(&layout, text.as_bytes().chunks(chunk));
            let counts = found.iter().map(|frame| frame.counts.iter().sum::<f32>());
            let counts: Vec<f32> = counts.collect();
            assert_eq!(counts.first(), Some(&42.0), "{text:?} by {chunk}");
            assert_eq!((counts.len(), damaged), (2, count), "{text:?} by {chunk}");
        }
    }
}

/// The frames and the damage of the only frame of a layout of 1x3 cells in `bytes`.
fn counts(text: &str, bytes: &[u8]) -> (Vec<Vec<f32>>, u64) {
    let layout = layout(&format!("rows = 1\ncols = 3\n{text}"));
    let (found, damaged) = decode(&layout, [bytes]);
    let counts = found.into_iter().map(|frame| frame.counts.into_vec());
    (counts.collect(), damaged)
}

#[test]
fn cells_are_numbers_of_any_kind_at_any_distance() {
    let floats: Vec<u8> = [1.5_f32, -2.25, 3e-3]
        .iter()
        .flat_map(|f| f.to_le_bytes())
        .collect();
    let whole: Vec<u8> = [1_i32, -70_000, 8_000_000]
        .iter()
        .flat_map(|n| n.to_be_bytes())
        .collect();
    for (text, cells, expected) in [
        ("cell = 'i8'", &[1, 0xFF, 0x80][..], [1.0, -1.0, -128.0]),
        (
            "cell = 'i8'\ninvert = true",
            &[1, 0xFF, 0x80],
            [-1.0, 1.0, 128.0],
        ),
        (
            "cell = 'i16le'",
            &[1, 0, 0xFF, 0xFF, 0, 0x80],
            [1.0, -1.0, -32768.0],
        ),
        (
            "cell = 'i16be'",
            &[0, 1, 0xFF, 0xFE, 0x7F, 0xFF],
            [1.0, -2.0, 32767.0],
        ),
        ("cell = 'i32be'", &whole, [1.0, -70_000.0, 8_000_000.0]),
        ("cell = 'f32le'", &floats, [1.5, -2.25, 3e-3]),
        // Fx, Fy and Fz of each taxel: Fz is read.
        (
            "header_bytes = 2\nstride_bytes = 3",
            &[0xFF, 0xFE, 7, 1, 2, 8, 3, 4, 9],
            [7.0, 8.0, 9.0],
        ),
        (
            "cell = 'u16le'\nmask = 0x0FFF",
            &[1, 0xF0, 2, 0x10, 3, 0],
            [1.0, 2.0, 3.0],
        ),
    ] {
        let text = format!("{text}\nsync = 'A5'\ntail = '5A'");
        let bytes = [&[0xA5], cells, &[0x5A]].concat();
        assert_eq!(
            counts(&text, &bytes),
            (vec![expected.to_vec()], 0),
            "{text}"
        );
    }
}

#[test]
fn a_float_that_is_no_number_is_damage() {
    for wrong in [f32::NAN, f32::INFINITY, -1e30] {
        let of = |floats: [f32; 3]| {
            let cells = floats.map(f32::to_le_bytes).concat();
            [&[0xA5, 0x5A], &cells[..], &[0x0D, 0x0A]].concat()
        };
        let bytes = [of([1.0; 3]), of([4.0, wrong, 6.0]), of([7.0; 3])].concat();
        let found = counts("sync = 'A5 5A'\ncell = 'f32le'\ntail = '0D 0A'", &bytes);
        assert_eq!(found, (vec![vec![1.0; 3], vec![7.0; 3]], 1), "{wrong}");
        // Also when none is right, and nothing shows where the first one begins.
        let cells = [wrong; 3].map(f32::to_le_bytes).concat();
        let tailed = [&cells[..], &[0x0D, 0x0A]].concat();
        let mut slip = Vec::new();
        slip_codec::SlipEncoder::new(false)
            .encode(&cells, &mut slip)
            .unwrap();
        for (keys, frame) in [("tail = '0D 0A'", tailed), ("framing = 'slip'", slip)] {
            let found = counts(&format!("{keys}\ncell = 'f32le'"), &frame.repeat(4));
            assert_eq!(found, (Vec::new(), 4), "{keys}: {wrong}");
        }
    }
}

#[test]
fn packed_frames_are_those_of_rfc_1055_and_of_the_paper_on_cobs() {
    let slip = [0xDB, 0xDC, 1, 0xDB, 0xDD, 0xC0];
    let cobs = [3, 0x11, 0x22, 2, 0x33, 0];
    for (framing, bytes, expected) in [
        ("slip", &slip, [192.0, 1.0, 219.0]),
        ("cobs", &cobs, [17.0, 34.0, 0.0]),
    ] {
        // The fourth byte of the second is that after the cells.
        let footer = usize::from(framing == "cobs");
        let text = format!("framing = '{framing}'\nfooter_bytes = {footer}");
        let found = |bytes: &[u8]| counts(&text, bytes);
        assert_eq!(found(bytes), (vec![expected.to_vec()], 0), "{framing}");
        // A frame that lost a byte, or has one too many, costs itself alone.
        for (more, rest) in [(&[][..], 3), (&[7], 2)] {
            let damaged = [&bytes[..], &bytes[..2], more, &bytes[rest..], bytes].concat();
            assert_eq!(
                found(&damaged),
                (vec![expected.to_vec(); 2], 1),
                "{framing}"
            );
        }
    }
}

#[test]
fn a_frame_without_marks_begins_after_a_pause_and_one_that_was_asked_for_at_once() {
    let found = |text: &str, parts: &[&[u8]]| {
        let layout = layout(&format!("preset = 'none'\nrows = 1\ncols = 3\n{text}"));
        let parts = parts.iter().map(|part| [*part]);
        let (found, damaged) = decode_after_pauses(&layout, parts);
        let firsts = found.iter().map(|frame| frame.counts[0]);
        (firsts.collect::<Vec<f32>>(), damaged)
    };
    let parts: [&[u8]; 4] = [&[9, 9], &[1, 2, 3], &[4, 5], &[6, 7, 8, 9, 10, 11]];
    assert_eq!(found("", &parts), (vec![1.0, 6.0, 9.0], 1));
    let asked = &parts[1..];
    assert_eq!(found("request = '52'", asked), (vec![1.0, 6.0, 9.0], 1));
    // A wrong checksum shows that frames were mixed up.
    let summed: [&[u8]; 3] = [&[1, 2, 3, 6], &[1, 2, 3, 7], &[1, 1, 1, 3]];
    assert_eq!(
        found("checksum = 'sum8'\nrequest = '52'", &summed),
        (vec![1.0, 1.0], 1)
    );
}

#[test]
fn text_has_any_separators_signs_decimals_and_words_beside_the_rows() {
    let layout = |more: &str| layout(&format!("preset = 'csv'\nrows = 2\ncols = 3\n{more}"));
    let banners = "Calibrating, 100 samples ...\r\n\n[]\ndone.\n";
    let texts = [
        "1.5,-2,3e2,.25,5.,+6\n",
        "1.5        -2\t\t\t\t   300    0.25            5 6\r\n",
        "frame:1.5\t-2\t300\t.25\t5\t6\n",
        "12:30:01.250; 1.5; -2; 300; .25; 5; 6;\n",
        "2026-11-26T12:30:01Z [[1.5, -2, 300], [.25, 5, 6]]\r\n",
        "123456,1.5,-2,300,.25,5,6\n",
        "R0 1.5 -2 300 R1 0.25 5 6 kPa\n",
        "R0 1.5 -2 300\nR1 0.25 5 6\n\n",
        "{\n  \"row0\": [1.5, -2, 3e2],\n  \"row1\": [0.25, 5, 6]\n}\n",
        "0: 1.5 -2 300 mV\n1: 0.25 5 6 mV\n--\n",
        "| 1.5 | -2 300 |\n| 1.5 -2 300 |\n| 0.25 5 6 |\n+----+\n",
        "1.5 | -2 | 300\n0.25 | 5 | 6\n\n",
    ];
    let all = texts.join(banners);
    for chunk in [1, 7, all.len()] {
        let (found, _) = decode(&layout(""), all.as_bytes().chunks(chunk));
        assert_eq!(found.len(), texts.len(), "by {chunk}");
        for (text, frame) in texts.iter().zip(found) {
            let expected = [1.5, -2.0, 3e2, 0.25, 5.0, 6.0];
            assert_eq!(frame.counts[..], expected, "{text:?} by {chunk}");
        }
    }
    // One array of two.
    let dual =
        "Sensor 1\n1 2 3\n4 5 6\nSensor 2\n7 8 9\n1 1 1\nSensor 11\n2 3 4\n5 6 7\nPad 12\n8 1 2\n3 4 5\nEND\n"
            .repeat(3);
    let firsts = [
        ("Sensor 1", 1.0),
        ("Sensor 2", 7.0),
        ("Sensor 11", 2.0),
        ("Pad", 8.0),
    ];
    for (heading, first) in firsts {
        let layout = layout(&format!("heading = '{heading}'"));
        for chunk in [1, dual.len()] {
            let (found, damaged) = decode(&layout, dual.as_bytes().chunks(chunk));
            let firsts: Vec<f32> = found.iter().map(|frame| frame.counts[0]).collect();
            assert_eq!(
                (firsts, damaged),
                (vec![first; 3], 0),
                "{heading} by {chunk}"
            );
        }
    }
}

#[test]
fn what_is_wrong_with_a_line_is_said() {
    let layout = layout("preset = 'csv'\nrows = 2\ncols = 3");
    for (text, expected) in [
        (
            "1,2,3,4,5\n",
            "a line has 5 numbers, expected 3 for a row or 6 for a frame",
        ),
        ("1,2,3,0x4,5,6,7\n", "a line has \"0x4\" among its numbers"),
        ("1N 2N 3N\n", "a line has \"1N\" among its numbers"),
        ("1 2\n3 4\n\n", "a line has 2 numbers, expected 3 for a row"),
        (
            "1 2 3\n4 5 6\n",
            "4 lines with numbers come before one without, expected 2",
        ),
    ] {
        let mut decoder = Decoder::new(layout.clone());
        decoder.push(text.repeat(8).as_bytes());
        assert!(decoder.next_frame().is_none(), "{text:?}");
        let problem = decoder.problem().unwrap();
        assert!(problem.contains(expected), "{text:?}: {problem}");
    }
    let mut decoder = Decoder::new(Layout::new(&Settings::default()).unwrap());
    decoder.push(&[&[0xFF, 0xFB, 0x2C][..], &[0; 4000]].concat());
    while decoder.next_frame().is_some() {}
    assert!(decoder.problem().unwrap().contains("raw mode"));
}

/// The time that this thread has computed for a search through `bytes`.
fn time_for(layout: &Layout, bytes: &[u8]) -> std::time::Duration {
    let now = || {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        std::time::Duration::try_from(time).unwrap()
    };
    let begin = now();
    let mut decoder = Decoder::new(layout.clone());
    decoder.push(bytes);
    while decoder.next_frame().is_some() {}
    now() - begin
}

#[test]
fn a_search_takes_a_time_in_proportion_to_the_bytes() {
    for (text, part) in [
        (
            "sync = 'AA AA'\nrows = 64\ncols = 64\nheader_bytes = 8192\nchecksum = 'crc16-modbus'",
            &[0xAA][..],
        ),
        (
            "tail = '00'\nrows = 64\ncols = 64\nheader_bytes = 8192\nchecksum = 'sum8'",
            &[0],
        ),
        (
            "preset = 'csv'\nrows = 64\ncols = 64",
            b"1 2 3 4 5 6 7 8 9\n",
        ),
        (
            "preset = 'csv'\nrows = 64\ncols = 64\nheading = 'x'",
            b"x 1\n",
        ),
        ("framing = 'slip'\nrows = 64\ncols = 64", &[1, 2, 3, 0xC0]),
        ("framing = 'cobs'\nrows = 64\ncols = 64", &[1]),
    ] {
        let layout = layout(text);
        let bytes = |count: usize| part.repeat(count.div_ceil(part.len()));
        let least = |count: usize| (0..3).map(|_| time_for(&layout, &bytes(count))).min();
        let (one, eight) = (least(64 * 1024).unwrap(), least(8 * 64 * 1024).unwrap());
        // Eight times as many bytes would take 64 times as long where the time grows with the square.
        assert!(eight < 24 * one, "{text}: {one:?}, {eight:?}");
        assert!(one.as_millis() < 200, "{text}: {one:?}");
    }
}
