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
