//! Every method under every seed, and the tables that follow: the paper's Tables 2 and 3.
//!
//! In: a data set. Out, in a directory: `data/`, what every model is judged on; `runs/`, a run's
//! directory a method and seed; `logs/`; and `results.json`, `tables.md` and `report.html`, written
//! anew whenever a run ends, of all finished runs that stand there, asked for this time or before.
//! Nothing is trained in this process: each run is one of its own, so that it can be stopped,
//! resumed and spread as it likes, and what is finished is not done again.

mod children;
pub mod courses;
pub mod digits;
mod plan;
mod sets;
mod so_far;
pub mod results;
mod swaps;
pub mod tables;
pub mod report;

use std::path::Path;

use anyhow::{Context as _, bail, ensure};

pub use plan::Plan;

use children::Failure;
use plan::{PlannedRun, planned, recipes, unfinished};
use results::{Comparison, Entry};
use sets::TestSet;
use swaps::Swaps;

use crate::train::data::dataset::Dataset;
use crate::train::run::Run;
use crate::train::run::disk::{lock, write_whole};

/// Runs what is not finished, and writes results and tables of all that is.
///
/// # Errors
///
/// If the data cannot be read, the directory cannot be written, holds runs that were told otherwise
/// or is being worked on by another process, or at the end if a run failed.
pub fn compare(plan: &Plan) -> anyhow::Result<()> {
    // Nothing is made before it is known that the data will do.
    let dataset = Dataset::read(&plan.data)?;
    sets::check_seed(&dataset)?;
    sets::warn_of_pitch(&dataset);
    dataset.warn_of_object_in_both_splits();
    let recipes = recipes(plan, &dataset)?;
    let swaps = Swaps::of(plan, &recipes)?;
    for part in ["data", "runs", "logs"] {
        let part = plan.out.join(part);
        std::fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
    }
    let _lock = lock(&plan.out)?;
    let runs = planned(plan, &recipes, &dataset)?;
    let mut open = unfinished(&runs, &plan.out)?;
    let sets = sets::all(dataset, plan.profile, &plan.out.join("data"))?;
    write_results(plan, &runs, &sets)?;
    // The longest first, but every method once before any method twice.
    open.sort_by(|(a, first), (b, second)| {
        (a.told.seed)
            .cmp(&b.told.seed)
            .then(second.effort.total_cmp(&first.effort))
    });
    let jobs = open.into_iter().map(|(_, job)| job).collect();
    let mut failures = children::run(jobs, plan.jobs, |_| write_results(plan, &runs, &sets))?;
    let swapped = swaps.map_or(Ok(()), |swaps| {
        failures.extend(swaps.run(plan)?);
        write_tables(&plan.out)
    });
    let failed = report_failures(&failures, &plan.out);
    match (failed, swapped) {
        // Both in one line: the runs that failed before are not forgotten.
        (Err(failed), Err(error)) => bail!("{failed}; then {error:#}"),
        (failed, swapped) => failed.and(swapped),
    }
}

fn report_failures(failures: &[Failure], out: &Path) -> anyhow::Result<()> {
    ensure!(
        failures.is_empty(),
        "{} {} failed (logs in {}): {}",
        failures.len(),
        if failures.len() == 1 { "run" } else { "runs" },
        out.join("logs").display(),
        failures
            .iter()
            .map(|failure| format!("{}: {}", failure.name, failure.reason))
            .collect::<Vec<_>>()
            .join("; ")
    );
    Ok(())
}

/// Writes `results.json` of the finished runs, and the tables.
fn write_results(plan: &Plan, runs: &[PlannedRun], sets: &[TestSet]) -> anyhow::Result<()> {
    let mut entries = Vec::new();
    for run in runs.iter().filter(|run| run.is_finished()) {
        if let Some(told) = Run::told(&run.directory)? {
            entries.push(Entry::of(&run.directory, &told, sets)?);
        }
    }
    let json = serde_json::to_vec_pretty(&entries)?;
    write_whole(&plan.out.join("results.json"), &json)?;
    write_tables(&plan.out)
}

/// Writes `tables.md` and `report.html` from what stands in a comparison's directory.
fn write_tables(out: &Path) -> anyhow::Result<()> {
    let comparison = Comparison::read(out)?.context("results.json was written just now")?;
    let markdown = tables::markdown(&comparison);
    write_whole(&out.join("tables.md"), markdown.as_bytes())?;
    write_whole(
        &out.join("report.html"),
        report::comparison(&comparison)?.as_bytes(),
    )
}
