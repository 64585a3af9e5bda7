//! Checksums of serial sensors.

use crc::{CRC_16_IBM_3740, CRC_16_MODBUS, Crc, Table};
use serde::{Deserialize, Serialize};

/// A checksum over all bytes of the frame before it, sent little-endian.
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
    /// CRC-16/CCITT-FALSE (IBM-3740): polynomial 0x1021, start 0xFFFF, not reflected.
    Crc16Ccitt,
}

impl Checksum {
    /// The number of bytes that the checksum takes on the wire.
    pub fn bytes(self) -> usize {
        match self {
            Checksum::None => 0,
            Checksum::Sum8 | Checksum::Xor8 => 1,
            Checksum::Crc16Modbus | Checksum::Crc16Ccitt => 2,
        }
    }

    /// The checksum of `bytes`.
    pub fn of(self, bytes: &[u8]) -> u16 {
        match self {
            Checksum::None => 0,
            Checksum::Sum8 => {
                u16::from(bytes.iter().fold(0_u8, |sum, &byte| sum.wrapping_add(byte)))
            }
            Checksum::Xor8 => u16::from(bytes.iter().fold(0_u8, |sum, &byte| sum ^ byte)),
            Checksum::Crc16Modbus => MODBUS.checksum(bytes),
            Checksum::Crc16Ccitt => CCITT.checksum(bytes),
        }
    }
}

static MODBUS: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_MODBUS);
static CCITT: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_IBM_3740);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn check_values_are_those_of_the_crc_catalogue() {
        let check = b"123456789";
        assert_eq!(Checksum::Crc16Modbus.of(check), 0x4B37);
        assert_eq!(Checksum::Crc16Ccitt.of(check), 0x29B1);
        assert_eq!(Checksum::Sum8.of(check), 0xDD);
        assert_eq!(Checksum::Xor8.of(check), 0x31);
    }
}
