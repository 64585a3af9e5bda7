//! Options that only earlier versions had, in the settings of their runs.
//!
//! None of them helped. `docs/method.md` names them.

use super::SettingsError;

/// The last revision that knew the options.
const LAST_REVISION: &str = "e2a4848";
/// The table, the key and the default of each option.
const OPTIONS: [(&str, &str, Default); 5] = [
    ("", "minibatch_discrimination", Default::Off),
    ("ustgan", "turns", Default::Alternate),
    ("stgan", "turns", Default::Alternate),
    ("ustgan", "sigma_cap", Default::Zero),
    ("stgan", "sigma_cap", Default::Zero),
];

#[derive(Debug, Clone, Copy)]
enum Default {
    Off,
    Alternate,
    Zero,
}

impl Default {
    fn is(self, value: &toml::Value) -> bool {
        match self {
            Self::Off => value.as_bool() == Some(false),
            Self::Alternate => value.as_str() == Some("alternate"),
            Self::Zero => value.as_float() == Some(0.0),
        }
    }
}

/// Removes the retired options from a run's settings, and returns whether there were any.
///
/// # Errors
///
/// Returns an error if the run used an option, because this version cannot do what the run did.
pub(crate) fn strip(settings: &mut toml::Table) -> Result<bool, SettingsError> {
    let mut had_any = false;
    for (table, key, default) in OPTIONS {
        let holder = match settings.get_mut(table) {
            _ if table.is_empty() => &mut *settings,
            Some(toml::Value::Table(inner)) => inner,
            _ => continue,
        };
        let Some(value) = holder.remove(key) else {
            continue;
        };
        had_any = true;
        if !default.is(&value) {
            let dot = if table.is_empty() { "" } else { "." };
            return Err(SettingsError::Retired {
                key: format!("{table}{dot}{key}"),
                last_revision: LAST_REVISION,
            });
        }
    }
    Ok(had_any)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_old_runs_unused_options_are_taken_out_and_used_ones_refused() {
        let mut table: toml::Table = toml::from_str(
            "minibatch_discrimination = false\n[ustgan]\nturns = \"alternate\"\nsigma_cap = 0.0\nbatch = 7",
        )
        .unwrap();
        assert!(strip(&mut table).unwrap());
        let left: toml::Table = toml::from_str("[ustgan]\nbatch = 7").unwrap();
        assert_eq!(table, left);
        assert!(!strip(&mut table).unwrap());

        let mut table = toml::from_str("[stgan]\nturns = \"threshold\"").unwrap();
        let error = strip(&mut table).unwrap_err().to_string();
        assert_eq!(
            error,
            "the run used `stgan.turns`, which is gone: read it with revision e2a4848"
        );
    }
}
