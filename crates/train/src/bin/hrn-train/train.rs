//! `hrn-train train`.

use std::time::Instant;

use anyhow::Context as _;
use hrn_train::train::{self, Train};

use super::account;

pub(super) fn train(arguments: &Train) -> anyhow::Result<String> {
    if let Some(parent) = arguments.parent {
        end_with(parent)?;
    }
    let begun = Instant::now();
    let evaluation = train::train(arguments)?;
    let figures = evaluation.as_ref().map(account::of_evaluated);
    Ok(format!(
        "trained in {:.1} s: {}\n{}",
        begun.elapsed().as_secs_f64(),
        arguments.out.join("hrn.onnx").display(),
        figures.unwrap_or_else(|| {
            "not evaluated: the data has no labelled test presses\n".to_owned()
        })
    ))
}

/// Asks the system to end this process when its parent ends, for whatever reason.
fn end_with(parent: i32) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::TERM))
        .map_err(std::io::Error::from)
        .context("end with the parent process")?;
    anyhow::ensure!(
        std::os::unix::process::parent_id().cast_signed() == parent,
        "the process that started this one, {parent}, has ended"
    );
    Ok(())
}
