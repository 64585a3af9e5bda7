//! Frames of whole presses in memory: only the taxels that read something, which are a twentieth of
//! all.

use hardnessd_core::verdict::{ModelFrame, TAXELS};

/// Newtons per unit of a file's `frames_mn`.
pub(super) const NEWTONS: f32 = 1e-3;

/// Frames in millinewtons.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Frames {
    /// Place and millinewtons of each taxel above 0, frame by frame.
    taxels: Vec<(u16, u16)>,
    /// The number of such taxels up to the end of each frame.
    ends: Vec<usize>,
}

impl Frames {
    /// The frames in `millinewtons`, `[frames, 784]`.
    pub(super) fn of(millinewtons: &[u16]) -> Self {
        let mut frames = Self::default();
        for frame in millinewtons.chunks(TAXELS) {
            frames.push(frame.iter().copied());
        }
        frames.taxels.shrink_to_fit();
        frames
    }

    /// The number of frames.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Adds a frame of [`TAXELS`] numbers.
    pub(super) fn push(&mut self, millinewtons: impl Iterator<Item = u16>) {
        let loaded = (0..).zip(millinewtons).filter(|&(_, mn)| mn > 0);
        self.taxels.extend(loaded);
        self.ends.push(self.taxels.len());
    }

    pub(super) fn append(&mut self, other: &Self) {
        let before = self.taxels.len();
        self.taxels.extend_from_slice(&other.taxels);
        self.ends.extend(other.ends.iter().map(|end| before + end));
    }

    fn taxels(&self, frame: usize) -> &[(u16, u16)] {
        let begin = frame.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.taxels[begin..self.ends[frame]]
    }

    /// A frame in newtons.
    pub(super) fn newtons(&self, frame: usize) -> ModelFrame {
        let mut dense = ModelFrame::default();
        for &(place, mn) in self.taxels(frame) {
            dense.newtons[usize::from(place)] = f32::from(mn) * NEWTONS;
        }
        dense
    }

    /// All frames as a file has them, `[frames, 784]`.
    pub(super) fn dense(&self) -> Vec<u16> {
        let mut all = vec![0; self.len() * TAXELS];
        for (number, frame) in all.chunks_mut(TAXELS).enumerate() {
            for &(place, mn) in self.taxels(number) {
                frame[usize::from(place)] = mn;
            }
        }
        all
    }
}
