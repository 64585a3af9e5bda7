//! Frames in memory: only the taxels that are not 0, which are few.

use hardnessd_core::verdict::ModelFrame;

/// Frames in newtons, one after the other.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Frames {
    /// Place and newtons of each taxel that is not 0, frame by frame.
    places: Vec<u16>,
    newtons: Vec<f32>,
    /// The number of such taxels up to the end of each frame.
    ends: Vec<usize>,
}

impl Frames {
    /// The number of frames.
    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// Makes room for so many taxels that are not 0. What grows takes up to twice its room.
    pub(super) fn reserve(&mut self, taxels: usize) {
        self.places.reserve_exact(taxels);
        self.newtons.reserve_exact(taxels);
    }

    /// Adds a frame of all taxels.
    pub(super) fn push(&mut self, newtons: impl Iterator<Item = f32>) {
        for (place, newtons) in (0..).zip(newtons) {
            if newtons != 0.0 {
                self.places.push(place);
                self.newtons.push(newtons);
            }
        }
        self.ends.push(self.places.len());
    }

    pub(super) fn append(&mut self, other: &Self) {
        let before = self.places.len();
        self.places.extend_from_slice(&other.places);
        self.newtons.extend_from_slice(&other.newtons);
        self.ends.extend(other.ends.iter().map(|end| before + end));
    }

    /// What they take in memory, with the time and the approach of each.
    pub(super) fn bytes(&self) -> usize {
        let of_taxel = size_of::<u16>() + size_of::<f32>();
        let of_frame = size_of::<usize>() + size_of::<(f32, Option<f32>)>();
        self.places.len() * of_taxel + self.ends.len() * of_frame
    }

    /// Place and newtons of the taxels of a frame that are not 0.
    pub(super) fn taxels(&self, number: usize) -> impl Iterator<Item = (u16, f32)> {
        let begin = number.checked_sub(1).map_or(0, |before| self.ends[before]);
        let taxels = begin..self.ends[number];
        let newtons = self.newtons[taxels.clone()].iter().copied();
        self.places[taxels].iter().copied().zip(newtons)
    }

    /// A frame with all its taxels.
    pub(super) fn frame(&self, number: usize) -> ModelFrame {
        let mut dense = ModelFrame::default();
        for (place, newtons) in self.taxels(number) {
            dense.newtons[usize::from(place)] = newtons;
        }
        dense
    }
}
