//! Streams of many layouts, with the frames that are in them.
//!
//! In: a seed. Out: a [`Case`], whose bytes are written here and not by the decoder's own layouts.

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::Checksum;
use hardnessd_simulator::random::Stream;

/// A stream, and what a right layout finds in it.
#[derive(Debug)]
pub(super) struct Case {
    pub(super) bytes: Vec<u8>,
    pub(super) frames: Vec<RawFrame>,
    /// The layout in words.
    pub(super) words: String,
}

const ARRAYS: [(usize, usize); 18] = [
    (8, 16),
    (12, 6),
    (12, 8),
    (16, 10),
    (20, 10),
    (25, 4),
    (15, 7),
    (12, 32),
    (16, 32),
    (32, 32),
    (28, 56),
    (64, 64),
    (4, 4),
    (28, 28),
    (16, 16),
    (10, 10),
    (24, 32),
    (6, 14),
];

/// How a number beside the cells is written.
#[derive(Debug, Clone, Copy)]
struct Number {
    bytes: usize,
    is_big_endian: bool,
    /// By how much it grows in a frame, on average.
    step: u64,
    jitter: u64,
}

impl Number {
    fn random(stream: &mut Stream) -> Self {
        let bytes = [1, 2, 4][stream.below(3)];
        let (step, jitter) = match (bytes, stream.below(3)) {
            (4, 0) => (20_000, 400),
            (4, 1) => (33, 2),
            _ => (1, 0),
        };
        Self {
            bytes,
            is_big_endian: stream.below(2) == 0,
            step,
            jitter,
        }
    }

    fn write(self, value: u64, out: &mut Vec<u8>) {
        let little = value.to_le_bytes();
        let bytes = &little[..self.bytes];
        if self.is_big_endian {
            out.extend(bytes.iter().rev());
        } else {
            out.extend(bytes);
        }
    }
}

/// A stream of bytes of a random layout.
pub(super) fn case(seed: u64) -> Case {
    let mut stream = Stream::new(seed, "sniffed");
    let (rows, cols) = ARRAYS[seed as usize % ARRAYS.len()];
    let array = Array { rows, cols };
    if stream.below(6) == 0 {
        return text(array, &mut stream);
    }
    let cell_bytes = 1 + stream.below(2);
    let is_big_endian = stream.below(2) == 0;
    let full_scale = match (cell_bytes, stream.below(3)) {
        (1, _) => 255,
        (_, 0) => 1023,
        (_, 1) => 4095,
        _ => 250,
    };
    let (frames, rest) = frames(array, full_scale, &mut stream);
    let mark = |stream: &mut Stream, most: usize| -> Vec<u8> {
        let length = 1 + stream.below(most);
        let usual = stream.below(2) == 0;
        let mut mark: Vec<u8> = (0..length).map(|_| mark_byte(stream, rest)).collect();
        if usual && length > 1 {
            // What boards send, whatever their taxels read.
            mark.iter_mut()
                .zip(USUAL)
                .for_each(|(byte, usual)| *byte = usual);
        }
        mark
    };
    let sync = mark(&mut stream, 8);
    let tail = match stream.below(3) {
        0 => mark(&mut stream, 2),
        _ => Vec::new(),
    };
    let number =
        |stream: &mut Stream, one_in| (stream.below(one_in) == 0).then(|| Number::random(stream));
    let header = number(&mut stream, 4);
    let footer = number(&mut stream, 4);
    let length = stream.below(4);
    let checksum = [
        Checksum::None,
        Checksum::None,
        Checksum::None,
        Checksum::Sum8,
        Checksum::Xor8,
        Checksum::Crc16Modbus,
        Checksum::Crc16CcittBe,
        Checksum::Crc32,
        Checksum::Crc32Be,
    ][stream.below(9)];
    let is_over_cells = stream.below(3) == 0;
    // A sum that the decoder does not know, and another that nobody knows.
    let unknown_sum = match checksum {
        Checksum::None => stream.below(4),
        _ => 3,
    };
    let mut bytes = Vec::new();
    let mut numbers = [stream.below(200) as u64, stream.below(200) as u64];
    let dropped = frames.len() / 3 + stream.below(3);
    let flipped = 2 * frames.len() / 3 + stream.below(3);
    let is_damaged = stream.below(2) == 0;
    let mut frame_bytes = 0;
    for (index, frame) in frames.iter().enumerate() {
        let start = bytes.len();
        bytes.extend(&sync);
        let cells_bytes = array.taxels() * cell_bytes;
        match length {
            0 => bytes.extend((cells_bytes as u16).to_le_bytes()),
            1 => bytes.extend((cells_bytes as u16).to_be_bytes()),
            _ => {}
        }
        let mut write = |which: usize, number: Option<Number>, bytes: &mut Vec<u8>| {
            if let Some(number) = number {
                number.write(numbers[which], bytes);
                let jitter = stream.below(2 * number.jitter as usize + 1) as u64;
                numbers[which] += number.step + jitter - number.jitter;
            }
        };
        write(0, header, &mut bytes);
        let cells_at = bytes.len();
        for &count in &frame.counts {
            match (cell_bytes, is_big_endian) {
                (1, _) => bytes.push(count as u8),
                (_, false) => bytes.extend(count.to_le_bytes()),
                (_, true) => bytes.extend(count.to_be_bytes()),
            }
        }
        let cells_end = bytes.len();
        write(1, footer, &mut bytes);
        let covered = if is_over_cells {
            &bytes[cells_at..cells_end]
        } else {
            &bytes[start..]
        };
        let sum = checksum.of(covered);
        let total: u32 = frame.counts.iter().map(|&count| u32::from(count)).sum();
        let is_be = matches!(checksum, Checksum::Crc16CcittBe | Checksum::Crc32Be);
        let sum = if is_be {
            (sum << (32 - 8 * checksum.bytes())).to_be_bytes()
        } else {
            sum.to_le_bytes()
        };
        bytes.extend(&sum[..checksum.bytes()]);
        match unknown_sum {
            0 => bytes.extend((total as u16).to_le_bytes()),
            1 => bytes.extend(total.to_be_bytes()),
            _ => {}
        }
        bytes.extend(&tail);
        frame_bytes = bytes.len() - start;
        let at = start + stream.below(frame_bytes);
        if is_damaged && index == dropped {
            bytes.remove(at);
        } else if is_damaged && index == flipped {
            bytes[at] ^= 1 << stream.below(8);
        }
    }
    if stream.below(2) == 0 {
        bytes.drain(..stream.below(frame_bytes));
        bytes.truncate(bytes.len() - stream.below(frame_bytes));
    }
    let words = format!(
        "{rows}x{cols} cells of {cell_bytes} (big-endian: {is_big_endian}, to {full_scale}), rest {rest}, \
         sync {sync:02X?}, tail {tail:02X?}, length {length}, header {header:?}, footer {footer:?}, \
         {checksum:?} (over cells: {is_over_cells}), unknown sum {unknown_sum}, {} frames, damaged: {is_damaged}",
        frames.len()
    );
    Case {
        bytes,
        frames,
        words,
    }
}

/// The beginning of many marks.
const USUAL: [u8; 4] = [0xAA, 0x55, 0x03, 0x99];

/// A byte that is unlike the low bytes of taxels at rest.
fn mark_byte(stream: &mut Stream, rest: u16) -> u8 {
    let low = (rest % 256) as u8;
    // Taxels may rest at anything below a low rest.
    let is_like = |byte: u8| byte.abs_diff(low) < 24 || rest < 100 && byte <= low;
    loop {
        let byte = stream.below(256) as u8;
        if !is_like(byte) {
            return byte;
        }
    }
}

/// Frames as text.
fn text(array: Array, stream: &mut Stream) -> Case {
    let (frames, rest) = frames(array, 1023, stream);
    let is_rows = stream.below(3) == 0;
    let (separator, open, close) = [
        (",", "", ""),
        (" ", "", ""),
        (", ", "[", "]"),
        (";", "(", ")"),
    ][stream.below(4)];
    let leading = stream.below(3);
    let mut text = String::from("ready\r\n");
    for (index, frame) in frames.iter().enumerate() {
        let words = |counts: &[u16]| {
            let words: Vec<String> = counts.iter().map(u16::to_string).collect();
            words.join(separator)
        };
        if is_rows {
            for row in frame.counts.chunks(array.cols) {
                text += &format!("{open}{}{close}\n", words(row));
            }
        } else {
            text += &match leading {
                0 => String::new(),
                1 => format!("{},", 1000 + 20 * index),
                _ => "frame: ".to_owned(),
            };
            text += &format!("{open}{}{close}", words(&frame.counts));
        }
        text += "\n";
    }
    let Array { rows, cols } = array;
    Case {
        bytes: text.into_bytes(),
        words: format!(
            "text of {rows}x{cols}, rest {rest}, rows: {is_rows}, separator {separator:?}, leading {leading}, {} frames",
            frames.len()
        ),
        frames,
    }
}

/// A contact: how deep it is at a distance from its middle.
#[derive(Debug, Clone, Copy)]
struct Contact {
    row: f64,
    col: f64,
    /// The half of its length, and of its width.
    radii: (f64, f64),
    angle: f64,
}

impl Contact {
    fn depth(&self, row: f64, col: f64, load: f64) -> f64 {
        let (dr, dc) = (row - self.row, col - self.col);
        let along = dr * self.angle.cos() + dc * self.angle.sin();
        let across = dc * self.angle.cos() - dr * self.angle.sin();
        let distance = (along / self.radii.0).powi(2) + (across / self.radii.1).powi(2);
        (load - distance).max(0.0)
    }
}

/// Rest and presses of several shapes and places, with the largest count of a taxel at rest.
pub(super) fn frames(array: Array, full_scale: u16, stream: &mut Stream) -> (Vec<RawFrame>, u16) {
    let Array { rows, cols } = array;
    let kind_of_rest = stream.below(if full_scale > 1000 { 6 } else { 4 });
    let level = stream.range(60.0, 0.5 * f64::from(full_scale));
    let noise = [0.0, 0.0, 0.7, 2.0][stream.below(4)];
    let offsets: Vec<f64> = (0..array.taxels())
        .map(|_| match kind_of_rest {
            0 | 1 => 0.0,
            2 => 9.0,
            // Two bytes for a cell need not rest near 0.
            4 => level.round(),
            5 => (level + 3.0 * stream.normal()).round(),
            _ => stream.range(0.0, 24.0).round(),
        })
        .collect();
    let mut frames = Vec::new();
    let mut rest = 0;
    let presses = 2 + stream.below(4);
    for press in 0..=presses {
        let contacts = contacts(array, stream);
        let peak = stream.range(0.4, 0.95) * (f64::from(full_scale) - 40.0);
        let (quiet, held) = (4 + stream.below(10), 8 + stream.below(14));
        for time in 0..quiet + if press < presses { held } else { 0 } {
            let load = match time.checked_sub(quiet) {
                None => 0.0,
                Some(time) => (std::f64::consts::PI * (time as f64 + 0.5) / held as f64)
                    .sin()
                    .sqrt(),
            };
            let mut raw = RawFrame::zero(array);
            for row in 0..rows {
                for col in 0..cols {
                    let place = array.place(row, col);
                    let deepest = contacts
                        .iter()
                        .map(|contact| contact.depth(row as f64, col as f64, load))
                        .fold(0.0, f64::max);
                    let gain = 1.0 + 0.1 * ((place * 7919 % 13) as f64 / 6.5 - 1.0);
                    let value = offsets[place]
                        + noise * stream.normal()
                        + peak * gain * deepest.sqrt().min(1.0) * load;
                    raw.counts[place] = value.round().clamp(0.0, f64::from(full_scale)) as u16;
                }
            }
            if load == 0.0 {
                rest = rest.max(raw.counts.iter().copied().max().unwrap_or(0));
            }
            frames.push(raw);
        }
    }
    (frames, rest)
}

fn contacts(array: Array, stream: &mut Stream) -> Vec<Contact> {
    let sides = (array.rows as f64, array.cols as f64);
    let short = sides.0.min(sides.1);
    let round = |stream: &mut Stream, most: f64| {
        let radius = (stream.range(0.12, most) * short).max(1.3);
        Contact {
            row: stream.range(0.1, 0.9) * (sides.0 - 1.0),
            col: stream.range(0.1, 0.9) * (sides.1 - 1.0),
            radii: (radius, radius),
            angle: 0.0,
        }
    };
    match stream.below(5) {
        0 | 1 => vec![round(stream, 0.4)],
        2 => {
            let long = round(stream, 0.5);
            let radii = (
                long.radii.0 * stream.range(1.5, 3.0),
                (long.radii.0 * 0.5).max(1.0),
            );
            let angle = stream.range(0.0, std::f64::consts::PI);
            vec![Contact {
                radii,
                angle,
                ..long
            }]
        }
        3 => vec![round(stream, 0.25), round(stream, 0.25)],
        _ => {
            let edge = [0.0, 1.0][stream.below(2)];
            let contact = round(stream, 0.4);
            vec![if stream.below(2) == 0 {
                Contact {
                    row: edge * (sides.0 - 1.0),
                    ..contact
                }
            } else {
                Contact {
                    col: edge * (sides.1 - 1.0),
                    ..contact
                }
            }]
        }
    }
}
