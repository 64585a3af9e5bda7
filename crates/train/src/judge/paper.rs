//! The results that the paper reports, for the tables and tests that compare with them.

/// Table 3 as counts of 250 a level, in the order of Table 2: rows are the truth, columns the prediction. The
/// paper prints shares, each a whole number of 250ths. Its other figures follow from these.
#[rustfmt::skip]
const TABLE_3: [(&str, [[u64; 4]; 4]); 8] = [
    ("hrn15", [[168, 51, 19, 12], [30, 153, 53, 14], [19, 56, 142, 33], [11, 25, 35, 179]]),
    ("hrn50", [[224, 15, 7, 4], [13, 211, 17, 9], [11, 24, 202, 13], [2, 5, 14, 229]]),
    ("hrn100", [[244, 5, 1, 0], [5, 236, 7, 2], [6, 10, 231, 3], [0, 0, 2, 248]]),
    ("sgan", [[223, 19, 5, 3], [12, 210, 18, 10], [11, 26, 201, 12], [2, 7, 13, 228]]),
    ("igan", [[229, 14, 5, 2], [12, 213, 16, 9], [10, 24, 204, 12], [2, 5, 11, 232]]),
    ("nahrn", [[223, 17, 7, 3], [13, 208, 19, 10], [12, 27, 197, 14], [3, 5, 13, 229]]),
    ("nihrn", [[231, 11, 6, 2], [9, 221, 15, 5], [9, 21, 212, 8], [1, 5, 7, 237]]),
    ("ours", [[241, 6, 3, 0], [5, 232, 10, 3], [6, 18, 225, 1], [0, 0, 4, 246]]),
];

/// The paper's confusion matrix of a method, if it has one.
pub fn confusion(method: &str) -> Option<Vec<Vec<u64>>> {
    let (_, counts) = TABLE_3.iter().find(|(name, _)| *name == method)?;
    Some(counts.iter().map(|row| row.to_vec()).collect())
}
