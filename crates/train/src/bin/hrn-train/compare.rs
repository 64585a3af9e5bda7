//! `hrn-train compare`.

use hrn_train::compare::{self, Plan};

use super::arguments::Compare;

pub(super) fn compare(arguments: Compare) -> anyhow::Result<String> {
    let jobs = arguments.jobs.map(std::num::NonZeroUsize::get);
    let methods = arguments.methods.iter();
    let plan = Plan {
        methods: methods.map(|recipe| recipe.name.clone()).collect(),
        data: arguments.data,
        out: arguments.out,
        labels: arguments.labels,
        seeds: arguments.seeds,
        profile: arguments.profile,
        jobs: jobs.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from)),
    };
    match arguments.plan {
        true => compare::plan(&plan),
        false => compare::compare(&plan),
    }
}
