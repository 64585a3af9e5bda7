//! What a value may be, and what is said of one that may not.

/// Why settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// Not TOML, an unknown key, or a value of another type.
    #[error("{0}")]
    Syntax(String),
    /// A value outside its range.
    #[error("`{key}`: found {found}, expected {expected}")]
    Range {
        /// Path of the key.
        key: String,
        /// Its value.
        found: f64,
        /// What is accepted.
        expected: &'static str,
    },
    /// A run of an earlier version used an option that is gone.
    #[error("the run used `{key}`, which is gone: read it with revision {last_revision}")]
    Retired {
        /// Path of the key.
        key: String,
        /// The last revision that knew it.
        last_revision: &'static str,
    },
}

/// Checks what every loop has.
pub(in crate::train) fn check_loop(
    table: &str,
    batch: usize,
    epochs: u32,
    averaging: f64,
    checkpoint_every_epochs: u32,
) -> Result<(), SettingsError> {
    // Batch normalisation needs two samples.
    check(table, "batch", batch as f64, batch > 1, "2 or more")?;
    check(table, "epochs", epochs, epochs > 0, "1 or more")?;
    let fits = (0.0..1.0).contains(&averaging);
    check(table, "averaging", averaging, fits, "0 to below 1")?;
    let (key, every) = ("checkpoint_every_epochs", checkpoint_every_epochs);
    check(table, key, every, every > 0, "1 or more")
}

/// Refuses a value of `table` and `key` unless it `fits`.
pub(in crate::train) fn check(
    table: &str,
    key: &str,
    found: impl Into<f64>,
    fits: bool,
    expected: &'static str,
) -> Result<(), SettingsError> {
    let found = found.into();
    if fits && found.is_finite() {
        return Ok(());
    }
    Err(SettingsError::Range {
        key: format!("{table}{key}"),
        found,
        expected,
    })
}
