//! The one colour map: the colour of each share of the largest force. The terminal, the live page
//! and pictures use it. `page.html` repeats the table, and a test compares the two.

/// Ten colours of matplotlib's viridis (CC0) at even distances. Lightness rises evenly, so the
/// order is visible even without colour.
pub const VIRIDIS: [[u8; 3]; 10] = [
    [68, 1, 84],
    [72, 40, 120],
    [62, 74, 137],
    [49, 104, 142],
    [38, 130, 142],
    [31, 158, 137],
    [53, 183, 121],
    [109, 205, 89],
    [180, 222, 44],
    [253, 231, 37],
];

/// The colour of `share`, as red, green and blue. A share below 0 or above 1 has the colour of that
/// end.
pub fn viridis(share: f32) -> [u8; 3] {
    let at = share.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f32;
    let k = (at as usize).min(VIRIDIS.len() - 2);
    let rest = at - k as f32;
    std::array::from_fn(|channel| {
        let (a, b) = (
            f32::from(VIRIDIS[k][channel]),
            f32::from(VIRIDIS[k + 1][channel]),
        );
        (a + rest * (b - a)).round() as u8
    })
}
