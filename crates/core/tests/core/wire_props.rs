//! Any chunking gives the same frames, noise never panics, and damage loses only the damaged frame.

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Decoded, Decoder, Layout, Preset, Settings};
use proptest::prelude::*;

/// A layout of each kind: all presets, and layouts that override them.
const LAYOUTS: [&str; 19] = [
    "preset = 'jx255n'",
    "preset = 'jx255n-u16'",
    "preset = 'jq'",
    "preset = 'jq-tail'",
    "preset = 'jq-u16'",
    "preset = 'ff-tail'",
    "preset = 'ascii'",
    "preset = 'zero-run'",
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
    "preset = 'ff-tail'\nrows = 10\ncols = 10\nchecksum = 'sum8'\ntail = '0A'",
];

fn layout(text: &str) -> Layout {
    Layout::new(&toml::from_str(text).unwrap()).unwrap()
}

fn layouts() -> impl Iterator<Item = (&'static str, Layout)> {
    LAYOUTS.into_iter().map(|text| (text, layout(text)))
}

/// The bytes before the cells of a frame that only the next frame's mark makes whole. If they
/// break, the frame before is lost too.
fn mark_bytes(text: &str) -> usize {
    match text {
        "preset = 'jq'" | "preset = 'jq-glove'" => 4,
        text if text.starts_with("preset = 'flexitac'") => 2,
        "preset = 'm1616'" => 3,
        text if text.contains("count = 3") => 5,
        _ => 0,
    }
}

/// SplitMix64 (Steele, Lea, Flood 2014).
struct Stream(u64);

impl Stream {
    fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
}

/// A press-like frame: mostly zeros, some counts up to 250.
fn frame(layout: &Layout, stream: &mut Stream) -> RawFrame {
    let mut frame = RawFrame::zero(layout.array());
    for count in &mut frame.counts {
        if stream.next_u64() % 10 < 3 {
            *count = (stream.next_u64() % 251) as u16;
        }
    }
    frame
}

fn frames(layout: &Layout, seed: u64, count: usize) -> Vec<RawFrame> {
    let mut stream = Stream(seed);
    (0..count).map(|_| frame(layout, &mut stream)).collect()
}

fn noise(seed: u64, bytes: usize) -> Vec<u8> {
    let mut stream = Stream(!seed);
    (0..bytes).map(|_| stream.next_u64() as u8).collect()
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
    let mut decoder = Decoder::new(layout.clone());
    let (mut whole, mut damaged, mut total) = (Vec::new(), 0, 0);
    let mut last_end = 0;
    let mut drain = |decoder: &mut Decoder| loop {
        let before = (decoder.pending(), decoder.skipped());
        match decoder.next_frame() {
            None => break,
            Some(Err(_)) => damaged += 1,
            Some(Ok(decoded)) => {
                let skipped = (decoder.skipped() - before.1) as usize;
                let frame_bytes = before.0 - decoder.pending() - skipped;
                assert!((1..=layout.max_frame_bytes()).contains(&frame_bytes));
                assert!(
                    decoded.end >= last_end + frame_bytes as u64,
                    "frames do not overlap"
                );
                last_end = decoded.end;
                whole.push((decoded.frame, frame_bytes));
            }
        }
    };
    for chunk in chunks {
        decoder.push(chunk);
        total += chunk.len();
        drain(&mut decoder);
    }
    decoder.settle();
    drain(&mut decoder);
    let frame_bytes: usize = whole.iter().map(|&(_, bytes)| bytes).sum();
    assert_eq!(decoder.received(), total as u64);
    assert_eq!(
        total,
        frame_bytes + decoder.skipped() as usize + decoder.pending(),
        "bytes in = whole frames + skipped + pending"
    );
    assert!(
        decoder.pending() <= 2 * layout.max_frame_bytes(),
        "little is ever pending"
    );
    (whole.into_iter().map(|(frame, _)| frame).collect(), damaged)
}

#[test]
fn every_layout_gives_back_what_it_encodes() {
    for (preset, layout) in layouts() {
        let sent = frames(&layout, 1, 5);
        let (found, damaged) = decode(&layout, [encode(&layout, &sent).as_slice()]);
        assert_eq!(found, sent, "{preset:?}");
        assert_eq!(damaged, 0, "{preset:?}");
    }
}

#[test]
fn jx255n_is_790_bytes_and_its_bytes_are_frozen() {
    let layout = layout("preset = 'jx255n'");
    let mut raw = RawFrame::default();
    raw.counts[0] = 1;
    raw.counts[783] = 255;
    let bytes = encode(&layout, &[raw.clone()]);
    assert_eq!(bytes.len(), 790);
    assert_eq!(bytes[..5], [0xBB, 0xAA, 0x10, 0x03, 0x01]);
    // This is CRC-16/MODBUS over the 788 bytes before it, by crcmod's "modbus".
    let crc = hardnessd_core::wire::Checksum::Crc16Modbus.of(&bytes[..788]);
    assert_eq!(bytes[788..], crc.to_le_bytes()[..2]);
    let u16_layout = Layout::new(&Settings {
        preset: Preset::Jx255nU16,
        ..Settings::default()
    });
    assert_eq!(
        encode(&u16_layout.unwrap(), &[raw])[..4],
        [0xBB, 0xAA, 0x20, 0x06]
    );
}

#[test]
fn ten_megabytes_of_noise_around_100_frames_lose_none() {
    let layout = layout("preset = 'jx255n'");
    let sent = frames(&layout, 4, 100);
    let mut bytes = Vec::new();
    for (index, frame) in sent.iter().enumerate() {
        bytes.extend(noise(index as u64, 100_000));
        layout.encode(frame, &mut bytes);
    }
    bytes.extend(noise(1000, 100_000));
    let (found, _) = decode(&layout, bytes.chunks(4096));
    assert_eq!(found, sent);
}

#[test]
fn a_damaged_frame_costs_itself_alone() {
    // One byte is lost in the middle frame, at every place.
    for (preset, layout) in layouts() {
        let mut sent = frames(&layout, 5, 3);
        // The tail of jq-u16 ends with 0. If that 0 is lost and the next frame begins with 0, no
        // reader can tell which frame lost it.
        sent[2].counts[layout.array().place(0, 0)] = 1;
        let whole = encode(&layout, &sent);
        let first = encode(&layout, &sent[..1]).len();
        let middle = encode(&layout, &sent[1..2]).len();
        let header = mark_bytes(preset);
        for lost in (header..middle).step_by(7) {
            let mut bytes = whole.clone();
            bytes.remove(first + lost);
            let (found, _) = decode(&layout, [bytes.as_slice()]);
            assert!(
                found.contains(&sent[0]),
                "{preset:?} byte {lost}: frame before"
            );
            assert!(
                found.contains(&sent[2]),
                "{preset:?} byte {lost}: frame after"
            );
            assert!(found.len() <= 3, "{preset:?} byte {lost}");
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
fn a_frame_that_starts_inside_a_rejected_one_is_found() {
    let layout = layout("preset = 'jx255n'");
    let sent = frames(&layout, 7, 2);
    let whole = encode(&layout, &sent);
    for cut in 4..790 {
        // The first frame breaks off after `cut` bytes and the second follows at once.
        let bytes = [&whole[..cut], &whole[790..]].concat();
        let (found, damaged) = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, sent[1..], "cut at {cut}");
        assert_eq!(damaged, 1, "cut at {cut}");
    }
}

/// A frame whose counts hold a header of jq from `first` on.
fn with_header_inside(mut raw: RawFrame, first: usize) -> RawFrame {
    raw.counts[first..first + 4].copy_from_slice(&[0xAA, 0x55, 0x03, 0x99]);
    raw
}

#[test]
fn jq_is_not_misled_by_its_header_in_the_data() {
    let layout = layout("preset = 'jq'");
    let held = with_header_inside(frames(&layout, 8, 1).remove(0), 300);
    let sent = vec![held; 6];
    let whole = encode(&layout, &sent);
    assert_eq!(decode(&layout, [whole.as_slice()]), (sent.clone(), 0));
    for lost in (788 + 4..2 * 788).step_by(5) {
        let mut bytes = whole.clone();
        bytes.remove(lost);
        let (found, _) = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, sent[1..], "byte {lost} lost");
    }
}

#[test]
fn after_a_restart_nothing_is_made_of_the_bytes_before() {
    for (preset, layout) in layouts() {
        // The data contains a header of jq. The place in the stream decides which header begins a
        // frame.
        let held = frames(&layout, 12, 1).remove(0);
        let middle = held.counts.len() / 3;
        let held = with_header_inside(held, middle);
        let whole = encode(&layout, &vec![held; 5]);
        let mut bytes = whole.clone();
        bytes.remove(100);
        let found = |decoder: &mut Decoder| {
            decoder.push(&bytes);
            decoder.settle();
            let items = std::iter::from_fn(|| decoder.next_frame());
            items
                .map(|item| item.map(|decoded| decoded.frame))
                .collect::<Vec<_>>()
        };
        let expected = found(&mut Decoder::new(layout.clone()));
        let frame = whole.len() / 5;
        for before in [frame * 4 / 7, frame + 10, 2 * frame + 20] {
            let mut decoder = Decoder::new(layout.clone());
            decoder.push(&whole[..before]);
            while decoder.next_frame().is_some() {}
            decoder.restart();
            assert_eq!(decoder.pending(), 0);
            assert_eq!(
                found(&mut decoder),
                expected,
                "{preset:?}, {before} bytes before"
            );
        }
    }
}

#[test]
fn jq_waits_for_no_header_that_is_farther_from_its_phase() {
    let layout = layout("preset = 'jq'");
    let held = with_header_inside(frames(&layout, 8, 1).remove(0), 300);
    let mut bytes = encode(&layout, &vec![held; 4]);
    // The lost byte is after the header in the second frame's data, so no header follows that one.
    bytes.remove(788 + 600);
    let mut decoder = Decoder::new(layout);
    let mut whole = Vec::new();
    for (at, byte) in bytes.iter().enumerate() {
        decoder.push(&[*byte]);
        while let Some(item) = decoder.next_frame() {
            if item.is_ok() {
                whole.push(at + 1);
            }
        }
        assert!(
            decoder.pending() < 788 + 4,
            "{} bytes held",
            decoder.pending()
        );
    }
    // The first and the third frame are found as soon as the header after each is complete.
    assert_eq!(whole, [788 + 4, 3 * 788 - 1 + 4]);
}

#[test]
fn of_two_headers_as_near_to_its_phase_jq_takes_the_earlier() {
    let layout = layout("preset = 'jq'");
    let held = with_header_inside(frames(&layout, 8, 1).remove(0), 300);
    let sent = vec![held; 5];
    let mut bytes = encode(&layout, &sent);
    // Remove half as many bytes as are before the header in the data. The next frame then begins as
    // far before the phase as the header in its data is after it. Another header follows either of
    // them.
    bytes.drain(788 + 400..788 + 400 + (4 + 300) / 2);
    assert_eq!(decode(&layout, [bytes.as_slice()]).0, sent[1..]);
}

#[test]
fn a_pause_makes_the_last_jq_frame_whole() {
    let layout = layout("preset = 'jq'");
    let bytes = encode(&layout, &frames(&layout, 9, 1));
    let mut decoder = Decoder::new(layout);
    decoder.push(&bytes);
    assert_eq!(
        decoder.next_frame(),
        None,
        "a header may yet fail to follow"
    );
    decoder.settle();
    assert!(matches!(decoder.next_frame(), Some(Ok(_))));
    assert_eq!(decoder.pending(), 0);
}

#[test]
fn long_noise_counts_alike_in_any_chunks() {
    let digits = [b"7 ".repeat(9000), b"\n\n".to_vec()].concat();
    let pairs = [[0x00, 0xFE].repeat(2500), vec![0xFF]].concat();
    for (preset, noise) in [("preset = 'ascii'", digits), ("preset = 'zero-run'", pairs)] {
        let layout = layout(preset);
        let sent = frames(&layout, 10, 3);
        // Before any frame, noise cannot be told from a frame whose beginning was missed. After a
        // frame, noise is damage.
        let first = encode(&layout, &sent[..1]);
        let others = encode(&layout, &sent[1..]);
        let bytes = [&noise, first.as_slice(), &noise, &others].concat();
        let expected = decode(&layout, [bytes.as_slice()]);
        assert_eq!(expected, (sent, 1), "{preset:?}");
        for size in [1, 100, 3000, 10_000] {
            let found = decode(&layout, bytes.chunks(size));
            assert_eq!(found, expected, "{preset:?} by {size}");
        }
        let mut decoder = Decoder::new(layout.clone());
        decoder.push(&noise[..noise.len() - 2]);
        assert_eq!(decoder.next_frame(), None);
        assert_eq!(decoder.pending(), layout.max_frame_bytes(), "{preset:?}");
    }
}

#[test]
fn lines_of_noise_before_the_first_ascii_frame_are_no_damage_in_any_chunks() {
    let text = "preset = 'ascii'\nrows = 2\ncols = 1";
    let layout = Layout::new(&toml::from_str(text).unwrap()).unwrap();
    // The bytes are longer than a frame, so the decoder drops the first lines in the middle of a
    // line.
    let bytes = [b"x 1\n".repeat(9), b"\n7\n8\n\n".to_vec()].concat();
    let expected = decode(&layout, [bytes.as_slice()]);
    assert_eq!((expected.0.len(), expected.1), (1, 0));
    for size in 1..bytes.len() {
        assert_eq!(decode(&layout, bytes.chunks(size)), expected, "by {size}");
    }
    // The rest of a cut number is not a number.
    let bytes = [b"7".as_slice(), &[b'0'; 30], b"1\n8\n\n"].concat();
    for size in 1..=bytes.len() {
        assert_eq!(decode(&layout, bytes.chunks(size)).0, [], "by {size}");
    }
}

#[test]
fn what_stands_right_before_an_ascii_frame_costs_it_nothing() {
    let layout = layout("preset = 'ascii'");
    let sent = frames(&layout, 11, 2);
    let [first, second] = [0, 1].map(|index| encode(&layout, &sent[index..=index]));
    let after_space = |at: usize| at + first[at..].iter().position(|&b| b == b' ').unwrap() + 1;
    for noise in [
        b"abc".as_slice(),
        b"\xFE\xFD",
        b"noise, 3 x",
        b"5x",
        b"12\xFF7-",
        &first[..after_space(300)],
        &first[..after_space(1500)],
    ] {
        for before in [&[][..], &first] {
            let bytes = [before, noise, &second].concat();
            for size in [1, 7, bytes.len()] {
                let (found, _) = decode(&layout, bytes.chunks(size));
                assert_eq!(found.last(), Some(&sent[1]), "{noise:?} by {size}");
                assert_eq!(found.len(), 1 + before.len().min(1), "{noise:?} by {size}");
            }
        }
    }
}

#[test]
fn ascii_reads_any_separator_and_line_end() {
    let layout = Layout::new(&Settings {
        preset: Preset::Ascii,
        rows: Some(2),
        cols: Some(3),
        ..Settings::default()
    })
    .unwrap();
    let text = "9 9\n\n1,2\t3\r\n 4  5,6 \r\n\r\n\nnoise\n1 2 3\n4 5 6\n\n1 2\n4 5 6\n\n";
    let mut decoder = Decoder::new(layout.clone());
    decoder.push(text.as_bytes());
    let mut found = Vec::new();
    let mut damaged = 0;
    while let Some(item) = decoder.next_frame() {
        match item {
            Ok(decoded) => found.push(decoded.frame),
            Err(_) => damaged += 1,
        }
    }
    assert_eq!(found.len(), 2);
    assert_eq!(damaged, 1, "the frame with a short row");
    for frame in found {
        assert_eq!(frame.array, layout.array());
        assert_eq!(frame.counts[..], [1, 2, 3, 4, 5, 6]);
    }
}

#[test]
fn words_between_ascii_frames_end_them_as_a_blank_line_does() {
    let layout = layout("preset = 'ascii'\nrows = 5\ncols = 7");
    let sent = frames(&layout, 17, 4);
    for banner in [
        "=== frame ===\n",
        "---\r\n",
        "[ ]\n",
        "--- end ---\n\n--- frame ---\n",
    ] {
        let mut bytes = banner.as_bytes().to_vec();
        for frame in &sent {
            layout.encode(frame, &mut bytes);
            assert_eq!(bytes.pop(), Some(b'\n'), "the blank line");
            bytes.extend(banner.as_bytes());
        }
        for size in [1, 7, bytes.len()] {
            let found = decode(&layout, bytes.chunks(size));
            assert_eq!(found, (sent.clone(), 0), "{banner:?} by {size}");
        }
    }
}

#[test]
fn zero_run_packs_runs_across_254_zeros() {
    let layout = layout("preset = 'zero-run'");
    let mut raw = RawFrame::default();
    raw.counts[600] = 7;
    let bytes = encode(&layout, &[raw.clone()]);
    assert_eq!(bytes, [0, 254, 0, 254, 0, 92, 7, 0, 183, 0xFF]);
    assert_eq!(decode(&layout, [bytes.as_slice()]), (vec![raw], 0));
}

#[test]
fn an_empty_zero_run_is_noise_and_an_end_alone_no_damage() {
    let text = "preset = 'zero-run'\nrows = 1\ncols = 2";
    let mut decoder = Decoder::new(Layout::new(&toml::from_str(text).unwrap()).unwrap());
    decoder.push(&[5, 6, 0xFF, 0xFF, 0, 0, 5, 6, 0xFF]);
    let found: Vec<_> = std::iter::from_fn(|| decoder.next_frame()).collect();
    assert!(matches!(found[..], [Ok(_), Ok(_)]), "{found:?}");
    assert_eq!(decoder.skipped(), 3);
}

#[test]
fn cells_masks_orders_and_small_arrays_land_in_place() {
    let text = r#"
        preset = "jx255n"
        sync = "A5"
        tail = "0d 0a"
        length = "u8"
        cell = "u16be"
        mask = 0x0FFF
        invert = true
        checksum = "crc16-ccitt"
        rows = 2
        cols = 3
        order = "serpentine"
    "#;
    let layout = Layout::new(&toml::from_str(text).unwrap()).unwrap();
    let mut body = vec![0xA5, 12];
    for cell in [0xFFFE_u16, 0x0FFD, 0x0FFC, 0x0FFB, 0x0FFA, 0x0FF9] {
        body.extend(cell.to_be_bytes());
    }
    let crc = hardnessd_core::wire::Checksum::Crc16Ccitt.of(&body);
    body.extend(&crc.to_le_bytes()[..2]);
    body.extend([0x0D, 0x0A]);
    let (found, damaged) = decode(&layout, [body.as_slice()]);
    assert_eq!((found.len(), damaged), (1, 0));
    // The second row comes from its end.
    assert_eq!(found[0].counts[..], [1, 2, 3, 6, 5, 4]);
    let mut again = Vec::new();
    layout.encode(&found[0], &mut again);
    // The mask hides the top bits of the first cell, so only that byte differs.
    assert_eq!(again[3..14], body[3..14]);
}

#[test]
fn every_part_of_a_frame_stands_where_it_should() {
    // Two rows of three cells: the sensor's first row is 1 2 3, and its second is 4 5 6.
    let mut frame = RawFrame::zero(Array { rows: 2, cols: 3 });
    frame.counts.copy_from_slice(&[1, 2, 3, 4, 5, 6]);
    for (text, expected) in [
        ("", &[1, 2, 3, 4, 5, 6][..]),
        ("order = 'serpentine'", &[1, 2, 3, 6, 5, 4]),
        ("order = 'column-major'", &[1, 4, 2, 5, 3, 6]),
        ("length = 'u8'", &[6, 1, 2, 3, 4, 5, 6]),
        ("length = 'u16le'", &[6, 0, 1, 2, 3, 4, 5, 6]),
        ("length = 'u16be'", &[0, 6, 1, 2, 3, 4, 5, 6]),
        ("cell = 'u16le'", &[1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0]),
        ("cell = 'u16be'", &[0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6]),
        // The checksum includes the sync: A5 + 21, and A5 ^ 7.
        ("checksum = 'sum8'", &[1, 2, 3, 4, 5, 6, 0xBA]),
        ("checksum = 'xor8'", &[1, 2, 3, 4, 5, 6, 0xA2]),
        ("header_bytes = 2", &[0, 0, 1, 2, 3, 4, 5, 6]),
        ("footer_bytes = 2", &[1, 2, 3, 4, 5, 6, 0, 0]),
        (
            "length = 'u8'\nheader_bytes = 1\nfooter_bytes = 1",
            &[6, 0, 1, 2, 3, 4, 5, 6, 0],
        ),
        // The checksums of these bytes by zlib, by binascii.crc_hqx and by the Modbus specification.
        (
            "checksum = 'crc32'",
            &[1, 2, 3, 4, 5, 6, 0x30, 0xF5, 0xCB, 0xB8],
        ),
        (
            "checksum = 'crc32-be'",
            &[1, 2, 3, 4, 5, 6, 0xB8, 0xCB, 0xF5, 0x30],
        ),
        ("checksum = 'crc16-ccitt'", &[1, 2, 3, 4, 5, 6, 0x6A, 0x94]),
        (
            "checksum = 'crc16-ccitt-be'",
            &[1, 2, 3, 4, 5, 6, 0x94, 0x6A],
        ),
        (
            "checksum = 'crc16-modbus-be'",
            &[1, 2, 3, 4, 5, 6, 0xCC, 0x54],
        ),
        (
            "footer_bytes = 1\nchecksum = 'crc32'",
            &[1, 2, 3, 4, 5, 6, 0, 0xD4, 0x14, 0x63, 0xF4],
        ),
        (
            "footer_bytes = 1\nchecksum = 'crc32'\nchecksum_over = 'cells'",
            &[1, 2, 3, 4, 5, 6, 0, 0x24, 0x77, 0xF6, 0x81],
        ),
        (
            "header_bytes = 1\npackets = { count = 2 }",
            &[1, 1, 2, 3, 0xA5, 2, 4, 5, 6],
        ),
        (
            "header_bytes = 2\nfooter_bytes = [0, 1]\nchecksum = 'sum8'\nchecksum_over = 'cells'\n\
             packets = { count = 2, number_at = 1, first = 7 }",
            &[0, 7, 1, 2, 3, 6, 0xA5, 0, 8, 4, 5, 6, 0, 15],
        ),
    ] {
        let text = format!("preset = 'jq'\nsync = 'A5'\nrows = 2\ncols = 3\n{text}");
        let layout = Layout::new(&toml::from_str(&text).unwrap()).unwrap();
        let bytes = encode(&layout, &[frame.clone()]);
        assert_eq!(bytes, [&[0xA5], expected].concat(), "{text}");
        assert_eq!(
            decode(&layout, [bytes.as_slice()]),
            (vec![frame.clone()], 0),
            "{text}"
        );
    }
}

#[test]
fn a_cell_that_cannot_be_sent_is_neither_sent_nor_full_scale() {
    // 255 is the mark of both presets. So cells go up to 254, even if the mask is written out.
    for preset in ["ff-tail", "zero-run"] {
        for (rest, full_scale, sent, read) in [
            ("", 254, 255, 254),
            ("mask = 255", 254, 255, 254),
            ("mask = 0x7F", 127, 255, 127),
            // A cell counts down from 255 here, and 0 has to be sent as 1.
            ("invert = true", 255, 0, 1),
            ("invert = true", 255, 255, 255),
        ] {
            let text = format!("preset = '{preset}'\n{rest}");
            let layout = Layout::new(&toml::from_str(&text).unwrap()).unwrap();
            assert_eq!(layout.full_scale(), Some(full_scale), "{text}");
            let mut frame = RawFrame::default();
            frame.counts.fill(sent);
            let mut bytes = Vec::new();
            for _ in 0..2 {
                layout.encode(&frame, &mut bytes);
            }
            let mut decoder = Decoder::new(layout);
            decoder.push(&bytes);
            decoder.settle();
            let mut whole = 0;
            while let Some(Ok(Decoded { frame, .. })) = decoder.next_frame() {
                assert!(frame.counts.iter().all(|&count| count == read), "{text}");
                whole += 1;
            }
            assert_eq!(whole, 2, "{text}");
        }
    }
}

#[test]
fn a_layout_that_cannot_work_is_refused_with_its_key() {
    for (text, expected) in [
        (
            "preset = 'jq'\nsync = ''",
            "sync: found neither sync nor tail",
        ),
        ("rows = 65", "rows: found 65, expected 1 to 64"),
        (
            "length = 'u8'",
            "length: found 784 payload bytes, expected at most 255",
        ),
        ("mask = 0x1FF", "mask: found 511, expected 1 to 255"),
        ("mask = 0", "mask: found 0, expected 1 to 255"),
        (
            "preset = 'zero-run'\ntail = 'FF'",
            "tail: found a value, expected none: frames of preset zero-run have no such part",
        ),
        (
            "preset = 'csv'\nchecksum_over = 'cells'",
            "checksum_over: found a value, expected none: frames of preset csv",
        ),
        (
            "header_bytes = 8193",
            "header_bytes: found 8193 bytes, expected 0 to 8192",
        ),
        (
            "preset = 'jq-glove'\nfooter_bytes = [1]",
            "footer_bytes: found 1 numbers, expected one for each packet (2)",
        ),
        (
            "preset = 'jq-glove'\nsync = ''\ntail = 'AA'",
            "packets: found no sync",
        ),
        (
            "preset = 'jq-glove'\npackets = { count = 3 }",
            "packets.count: found 3, expected 1 to 255 that divides the 256 cells evenly",
        ),
        (
            "header_bytes = 1\npackets = { count = 0 }",
            "packets.count: found 0",
        ),
        (
            "packets = { count = 2 }",
            "packets.number_at: found 0, expected a byte of the header (header_bytes: 0)",
        ),
        (
            "header_bytes = 1\npackets = { count = 2, first = 255 }",
            "packets.first: found 255, expected at most 254",
        ),
        (
            "preset = 'jq-tail'\nlength = 'u16le'",
            "length: found a length field without sync",
        ),
    ] {
        let error = Layout::new(&toml::from_str(text).unwrap())
            .unwrap_err()
            .to_string();
        assert!(error.starts_with(expected), "{text}: {error}");
    }
    let error = toml::from_str::<Settings>("sync = 'B'")
        .unwrap_err()
        .to_string();
    assert!(error.contains("pairs of hex digits"), "{error}");
    let error = toml::from_str::<Settings>("footer_bytes = -1")
        .unwrap_err()
        .to_string();
    assert!(error.contains("expected a number of bytes"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_in_any_chunks_never_panic_and_balance(
        bytes in proptest::collection::vec(any::<u8>(), 0..6000),
        chunk in 1_usize..2000,
        index in 0..LAYOUTS.len(),
    ) {
        let layout = layout(LAYOUTS[index]);
        let whole = decode(&layout, [bytes.as_slice()]);
        prop_assert_eq!(decode(&layout, bytes.chunks(chunk)), whole);
    }

    #[test]
    fn damaged_streams_in_any_chunks_balance(
        seed in any::<u64>(),
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
    fn a_line_survives_any_words_before_it(
        noise in "[^\n0-9]{0,200}",
        seed in any::<u64>(),
        chunk in 1_usize..100,
    ) {
        let layout = layout("preset = 'csv'\nrows = 5\ncols = 7");
        let sent = frames(&layout, seed, 2);
        let mut bytes = encode(&layout, &sent[..1]);
        bytes.extend(noise.as_bytes());
        layout.encode(&sent[1], &mut bytes);
        prop_assert_eq!(decode(&layout, bytes.chunks(chunk)), (sent, 0));
    }

    #[test]
    fn any_words_end_an_ascii_frame_in_any_chunks(
        words in "[^\n0-9]{0,60}",
        noise in "[ 0-9a-z\n]{0,80}",
        seed in any::<u64>(),
        chunk in 1_usize..100,
    ) {
        let layout = layout("preset = 'ascii'\nrows = 5\ncols = 7");
        let sent = frames(&layout, seed, 2);
        let mut bytes = encode(&layout, &sent[..1]);
        bytes.pop();
        bytes.extend(words.as_bytes());
        bytes.push(b'\n');
        bytes.extend(noise.as_bytes());
        bytes.push(b'\n');
        layout.encode(&sent[1], &mut bytes);
        let found = decode(&layout, bytes.chunks(chunk));
        prop_assert_eq!(&found, &decode(&layout, [bytes.as_slice()]));
        prop_assert_eq!(found.0.last(), Some(&sent[1]));
        // The longest frame has room for these words.
        if words.len() <= 40 {
            prop_assert_eq!(found.0.first(), Some(&sent[0]));
        }
    }

    #[test]
    fn an_ascii_frame_survives_any_noise_before_it_that_does_not_end_with_a_digit(
        noise in proptest::collection::vec(any::<u8>(), 0..40),
        last in any::<u8>().prop_filter("a digit is part of the first cell", |b| !b.is_ascii_digit()),
        seed in any::<u64>(),
        chunk in 1_usize..100,
    ) {
        let layout = layout("preset = 'ascii'");
        let sent = frames(&layout, seed, 2);
        let mut bytes = encode(&layout, &sent[..1]);
        bytes.extend(noise);
        bytes.push(last);
        layout.encode(&sent[1], &mut bytes);
        let (found, _) = decode(&layout, bytes.chunks(chunk));
        prop_assert_eq!(found.first(), Some(&sent[0]));
        prop_assert_eq!(found.last(), Some(&sent[1]));
    }

    #[test]
    fn frames_between_noise_survive_where_the_layout_can_tell(
        seed in any::<u64>(),
        gaps in proptest::collection::vec(0_usize..900, 4),
        index in 0_usize..2,
    ) {
        let layout = layout(LAYOUTS[index]);
        let sent = frames(&layout, seed, 3);
        let mut bytes = Vec::new();
        for (index, frame) in sent.iter().enumerate() {
            bytes.extend(noise(seed ^ index as u64, gaps[index]));
            layout.encode(frame, &mut bytes);
        }
        bytes.extend(noise(seed, gaps[3]));
        prop_assert_eq!(decode(&layout, [bytes.as_slice()]).0, sent);
    }
}

#[test]
fn a_missing_packet_costs_its_frame_alone_and_counts_as_damage_once() {
    for text in [
        "preset = 'jq-glove'",
        "preset = 'jq-glove'\nchecksum = 'crc32'",
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
            for chunk in [1, 50, bytes.len()] {
                let found = decode(&layout, bytes.chunks(chunk));
                assert_eq!(found, (expected.clone(), 1), "{text}: packet {missing}");
            }
        }
        // Packets in a wrong order are no frame.
        let mut bytes = whole.clone();
        bytes[marks[of_frame]..marks[of_frame + 2]]
            .rotate_left(marks[of_frame + 1] - marks[of_frame]);
        let (found, damaged) = decode(&layout, [bytes.as_slice()]);
        assert_eq!(found, [0, 2, 3].map(|at| sent[at].clone()), "{text}");
        assert!(damaged > 0, "{text}");
    }
}

#[test]
fn lines_have_any_separators_brackets_and_words_before_them() {
    let layout = layout("preset = 'csv'\nrows = 2\ncols = 3");
    let banners = ["Calibrating, 100 samples ...\r\n", "\n", "[]\n", "done.\n"];
    let lines = [
        "1,2,3,4,5,6\n",
        "frame: 1 2 3 4 5 6\r\n",
        "frame:1\t2\t3\t4\t5\t6\n",
        "12:30:01.250; 1; 2; 3; 4; 5; 6;\n",
        "2026-11-26T12:30:01Z [[1, 2, 3], [4, 5, 6]]\r\n",
        "123456,1,2,3,4,5,6\n",
        "  1   2   3\t 4   5   6\n",
    ];
    let text = lines.join(&banners.concat());
    let mut sent = RawFrame::zero(layout.array());
    sent.counts.copy_from_slice(&[1, 2, 3, 4, 5, 6]);
    for chunk in [1, 7, text.len()] {
        let found = decode(&layout, text.as_bytes().chunks(chunk));
        assert_eq!(found, (vec![sent.clone(); lines.len()], 0), "by {chunk}");
    }
    let mut decoder = Decoder::new(layout);
    decoder.push(text.as_bytes());
    while decoder.next_frame().is_some() {}
    let banner_bytes = banners.concat().len() * (lines.len() - 1);
    assert_eq!(decoder.skipped(), banner_bytes as u64);
}

#[test]
fn a_damaged_line_is_counted_and_costs_no_other() {
    let layout = layout("preset = 'csv'\nrows = 2\ncols = 3");
    for (damaged, count) in [
        ("1,2,3,4,5\n", 1),
        ("1,2,3,4,5,x\n", 1),
        ("1,2,3,45,6\n", 1),
        ("1,2,3,4,70000,6\n", 1),
        // The LF is lost.
        ("1,2,3,4,5,6,", 1),
        ("1,2,3,4,5,6", 1),
        // So little of a line might be other words.
        ("1,2,3\n", 0),
    ] {
        let text = format!("7,7,7,7,7,7\n{damaged}8,8,8,8,8,8\n");
        for chunk in [1, 5, text.len()] {
            let (found, damaged) = decode(&layout, text.as_bytes().chunks(chunk));
            let counts = found.iter().map(|frame| frame.counts.iter().sum::<u16>());
            let counts: Vec<u16> = counts.collect();
            assert_eq!(counts.first(), Some(&42), "{text:?} by {chunk}");
            assert_eq!((counts.len(), damaged), (2, count), "{text:?} by {chunk}");
        }
    }
}

#[test]
fn the_rest_of_a_number_that_was_too_long_to_keep_is_not_a_cell() {
    let layout = layout("preset = 'csv'\nrows = 1\ncols = 2");
    let most = layout.max_frame_bytes();
    for spaces in most - 10..most + 10 {
        let text = format!("1234{}5\n", " ".repeat(spaces));
        let found = decode(&layout, [text.as_bytes()]).0;
        assert_eq!(found.len(), usize::from(text.len() <= most), "{spaces}");
        for chunk in [1, 3, 50] {
            assert_eq!(decode(&layout, text.as_bytes().chunks(chunk)).0, found);
        }
    }
}
