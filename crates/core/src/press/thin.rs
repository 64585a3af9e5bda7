//! The choice of a long press's frames for a model of its course.

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
    if places.binary_search(&best).is_ok() {
        return places;
    }
    let mut places = evenly(most - 1);
    if let Err(at) = places.binary_search(&best) {
        places.insert(at, best);
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_best_and_last_stay_and_the_rest_is_even() {
        for (frames, most) in [(1, 3), (47, 48), (48, 48), (49, 48), (700, 48), (50, 3)] {
            for best in [0, 1, frames / 3, frames - 1] {
                let best = best.min(frames - 1);
                let places = thinned(frames, best, most);
                assert!(places.len() <= most);
                assert!(places.len() + 1 >= most.min(frames), "{frames}: {places:?}");
                assert!(places.is_sorted_by(|a, b| a < b), "{places:?}");
                for kept in [0, best, frames - 1] {
                    assert!(places.contains(&kept), "{kept} of {frames} is missing");
                }
                let widest = places.windows(2).map(|pair| pair[1] - pair[0]).max();
                let even = frames.div_ceil(most.min(frames).saturating_sub(2).max(1));
                assert!(widest.unwrap_or(1) <= even + 1, "{frames}: {widest:?}");
            }
        }
    }
}
