//! A press on the array's own grid, in equal parts of its time.
//!
//! In: the frames of a press with their times. Out: the input `parts` of a model that has `hrn.grid`. The
//! trainer computes it with this code, so both see the same.

/// The number of parts.
pub const PARTS: usize = 8;

/// The mean newtons of each taxel in [`PARTS`] equal parts of a press's time, part by part: `[PARTS, rows,
/// cols]`, with the sign. Each moment is the time of a frame since the press began, ascending, and its
/// taxels. A part without a frame has the frame that is nearest to its middle.
///
/// # Panics
///
/// Panics if there is no frame.
///
/// # Example
///
/// ```
/// use hardnessd_core::verdict::parts::parts;
///
/// let frames = [[1.0], [3.0], [5.0], [7.0]];
/// let moments: Vec<(f32, &[f32])> = (0..4).map(|n| (n as f32, &frames[n][..])).collect();
/// assert_eq!(parts(&moments), [1.0, 3.0, 3.0, 3.0, 5.0, 5.0, 5.0, 7.0]);
/// ```
pub fn parts(moments: &[(f32, &[f32])]) -> Vec<f32> {
    let (begin, end) = (moments[0].0, moments[moments.len() - 1].0);
    let length = (end - begin).max(f32::MIN_POSITIVE);
    let share = |time: f32| (time - begin) / length * PARTS as f32;
    let part_of = |time: f32| (share(time) as usize).min(PARTS - 1);
    let mut parts = Vec::with_capacity(PARTS * moments[0].1.len());
    for part in 0..PARTS {
        let within = moments.iter().filter(|(time, _)| part_of(*time) == part);
        let middle = part as f32 + 0.5;
        let from_middle = |moment: &&(f32, &[f32])| (share(moment.0) - middle).abs();
        let nearest = moments
            .iter()
            .min_by(|one, other| from_middle(one).total_cmp(&from_middle(other)));
        let count = within.clone().count();
        let mut sums = vec![0.0_f64; moments[0].1.len()];
        for (_, newtons) in within.chain(nearest.filter(|_| count == 0)) {
            for (sum, newtons) in sums.iter_mut().zip(*newtons) {
                *sum += f64::from(*newtons);
            }
        }
        let divisor = count.max(1) as f64;
        parts.extend(sums.into_iter().map(|sum| (sum / divisor) as f32));
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_means_and_one_frame_fills_all() {
        let frames: Vec<[f32; 2]> = (0..17).map(|n| [n as f32, -2.0]).collect();
        let moments: Vec<(f32, &[f32])> = frames.iter().map(|f| (f[0] / 10.0, &f[..])).collect();
        let found = parts(&moments);
        // Two frames a part, and three in the last one.
        let means = [0.5, 2.5, 4.5, 6.5, 8.5, 10.5, 12.5, 15.0];
        for (part, mean) in means.into_iter().enumerate() {
            assert!((found[2 * part] - mean).abs() < 1e-6, "{part}: {found:?}");
            assert_eq!(found[2 * part + 1], -2.0);
        }
        assert_eq!(parts(&moments[3..4]), [3.0, -2.0].repeat(PARTS));
    }
}
