//! The range of every number, in one table, and the error for a number outside it.

use crate::exit::coded;
use hardnessd_core::exit::CONFIG;

/// The key whose number may also be 0, for an image without a logarithm.
const OR_ZERO: &str = "log_above_n";

/// The key of each number, and the least and the greatest that it may be.
#[rustfmt::skip]
const BOUNDS: &[(&str, f64, f64)] = &[
    ("full_scale_n", 1e-3, f64::INFINITY),
    (OR_ZERO, 1e-3, 1e3),
    // Fifty components of 10,000 samples each take 1.6 GB.
    ("generated_a_component", 1.0, 1e4),
    ("held_out", 0.0, 0.5),
    // Batch normalisation needs two samples.
    ("batch", 2.0, 1e6),
    ("epochs", 1.0, f64::INFINITY),
    ("averaging", 0.0, 0.999_999),
    ("learning_rate", 1e-9, f64::INFINITY),
    ("beta1", 0.0, 0.999_999),
    ("weight_decay", 0.0, f64::INFINITY),
    ("shift_taxels", 0.0, 4.0),
    // What a robot reports.
    ("unknown", 0.0, 1.0),
    ("unknown_arm", 0.0, 1.0),
    ("exact", 0.0, 1.0),
    ("position", 0.0, 0.5),
    ("arm", 0.0, 0.9),
    ("clock_frames", 0.0, 5.0),
    ("early", 0.0, 1.0),
    ("slower", 0.0, 1.0),
    ("stretched", 0.0, 1.0),
    // The simulator's settings.
    ("objects", 0.0, 1e4),
    ("test_objects", 0.0, 1e4),
    ("presses", 1.0, 1e4),
    ("lowest_force_n", 0.01, 25.0),
    ("frame_rate_hz", 1.0, 200.0),
    ("covers", 1.0, 1e4),
    ("test_covers", 1.0, 1e4),
    ("electronics", 1.0, 1e4),
];

/// Checks the numbers of a table, and of those in it. A list has the same bound for each of its numbers, which
/// ascend.
pub(crate) fn check(table: &toml::Table) -> anyhow::Result<()> {
    check_below("", table)
}

fn check_below(above: &str, table: &toml::Table) -> anyhow::Result<()> {
    for (key, value) in table {
        let found: Vec<f64> = match value {
            toml::Value::Table(inner) => {
                check_below(&format!("{above}{key}."), inner)?;
                continue;
            }
            toml::Value::Array(all) => all.iter().filter_map(number).collect(),
            value => number(value).into_iter().collect(),
        };
        let Some(&(_, least, most)) = BOUNDS.iter().find(|(of, ..)| of == key) else {
            continue;
        };
        for number in &found {
            let is_zero = key == OR_ZERO && *number == 0.0;
            let is_within = is_zero || number.is_finite() && (least..=most).contains(number);
            if !is_within || !found.is_sorted() {
                let expected = match most {
                    f64::INFINITY => format!("{least} or more"),
                    _ if key == OR_ZERO => format!("0, or {least} to {most}"),
                    _ => format!("{least} to {most}"),
                };
                let text = format!("`{above}{key}`: found {number}, expected {expected}");
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::Settings;

    fn bounded(table: &toml::Table) {
        for (key, value) in table {
            match value {
                toml::Value::Table(inner) => bounded(inner),
                value => assert!(
                    number(value).is_none() || BOUNDS.iter().any(|(of, ..)| of == key),
                    "{key}"
                ),
            }
        }
    }

    #[test]
    fn every_number_of_the_settings_has_a_bound_and_keeps_it() {
        let table = toml::Table::try_from(Settings::default()).unwrap();
        bounded(&table);
        assert!(check(&table).is_ok());
    }
}
