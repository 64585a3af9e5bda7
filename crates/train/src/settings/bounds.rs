//! The range of every number, in one table, and the error for a number outside it.

use super::Settings;

/// The reason that settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The text is not TOML, or has an unknown key or a value of another type.
    #[error("{0}")]
    Syntax(String),
    /// A value is outside its range.
    #[error("`{key}`: found {found}, expected {expected}")]
    Range {
        /// Path of the key.
        key: String,
        /// The value of the key.
        found: f64,
        /// The accepted range.
        expected: &'static str,
    },
}

/// The end of a key's path, the numbers that it may have, and those in words. A path of two parts comes
/// before one of its last part.
type Bound = (&'static str, fn(f64) -> bool, &'static str);

const SHARE: fn(f64) -> bool = |x| (0.0..=1.0).contains(&x);
const DECAY: fn(f64) -> bool = |x| (0.0..1.0).contains(&x);
const COUNT: fn(f64) -> bool = |x| x >= 1.0;
const POSITIVE: fn(f64) -> bool = |x| x > 0.0;
const NOT_NEGATIVE: fn(f64) -> bool = |x| x >= 0.0;

#[rustfmt::skip]
const BOUNDS: &[Bound] = &[
    ("full_scale_n", POSITIVE, "above 0"),
    ("log_above_n", |x| x == 0.0 || (1e-3..=1e3).contains(&x), "0, or 0.001 to 1000"),
    // Batch normalisation needs two samples.
    ("batch", |x| (2.0..=1e6).contains(&x), "2 to 1,000,000"),
    // Fifty components of 10,000 samples each take 1.6 GB.
    ("samples_a_component", |x| (1.0..=1e4).contains(&x), "1 to 10,000"),
    ("epochs", COUNT, "1 or more"),
    ("checkpoint_every_epochs", COUNT, "1 or more"),
    ("every_epochs", COUNT, "1 or more"),
    ("sigma_penalty", NOT_NEGATIVE, "0 or more"),
    ("averaging", DECAY, "0 to below 1"),
    ("level_balance", SHARE, "0 to 1"),
    ("shift_taxels", |x| (0.0..=4.0).contains(&x), "0 to 4"),
    ("learning_rate", POSITIVE, "above 0"),
    ("beta1", DECAY, "0 to below 1"),
    ("beta2", DECAY, "0 to below 1"),
    ("weight_decay", NOT_NEGATIVE, "0 or more"),
    ("reports.unknown", SHARE, "0 to 1"),
    ("reports.unknown_arm", SHARE, "0 to 1"),
    ("reports.exact", SHARE, "0 to 1"),
    ("reports.early", SHARE, "0 to 1"),
    ("reports.slower", SHARE, "0 to 1"),
    ("reports.stretched", SHARE, "0 to 1"),
    ("reports.position", |x| (0.0..=0.5).contains(&x), "0 to 0.5"),
    ("reports.arm", |x| (0.0..=0.9).contains(&x), "0 to 0.9"),
    ("reports.clock_frames", |x| (0.0..=5.0).contains(&x), "0 to 5"),
    ("validation.share", |x| (0.0..=0.5).contains(&x), "0 to 0.5"),
];

/// Checks every number of the settings.
pub(super) fn check(settings: &Settings) -> Result<(), SettingsError> {
    let table = toml::Table::try_from(settings).expect("settings are plain tables of numbers");
    check_table("", &table)
}

fn check_table(above: &str, table: &toml::Table) -> Result<(), SettingsError> {
    for (key, value) in table {
        let path = format!("{above}{key}");
        let found = match value {
            toml::Value::Table(inner) => {
                check_table(&format!("{path}."), inner)?;
                continue;
            }
            toml::Value::Integer(number) => *number as f64,
            toml::Value::Float(number) => *number,
            _ => continue,
        };
        let (_, fits, expected) = bound_of(&path).expect("a test finds each number's bound");
        if !found.is_finite() || !fits(found) {
            return Err(SettingsError::Range {
                key: path,
                found,
                expected,
            });
        }
    }
    Ok(())
}

fn bound_of(path: &str) -> Option<Bound> {
    let mut bounds = BOUNDS.iter().copied();
    bounds.find(|(key, ..)| path == *key || path.ends_with(&format!(".{key}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_a_bound_and_keeps_it() {
        // The check itself looks for each number's bound.
        assert!(check(&Settings::default()).is_ok());
    }
}
