//! Progress as a bar or lines, and the end of a stage that has diverged.

use anyhow::ensure;
use indicatif::{ProgressBar, ProgressStyle};

/// The largest loss or weight of a training that may still learn: a guess among four levels has a loss of 1.4.
const MOST: f64 = 1e6;

/// Ends a stage with a value that is NaN or beyond all that a network learns with, because no further step would mend it.
///
/// # Errors
///
/// Returns an error if `found`, the value of `what`, is such a value.
pub(crate) fn ensure_learning(
    stage: &str,
    epoch: u32,
    what: &str,
    found: f64,
) -> anyhow::Result<()> {
    ensure!(
        found.abs() <= MOST,
        "{stage}: epoch {epoch}: {what}: found {found}, expected at most {MOST:e}: the training has diverged"
    );
    Ok(())
}

/// A bar, which indicatif draws on a terminal only.
pub(crate) fn bar(template: &str, length: usize) -> ProgressBar {
    let style = ProgressStyle::with_template(template).expect("the template is right");
    ProgressBar::new(length as u64).with_style(style)
}

/// A bar over a stage's steps. Elsewhere than on a terminal, [`report`] prints lines.
pub(crate) fn progress_bar(stage: &str, steps: u64, done: u64) -> ProgressBar {
    let template = "{prefix} {bar:30} {pos}/{len} steps, {eta} left {msg}";
    let bar = bar(template, steps as usize).with_prefix(stage.to_owned());
    bar.set_position(done);
    bar.reset_eta();
    bar
}

/// Shows the state of a stage after an epoch: beside the bar on a terminal, as a line elsewhere.
pub(crate) fn report(bar: &ProgressBar, stage: &str, epoch: u32, epochs: u32, message: String) {
    if bar.is_hidden() {
        hardnessd_core::stderr_line!("{stage}: epoch {epoch} of {epochs}: {message}");
    } else {
        bar.set_message(message);
    }
}
