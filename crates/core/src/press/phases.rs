//! The parts of a press by its forces: loading, holding, release.

/// Loading ends at the first frame that has this share of the greatest force. A steady approach may
/// end there.
const LOADED_SHARE: f64 = 0.95;
/// After loading, an arm that moves at a steady speed holds its position until the force falls below
/// this share of the greatest force. Creep takes the force down by less. Of the shares from 0.5 to
/// 0.9, this one gave the most right verdicts on presses that only served to choose.
const HELD_SHARE: f64 = 0.8;

/// Places among the frames of a press.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Phases {
    /// The last frame of loading.
    pub loaded: usize,
    /// The first frame with the greatest force.
    pub top: usize,
    /// The last frame of the hold.
    pub held: usize,
}

impl Phases {
    /// The phases of a press whose frames have these forces. There is at least one.
    pub fn of(forces_n: &[f64]) -> Self {
        let greatest = forces_n.iter().copied().fold(0.0, f64::max);
        let first = |share: f64| {
            let mut forces = forces_n.iter();
            let place = forces.position(|&force| force >= share * greatest);
            place.unwrap_or(0)
        };
        let top = first(1.0);
        let falls = |&place: &usize| forces_n[place] < HELD_SHARE * greatest;
        let fallen = (top..forces_n.len()).find(falls);
        Self {
            loaded: first(LOADED_SHARE),
            top,
            held: fallen.unwrap_or(forces_n.len()) - 1,
        }
    }
}
