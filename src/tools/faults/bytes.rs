//! Faults of a frame's bytes.

use super::times::Frames;
use hardnessd_simulator::random::Stream;

/// A fault of some frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OfBytes {
    pub(super) frames: Frames,
    pub(super) damage: Damage,
}

/// What happens to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Damage {
    /// Random bytes come before it.
    Noise { bytes: usize },
    /// It loses bytes.
    DropBytes { bytes: usize },
    /// Bits of it are inverted.
    Flip { bits: usize },
    /// It comes twice.
    Repeat,
}

impl OfBytes {
    /// Damages the frame that is due at `time_s`.
    pub(super) fn strike(&mut self, time_s: f64, stream: &mut Stream, frame: &mut Vec<u8>) {
        if !self.frames.take(time_s) {
            return;
        }
        match self.damage {
            Damage::Noise { bytes } => {
                let noise = (0..bytes).map(|_| (stream.next_u64() >> 56) as u8);
                let noise: Vec<u8> = noise.collect();
                frame.splice(0..0, noise);
            }
            Damage::DropBytes { bytes } => {
                for _ in 0..bytes.min(frame.len()) {
                    frame.remove(stream.below(frame.len()));
                }
            }
            Damage::Flip { bits } => {
                // If all bytes were dropped, there is no bit to invert.
                let bits = if frame.is_empty() { 0 } else { bits };
                for _ in 0..bits {
                    let bit = stream.below(frame.len() * 8);
                    frame[bit / 8] ^= 1 << (bit % 8);
                }
            }
            Damage::Repeat => frame.extend_from_within(..),
        }
    }
}
