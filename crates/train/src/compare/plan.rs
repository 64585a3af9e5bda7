//! The plan of a comparison: its rows, their runs, and the command line of each run.
//!
//! In: the user's request, and the comparison's directory. Out: the runs of every row, finished or
//! not. Nothing is run here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use super::children::Job;
use super::results::Worth;
use crate::data::dataset::{Dataset, LabelChoice};
use crate::methods::{self, LabelsError, Method, Request};
use crate::run::{Description, Run};
use crate::settings::Profile;

/// The request for a comparison.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The data set to learn from.
    pub data: PathBuf,
    /// The directory of the comparison.
    pub out: PathBuf,
    /// The methods to run.
    pub methods: Vec<Method>,
    /// Numbers of labels to run each method with, besides its own number. A number that a method
    /// has anyway adds no run.
    pub labels: Vec<usize>,
    /// The number of seeds: runs use seeds 1 to this one.
    pub seeds: u64,
    /// The profile of each run.
    pub profile: Profile,
    /// The number of runs at a time.
    pub jobs: usize,
    /// Whether to also run with the materials' roles swapped.
    pub swaps: bool,
}

impl Plan {
    /// Whether the plan requests the runs of a recipe.
    pub(super) fn asks(&self, recipe: &Recipe) -> bool {
        self.methods.contains(&recipe.method) && (!recipe.is_extra || self.wants(recipe.labels))
    }

    fn wants(&self, labels: Option<usize>) -> bool {
        labels.is_some_and(|labels| self.labels.contains(&labels))
    }
}

/// A row of the tables, for any seed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Recipe {
    pub(super) method: Method,
    /// The number of labels, if it is not the method's own share.
    pub(super) labels: Option<usize>,
    pub(super) choice: LabelChoice,
    /// Whether the row appears only where its number of labels was requested.
    pub(super) is_extra: bool,
}

/// All possible rows, those of the plan's methods first.
pub(super) fn recipes(plan: &Plan, dataset: &Dataset) -> anyhow::Result<Vec<Recipe>> {
    let few = methods::labels(Method::Hrn15, dataset, None)?;
    let mut methods = plan.methods.clone();
    methods.extend(Method::all());
    let mut recipes = Vec::new();
    for (number, &method) in methods.iter().enumerate() {
        if methods[..number].contains(&method) {
            continue;
        }
        let own = Recipe {
            method,
            labels: None,
            choice: LabelChoice::Object,
            is_extra: false,
        };
        recipes.push(own);
        match method {
            // Run with as few labels as the other methods have, and with all of them.
            Method::Features => recipes.push(Recipe {
                labels: Some(few),
                ..own
            }),
            // Choose labels by object, and at random, as the paper probably chose them.
            Method::Ours | Method::Hrn15 => recipes.push(Recipe {
                choice: LabelChoice::Random,
                ..own
            }),
            _ => {}
        }
        let mut budgets: BTreeSet<usize> = plan.labels.iter().copied().collect();
        budgets.extend(budgets_in(&plan.out.join("runs"), method));
        for labels in budgets {
            let has = |recipe: &Recipe| {
                recipe.method == method
                    && recipe.choice == LabelChoice::Object
                    && methods::labels(method, dataset, recipe.labels).ok() == Some(labels)
            };
            // A directory may have any name.
            let is_possible = methods::labels(method, dataset, Some(labels)).is_ok();
            if (is_possible || plan.labels.contains(&labels)) && !recipes.iter().any(has) {
                recipes.push(Recipe {
                    labels: Some(labels),
                    is_extra: true,
                    ..own
                });
            }
        }
    }
    Ok(recipes)
}

/// Numbers of labels of a method's earlier runs, from directories called `METHOD-LABELS-SEED`.
fn budgets_in(runs: &Path, method: Method) -> BTreeSet<usize> {
    let prefix = format!("{}-", method.name());
    let names = std::fs::read_dir(runs).into_iter().flatten().flatten();
    let budget = |entry: std::fs::DirEntry| {
        let name = entry.file_name();
        let (labels, seed) = name.to_str()?.strip_prefix(&prefix)?.split_once('-')?;
        seed.parse::<u64>().ok()?;
        labels.parse().ok()
    };
    names.filter_map(budget).collect()
}

/// Every run that the plan requests, and the finished runs of earlier plans.
pub(super) fn planned(
    plan: &Plan,
    recipes: &[Recipe],
    dataset: &Dataset,
) -> anyhow::Result<Vec<PlannedRun>> {
    let directory = plan.out.join("runs");
    let mut runs = Vec::new();
    for recipe in recipes {
        let asked = if plan.asks(recipe) { plan.seeds } else { 0 };
        let mut seeds = seeds_in(&directory, &recipe.name())?;
        seeds.extend(1..=asked);
        for seed in seeds {
            let run = PlannedRun {
                recipe: *recipe,
                description: recipe.description(seed, plan.profile, dataset)?,
                data: plan.data.clone(),
                directory: directory.join(format!("{}-{seed}", recipe.name())),
                // These methods have the same USTGAN as `ours`, and the same generated samples.
                shares_with: matches!(recipe.method, Method::Nahrn | Method::Nihrn)
                    .then(|| format!("{}-{seed}", recipe.as_ours().name())),
            };
            if (1..=asked).contains(&seed) || run.counts() {
                runs.push(run);
            }
        }
    }
    Ok(runs)
}

/// The seeds of the runs called `NAME-SEED` in a directory.
pub(super) fn seeds_in(runs: &Path, name: &str) -> anyhow::Result<BTreeSet<u64>> {
    let prefix = format!("{name}-");
    let mut seeds = BTreeSet::new();
    for entry in std::fs::read_dir(runs).with_context(|| runs.display().to_string())? {
        let name = entry?.file_name();
        let name = name.to_str().and_then(|name| name.strip_prefix(&prefix));
        seeds.extend(name.and_then(|seed| seed.parse::<u64>().ok()));
    }
    Ok(seeds)
}

impl Recipe {
    /// The recipe of `ours` with the same labels.
    fn as_ours(&self) -> Self {
        Self {
            method: Method::Ours,
            ..*self
        }
    }

    /// The name of the recipe in its runs' directories.
    pub(super) fn name(&self) -> String {
        let mut name = self.method.name().to_owned();
        if let Some(labels) = self.labels {
            name += &format!("-{labels}");
        }
        if self.choice == LabelChoice::Random {
            name += "-random";
        }
        name
    }

    /// The description of the recipe's run with a seed.
    pub(super) fn description(
        &self,
        seed: u64,
        profile: Profile,
        dataset: &Dataset,
    ) -> Result<Description, LabelsError> {
        let request = Request {
            profile,
            seed,
            labels: self.labels,
            label_choice: self.choice,
            settings: self.method.settings(profile),
        };
        request.of_method(self.method, dataset)
    }

    /// The cost of a run, in thousands of HRN's steps in the `paper` profile. A step of a GAN
    /// counts as six (by the seconds in `results/quick`). Stages taken from `ours` count
    /// nothing. Other profiles have the same proportions.
    fn effort(&self) -> f64 {
        match self.method {
            // The gradient penalty is another pass through the discriminator.
            Method::OursSteady => 480.0,
            Method::Ours => 396.0,
            Method::Sgan | Method::Igan => 255.0,
            Method::Hrn15Long | Method::Nihrn => 93.0,
            Method::Hrn100 => 20.0,
            Method::Hrn15Tuned => 15.0,
            Method::Hrn50 | Method::Frame => 10.0,
            Method::Hrn15 | Method::Nahrn => 3.0,
            Method::Hrn15Strong => 5.0,
            Method::Features => 0.5,
        }
    }
}

/// A training run of the plan, finished or not.
#[derive(Debug)]
pub(super) struct PlannedRun {
    pub(super) recipe: Recipe,
    pub(super) description: Description,
    pub(super) data: PathBuf,
    pub(super) directory: PathBuf,
    /// Name of a run that has stages in common with this run.
    pub(super) shares_with: Option<String>,
}

impl PlannedRun {
    /// Whether the run's model exists, or else what it reached.
    pub(super) fn is_finished(&self) -> bool {
        self.directory.join("hrn.onnx").exists() || Worth::is_kept(&self.directory)
    }

    /// Whether a run that was not requested belongs in the tables: it is finished, and its
    /// description equals the one it would get now. Prints a difference, if any.
    pub(super) fn counts(&self) -> bool {
        if !self.is_finished() {
            return false;
        }
        let difference = self
            .difference()
            .unwrap_or_else(|error| Some(format!("{error:#}")));
        if let Some(difference) = &difference {
            let run = self.directory.display();
            hardnessd_core::stderr_line!(
                "{run}: not requested, and left out of the tables; {difference}"
            );
        }
        difference.is_none()
    }

    /// Checks that a run in the directory has this run's description.
    fn check(&self) -> anyhow::Result<()> {
        match self.difference()? {
            None => Ok(()),
            Some(difference) => bail!(
                "{}: has a run with other settings; {difference}; choose another --out, or remove \
                 this directory to run it again",
                self.directory.display()
            ),
        }
    }

    /// The difference between the description in the directory and this run's; `None` if there is
    /// no difference or no run.
    fn difference(&self) -> anyhow::Result<Option<String>> {
        let before = Run::description_at(&self.directory)?;
        Ok(before.and_then(|before| before.difference(&self.description)))
    }

    fn job(&self, out: &Path) -> Job {
        let path = |path: &Path| path.to_string_lossy().into_owned();
        let name = self
            .directory
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let profile = clap::ValueEnum::to_possible_value(&self.description.profile);
        let mut arguments: Vec<String> = [
            "train",
            "--resume",
            "--method",
            self.recipe.method.name(),
            "--data",
            &path(&self.data),
            "--out",
            &path(&self.directory),
            "--seed",
            &self.description.seed.to_string(),
            "--profile",
            profile
                .as_ref()
                .map_or("", clap::builder::PossibleValue::get_name),
        ]
        .map(str::to_owned)
        .to_vec();
        if let Some(labels) = self.recipe.labels {
            arguments.extend(["--labels".to_owned(), labels.to_string()]);
        }
        if self.recipe.choice == LabelChoice::Random {
            arguments.extend(["--label-choice", "random"].map(str::to_owned));
        }
        Job {
            from: (self.shares_with.as_ref()).map(|other| self.directory.with_file_name(other)),
            after: self.shares_with.clone(),
            log: out.join("logs").join(format!("{name}.log")),
            product: self.directory.join("hrn.onnx"),
            effort: self.recipe.effort(),
            arguments,
            name,
        }
    }
}

/// A shell command line for each unfinished run. A run that takes stages from another one follows
/// it on the same line.
pub(super) fn command_lines(jobs: &[Job]) -> anyhow::Result<String> {
    let line = |job: &Job, from: Option<&Path>| {
        let mut words = vec!["hrn-train".to_owned()];
        words.extend(job.arguments.iter().cloned());
        if let Some(from) = from {
            words.extend(["--from".to_owned(), from.to_string_lossy().into_owned()]);
        }
        let words = shlex::try_join(words.iter().map(String::as_str));
        Ok::<_, shlex::QuoteError>(format!("RAYON_NUM_THREADS=1 {}", words?))
    };
    let mut lines = String::new();
    let waits_for = |job: &Job, other: &Job| job.after.as_ref() == Some(&other.name);
    for job in jobs {
        if jobs.iter().any(|other| waits_for(job, other)) {
            continue;
        }
        let from = job.from.as_deref().filter(|from| from.is_dir());
        lines += &line(job, from)?;
        for next in jobs.iter().filter(|next| waits_for(next, job)) {
            lines += " && ";
            lines += &line(next, next.from.as_deref())?;
        }
        lines.push('\n');
    }
    Ok(lines)
}

/// The runs that are not finished, with their jobs.
pub(super) fn unfinished<'a>(
    runs: impl IntoIterator<Item = &'a PlannedRun>,
    out: &Path,
) -> anyhow::Result<Vec<(&'a PlannedRun, Job)>> {
    let mut open = Vec::new();
    for run in runs {
        run.check()?;
        if !run.is_finished() {
            open.push((run, run.job(out)));
        }
    }
    Ok(open)
}
