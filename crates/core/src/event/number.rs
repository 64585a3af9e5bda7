//! How numbers are written: the same text as serde_json's, and sooner where a number has few digits.
//!
//! Most numbers of an event are the forces of a frame, rounded to three digits.

use std::io::{self, Write};

use serde::Serialize;
use serde_json::Serializer;
use serde_json::ser::{CompactFormatter, Formatter};

/// A value as JSON, without spaces.
pub(super) fn json<T: Serialize>(value: &T) -> String {
    let mut text = Vec::with_capacity(512);
    value
        .serialize(&mut Serializer::with_formatter(&mut text, Thousandths))
        .expect("plain structs of numbers and strings always serialise");
    String::from_utf8(text).expect("JSON is UTF-8")
}

/// Writes whole thousandths by their digits.
struct Thousandths;

/// From here on, an f64 may differ from its nearest thousandth and have the same text.
const LARGEST: f64 = 1e9;

impl Formatter for Thousandths {
    fn write_f64<W: ?Sized + Write>(&mut self, writer: &mut W, value: f64) -> io::Result<()> {
        let thousandths = (value * 1e3).round_ties_even();
        let is_whole = thousandths / 1e3 == value && value.abs() < LARGEST;
        let is_negative_zero = value == 0.0 && value.is_sign_negative();
        if !is_whole || is_negative_zero {
            return CompactFormatter.write_f64(writer, value);
        }
        let thousandths = thousandths.abs() as u64;
        let mut text = [b'0'; 16];
        let fraction = thousandths % 1000;
        let digits = match fraction {
            0 => 1,
            _ if fraction.is_multiple_of(100) => 1,
            _ if fraction.is_multiple_of(10) => 2,
            _ => 3,
        };
        let mut end = 13;
        for (place, unit) in [(0, 100), (1, 10), (2, 1)] {
            text[end + place] = b'0' + (fraction / unit % 10) as u8;
        }
        let after = end + digits;
        end -= 1;
        text[end] = b'.';
        let mut whole = thousandths / 1000;
        loop {
            end -= 1;
            text[end] = b'0' + (whole % 10) as u8;
            whole /= 10;
            if whole == 0 {
                break;
            }
        }
        if value < 0.0 {
            end -= 1;
            text[end] = b'-';
        }
        writer.write_all(&text[end..after])
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::json;
    use crate::event::round_3;

    proptest! {
        #[test]
        fn every_number_is_written_as_by_serde_json(value in any::<f64>(), small in -1e6..1e6) {
            for value in [value, small, round_3(small)] {
                prop_assert_eq!(json(&value), serde_json::to_string(&value).unwrap());
            }
        }
    }
}
