//! Checksums of serial sensors.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::{Deserialize, Serialize};

/// A checksum. Its bytes are sent low byte first, or high byte first in the forms that end with
/// `Be`.
///
/// [`Settings`](super::Settings) has an example.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Checksum {
    /// No checksum.
    #[default]
    None,
    /// The sum of the bytes, modulo 256.
    Sum8,
    /// The exclusive or of the bytes.
    Xor8,
    /// The two's complement of the sum of the bytes, as in Modbus ASCII.
    Lrc8,
    /// The sum of the bytes, modulo 65536.
    Sum16,
    /// The same, high byte first.
    Sum16Be,
    /// CRC-8 (SMBus): polynomial 0x07, start 0.
    Crc8,
    /// CRC-16/MODBUS: polynomial 0x8005 reflected, start 0xFFFF.
    Crc16Modbus,
    /// The same, high byte first.
    Crc16ModbusBe,
    /// CRC-16/CCITT-FALSE (IBM-3740): polynomial 0x1021, start 0xFFFF, not reflected.
    Crc16Ccitt,
    /// The same, high byte first.
    Crc16CcittBe,
    /// CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected.
    Crc16Xmodem,
    /// The same, high byte first.
    Crc16XmodemBe,
    /// CRC-32 (ISO-HDLC), as in zip and Ethernet: polynomial 0x04C11DB7 reflected, start and final
    /// exclusive or 0xFFFFFFFF.
    Crc32,
    /// The same, high byte first.
    Crc32Be,
}

/// How a checksum is computed.
#[derive(Clone, Copy)]
enum Method {
    Sum,
    Negated,
    Xor,
    Crc(&'static Crc),
}

impl Checksum {
    /// The number of bytes on the wire, whether the high one comes first, and the method.
    fn parts(self) -> (usize, bool, Method) {
        match self {
            Checksum::None => (0, false, Method::Sum),
            Checksum::Sum8 => (1, false, Method::Sum),
            Checksum::Xor8 => (1, false, Method::Xor),
            Checksum::Lrc8 => (1, false, Method::Negated),
            Checksum::Sum16 => (2, false, Method::Sum),
            Checksum::Sum16Be => (2, true, Method::Sum),
            Checksum::Crc8 => (1, false, Method::Crc(&CRC8)),
            Checksum::Crc16Modbus => (2, false, Method::Crc(&MODBUS)),
            Checksum::Crc16ModbusBe => (2, true, Method::Crc(&MODBUS)),
            Checksum::Crc16Ccitt => (2, false, Method::Crc(&CCITT)),
            Checksum::Crc16CcittBe => (2, true, Method::Crc(&CCITT)),
            Checksum::Crc16Xmodem => (2, false, Method::Crc(&XMODEM)),
            Checksum::Crc16XmodemBe => (2, true, Method::Crc(&XMODEM)),
            Checksum::Crc32 => (4, false, Method::Crc(&CRC32)),
            Checksum::Crc32Be => (4, true, Method::Crc(&CRC32)),
        }
    }

    /// The number of bytes that the checksum takes on the wire.
    pub fn bytes(self) -> usize {
        self.parts().0
    }

    /// The checksum of `bytes` as it is sent. Only the first [`Self::bytes`] of the result count.
    pub fn sent(self, bytes: &[u8]) -> [u8; 4] {
        let (_, _, method) = self.parts();
        let begin = match method {
            Method::Crc(crc) => crc.init,
            Method::Sum | Method::Negated | Method::Xor => 0,
        };
        let after = |state, &byte: &u8| method.after(state, byte);
        self.finished(bytes.iter().fold(begin, after))
    }

    /// The checksum of bytes with this state after the last one, as it is sent.
    fn finished(self, state: u32) -> [u8; 4] {
        let (bytes, is_big_endian, method) = self.parts();
        let sum = match method {
            Method::Sum | Method::Xor => state,
            Method::Negated => state.wrapping_neg(),
            Method::Crc(crc) => crc.finished(state),
        };
        match (bytes, is_big_endian) {
            (0, _) => [0; 4],
            (bytes, true) => (sum << (32 - 8 * bytes)).to_be_bytes(),
            (bytes, false) => (sum & (u32::MAX >> (32 - 8 * bytes))).to_le_bytes(),
        }
    }
}

impl Method {
    /// The state after `byte`, if it was `state` before.
    fn after(self, state: u32, byte: u8) -> u32 {
        match self {
            Method::Sum | Method::Negated => state.wrapping_add(byte.into()),
            Method::Xor => state ^ u32::from(byte),
            Method::Crc(crc) => crc.after(state, byte),
        }
    }
}

/// A CRC. Its states are polynomials whose lowest bit is that of the highest power, as in algorithms
/// that are reflected.
struct Crc {
    width: u32,
    /// The polynomial, in the order of bits of the states.
    polynomial: u32,
    /// The state before the first byte. It reads the same in both orders of bits, and so does `xorout`.
    init: u32,
    xorout: u32,
    /// Whether the lowest bit of a byte comes first.
    is_reflected: bool,
    /// The state after each byte, if it was 0 before.
    table: [u32; 256],
}

impl Crc {
    /// The CRC with these parameters of the catalogue of CRCs.
    const fn new(width: u32, polynomial: u32, init: u32, xorout: u32, is_reflected: bool) -> Self {
        let polynomial = polynomial.reverse_bits() >> (32 - width);
        let mut table = [0; 256];
        let mut byte = 0;
        while byte < table.len() {
            let mut state = byte as u32;
            let mut bit = 0;
            while bit < 8 {
                state = times_x(state, polynomial);
                bit += 1;
            }
            table[byte] = state;
            byte += 1;
        }
        Self {
            width,
            polynomial,
            init,
            xorout,
            is_reflected,
            table,
        }
    }

    fn after(&self, state: u32, byte: u8) -> u32 {
        let byte = match self.is_reflected {
            true => byte,
            false => byte.reverse_bits(),
        };
        self.table[usize::from(state as u8 ^ byte)] ^ (state >> 8)
    }

    fn finished(&self, state: u32) -> u32 {
        let sum = match self.is_reflected {
            true => state,
            false => state.reverse_bits() >> (32 - self.width),
        };
        sum ^ self.xorout
    }

    /// The product of two states, modulo the polynomial.
    fn product(&self, one: u32, mut other: u32) -> u32 {
        let mut product = 0;
        for bit in (0..self.width).rev() {
            if one >> bit & 1 == 1 {
                product ^= other;
            }
            other = times_x(other, self.polynomial);
        }
        product
    }

    /// What a state is multiplied by in `length` bytes of 0: x to the power of their bits.
    fn power(&self, length: usize) -> u32 {
        let one = 1 << (self.width - 1);
        let (mut power, mut square) = (one, times_x(one, self.polynomial));
        let mut exponent = 8 * length;
        while exponent > 0 {
            if exponent & 1 == 1 {
                power = self.product(power, square);
            }
            square = self.product(square, square);
            exponent >>= 1;
        }
        power
    }
}

const fn times_x(state: u32, polynomial: u32) -> u32 {
    match state & 1 {
        0 => state >> 1,
        _ => (state >> 1) ^ polynomial,
    }
}

static CRC8: Crc = Crc::new(8, 0x07, 0, 0, false);
static MODBUS: Crc = Crc::new(16, 0x8005, 0xFFFF, 0, true);
static CCITT: Crc = Crc::new(16, 0x1021, 0xFFFF, 0, false);
static XMODEM: Crc = Crc::new(16, 0x1021, 0, 0, false);
static CRC32: Crc = Crc::new(32, 0x04C1_1DB7, u32::MAX, u32::MAX, true);

/// The checksums of stretches of the same bytes. Stretches that overlap cost no more than the bytes
/// they cover together, however many there are: a search through damaged bytes takes a time in
/// proportion to their number.
///
/// The state of a stretch is that after its end, less what the state before its beginning has become
/// by its end, as in `crc32_combine` of zlib.
pub(super) struct Sums<'a> {
    checksum: Checksum,
    bytes: &'a [u8],
    /// The end of the stretches that did not overlap the ones before them.
    end: usize,
    /// The state before the first byte and after each one, from 0 on, once a stretch has overlapped.
    states: Vec<u32>,
    /// What a state is multiplied by in stretches of these lengths.
    powers: BTreeMap<usize, u32>,
}

impl<'a> Sums<'a> {
    pub(super) fn new(checksum: Checksum, bytes: &'a [u8]) -> Self {
        Self {
            checksum,
            bytes,
            end: 0,
            states: vec![0],
            powers: BTreeMap::new(),
        }
    }

    /// The checksum of the bytes `stretch`, as it is sent.
    pub(super) fn sent(&mut self, stretch: Range<usize>) -> [u8; 4] {
        if stretch.start >= self.end {
            self.end = stretch.end;
            return self.checksum.sent(&self.bytes[stretch]);
        }
        let (_, _, method) = self.checksum.parts();
        for at in self.states.len() - 1..stretch.end {
            let after = method.after(self.states[at], self.bytes[at]);
            self.states.push(after);
        }
        let (before, after) = (self.states[stretch.start], self.states[stretch.end]);
        self.checksum.finished(match method {
            Method::Sum | Method::Negated => after.wrapping_sub(before),
            Method::Xor => after ^ before,
            Method::Crc(crc) => {
                let power = self.powers.entry(stretch.len());
                let power = power.or_insert_with_key(|&length| crc.power(length));
                after ^ crc.product(*power, before ^ crc.init)
            }
        })
    }
}

/// The bytes that a checksum covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChecksumOver {
    /// All bytes before the checksum.
    #[default]
    All,
    /// All bytes before the checksum but those of `sync`.
    AfterSync,
    /// From the first byte of the first cell to the last byte of the last cell.
    Cells,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every checksum, and what it is of `123456789` by the catalogue of CRCs and by hand.
    const CHECKED: [(Checksum, u32); 15] = [
        (Checksum::None, 0),
        (Checksum::Sum8, 0xDD),
        (Checksum::Xor8, 0x31),
        (Checksum::Lrc8, 0x23),
        (Checksum::Sum16, 0x01DD),
        (Checksum::Sum16Be, 0x01DD),
        (Checksum::Crc8, 0xF4),
        (Checksum::Crc16Modbus, 0x4B37),
        (Checksum::Crc16ModbusBe, 0x4B37),
        (Checksum::Crc16Ccitt, 0x29B1),
        (Checksum::Crc16CcittBe, 0x29B1),
        (Checksum::Crc16Xmodem, 0x31C3),
        (Checksum::Crc16XmodemBe, 0x31C3),
        (Checksum::Crc32, 0xCBF4_3926),
        (Checksum::Crc32Be, 0xCBF4_3926),
    ];

    #[test]
    fn check_values_are_those_of_the_crc_catalogue() {
        for (checksum, expected) in CHECKED {
            let mut sent = checksum.sent(b"123456789")[..checksum.bytes()].to_vec();
            if !checksum.parts().1 {
                sent.reverse();
            }
            let found = sent.iter().fold(0, |sum, &byte| sum << 8 | u32::from(byte));
            assert_eq!(found, expected, "{checksum:?}");
        }
    }

    #[test]
    fn overlapping_stretches_have_the_checksums_of_their_bytes() {
        let bytes: Vec<u8> = (0..400_u32).map(|n| (n * n * 7 + 3 * n) as u8).collect();
        for (checksum, _) in CHECKED {
            let mut sums = Sums::new(checksum, &bytes);
            for start in (0..200).step_by(3) {
                for length in [150, 40] {
                    let expected = checksum.sent(&bytes[start..start + length]);
                    let found = sums.sent(start..start + length);
                    assert_eq!(found, expected, "{checksum:?} from {start}");
                }
            }
        }
    }
}
