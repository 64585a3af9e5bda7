//! The check of a configured value. In: its key, the value, and what it may be. Out: an error that
//! says all three.

use std::fmt::{Debug, Display};

/// A value that is not in its range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: {problem}")]
pub struct OutOfRange {
    /// The key of the value in its table.
    pub key: &'static str,
    /// What was found, and what was expected.
    problem: Box<str>,
}

impl OutOfRange {
    /// The error of a value `found` that does not fit.
    pub fn new(key: &'static str, found: impl Debug, expected: impl Display) -> Self {
        Self {
            key,
            problem: format!("found {found:?}, expected {expected}").into(),
        }
    }
}

/// Returns an error about `found`, unless it `fits`.
///
/// # Errors
///
/// Returns [`OutOfRange`] if `fits` is false.
pub fn check(
    key: &'static str,
    found: impl Debug,
    fits: bool,
    expected: impl Display,
) -> Result<(), OutOfRange> {
    match fits {
        true => Ok(()),
        false => Err(OutOfRange::new(key, found, expected)),
    }
}

/// Checks that a number is from `least` to `most`. `unit` follows these in the message.
///
/// # Errors
///
/// Returns [`OutOfRange`] if the number is less or more, or no number.
pub fn within<T: PartialOrd + Debug + Display>(
    key: &'static str,
    found: T,
    (least, most): (T, T),
    unit: &str,
) -> Result<(), OutOfRange> {
    let fits = (&least..=&most).contains(&&found);
    let expected = format!("{least} to {most} {unit}");
    check(key, found, fits, expected.trim_end())
}

/// Checks that a number is above 0 and at most `most`.
///
/// # Errors
///
/// Returns [`OutOfRange`] if the number is less or more, or no number.
pub fn positive(key: &'static str, found: f64, most: f64) -> Result<(), OutOfRange> {
    let fits = found > 0.0 && found <= most;
    let expected = format_args!("a number above 0 and at most {most}");
    check(key, found, fits, expected)
}
