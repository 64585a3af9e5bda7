//! Progress as a bar or lines, and the end of a stage that has diverged.

use anyhow::ensure;
use indicatif::{ProgressBar, ProgressStyle};

/// Ends a stage with a value that is NaN or infinite, because no further step would make it finite.
///
/// # Errors
///
/// Returns an error if `found`, the value of `what`, is not finite.
pub(crate) fn ensure_finite(stage: &str, epoch: u32, what: &str, found: f64) -> anyhow::Result<()> {
    ensure!(
        found.is_finite(),
        "{stage}: epoch {epoch}: {what}: found {found}, expected a finite number: the training has \
         diverged"
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
