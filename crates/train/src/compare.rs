//! Trains every method under every seed, and writes the tables, such as the paper's Tables 2 and 3.
//!
//! In: a data set. Out, in a directory: `data/` with the test sets, `runs/` with one run's
//! directory per method and seed, `logs/`, and `results.json`, `objects.csv`, `tables.md` and
//! `report.html`. These four are written anew whenever a run ends, and cover all finished runs in
//! the directory, from this call or an earlier one. This process trains nothing. Each run is a
//! process of its own, so that runs can be stopped, resumed and distributed. Finished runs are not
//! repeated.

mod children;
pub mod hertz;
pub mod course_results;
pub mod courses;
pub mod digits;
mod plan;
mod sets;
mod so_far;
pub mod results;
mod swaps;
pub mod table;
pub mod tables;
pub mod report;

use std::path::Path;

use anyhow::{Context as _, bail, ensure};

pub use plan::Plan;

use children::{Failure, Job};
use plan::{PlannedRun, planned, recipes, unfinished};
use results::{Comparison, Entry};
use sets::TestSet;
use swaps::Swaps;

use crate::data::dataset::Dataset;
use crate::methods::{self, Method};
use crate::run::Run;
use crate::run::disk::{lock, refuse_foreign, write_whole};

/// The command lines of the unfinished runs that [`compare`] would run, the longest first.
/// [`compare`] finds the results that these commands leave in the directory.
///
/// # Errors
///
/// Fails as [`compare`] does before its first run.
pub fn plan(plan: &Plan) -> anyhow::Result<String> {
    let dataset = checked(plan)?;
    let recipes = recipes(plan, &dataset)?;
    let swaps = Swaps::of(plan, &recipes)?;
    make_directories(plan)?;
    let runs = planned(plan, &recipes, &dataset)?;
    let swapped = swaps.map_or(Ok(Vec::new()), |swaps| swaps.planned(plan))?;
    let every = runs.iter().chain(swapped.iter().map(|(run, _)| run));
    let jobs: Vec<Job> = in_order(unfinished(every, &plan.out)?);
    plan::command_lines(&jobs)
}

/// Reads and checks the plan's data, and checks its directory, before anything is written.
fn checked(plan: &Plan) -> anyhow::Result<Dataset> {
    let written = ["objects.csv", "tables.md", "report.html", "swaps.json"];
    refuse_foreign(&plan.out, "results.json", &written)?;
    let dataset = Dataset::read(&plan.data)?;
    sets::check_seed(&dataset)?;
    sets::warn_of_pitch(&dataset);
    dataset.warn_of_object_in_both_splits();
    for &labels in &plan.labels {
        methods::labels(Method::Hrn100, &dataset, Some(labels))?;
    }
    Ok(dataset)
}

fn make_directories(plan: &Plan) -> anyhow::Result<()> {
    for part in ["data", "runs", "logs"] {
        let part = plan.out.join(part);
        std::fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
    }
    Ok(())
}

/// Sorts the runs: the longest first, but each method's first seed before any method's second.
fn in_order(mut open: Vec<(&PlannedRun, Job)>) -> Vec<Job> {
    open.sort_by(|(a, first), (b, second)| {
        (a.description.seed)
            .cmp(&b.description.seed)
            .then(second.effort.total_cmp(&first.effort))
    });
    open.into_iter().map(|(_, job)| job).collect()
}

/// Runs the unfinished runs, and writes results and tables of all finished ones.
///
/// # Errors
///
/// Fails if the data cannot be read, if the directory cannot be written, holds runs with other
/// settings or is in use by another process, or at the end if a run failed.
pub fn compare(plan: &Plan) -> anyhow::Result<()> {
    let dataset = checked(plan)?;
    let recipes = recipes(plan, &dataset)?;
    let swaps = Swaps::of(plan, &recipes)?;
    make_directories(plan)?;
    let _lock = lock(&plan.out)?;
    let runs = planned(plan, &recipes, &dataset)?;
    let open = unfinished(&runs, &plan.out)?;
    let sets = sets::all(dataset, plan.profile, &plan.out.join("data"))?;
    write_results(plan, &runs, &sets)?;
    let mut failures = children::run(in_order(open), plan.jobs, |_| {
        write_results(plan, &runs, &sets)
    })?;
    let swapped = swaps.map_or(Ok(()), |swaps| {
        failures.extend(swaps.run(plan)?);
        write_tables(&plan.out)
    });
    let failed = report_failures(&failures, &plan.out);
    match (failed, swapped) {
        // Report both in one line, so that the swaps' error does not hide the failed runs.
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

/// Writes `results.json` with the finished runs, and the tables.
fn write_results(plan: &Plan, runs: &[PlannedRun], sets: &[TestSet]) -> anyhow::Result<()> {
    let mut entries = Vec::new();
    for run in runs.iter().filter(|run| run.is_finished()) {
        if let Some(description) = Run::description_at(&run.directory)? {
            entries.push(Entry::of(&run.directory, &description, sets)?);
        }
    }
    let json = serde_json::to_vec_pretty(&entries)?;
    write_whole(&plan.out.join("results.json"), &json)?;
    write_tables(&plan.out)
}

/// Writes `objects.csv`, `tables.md` and `report.html` from the files in a comparison's directory.
fn write_tables(out: &Path) -> anyhow::Result<()> {
    let comparison = Comparison::read(out)?.context("results.json was written just now")?;
    write_whole(&out.join("objects.csv"), comparison.objects().as_bytes())?;
    let markdown = tables::markdown(&comparison);
    write_whole(&out.join("tables.md"), markdown.as_bytes())?;
    write_whole(
        &out.join("report.html"),
        report::comparison(&comparison)?.as_bytes(),
    )
}
