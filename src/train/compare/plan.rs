//! What a comparison runs: its rows, their runs, and the command line of each.
//!
//! In: what is asked for, and what stands in the comparison's directory. Out: the runs of every row,
//! finished or not. Nothing is run here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use super::children::Job;
use crate::train::data::dataset::{Dataset, LabelChoice};
use crate::train::methods::{self, LabelsError, Method, Request};
use crate::train::run::{Description, Run};
use crate::train::settings::Profile;

/// What to compare.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The data set to learn from.
    pub data: PathBuf,
    /// Directory of the comparison.
    pub out: PathBuf,
    /// Which methods to run.
    pub methods: Vec<Method>,
    /// Numbers of labels to run each of them with, beside its own; those that a method has anyway change nothing.
    pub labels: Vec<usize>,
    /// To run under seeds 1 to this one.
    pub seeds: u64,
    /// How long each run may take.
    pub profile: Profile,
    /// Runs at a time.
    pub jobs: usize,
    /// Whether to swap the materials' roles as well.
    pub swaps: bool,
}

impl Plan {
    /// Whether it has a recipe's runs done.
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
    /// Labels other than the method's own share.
    pub(super) labels: Option<usize>,
    pub(super) choice: LabelChoice,
    /// Whether the tables have it only where its number of labels was asked for.
    pub(super) is_extra: bool,
}

/// The rows that there can be, those of the plan's methods first.
pub(super) fn recipes(plan: &Plan, dataset: &Dataset) -> anyhow::Result<Vec<Recipe>> {
    let few = methods::labels(Method::Hrn15, dataset, None)?;
    let mut methods = plan.methods.clone();
    methods.extend(Method::of_frames());
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
            // As few labels as the others have, and all of them.
            Method::Features => recipes.push(Recipe {
                labels: Some(few),
                ..own
            }),
            // Labels by object, and as the paper probably chose them.
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
            if !recipes.iter().any(has) {
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

/// Numbers of labels that a method was run with before: of the runs called `METHOD-LABELS-SEED`.
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

/// Every run that the plan asks for, and those that another finished before.
pub(super) fn planned(
    plan: &Plan,
    recipes: &[Recipe],
    dataset: &Dataset,
) -> anyhow::Result<Vec<PlannedRun>> {
    let directory = plan.out.join("runs");
    let mut runs = Vec::new();
    for recipe in recipes {
        let asked = if plan.asks(recipe) { plan.seeds } else { 0 };
        let mut seeds = recipe.seeds_in(&directory)?;
        seeds.extend(1..=asked);
        for seed in seeds {
            let run = PlannedRun {
                recipe: *recipe,
                told: recipe.told(seed, plan.profile, dataset)?,
                data: plan.data.clone(),
                directory: directory.join(format!("{}-{seed}", recipe.name())),
                // USTGAN is the same, and what the STGANs generate.
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

impl Recipe {
    /// The paper's whole method with the same labels.
    fn as_ours(&self) -> Self {
        Self {
            method: Method::Ours,
            ..*self
        }
    }

    /// Of its runs' directories.
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

    /// Seeds of its runs that stand in a directory.
    fn seeds_in(&self, runs: &Path) -> anyhow::Result<BTreeSet<u64>> {
        let prefix = self.name() + "-";
        let mut seeds = BTreeSet::new();
        for entry in std::fs::read_dir(runs).with_context(|| runs.display().to_string())? {
            let name = entry?.file_name();
            let name = name.to_str().and_then(|name| name.strip_prefix(&prefix));
            seeds.extend(name.and_then(|seed| seed.parse::<u64>().ok()));
        }
        Ok(seeds)
    }

    /// What its run of a seed is told.
    pub(super) fn told(
        &self,
        seed: u64,
        profile: Profile,
        dataset: &Dataset,
    ) -> Result<Description, LabelsError> {
        let request = Request {
            method: self.method,
            profile,
            seed,
            labels: self.labels,
            label_choice: self.choice,
            settings: self.method.settings(profile),
        };
        request.description(dataset)
    }

    /// What a run costs, in thousands of HRN's steps in the `paper` profile, a step of a GAN as six
    /// (by the seconds in `results/quick`), without the stages that it takes from ours. Other
    /// profiles keep the proportions.
    fn effort(&self) -> f64 {
        match self.method {
            Method::Ours => 396.0,
            Method::Sgan | Method::Igan => 255.0,
            Method::Hrn15Long | Method::Nihrn => 93.0,
            Method::Hrn100 => 20.0,
            Method::Hrn15Tuned => 15.0,
            Method::FixMatch => 20.0,
            Method::SelfTraining => 10.0,
            Method::Hrn50 | Method::Frame => 10.0,
            Method::Hrn15 | Method::Nahrn => 3.0,
            Method::Hrn15Strong => 5.0,
            Method::Features => 0.5,
            // No row of a comparison.
            Method::Course | Method::Adapt => 0.0,
        }
    }
}

/// A training run of the plan, finished or not.
#[derive(Debug)]
pub(super) struct PlannedRun {
    pub(super) recipe: Recipe,
    pub(super) told: Description,
    pub(super) data: PathBuf,
    pub(super) directory: PathBuf,
    /// Name of a run that has stages in common with it.
    pub(super) shares_with: Option<String>,
}

impl PlannedRun {
    /// Whether its model stands.
    pub(super) fn is_finished(&self) -> bool {
        self.directory.join("hrn.onnx").exists()
    }

    /// Whether a run that is not asked for belongs in the tables: it is finished, and was told what
    /// it would be told now. That it was told otherwise is said.
    pub(super) fn counts(&self) -> bool {
        if !self.is_finished() {
            return false;
        }
        let difference = self
            .difference()
            .unwrap_or_else(|error| Some(format!("{error:#}")));
        if let Some(difference) = &difference {
            let run = self.directory.display();
            eprintln!("{run}: not asked for, and left out of the tables; {difference}");
        }
        difference.is_none()
    }

    /// Makes sure that what stands in the directory was told what this run is to be.
    fn check(&self) -> anyhow::Result<()> {
        match self.difference()? {
            None => Ok(()),
            Some(difference) => bail!(
                "{}: holds a run that was told otherwise; {difference}; compare into another \
                 directory, or remove this one to have it run again",
                self.directory.display()
            ),
        }
    }

    /// What the run in the directory was told otherwise; `None` if nothing, or if there is no run.
    fn difference(&self) -> anyhow::Result<Option<String>> {
        let told = Run::told(&self.directory)?;
        Ok(told.and_then(|told| told.difference(&self.told)))
    }

    fn job(&self, out: &Path) -> Job {
        let path = |path: &Path| path.to_string_lossy().into_owned();
        let name = self
            .directory
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let profile = clap::ValueEnum::to_possible_value(&self.told.profile);
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
            &self.told.seed.to_string(),
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

/// A command line for each run that is not finished, for a shell. A run that takes stages of another one
/// stands behind it on the same line.
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

/// What is still to be run.
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
