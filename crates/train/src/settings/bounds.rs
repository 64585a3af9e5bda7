//! The range of every number, in one table, and the error for a number outside it.

use crate::exit::coded;
use hardnessd_core::exit::CONFIG;

/// The end of a key's path, the numbers that it may have, and those in words. A path of two parts comes
/// before one of its last part.
type Bound = (&'static str, fn(f64) -> bool, &'static str);

const SHARE: fn(f64) -> bool = |x| (0.0..=1.0).contains(&x);
const DECAY: fn(f64) -> bool = |x| (0.0..1.0).contains(&x);
const COUNT: fn(f64) -> bool = |x| x >= 1.0;
const POSITIVE: fn(f64) -> bool = |x| x > 0.0;
const NOT_NEGATIVE: fn(f64) -> bool = |x| x >= 0.0;
const SOME: fn(f64) -> bool = |x| (1.0..=1e4).contains(&x);

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
    // The simulator's settings.
    ("objects", |x| (0.0..=1e4).contains(&x), "0 to 10,000"),
    ("test_objects", |x| (0.0..=1e4).contains(&x), "0 to 10,000"),
    ("presses", SOME, "1 to 10,000"),
    ("lowest_force_n", |x| (0.01..=25.0).contains(&x), "0.01 to 25"),
    ("frame_rate_hz", |x| (1.0..=200.0).contains(&x), "1 to 200"),
    ("covers", SOME, "1 to 10,000"),
    ("test_covers", SOME, "1 to 10,000"),
    ("electronics", SOME, "1 to 10,000"),
];

/// Checks the numbers of a table, and of those in it. A list has the same bound for each of its numbers, which
/// ascend.
pub(crate) fn check(table: &toml::Table) -> anyhow::Result<()> {
    check_below("", table)
}

fn check_below(above: &str, table: &toml::Table) -> anyhow::Result<()> {
    for (key, value) in table {
        let path = format!("{above}{key}");
        let found: Vec<f64> = match value {
            toml::Value::Table(inner) => {
                check_below(&format!("{path}."), inner)?;
                continue;
            }
            toml::Value::Array(all) => all.iter().filter_map(number).collect(),
            value => number(value).into_iter().collect(),
        };
        let Some((_, fits, expected)) = bound_of(&path) else {
            continue;
        };
        for number in &found {
            if !number.is_finite() || !fits(*number) || !found.is_sorted() {
                let text = format!("`{path}`: found {number}, expected {expected}");
                return Err(coded(CONFIG, text));
            }
        }
    }
    Ok(())
}

fn number(value: &toml::Value) -> Option<f64> {
    value
        .as_float()
        .or(value.as_integer().map(|number| number as f64))
}

fn bound_of(path: &str) -> Option<Bound> {
    let mut bounds = BOUNDS.iter().copied();
    bounds.find(|(key, ..)| path == *key || path.ends_with(&format!(".{key}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::Settings;

    fn bounded(above: &str, table: &toml::Table) {
        for (key, value) in table {
            let path = format!("{above}{key}");
            match value {
                toml::Value::Table(inner) => bounded(&format!("{path}."), inner),
                value => assert!(
                    number(value).is_none() || bound_of(&path).is_some(),
                    "{path}"
                ),
            }
        }
    }

    #[test]
    fn every_number_of_the_settings_has_a_bound_and_keeps_it() {
        let table = toml::Table::try_from(Settings::default()).unwrap();
        bounded("", &table);
        assert!(check(&table).is_ok());
    }
}
