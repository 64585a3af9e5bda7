//! What tests of several modules need.

/// Asserts that a number is near the expected one, by this share of it.
#[track_caller]
pub(crate) fn near(found: f64, expected: f64, tolerance: f64, what: &str) {
    let off = found / expected - 1.0;
    assert!(off.abs() < tolerance, "{what}: {found}, {expected}");
}
