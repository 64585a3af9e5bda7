//! Streams of many layouts, with the frames that are in them, and streams that the daemon cannot read.
//!
//! In: a seed. Out: a [`Case`], whose bytes are written here and not by the decoder's own layouts.

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::Checksum;
use hardnessd_simulator::random::Stream;

/// A stream, and what a right layout finds in it.
#[derive(Debug)]
pub(crate) struct Case {
    pub(crate) bytes: Vec<u8>,
    pub(crate) frames: Vec<RawFrame>,
    /// The same by the other numbers of each taxel, if it has several.
    pub(crate) others: Vec<Vec<RawFrame>>,
    /// The layout in words.
    pub(crate) words: String,
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
}

/// A whole number of so many bytes.
fn whole(value: u64, bytes: usize, is_big_endian: bool) -> Vec<u8> {
    let mut written = value.to_le_bytes()[..bytes].to_vec();
    if is_big_endian {
        written.reverse();
    }
    written
}

/// A stream of bytes of a random layout.
pub(crate) fn case(seed: u64) -> Case {
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
        if length < 2 {
            bytes.extend(whole(cells_bytes as u64, 2, length == 1));
        }
        let mut write = |which: usize, number: Option<Number>, bytes: &mut Vec<u8>| {
            if let Some(number) = number {
                bytes.extend(whole(numbers[which], number.bytes, number.is_big_endian));
                let jitter = stream.below(2 * number.jitter as usize + 1) as u64;
                numbers[which] += number.step + jitter - number.jitter;
            }
        };
        write(0, header, &mut bytes);
        let cells_at = bytes.len();
        for &count in &frame.counts {
            bytes.extend(whole(count as u64, cell_bytes, is_big_endian));
        }
        let cells_end = bytes.len();
        write(1, footer, &mut bytes);
        let covered = if is_over_cells {
            &bytes[cells_at..cells_end]
        } else {
            &bytes[start..]
        };
        let sum = checksum.sent(covered);
        let total: u32 = frame.counts.iter().map(|&count| count as u32).sum();
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
        others: Vec::new(),
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

/// Frames as text. Rows without an empty line between frames are not for the daemon.
fn text(array: Array, stream: &mut Stream) -> Case {
    let (mut frames, rest) = frames(array, 1023, stream);
    let is_rows = stream.below(4) == 0;
    let (separator, open, close) = [
        (",", "", ""),
        (" ", "", ""),
        (", ", "[", "]"),
        (";", "(", ")"),
    ][stream.below(4)];
    let leading = stream.below(3);
    let mut text = String::from("ready\r\n");
    let words = |counts: &[f32]| {
        let words: Vec<String> = counts.iter().map(f32::to_string).collect();
        format!("{open}{}{close}\n", words.join(separator))
    };
    for (index, frame) in frames.iter().enumerate() {
        if is_rows {
            text.extend(frame.counts.chunks(array.cols).map(words));
            text += ["", "\n"][leading % 2];
        } else {
            text += &match leading {
                0 => String::new(),
                1 => format!("{},", 1000 + 20 * index),
                _ => "frame: ".to_owned(),
            };
            text += &words(&frame.counts);
        }
    }
    let words = format!(
        "text of {array}, rest {rest}, rows: {is_rows}, separator {separator:?}, leading {leading}"
    );
    if is_rows && leading != 1 {
        frames.clear();
    }
    Case {
        bytes: text.into_bytes(),
        frames,
        others: Vec::new(),
        words,
    }
}

/// How hands and skins write a number.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Hand {
    F32le,
    F32be,
    I16le,
    I16be,
    I32le,
    I8,
    Volts,
    U8,
}

impl Hand {
    /// A number as it is sent, and what a reader finds.
    pub(crate) fn sent(self, number: f64) -> (Vec<u8>, f32) {
        let float = number as f32;
        let whole = number.round() as i16;
        match self {
            Hand::F32le => (float.to_le_bytes().to_vec(), float),
            Hand::F32be => (float.to_be_bytes().to_vec(), float),
            Hand::I16le => (whole.to_le_bytes().to_vec(), whole.into()),
            Hand::I16be => (whole.to_be_bytes().to_vec(), whole.into()),
            Hand::I32le => {
                let whole = number.round() as i32;
                (whole.to_le_bytes().to_vec(), whole as f32)
            }
            Hand::I8 => (vec![(whole as i8).cast_unsigned()], (whole as i8).into()),
            Hand::U8 => (vec![whole as u8], (whole as u8).into()),
            Hand::Volts => {
                let text = format!("{number:.3}");
                (format!("{text},").into_bytes(), text.parse().unwrap())
            }
        }
    }
}

/// A stream as hands and skins send it: signed cells, floats, several numbers a taxel, SLIP, COBS, text.
pub(crate) fn hand(seed: u64) -> Case {
    let mut stream = Stream::new(seed, "hand");
    let (rows, cols) = ARRAYS[stream.below(ARRAYS.len())];
    let array = Array { rows, cols };
    let (played, _) = frames(array, 250, &mut stream);
    let kind = stream.below(10);
    // How a number is written, how many a taxel has, by how much counts are multiplied, and what they begin
    // at.
    let (of, axes, scale, begin) = match kind {
        0 => (
            Hand::F32le,
            1,
            [1.0, 0.013, 3.3 / 255.0][stream.below(3)],
            0.0,
        ),
        1 => (Hand::F32be, 1, 0.004, 0.0),
        2 => (Hand::I16le, 1, 8.0, -120.0),
        3 => (Hand::I16be, 1, 8.0, -60.0),
        4 => (Hand::I32le, 1, 500.0, -4000.0),
        5 => (Hand::I8, 3, 0.4, -3.0),
        6 => (Hand::F32le, 1 + 2 * stream.below(2), 0.02, -1.0),
        7 => (Hand::Volts, 1, 0.0127, 0.0),
        _ => (Hand::U8, 1, 1.0, 0.0),
    };
    let sync: Vec<u8> =
        [&[0xAA, 0x55][..], &[0xFE, 0x01], &[0x5A, 0xA5, 0x01]][stream.below(3)].to_vec();
    let tail: &[u8] = [&[][..], &[0x0D, 0x0A]][stream.below(2)];
    let checksum = [
        Checksum::None,
        Checksum::Lrc8,
        Checksum::Crc16Xmodem,
        Checksum::Crc8,
    ][stream.below(4)];
    let is_packed = kind >= 8;
    let has_sync = !is_packed || stream.below(2) == 0;
    let mut bytes = Vec::new();
    let mut found = vec![Vec::new(); axes];
    for frame in &played {
        let mut packet = if has_sync && kind != 7 {
            sync.clone()
        } else {
            Vec::new()
        };
        let mut read = vec![RawFrame::zero(array); axes];
        for (place, &count) in frame.counts.iter().enumerate() {
            for (axis, read) in read.iter_mut().enumerate() {
                // The axes differ in size, and one may be negative.
                let share = [1.0, 0.45, -0.6][axis];
                let noise = if matches!(of, Hand::U8) {
                    0.0
                } else {
                    0.3 * stream.normal()
                };
                let number = begin + scale * (f64::from(count) * share + noise);
                let (bytes, found) = of.sent(number);
                packet.extend(bytes);
                read.counts[place] = found;
            }
        }
        for (all, read) in found.iter_mut().zip(read) {
            all.push(read);
        }
        if kind == 7 {
            packet.pop();
            packet.push(b'\n');
            bytes.extend(packet);
            continue;
        }
        let sum = checksum.sent(&packet);
        packet.extend(&sum[..checksum.bytes()]);
        match kind {
            8 => bytes.extend(slip(&packet)),
            9 => bytes.extend(cobs(&packet)),
            _ => {
                packet.extend(tail);
                bytes.extend(packet);
            }
        }
    }
    let words = format!(
        "hand {kind}: {array}, {of:?} x {axes}, scale {scale}, sync {sync:02X?} ({has_sync}), tail {tail:02X?}, {checksum:?}"
    );
    Case {
        bytes,
        frames: found.remove(0),
        others: found,
        words,
    }
}

/// A stream of bytes that the daemon cannot read, or that is no array: `frames` is empty.
pub(crate) fn unreadable(seed: u64) -> Case {
    let mut stream = Stream::new(seed, "unreadable");
    let (rows, cols) = ARRAYS[stream.below(ARRAYS.len())];
    let array = Array { rows, cols };
    let (frames, _) = frames(array, [250, 1023, 4000][stream.below(3)], &mut stream);
    let kind = stream.below(4);
    let sync: Vec<u8> = [&[0xAA, 0x55][..], &[0xFE], &[0x5A, 0xA5, 0x01]][stream.below(3)].to_vec();
    let cells = |frame: &RawFrame| -> Vec<u8> {
        frame
            .counts
            .iter()
            .map(|&count| (count / 16.0) as u8)
            .collect()
    };
    let framed = |payload: Vec<u8>| [sync.clone(), payload].concat();
    let mut bytes = Vec::new();
    for (index, frame) in frames.iter().enumerate() {
        let packet = framed(cells(frame));
        match kind {
            0 => bytes.extend(
                format!(
                    "T={index} load={} state=ok\r",
                    (frame.counts[0] / 9.0) as u32
                )
                .bytes(),
            ),
            // Some numbers are left out, so lengths vary.
            1 => bytes.extend(framed(
                packet
                    .iter()
                    .copied()
                    .filter(|&byte| byte % 3 > 0)
                    .collect(),
            )),
            // Nine numbers of an inertial sensor.
            2 => {
                let t = index as f64 / 9.0;
                let axes = (0..9).map(|axis| 900.0 * (t * (1.0 + f64::from(axis) * 0.37)).sin());
                bytes.extend(framed(
                    axes.flat_map(|axis| (axis as i16).to_le_bytes()).collect(),
                ));
            }
            _ => bytes.extend(packet),
        }
    }
    let mut words = format!("unreadable {kind}: {array}, sync {sync:02X?}");
    if kind == 3 {
        let speed = [0.5, 2.0, 1.5, 0.75, 12.0][seed as usize % 5];
        bytes = at_other_speed(&bytes, speed);
        words += &format!(", read at {speed} of its speed");
    }
    Case {
        bytes,
        frames: Vec::new(),
        others: Vec::new(),
        words,
    }
}

fn slip(packet: &[u8]) -> Vec<u8> {
    let escaped = packet.iter().flat_map(|&byte| match byte {
        0xC0 => vec![0xDB, 0xDC],
        0xDB => vec![0xDB, 0xDD],
        other => vec![other],
    });
    escaped.chain([0xC0]).collect()
}

fn cobs(packet: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    for part in packet.split(|&byte| byte == 0) {
        let mut full = part.chunks_exact(254);
        for full in &mut full {
            out.push(0xFF);
            out.extend(full);
        }
        out.push(full.remainder().len() as u8 + 1);
        out.extend(full.remainder());
    }
    out.push(0);
    out
}

/// What a port reads that samples bits `speed` times as often as they are sent. A byte without a stop
/// bit is read as 0, as Linux does.
fn at_other_speed(sent: &[u8], speed: f64) -> Vec<u8> {
    let bits: Vec<u8> = sent
        .iter()
        .flat_map(|byte| {
            [0].into_iter()
                .chain((0..8).map(move |at| byte >> at & 1))
                .chain([1])
        })
        .collect();
    let bit = |time: f64| bits.get(time as usize).copied().unwrap_or(1);
    let (mut read, mut time) = (Vec::new(), 0.0);
    while time < bits.len() as f64 {
        if bit(time) == 1 {
            time = time.floor() + 1.0;
            continue;
        }
        let sample = |at: u32| bit(time + (f64::from(at) + 0.5) / speed);
        let byte = (0..8).fold(0, |byte, at| byte | sample(at + 1) << at);
        let has_stop = sample(9) == 1;
        read.push(if has_stop { byte } else { 0 });
        time += 9.5 / speed;
        while !has_stop && time < bits.len() as f64 && bit(time) == 0 {
            time += 1.0;
        }
    }
    read
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
pub(crate) fn frames(array: Array, full_scale: u16, stream: &mut Stream) -> (Vec<RawFrame>, u16) {
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
                    raw.counts[place] = value.round().clamp(0.0, f64::from(full_scale)) as f32;
                }
            }
            if load == 0.0 {
                rest = rest.max(raw.counts.iter().copied().fold(0.0, f32::max) as u16);
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
            let mut contact = round(stream, 0.4);
            match stream.below(2) {
                0 => contact.row = edge * (sides.0 - 1.0),
                _ => contact.col = edge * (sides.1 - 1.0),
            }
            vec![contact]
        }
    }
}
