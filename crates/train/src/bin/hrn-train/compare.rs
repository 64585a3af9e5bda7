//! `hrn-train compare` and `hrn-train report`.

use std::path::{Path, PathBuf};

use hrn_train::compare::courses::{CoursePlan, compare_courses};
use hrn_train::compare::results::Comparison;
use hrn_train::compare::{self, Plan, report, tables};
use hrn_train::methods::Method;

use super::arguments::Compare;
use super::failure::{Unreadable, WrongUsage};
use super::files::{check_new, load, write};

pub(super) fn compare(arguments: Compare) -> anyhow::Result<String> {
    if arguments.course {
        let models = arguments.model.iter();
        let models = models.map(|path| Ok((path.display().to_string(), load(path)?)));
        let table = compare_courses(&CoursePlan {
            data: arguments.data,
            tests: arguments.test,
            models: models.collect::<anyhow::Result<_>>()?,
            out: arguments.out.clone(),
        })?;
        let page = arguments.out.join("course.md");
        return Ok(format!("{table}\n{}\n", page.display()));
    }
    let [data] =
        <[PathBuf; 1]>::try_from(arguments.data).map_err(|all| WrongUsage::ManyFiles(all.len()))?;
    let methods = if arguments.methods.is_empty() {
        Method::all().to_vec()
    } else {
        arguments.methods
    };
    let jobs = arguments.jobs.map(std::num::NonZeroUsize::get);
    let plan = Plan {
        data,
        out: arguments.out.clone(),
        methods,
        labels: arguments.labels,
        seeds: arguments.seeds,
        profile: arguments.profile,
        jobs: jobs.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from)),
        swaps: arguments.swaps,
    };
    if arguments.plan {
        return compare::plan(&plan);
    }
    compare::compare(&plan)?;
    let page = arguments.out.join("report.html");
    let found = Comparison::read(&arguments.out)?;
    let table = found.map_or_else(String::new, |found| {
        tables::headline(&found.rows()).text() + "\n"
    });
    Ok(format!("{table}{}\n", page.display()))
}

pub(super) fn report_of(directory: &Path, out: &Path) -> anyhow::Result<String> {
    std::fs::read_dir(directory).map_err(|source| Unreadable {
        path: directory.to_owned(),
        source,
    })?;
    check_new(out)?;
    write(out, report::of(directory)?.as_bytes())?;
    Ok(format!("{}\n", out.display()))
}
