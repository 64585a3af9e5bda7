//! Bytes that are not a frame as it is: packed, doubled by a server, or read at a wrong speed.
//!
//! In: raw bytes. Out: what was done to them, if that shows. It is asked before anything else, because
//! frames seem to recur in such bytes too.

use hardnessd_core::wire::{Framing, TELNET, is_telnet};

/// Frames that end with a byte, which is escaped within them.
struct Escaped {
    end: u8,
    escape: u8,
    /// What may follow an escape.
    escaped: [u8; 2],
    what: Coding,
}

/// What was done to the bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Coding {
    /// They are packed in frames that the daemon reads.
    Packed(Framing),
    /// They are surely packed in another way.
    Unreadable(&'static str),
    /// They look packed in another way, or read at a wrong speed. If frames of one length explain them, this is chance:
    /// negative numbers have many bytes of FF, and so has a mark.
    Maybe(&'static str),
}

const ESCAPED: [Escaped; 2] = [
    Escaped {
        end: 0xC0,
        escape: 0xDB,
        escaped: [0xDC, 0xDD],
        what: Coding::Packed(Framing::Slip),
    },
    Escaped {
        end: 0x7E,
        escape: 0x7D,
        escaped: [0x5E, 0x5D],
        what: Coding::Unreadable(
            "it looks like HDLC (7E ends a frame, and 7D escapes within it), which the daemon does not read",
        ),
    },
];

const TOO_FAST: &str =
    "the port is read faster than the sensor sends, for its bits come in runs: try a lower --baud";
const TOO_SLOW: &str = "the port is read slower than the sensor sends, for stop bits are among the bits: try a \
                        higher --baud";

/// The fewest frames, and escapes, that show a packing.
const FEWEST: usize = 8;
/// The share of frames or escapes that are as expected. The others may be damaged.
const MOSTLY: f64 = 0.95;
/// The share of frames that are as long as each other where a few escapes are.
const ALIKE: f64 = 0.8;
/// The most frames that are looked at.
const MOST_FRAMES: usize = 2000;

/// What was done to `bytes`, if that shows.
pub(crate) fn of(bytes: &[u8]) -> Option<Coding> {
    // One option may be chance.
    if is_telnet(bytes) && is_telnet(&bytes[3..]) {
        return Some(Coding::Unreadable(TELNET));
    }
    if let Some(found) = ESCAPED.iter().find_map(|escaped| escaped.found(bytes)) {
        return Some(found);
    }
    if is_cobs(bytes) {
        return Some(Coding::Packed(Framing::Cobs));
    }
    if doubles_ff(bytes) {
        return Some(Coding::Maybe(TELNET));
    }
    if is_too_slow(bytes) {
        return Some(Coding::Maybe(TOO_SLOW));
    }
    is_too_fast(bytes).then_some(Coding::Maybe(TOO_FAST))
}

/// The share of `of` that `is` so. None of a few.
fn share<T>(of: impl Iterator<Item = T>, is: impl Fn(T) -> bool) -> f64 {
    let (mut all, mut are) = (0, 0);
    for one in of {
        all += 1;
        are += usize::from(is(one));
    }
    if all >= FEWEST {
        f64::from(are as u32) / all as f64
    } else {
        0.0
    }
}

fn mostly<T>(of: impl Iterator<Item = T>, is: impl Fn(T) -> bool) -> bool {
    share(of, is) >= MOSTLY
}

impl Escaped {
    fn found(&self, bytes: &[u8]) -> Option<Coding> {
        let frames = || {
            bytes
                .split(|&byte| byte == self.end)
                .filter(|frame| !frame.is_empty())
                .take(MOST_FRAMES)
        };
        let escapes: Vec<&[u8; 2]> = bytes
            .array_windows()
            .filter(|[byte, _]| *byte == self.escape)
            .collect();
        let valid = escapes
            .iter()
            .filter(|[_, next]| self.escaped.contains(next))
            .count();
        let are_valid = valid as f64 >= MOSTLY * escapes.len() as f64;
        // Where hardly anything is escaped, frames are as long as each other.
        let are_alike = || share(lengths(frames()), |(length, usual)| length == usual) >= ALIKE;
        let spread = bytes.iter().filter(|&&byte| byte == self.end).count() * 4 < bytes.len();
        let are_escaped = escapes.len() >= FEWEST;
        let is_found = spread && are_valid && frames().count() >= FEWEST;
        (is_found && (are_escaped || are_alike())).then_some(match self.what {
            Coding::Unreadable(words) if !are_escaped => Coding::Maybe(words),
            what => what,
        })
    }
}

/// The lengths of some frames, each with the middle one.
fn lengths<'a>(frames: impl Iterator<Item = &'a [u8]>) -> impl Iterator<Item = (usize, usize)> {
    let lengths: Vec<usize> = frames.map(<[u8]>::len).collect();
    let mut sorted = lengths.clone();
    sorted.sort_unstable();
    let usual = sorted.get(sorted.len() / 2).copied().unwrap_or(0);
    lengths
        .into_iter()
        .filter(move |_| usual > 3)
        .map(move |length| (length, usual))
}

/// Whether nearly all frames that end with 0 can be unpacked.
fn is_cobs(bytes: &[u8]) -> bool {
    let frames = bytes
        .split_inclusive(|&byte| byte == 0)
        .filter(|frame| frame.len() > 1)
        .take(MOST_FRAMES);
    let frames: Vec<&[u8]> = frames.collect();
    let long = frames.iter().filter(|frame| frame.len() > 5).count();
    let is_packed = |frame: &[u8]| Framing::Cobs.unpacked(frame).is_some();
    10 * long >= 9 * frames.len() && mostly(frames.into_iter(), is_packed)
}

const ALL_ONES: u8 = 0xFF;

/// Whether each FF is doubled.
fn doubles_ff(bytes: &[u8]) -> bool {
    let runs = bytes
        .chunk_by(|a, b| a == b)
        .filter(|run| run[0] == ALL_ONES);
    mostly(runs, |run| run.len().is_multiple_of(2) && run.len() < 64)
}

/// Whether two bytes are read as one: then the stop bit of the first is the fourth of its bits, and a byte
/// without a stop bit is read as 0.
fn is_too_slow(bytes: &[u8]) -> bool {
    const STOP: u8 = 1 << 3;
    let others = bytes.iter().filter(|&&byte| byte > 0);
    usual(bytes).filter(|&value| value > 0).count() >= 6
        && share(others, |byte| byte & STOP > 0) >= 0.98
}

/// Whether each bit is as long as several: then the first one is 0 like the start bit, and none is alone.
fn is_too_fast(bytes: &[u8]) -> bool {
    // The bits of a byte in the order of the wire, after the start bit.
    let is_in_runs = |value: &u8| {
        let bits = u16::from(*value) << 1;
        let alone = (1..8).any(|at| {
            (bits >> at & 1) != (bits >> (at - 1) & 1) && (bits >> at & 1) != (bits >> (at + 1) & 1)
        });
        value & 1 == 0 && !alone
    };
    let all = usual(bytes).count();
    all >= 3 && 5 * usual(bytes).filter(is_in_runs).count() >= 4 * all
}

/// The values that one byte in 2000 has, or more.
fn usual(bytes: &[u8]) -> impl Iterator<Item = u8> {
    let mut counts = [0_usize; 256];
    for &byte in bytes {
        counts[usize::from(byte)] += 1;
    }
    let least = bytes.len();
    (0..=u8::MAX).filter(move |&value| counts[usize::from(value)] * 2000 >= least)
}
