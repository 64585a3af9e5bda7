//! A frame as short text: its taxels that are not 0, in base64.
//!
//! Each such taxel has six bytes: its place in the frame (u16) and its newtons (f32), both
//! little-endian. The places ascend. `docs/formats.md` shows how numpy reads and writes the text.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serializer, de::Error};

use super::{Frame, TAXELS};

/// The bytes of one taxel.
const BYTES: usize = 6;

/// The frame as text.
pub fn write(frame: &Frame) -> String {
    let mut bytes = Vec::new();
    for (place, newtons) in (0_u16..).zip(frame.newtons) {
        // A negative zero is kept, so that a frame is read back bit for bit.
        if newtons.to_bits() != 0 {
            bytes.extend(place.to_le_bytes());
            bytes.extend(newtons.to_le_bytes());
        }
    }
    STANDARD.encode(bytes)
}

/// The reason why a text is not a frame.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SparseError {
    /// The text is not base64.
    #[error("found no base64 ({0})")]
    Text(#[from] base64::DecodeError),
    /// The number of bytes is not a multiple of a taxel's bytes.
    #[error("found {0} bytes, expected {BYTES} a taxel")]
    Length(usize),
    /// The place is outside the frame, or does not follow the place before it.
    #[error("found place {0}, expected ascending places below {TAXELS}")]
    Place(u16),
    /// The force is negative or not finite.
    #[error("found {0} N at a taxel, expected 0 or more")]
    Newtons(f32),
}

/// Reads the frame that a text holds.
///
/// # Errors
///
/// Returns a [`SparseError`] if the text holds no frame.
pub fn read(text: &str) -> Result<Frame, SparseError> {
    let bytes = STANDARD.decode(text)?;
    let (taxels, rest) = bytes.as_chunks::<BYTES>();
    if !rest.is_empty() {
        return Err(SparseError::Length(bytes.len()));
    }
    let mut frame = Frame::default();
    let mut least = 0;
    for &[low, high, newtons @ ..] in taxels {
        let place = u16::from_le_bytes([low, high]);
        let newtons = f32::from_le_bytes(newtons);
        if usize::from(place) >= TAXELS || place < least {
            return Err(SparseError::Place(place));
        }
        if !newtons.is_finite() || newtons < 0.0 {
            return Err(SparseError::Newtons(newtons));
        }
        frame.newtons[usize::from(place)] = newtons;
        least = place + 1;
    }
    Ok(frame)
}

/// Used by `#[serde(with)]`.
pub(crate) fn serialize<S: Serializer>(frame: &Frame, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&write(frame))
}

/// Used by `#[serde(with)]`.
pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Frame, D::Error> {
    let text = String::deserialize(deserializer)?;
    read(&text).map_err(D::Error::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_read_as_it_was_written() {
        let mut frame = Frame::default();
        assert_eq!(write(&frame), "");
        for (place, newtons) in [(0, 0.5), (3, 1e-30), (783, 10.2), (400, 0.04)] {
            frame.newtons[place] = newtons;
        }
        assert_eq!(read(&write(&frame)), Ok(frame));
        assert_eq!(&write(&frame)[..8], "AAAAAAA/");
    }

    #[test]
    fn text_that_is_no_frame_says_why() {
        let text = |taxels: &[(u16, f32)]| {
            let bytes = taxels.iter().flat_map(|(place, newtons)| {
                place.to_le_bytes().into_iter().chain(newtons.to_le_bytes())
            });
            STANDARD.encode(bytes.collect::<Vec<u8>>())
        };
        assert!(matches!(read("*"), Err(SparseError::Text(_))));
        assert_eq!(read("AAAA"), Err(SparseError::Length(3)));
        assert_eq!(read(&text(&[(784, 1.0)])), Err(SparseError::Place(784)));
        let twice = text(&[(7, 1.0), (7, 1.0)]);
        assert_eq!(read(&twice), Err(SparseError::Place(7)));
        assert_eq!(read(&text(&[(7, -1.0)])), Err(SparseError::Newtons(-1.0)));
        assert!(read(&text(&[(7, f32::NAN)])).is_err());
    }
}
