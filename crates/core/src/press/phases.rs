//! The frames of a press by what they are for: loading, holding, release; and the choice of some.

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
        // Below a baseline that stands too high, no force is above 0. Such a press has fallen after its first
        // frame.
        let fallen = (top + 1..forces_n.len()).find(falls);
        Self {
            loaded: first(LOADED_SHARE),
            top,
            held: fallen.unwrap_or(forces_n.len()) - 1,
        }
    }
}

/// The places of at most `most` of a press's `frames`: evenly from the first to the last, with the
/// best among them. If there are no more than `most` frames, all places.
///
/// # Panics
///
/// Panics if `best` is not below `frames`, or `most` is under 3.
pub fn thinned(frames: usize, best: usize, most: usize) -> Vec<usize> {
    assert!(best < frames && most >= 3, "{best} of {frames}, {most}");
    if frames <= most {
        return (0..frames).collect();
    }
    let evenly = |count: usize| -> Vec<usize> {
        (0..count).map(|k| k * (frames - 1) / (count - 1)).collect()
    };
    let places = evenly(most);
    if places.contains(&best) {
        return places;
    }
    let mut places = evenly(most - 1);
    if let Err(at) = places.binary_search(&best) {
        places.insert(at, best);
    }
    places
}
