//! Checksums of serial sensors.

use crc::{
    Algorithm, CRC_8_SMBUS, CRC_16_IBM_3740, CRC_16_MODBUS, CRC_16_XMODEM, CRC_32_ISO_HDLC, Crc,
    Table,
};
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
    Crc(&'static Crc<u32, Table<16>>),
}

impl Checksum {
    /// The number of bytes that the checksum takes on the wire.
    pub fn bytes(self) -> usize {
        match self {
            Checksum::None => 0,
            Checksum::Sum8 | Checksum::Xor8 | Checksum::Lrc8 | Checksum::Crc8 => 1,
            Checksum::Crc32 | Checksum::Crc32Be => 4,
            _ => 2,
        }
    }

    fn is_big_endian(self) -> bool {
        matches!(
            self,
            Checksum::Sum16Be
                | Checksum::Crc16ModbusBe
                | Checksum::Crc16CcittBe
                | Checksum::Crc16XmodemBe
                | Checksum::Crc32Be
        )
    }

    fn method(self) -> Method {
        match self {
            Checksum::None | Checksum::Sum8 | Checksum::Sum16 | Checksum::Sum16Be => Method::Sum,
            Checksum::Lrc8 => Method::Negated,
            Checksum::Xor8 => Method::Xor,
            Checksum::Crc8 => Method::Crc(&CRC8),
            Checksum::Crc16Modbus | Checksum::Crc16ModbusBe => Method::Crc(&MODBUS),
            Checksum::Crc16Ccitt | Checksum::Crc16CcittBe => Method::Crc(&CCITT),
            Checksum::Crc16Xmodem | Checksum::Crc16XmodemBe => Method::Crc(&XMODEM),
            Checksum::Crc32 | Checksum::Crc32Be => Method::Crc(&CRC32),
        }
    }

    /// The checksum of `bytes`.
    pub fn of(self, bytes: &[u8]) -> u32 {
        match self.method() {
            Method::Crc(crc) => crc.checksum(bytes),
            method => self.finished(method.after(0, bytes)),
        }
    }

    /// The checksum of `bytes` as it is sent. Only the first [`Self::bytes`] of the result count.
    pub fn sent(self, bytes: &[u8]) -> [u8; 4] {
        self.written(self.of(bytes))
    }

    fn written(self, sum: u32) -> [u8; 4] {
        match self.is_big_endian() {
            true => (sum << (32 - 8 * self.bytes())).to_be_bytes(),
            false => sum.to_le_bytes(),
        }
    }

    /// The checksum of bytes whose state is `state`.
    fn finished(self, state: u32) -> u32 {
        let value = match self.method() {
            Method::Negated => state.wrapping_neg(),
            Method::Sum | Method::Xor => state,
            Method::Crc(crc) => state ^ crc.algorithm.xorout,
        };
        match self.bytes() {
            0 => 0,
            bytes => value & (u32::MAX >> (32 - 8 * bytes)),
        }
    }
}

impl Method {
    /// The state after `bytes`, if it was `state` before them. A state begins with 0.
    fn after(self, state: u32, bytes: &[u8]) -> u32 {
        match self {
            Method::Sum | Method::Negated => bytes
                .iter()
                .fold(state, |sum, &byte| sum.wrapping_add(byte.into())),
            Method::Xor => bytes.iter().fold(state, |xor, &byte| xor ^ u32::from(byte)),
            Method::Crc(crc) => {
                let mut digest = crc.digest_with_initial(mirrored(crc.algorithm, state));
                digest.update(bytes);
                digest.finalize() ^ crc.algorithm.xorout
            }
        }
    }
}

/// An initial value as a state, or a state as an initial value: the crate reverses the bits of an
/// initial value for an algorithm that is reflected.
fn mirrored(algorithm: &Algorithm<u32>, value: u32) -> u32 {
    match algorithm.refin {
        true => value.reverse_bits() >> (32 - algorithm.width),
        false => value,
    }
}

/// The checksums of stretches of the same bytes. Stretches that overlap cost no more than the bytes
/// they cover together, however many there are: a search through damaged bytes takes a time in
/// proportion to their number.
///
/// The state of a stretch is that after its end, less what the state before its beginning has become
/// by its end. Of a CRC, the latter is a linear function of the bits of the state, for each length
/// another one, as in `crc32_combine` of zlib.
pub(super) struct Sums<'a> {
    checksum: Checksum,
    bytes: &'a [u8],
    /// The end of the stretches so far, as long as none overlap.
    end: usize,
    /// From where on `states` are known.
    from: usize,
    /// The state after each of the bytes from `from` on. Empty as long as no stretches overlap.
    states: Vec<u32>,
    /// For each length so far, what becomes of each bit of a state.
    shifts: Vec<(usize, Vec<u32>)>,
}

impl<'a> Sums<'a> {
    pub(super) fn new(checksum: Checksum, bytes: &'a [u8]) -> Self {
        Self {
            checksum,
            bytes,
            end: 0,
            from: 0,
            states: Vec::new(),
            shifts: Vec::new(),
        }
    }

    /// The checksum of `bytes[start..end]`, as it is sent. No later stretch may begin before the
    /// first one that overlaps another.
    pub(super) fn sent(&mut self, start: usize, end: usize) -> [u8; 4] {
        if self.states.is_empty() {
            if start >= self.end {
                self.end = end;
                return self.checksum.sent(&self.bytes[start..end]);
            }
            self.from = start;
            self.states.push(0);
        }
        let method = self.checksum.method();
        for at in self.from + self.states.len() - 1..end {
            let last = self.states[self.states.len() - 1];
            self.states.push(method.after(last, &self.bytes[at..=at]));
        }
        let (before, after) = (self.states[start - self.from], self.states[end - self.from]);
        let state = match method {
            Method::Sum | Method::Negated => after.wrapping_sub(before),
            Method::Xor => after ^ before,
            Method::Crc(crc) => {
                let begin = before ^ mirrored(crc.algorithm, crc.algorithm.init);
                after ^ self.shifted(crc, begin, end - start)
            }
        };
        self.checksum.written(self.checksum.finished(state))
    }

    /// What becomes of a state by `length` bytes of 0.
    fn shifted(&mut self, crc: &'static Crc<u32, Table<16>>, state: u32, length: usize) -> u32 {
        if !self.shifts.iter().any(|(known, _)| *known == length) {
            let zeros = vec![0; length];
            let bits = 0..crc.algorithm.width;
            let of_bit = |bit| Method::Crc(crc).after(1_u32 << bit, &zeros);
            self.shifts.push((length, bits.map(of_bit).collect()));
        }
        let known = self.shifts.iter().find(|(known, _)| *known == length);
        let of_bits = known.map_or(&[][..], |(_, of_bits)| of_bits);
        let set = of_bits.iter().enumerate();
        set.filter(|(bit, _)| state >> bit & 1 == 1)
            .fold(0, |shifted, (_, of_bit)| shifted ^ of_bit)
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

/// The same algorithm for states of 32 bits.
macro_rules! wide {
    ($algorithm:expr) => {
        Algorithm {
            width: $algorithm.width,
            poly: $algorithm.poly as u32,
            init: $algorithm.init as u32,
            refin: $algorithm.refin,
            refout: $algorithm.refout,
            xorout: $algorithm.xorout as u32,
            check: $algorithm.check as u32,
            residue: $algorithm.residue as u32,
        }
    };
}

const CRC8_ALGORITHM: Algorithm<u32> = wide!(CRC_8_SMBUS);
const MODBUS_ALGORITHM: Algorithm<u32> = wide!(CRC_16_MODBUS);
const CCITT_ALGORITHM: Algorithm<u32> = wide!(CRC_16_IBM_3740);
const XMODEM_ALGORITHM: Algorithm<u32> = wide!(CRC_16_XMODEM);

static CRC8: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC8_ALGORITHM);
static MODBUS: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&MODBUS_ALGORITHM);
static CCITT: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CCITT_ALGORITHM);
static XMODEM: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&XMODEM_ALGORITHM);
static CRC32: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

#[cfg(test)]
mod tests {
    use super::*;

    /// Every checksum, and what it is of `123456789` by the catalogue of CRCs and by hand.
    const CHECKED: [(Checksum, u32); 11] = [
        (Checksum::None, 0),
        (Checksum::Sum8, 0xDD),
        (Checksum::Xor8, 0x31),
        (Checksum::Lrc8, 0x23),
        (Checksum::Sum16, 0x01DD),
        (Checksum::Crc8, 0xF4),
        (Checksum::Crc16Modbus, 0x4B37),
        (Checksum::Crc16Ccitt, 0x29B1),
        (Checksum::Crc16Xmodem, 0x31C3),
        (Checksum::Crc32, 0xCBF4_3926),
        (Checksum::Crc32Be, 0xCBF4_3926),
    ];

    #[test]
    fn check_values_are_those_of_the_crc_catalogue() {
        for (checksum, expected) in CHECKED {
            assert_eq!(checksum.of(b"123456789"), expected, "{checksum:?}");
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
                    let found = sums.sent(start, start + length);
                    assert_eq!(found, expected, "{checksum:?} from {start}");
                }
            }
        }
    }
}
