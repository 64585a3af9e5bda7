//! The newtons of a frame as short text: the taxels that are not 0, in base64.
//!
//! Each such taxel has six bytes: its place in the frame (u16) and its newtons (f32), both
//! little-endian. The places ascend. `docs/formats.md` shows how numpy reads and writes the text.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

/// The bytes of one taxel.
const BYTES: usize = 6;

/// The newtons of a frame as text.
pub fn write(newtons: &[f32]) -> String {
    let mut bytes = Vec::new();
    for (place, newtons) in (0_u16..).zip(newtons) {
        // A negative zero is kept, so that a frame is read back bit for bit.
        if newtons.to_bits() != 0 {
            bytes.extend(place.to_le_bytes());
            bytes.extend(newtons.to_le_bytes());
        }
    }
    STANDARD.encode(bytes)
}

/// Reads the newtons of a frame of `taxels` taxels.
///
/// # Errors
///
/// Returns the problem, in words, if the text holds no such frame.
pub fn read(text: &str, taxels: usize) -> Result<Vec<f32>, String> {
    let bytes = STANDARD.decode(text);
    let bytes = bytes.map_err(|error| format!("found no base64 ({error})"))?;
    let (written, rest) = bytes.as_chunks::<BYTES>();
    if !rest.is_empty() {
        return Err(format!(
            "found {} bytes, expected {BYTES} a taxel",
            bytes.len()
        ));
    }
    let mut all = vec![0.0; taxels];
    let mut least = 0;
    for &[low, high, newtons @ ..] in written {
        let place = u16::from_le_bytes([low, high]);
        let newtons = f32::from_le_bytes(newtons);
        if usize::from(place) >= taxels || place < least {
            let expected = format!("ascending places below {taxels}");
            return Err(format!("found place {place}, expected {expected}"));
        }
        if !newtons.is_finite() {
            return Err(format!(
                "found {newtons} N at a taxel, expected a finite number"
            ));
        }
        all[usize::from(place)] = newtons;
        least = place + 1;
    }
    Ok(all)
}
