//! Checksums of serial sensors.

use crc::{CRC_16_IBM_3740, CRC_16_MODBUS, CRC_32_ISO_HDLC, Crc, Table};
use serde::{Deserialize, Serialize};

/// A checksum. Its bytes are sent low byte first, or high byte first in the forms that end with
/// `Be`.
///
/// [`Settings`](super::Settings) has an example.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Checksum {
    /// No checksum.
    None,
    /// The sum of the bytes, modulo 256.
    Sum8,
    /// The exclusive or of the bytes.
    Xor8,
    /// CRC-16/MODBUS: polynomial 0x8005 reflected, start 0xFFFF.
    Crc16Modbus,
    /// The same, high byte first.
    Crc16ModbusBe,
    /// CRC-16/CCITT-FALSE (IBM-3740): polynomial 0x1021, start 0xFFFF, not reflected.
    Crc16Ccitt,
    /// The same, high byte first.
    Crc16CcittBe,
    /// CRC-32 (ISO-HDLC), as in zip and Ethernet: polynomial 0x04C11DB7 reflected, start and final
    /// exclusive or 0xFFFFFFFF.
    Crc32,
    /// The same, high byte first.
    Crc32Be,
}

impl Checksum {
    /// The number of bytes that the checksum takes on the wire.
    pub fn bytes(self) -> usize {
        match self {
            Checksum::None => 0,
            Checksum::Sum8 | Checksum::Xor8 => 1,
            Checksum::Crc16Modbus
            | Checksum::Crc16ModbusBe
            | Checksum::Crc16Ccitt
            | Checksum::Crc16CcittBe => 2,
            Checksum::Crc32 | Checksum::Crc32Be => 4,
        }
    }

    /// The checksum of `bytes`.
    pub fn of(self, bytes: &[u8]) -> u32 {
        match self {
            Checksum::None => 0,
            Checksum::Sum8 => {
                u32::from(bytes.iter().fold(0_u8, |sum, &byte| sum.wrapping_add(byte)))
            }
            Checksum::Xor8 => u32::from(bytes.iter().fold(0_u8, |sum, &byte| sum ^ byte)),
            Checksum::Crc16Modbus | Checksum::Crc16ModbusBe => MODBUS.checksum(bytes).into(),
            Checksum::Crc16Ccitt | Checksum::Crc16CcittBe => CCITT.checksum(bytes).into(),
            Checksum::Crc32 | Checksum::Crc32Be => CRC32.checksum(bytes),
        }
    }

    /// The checksum of `bytes` as it is sent. Only the first [`Self::bytes`] of the result count.
    pub fn sent(self, bytes: &[u8]) -> [u8; 4] {
        let sum = self.of(bytes);
        match self {
            Checksum::Crc16ModbusBe | Checksum::Crc16CcittBe | Checksum::Crc32Be => {
                (sum << (32 - 8 * self.bytes())).to_be_bytes()
            }
            _ => sum.to_le_bytes(),
        }
    }
}

/// The bytes that a checksum covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ChecksumOver {
    /// All bytes before the checksum.
    All,
    /// The cells alone.
    Cells,
}

static MODBUS: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_MODBUS);
static CCITT: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_IBM_3740);
static CRC32: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn check_values_are_those_of_the_crc_catalogue() {
        let check = b"123456789";
        assert_eq!(Checksum::Crc16Modbus.of(check), 0x4B37);
        assert_eq!(Checksum::Crc16Ccitt.of(check), 0x29B1);
        assert_eq!(Checksum::Crc32.of(check), 0xCBF4_3926);
        assert_eq!(Checksum::Sum8.of(check), 0xDD);
        assert_eq!(Checksum::Xor8.of(check), 0x31);
    }
}
