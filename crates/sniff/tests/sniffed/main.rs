//! Layouts are found in the bytes of the generator, or left open, and never taken for others.

#![allow(
    clippy::unwrap_used,
    reason = "a failed unwrap is a failed test; the lint only sees test functions"
)]

mod generator;

use generator::{Case, Hand, case, frames, hand, unreadable};
use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Cell, Checksum, Decoder, Layout, Order, Preset, Settings};
use hardnessd_simulator::random::Stream;
use hardnessd_sniff::{Arrival, Capture, Failure, Found, Known, Ranked, Scale, sniff};

fn decoded(settings: &Settings, bytes: &[u8]) -> Vec<RawFrame> {
    let mut decoder = Decoder::new(Layout::new(settings).unwrap());
    decoder.push(bytes);
    decoder.settle();
    std::iter::from_fn(|| decoder.next_frame())
        .filter_map(|item| item.ok().map(|decoded| decoded.frame))
        .collect()
}

/// The number of frames in `of` that are not among the others, or of which there are more.
fn missing(of: &[RawFrame], among: &[RawFrame]) -> usize {
    let is_missing = |frame: &&RawFrame| !among.contains(frame);
    let others = of.iter().filter(is_missing).count();
    others.max(of.len().saturating_sub(among.len()))
}

/// Frames that may differ: those at the ends of the stream, and beside damage.
const LOST: usize = 6;

fn of(bytes: &[u8], known: Known) -> Result<Found, Failure> {
    let capture = Capture {
        bytes: bytes.to_vec(),
        ..Capture::default()
    };
    sniff(&capture, known)
}

/// Whether the sensor at rest passes for no touch with this scale, and its presses are felt.
fn is_tared(scale: Scale, frames: &[RawFrame]) -> bool {
    let newtons = scale.newtons_per_count.unwrap_or(0.04);
    let rest = &frames[..4];
    let spread = |at: usize| {
        let counts = rest.iter().map(|frame| frame.counts[at]);
        counts.clone().fold(f32::MIN, f32::max) - counts.fold(f32::MAX, f32::min)
    };
    let touched = (0..rest[0].counts.len())
        .filter(|&at| spread(at) * newtons >= scale.contact_threshold_n.unwrap_or(0.07));
    let most = frames
        .iter()
        .flat_map(|frame| frame.counts.iter())
        .copied()
        .fold(0.0, f32::max);
    touched.count() < 3 && most * newtons > scale.contact_threshold_n.unwrap_or(0.07) * 2.0
}

/// Searches the streams of these seeds. Returns how many are right. None may be sure and wrong.
fn search(seeds: std::ops::Range<u64>, case: fn(u64) -> Case) -> usize {
    let mut right = 0;
    for seed in seeds {
        let case = case(seed);
        let Ok(found @ Found { doubt: None, .. }) = of(&case.bytes, Known::default()) else {
            continue;
        };
        let settings = &found.best.proposal.settings;
        let frames = decoded(settings, &case.bytes);
        let is_truth = |truth: &&Vec<RawFrame>| {
            missing(&frames, truth) <= LOST && missing(truth, &frames) <= LOST
        };
        let truth = std::iter::once(&case.frames)
            .chain(&case.others)
            .find(is_truth);
        let scale = Scale::of(settings, &case.bytes);
        let is_right = truth.is_some_and(|truth| is_tared(scale, truth));
        let what = format!("seed {seed}, {}: {settings:?}, {scale:?}", case.words);
        assert!(is_right, "{what}");
        right += 1;
    }
    right
}

#[test]
fn layouts_are_found_or_left_open_and_never_taken_for_others() {
    // These seeds were not used to choose a constant.
    let readable = search(600_000..600_072, case);
    assert!(readable >= 54, "{readable} of 72 found");
    let hands = search(600_000..600_050, hand);
    assert!(hands >= 38, "{hands} of 50 found");
    assert_eq!(search(600_000..600_024, unreadable), 0);
}

/// The frames of several presses, and their bytes. Taxels at rest read 0.
fn played(settings: &Settings) -> (Vec<RawFrame>, Vec<u8>) {
    let layout = Layout::new(settings).unwrap();
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
        preset: Some(preset),
        ..Settings::default()
    }
}

fn lines(bytes: &[u8]) -> String {
    let found = of(bytes, Known::default()).unwrap();
    assert_eq!(found.doubt, None);
    found.best.proposal.toml()
}

#[test]
fn boards_are_named_by_their_presets() {
    let presets = [
        Preset::Jx255n,
        Preset::Jx255nU16,
        Preset::Jq,
        Preset::JqTail,
        Preset::JqU16,
        Preset::JqGlove,
        Preset::Flexitac,
        Preset::M1616,
    ];
    for settings in presets.map(preset) {
        let name = format!("preset = \"{}\"\n", settings.preset());
        assert_eq!(lines(&played(&settings).1), name);
    }
}

#[test]
fn a_stiff_object_shows_the_array_with_a_few_taxels() {
    for (settings, seed) in [Preset::Jx255n, Preset::Flexitac]
        .into_iter()
        .flat_map(|name| (0..4).map(move |seed| (preset(name), seed)))
    {
        let layout = Layout::new(&settings).unwrap();
        let Array { rows, cols } = layout.array();
        let stream = &mut Stream::new(seed, "stiff");
        let mut bytes = Vec::new();
        for _ in 0..6 {
            let [top, left] = [rows, cols].map(|side| side / 2 - 3 + stream.below(4));
            let block: Vec<f64> = (0..12).map(|_| stream.range(4.0, 40.0)).collect();
            for share in [
                0.0, 0.0, 0.0, 0.0, 0.3, 0.7, 1.0, 1.0, 1.0, 0.9, 0.4, 0.0, 0.0,
            ] {
                let mut frame = RawFrame::zero(layout.array());
                for (at, most) in block.iter().enumerate() {
                    let place = (top + at / 3) * cols + left + at % 3;
                    frame.counts[place] = (share * most).round() as f32;
                }
                layout.encode(&frame, &mut bytes);
            }
        }
        let name = format!("preset = \"{}\"\n", settings.preset());
        assert_eq!(lines(&bytes), name, "seed {seed}");
    }
}

#[test]
fn a_board_of_its_own_gets_keys_and_no_preset() {
    // The mark and the cells of a FlexiTac, but another array.
    let settings = Settings {
        rows: Some(12),
        cols: Some(10),
        ..preset(Preset::Flexitac)
    };
    let keys = "sync = \"AA 55\"\nlength = \"none\"\ncell = \"u8\"\nchecksum = \"none\"\nrows = 12\ncols = 10\n";
    assert_eq!(lines(&played(&settings).1), keys);
}

#[test]
fn the_frame_of_a_board_may_hold_another_array() {
    // The mark, the length and the checksum of a JX255N say nothing of rows and cells.
    let other = |cell, rows, cols| {
        let settings = Settings {
            cell: Some(cell),
            rows: Some(rows),
            cols: Some(cols),
            ..preset(Preset::Jx255nU16)
        };
        let layout = Layout::new(&settings).unwrap();
        let most = if cell == Cell::U8 { 1.0 } else { 12.0 };
        let mut bytes = Vec::new();
        for mut frame in played(&settings).0 {
            frame.counts.iter_mut().for_each(|count| *count *= most);
            layout.encode(&frame, &mut bytes);
        }
        let found = of(&bytes, Known::default()).unwrap();
        (found.doubt, found.best.array, found.best.cell)
    };
    for (cell, rows, cols) in [(Cell::U16be, 28, 28), (Cell::U8, 49, 32)] {
        let array = Array { rows, cols };
        assert_eq!(other(cell, rows, cols), (None, array, Some(cell)));
    }
}

#[test]
fn a_quiet_board_of_text_has_its_presses() {
    for flicker in [0.02, 0.2, 0.5] {
        let mut stream = Stream::new(7, "quiet");
        let array = Array { rows: 10, cols: 10 };
        let (pressed, _) = frames(array, 250, &mut stream);
        let lines = pressed.iter().map(|frame| {
            let cells = frame.counts.iter().map(|&count| {
                let one = u32::from(stream.uniform() < flicker);
                (count as u32 + one).to_string()
            });
            cells.collect::<Vec<String>>().join(",") + "\r\n"
        });
        let found = of(lines.collect::<String>().as_bytes(), Known::default()).unwrap();
        assert_eq!((found.doubt, found.best.array), (None, array), "{flicker}");
    }
}

#[test]
fn pauses_tell_a_header_from_a_tail() {
    let (frames, bytes) = played(&preset(Preset::JqTail));
    let bytes = &bytes[300..];
    let length = bytes.len() / frames.len();
    // Each frame comes in two parts, and then the sensor is silent.
    let arrivals = (0..2 * frames.len() - 2).map(|part| Arrival {
        at: (788 - 300) + 788 * (part / 2) + 400 * (part % 2),
        time_s: part as f64 * 0.05 + if part % 2 == 0 { 0.0 } else { -0.045 },
    });
    assert!(length > 700);
    let arrivals: Vec<Arrival> = arrivals.collect();
    let found = |arrivals: Vec<Arrival>| {
        let bytes = bytes.to_vec();
        let found = sniff(&Capture { bytes, arrivals }, Known::default()).unwrap();
        found.best.proposal
    };
    assert_eq!(found(arrivals).toml(), "preset = \"jq-tail\"\n");
    let remarks = found(Vec::new()).remarks.concat();
    assert!(remarks.contains("switched on"), "{remarks}");
}

/// How most streams of these tests begin a frame.
const MARK: [u8; 3] = [0xE9, 0xD9, 0x45];

fn cells(frame: &RawFrame) -> Vec<u8> {
    frame.counts.iter().map(|&count| count as u8).collect()
}

/// The layout that is sure in frames that `packet` writes, if one is.
fn sure(
    mut stream: Stream,
    array: Array,
    mut packet: impl FnMut(&RawFrame, &mut Stream) -> Vec<u8>,
) -> Option<Ranked> {
    let (pressed, _) = frames(array, 250, &mut stream);
    let packets = pressed.iter().flat_map(|frame| packet(frame, &mut stream));
    let bytes: Vec<u8> = packets.collect();
    let found = of(&bytes, Known::default()).ok()?;
    found.doubt.is_none().then_some(found.best)
}

/// Asserts that these cells are sure in `least` or more of the streams of these seeds, and others in none. A stream
/// with fewer than `negative` numbers below 0 does not count. `number` makes one from a count and noise.
fn check_cells(
    (hand, cell): (Hand, Cell),
    (mark, array): (&[u8], Array),
    (seeds, least, negative): (std::ops::Range<u64>, usize, usize),
    number: impl Fn(f64, f64) -> f64,
) {
    let mut right = 0;
    for seed in seeds {
        let mut below = 0;
        let found = sure(Stream::new(seed, "cells"), array, |frame, stream| {
            let cells = frame.counts.iter().flat_map(|&count| {
                let (bytes, sent) = hand.sent(number(count.into(), stream.normal()));
                below += usize::from(sent < 0.0);
                bytes
            });
            mark.iter().copied().chain(cells).collect()
        });
        if let Some(found) = found
            && below >= negative
        {
            let found = (found.array, found.cell);
            assert_eq!(found, (array, Some(cell)), "{seed}: {below} below 0");
            right += 1;
        }
    }
    assert!(right >= least, "{right}");
}

#[test]
fn numbers_of_64_bits_are_taken_for_no_shorter_ones() {
    let array = Array { rows: 5, cols: 12 };
    for seed in 0..4 {
        let found = sure(Stream::new(seed, "cells"), array, |frame, stream| {
            let counts = frame.counts.iter().map(|&count| f64::from(count));
            let numbers = counts.map(|count| count / 12.5 + 0.02 * stream.normal());
            MARK.into_iter()
                .chain(numbers.flat_map(f64::to_be_bytes))
                .collect()
        });
        assert!(found.is_none(), "{seed}: {found:?}");
    }
}

#[test]
fn cells_that_are_below_0_for_moments_have_a_sign() {
    let array = Array { rows: 6, cols: 14 };
    let number = |count: f64, noise: f64| 0.4 * count + 1.2 + 0.7 * noise;
    check_cells((Hand::I8, Cell::I8), (&MARK, array), (0..12, 4, 10), number);
}

#[test]
fn taxels_at_their_maximum_have_no_sign() {
    let array = Array { rows: 8, cols: 10 };
    for is_inverted in [false, true] {
        let number = |count: f64, noise: f64| {
            let number = (2.5 * count + 3.0 + noise).round().clamp(0.0, 255.0);
            if is_inverted { 255.0 - number } else { number }
        };
        check_cells((Hand::U8, Cell::U8), (&MARK, array), (0..12, 6, 0), number);
    }
}

#[test]
fn taxels_that_are_seldom_large_are_no_halves_of_longer_numbers() {
    let cells = (Hand::I16le, Cell::I16le);
    let array = Array { rows: 8, cols: 8 };
    let number = |count: f64, noise: f64| 4.0 * count + 25.0 * noise;
    check_cells(cells, (&MARK, array), (0..40, 11, 1001), number);
}

#[test]
fn a_mark_is_no_large_float() {
    let cells = (Hand::F32le, Cell::F32le);
    let array = Array { rows: 12, cols: 32 };
    // As a float, the first four bytes are 733,828.
    let mark = [0x3C, 0x28, 0x33, 0x49, 0x06, 0x02];
    let number = |count: f64, noise: f64| 0.08 * count + 0.03 * noise;
    check_cells(cells, (&mark, array), (0..4, 3, 0), number);
}

#[test]
fn rows_that_run_to_and_fro_are_no_rows_of_twice_as_many() {
    for (rows, cols) in [(12, 16), (16, 10), (8, 8)] {
        let array = Array { rows, cols };
        let serpentine = |frame: &RawFrame, _: &mut Stream| {
            let mut cells = cells(frame);
            let odd_rows = cells.chunks_mut(cols).skip(1).step_by(2);
            odd_rows.for_each(<[u8]>::reverse);
            [&MARK[..], &cells].concat()
        };
        let found = (0..8).filter_map(|seed| {
            let found = sure(Stream::new(seed, "packets"), array, serpentine)?;
            Some(found.proposal.settings)
        });
        let found: Vec<Settings> = found.collect();
        let is_right = |found: &Settings| {
            let sides = (found.rows, found.cols);
            sides == (Some(rows), Some(cols)) && found.order == Some(Order::Serpentine)
        };
        assert!(found.len() >= 5 && found.iter().all(is_right), "{found:?}");
    }
}

#[test]
fn a_number_that_changes_slowly_is_no_taxel() {
    let array = Array { rows: 8, cols: 9 };
    let is_right = |seed: u64| {
        let mut volts = 180.0_f64;
        let found = sure(Stream::new(seed, "packets"), array, |frame, stream| {
            volts += 0.02 * stream.normal();
            let header = [0x0B, volts.round() as u8];
            // It changes in each frame, and is no taxel either.
            let footer = [stream.below(256) as u8];
            [&MARK[..], &header, &cells(frame), &footer].concat()
        })?;
        let found = found.proposal.settings;
        let header = found.sync.map_or(0, |sync| sync.0.len()) + found.header_bytes.unwrap_or(0);
        Some(header == 5 && found.footer_bytes == Some(1))
    };
    let found: Vec<bool> = (0..24).filter_map(is_right).collect();
    assert!(found.len() >= 8 && found.iter().all(|is| *is), "{found:?}");
}

#[test]
fn a_mark_of_ff_ff_is_no_telnet_server() {
    let (pressed, _) = frames(Array { rows: 3, cols: 3 }, 250, &mut Stream::new(1, "mark"));
    let packets = pressed.iter().flat_map(|frame| {
        let cells = frame.counts.iter().map(|&count| count as u8 / 2);
        [0xFF, 0xFF, 0x45].into_iter().chain(cells)
    });
    let found = of(&packets.collect::<Vec<u8>>(), Known::default()).unwrap();
    // Nine taxels are too few to be sure, and not unreadable.
    assert!(found.doubt.is_some() && found.best.array.taxels() == 9);
}

#[test]
fn a_taxel_that_is_stuck_at_full_scale_is_no_mark() {
    for (seed, stuck) in (0..24).flat_map(|seed| [40, 77].map(|stuck| (seed, stuck))) {
        let array = Array { rows: 12, cols: 13 };
        let found = sure(Stream::new(seed, "packets"), array, |frame, _| {
            let counts = frame.counts.iter().enumerate();
            let cells = counts.map(|(at, &count)| match at {
                _ if at == stuck => 0xFF,
                _ => (count * 1.5).min(255.0) as u8,
            });
            [0xA7].into_iter().chain(cells).collect()
        });
        let mark = found.and_then(|found| found.proposal.settings.sync);
        assert_ne!(mark.map(|mark| mark.0), Some(vec![0xFF]), "{seed} {stuck}");
    }
}

#[test]
fn the_high_bytes_of_a_clock_are_no_part_of_the_mark() {
    let mark = |seed| {
        let mut clock = 0x05F0_0000_u32;
        let found = sure(
            Stream::new(seed, "packets"),
            Array { rows: 8, cols: 9 },
            |frame, _| {
                clock += 2000;
                [&MARK[..], &clock.to_be_bytes(), &cells(frame)].concat()
            },
        )?;
        Some(found.proposal.settings.sync?.0)
    };
    let marks: Vec<Vec<u8>> = (0..8).filter_map(mark).collect();
    assert!(
        marks.len() >= 4 && marks.iter().all(|mark| !mark.contains(&5)),
        "{marks:?}"
    );
}

#[test]
fn a_status_is_no_part_of_the_mark() {
    let array = Array { rows: 8, cols: 9 };
    let found = |seed| {
        let mut sent = 0;
        let found = sure(Stream::new(seed, "packets"), array, |frame, _| {
            sent += 1;
            let status = if sent % 22 == 0 { 0x91 } else { 0x90 };
            [&MARK[..], &[status], &cells(frame)].concat()
        })?;
        let found = found.proposal.settings;
        Some((found.sync.map(|sync| sync.0), found.header_bytes))
    };
    let found: Vec<_> = (0..12).filter_map(found).collect();
    let expected = (Some(MARK.to_vec()), Some(1));
    // In a short stream it has another value too seldom.
    let right = found.iter().filter(|found| **found == expected);
    assert!(right.count() >= 5, "{found:?}");
}

#[test]
fn no_array_is_sure_where_the_right_one_is_none_that_is_tried() {
    let slope = |frame: &RawFrame, at: usize, by: usize| {
        let before = frame.counts[at.saturating_sub(by)];
        (frame.counts[at] - before) as i16
    };
    for seed in 0..12 {
        let packets = Stream::new(seed, "packets");
        let array = Array { rows: 8, cols: 16 };
        let behind = sure(packets, array, |frame, _| {
            let sum = frame.counts.iter().sum::<f32>();
            let counts = frame.counts.iter().chain([&sum]);
            let words: Vec<String> = counts.map(f32::to_string).collect();
            (words.join(",") + "\n").into_bytes()
        });
        let array = Array { rows: 9, cols: 8 };
        let planes = sure(packets, array, |frame, _| {
            let plane = |by: usize| (0..72).map(move |at| slope(frame, at, by));
            let down = frame.counts.iter().map(|&count| count as i16);
            let numbers = plane(1).chain(plane(8)).chain(down);
            let cells = numbers.flat_map(i16::to_le_bytes);
            MARK.into_iter().chain(cells).collect()
        });
        let array = Array { rows: 6, cols: 4 };
        let axes = sure(packets, array, |frame, stream| {
            let numbers = (0..24).flat_map(|at| {
                let warm = 250 + (2.0 * stream.normal()) as i16;
                let down = frame.counts[at] as i16;
                [warm, slope(frame, at, 1), slope(frame, at, 4), down]
            });
            let cells: Vec<u8> = numbers.flat_map(i16::to_le_bytes).collect();
            [&MARK[..], &cells].concat()
        });
        let array = Array { rows: 8, cols: 8 };
        let whole = sure(packets, array, |frame, stream| {
            let most = frame.counts.iter().copied().fold(0.0, f32::max);
            let gain = |at: usize| 0.8 + 0.4 * (at * 7919 % 64) as f32 / 64.0;
            let noise = |_| stream.normal() as f32;
            let noises: Vec<f32> = (0..64).map(noise).collect();
            let cells = (0..64).map(|at| (0.5 * gain(at) * most + noises[at] + 9.0) as u8);
            MARK.into_iter().chain(cells).collect()
        });
        let sure = [behind, planes, axes, whole].map(|found| found.is_some());
        assert_eq!(sure, [false; 4], "{seed}");
    }
}

#[test]
fn a_checksum_is_found_whatever_it_covers() {
    let mark = [0xA5_u8, 0x5A, 0x00, 0x86];
    let array = Array { rows: 8, cols: 10 };
    for checksum in [
        Checksum::Sum8,
        Checksum::Xor8,
        Checksum::Crc16Modbus,
        Checksum::Crc32,
    ] {
        // From the cells on, from the counter before them, and from the mark.
        for (over, begin) in [("\"cells\"", 6), ("\"after-sync\"", 4), ("", 0)] {
            let mut stream = Stream::new(3, "covered");
            let mut bytes = Vec::new();
            for (number, frame) in (0_u16..).zip(frames(array, 250, &mut stream).0) {
                let mut packet = [&mark[..], &number.to_le_bytes(), &cells(&frame)].concat();
                let sum = checksum.sent(&packet[begin..]);
                packet.extend(&sum[..checksum.bytes()]);
                bytes.extend(packet);
            }
            let found = lines(&bytes);
            let is_found = found.contains(&format!("checksum_over = {over}")) != over.is_empty();
            assert!(
                is_found && !found.contains("\"none\"\nrows"),
                "{begin}: {found}"
            );
        }
    }
}

/// A float of 16 bits, of a number from 2^-14 on. Below it is 0.
fn half(number: f64) -> u16 {
    let exponent = number.log2().floor().max(-15.0);
    let fraction = ((number / exponent.exp2() - 1.0) * 1024.0).round() as u16;
    if exponent < -14.0 {
        0
    } else {
        ((exponent as i16 + 15) as u16).wrapping_shl(10) + fraction
    }
}

#[test]
fn floats_of_16_bits_are_seldom_taken_for_counts() {
    let (mut searched, mut sure) = (0, 0);
    for (seed, rest_n) in (0..40).flat_map(|seed| [0.0, 0.4].map(|rest_n| (seed, rest_n))) {
        let mut stream = Stream::new(seed, "half");
        let array = Array { rows: 6, cols: 14 };
        let (pressed, rest) = frames(array, 250, &mut stream);
        // Floats without zeros and without noise are like counts.
        if rest > 0 {
            continue;
        }
        let mut bytes = Vec::new();
        // A press is held for a while.
        for frame in pressed.iter().flat_map(|frame| [frame; 3]) {
            bytes.extend(MARK);
            for &count in &frame.counts {
                let newtons = f64::from(count) / 12.5 + rest_n * (1.0 + 0.1 * stream.normal());
                bytes.extend(half(newtons).to_le_bytes());
            }
        }
        let found = of(&bytes, Known::default());
        sure += usize::from(found.is_ok_and(|found| found.doubt.is_none()));
        searched += 1;
    }
    // Little noise and no zeros look like counts.
    assert!(
        searched >= 8 && 10 * sure <= searched,
        "{sure} of {searched}"
    );
}

#[test]
fn each_failure_has_its_own_message() {
    let check = |bytes: &[u8], part: &str| {
        let message = match of(bytes, Known::default()) {
            Ok(Found {
                doubt: Some(doubt), ..
            }) => doubt,
            found => found.unwrap_err().to_string(),
        };
        assert!(
            message.contains(part) && !message.contains('\n'),
            "{part}: {message}"
        );
    };
    check(b"", "nothing arrives");
    let text = "boot ok\nwaiting for a host\n".repeat(50);
    check(text.as_bytes(), "text, but no array");
    let rows: String = (0..400)
        .map(|line| format!("{} {} 0 9 7\n", line % 4 * 50, line % 4))
        .collect();
    for rows in [rows.replace(' ', ".5 "), rows] {
        check(rows.as_bytes(), "an empty line after each frame");
    }
    let mut stream = Stream::new(1, "noise");
    let noise: Vec<u8> = (0..200_000).map(|_| stream.next_u64() as u8).collect();
    for bytes in [&noise, &noise[..20_000], &[0; 50_000]] {
        check(bytes, "nothing recurs");
    }
    // Frames of other sensors than arrays.
    let telemetry = noise
        .chunks(16)
        .flat_map(|bytes| [&[0xAA, 0x55], bytes].concat());
    let telemetry = of(&telemetry.collect::<Vec<u8>>(), Known::default());
    assert!(telemetry.is_err() || telemetry.is_ok_and(|found| found.doubt.is_some()));
    let unpressed = [&[0xAA, 0x55][..], &[0; 96]].concat().repeat(60);
    check(&unpressed, "nothing presses");
    let array = Array { rows: 8, cols: 8 };
    let (pressed, _) = frames(array, 250, &mut Stream::new(3, "packets"));
    let packets = pressed.iter().flat_map(|frame| {
        let cells = cells(frame);
        let rows = cells.chunks(8).zip(0..);
        let packets = rows.map(|(row, number)| [&[0xFE, 0xFD, number][..], row].concat());
        packets.collect::<Vec<_>>().concat()
    });
    let expected = "a number from 0 to 7 that begins again";
    check(&packets.collect::<Vec<u8>>(), expected);
    // Taxels that saturate are doubled as the mark is.
    let telnet = pressed.iter().flat_map(|frame| {
        let cells = cells(frame).into_iter().flat_map(|cell| match cell {
            0..120 => vec![cell],
            _ => vec![0xFF, 0xFF],
        });
        [0xFF, 0xFF, 0xFE].into_iter().chain(cells)
    });
    check(&telnet.collect::<Vec<u8>>(), "raw mode");
    let array = Array { rows: 80, cols: 80 };
    let (frames, _) = frames(array, 250, &mut Stream::new(3, "large"));
    let large = frames
        .iter()
        .flat_map(|frame| [vec![0xFE, 0xFD, 0xFC], cells(frame)].concat());
    check(&large.collect::<Vec<u8>>(), "of about 80x80 taxels");
}
