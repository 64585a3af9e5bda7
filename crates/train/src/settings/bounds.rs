//! The ranges of values, and the error for a value outside its range.

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
    /// `validation.keep` is `best`, and the network is not validated while it trains.
    #[error(
        "`validation.keep`: found best, expected last: this network uses held-out objects for its calibration \
         only"
    )]
    Keep,
}

/// The most samples that a component generates at once. Fifty components make half a million, which
/// take 1.6 GB.
pub(crate) const MOST_SAMPLES_A_COMPONENT: u32 = 10_000;
/// The most samples of a step.
const MOST_SAMPLES: usize = 1_000_000;

/// Checks the settings that every training loop has.
pub(crate) fn check_loop(
    table: &str,
    batch: usize,
    epochs: u32,
    averaging: f64,
    checkpoint_every_epochs: u32,
) -> Result<(), SettingsError> {
    // Batch normalisation needs two samples.
    let fits = (2..=MOST_SAMPLES).contains(&batch);
    check(table, "batch", batch as f64, fits, "2 to 1000000")?;
    check(table, "epochs", epochs, epochs > 0, "1 or more")?;
    let fits = (0.0..1.0).contains(&averaging);
    check(table, "averaging", averaging, fits, "0 to below 1")?;
    let (key, every) = ("checkpoint_every_epochs", checkpoint_every_epochs);
    check(table, key, every, every > 0, "1 or more")
}

/// Returns an error for a value of `table` and `key` unless it `fits`.
pub(crate) fn check(
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
