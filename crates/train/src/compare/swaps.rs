//! Trains and tests with the two materials of a level in swapped roles.
//!
//! A level is one material in training and another in the test, so an interval over objects says
//! nothing of the results that other materials would have given. Here each assignment of the roles
//! is a data set of its own. It is like the comparison's in all else: same seed, same numbers of
//! training objects, 20 objects per material to judge. Parts that data sets share are simulated
//! once.

use std::path::PathBuf;

use anyhow::Context as _;

use super::children::{self, Failure};
use super::plan::{Plan, PlannedRun, Recipe, seeds_in, unfinished};
use super::results::{SwapEntry, read_json};
use super::sets;
use crate::data::dataset::{Dataset, LabelChoice};
use crate::data::simulated;
use crate::judge::metrics::Evaluation;
use crate::methods::Method;
use crate::run::disk::write_whole;
use crate::settings::Profile;
use hardnessd_simulator::{DatasetSettings, LabelledSample, Material};

/// Four assignments in which every level is swapped twice.
const FEW: [[bool; 4]; 4] = [
    [false, false, false, false],
    [false, true, false, true],
    [true, false, true, false],
    [true, true, true, true],
];

/// The assignments that a recipe is run under; empty for most recipes.
fn assignments(recipe: &Recipe, profile: Profile) -> Vec<[bool; 4]> {
    let all = || (0..16).map(|bits| std::array::from_fn(|level| bits >> level & 1 == 1));
    match (recipe.method, recipe.choice, profile) {
        (_, LabelChoice::Random, _) => Vec::new(),
        (
            Method::Features | Method::Hrn15Strong | Method::Hrn15Tuned,
            _,
            Profile::Paper | Profile::Quick,
        ) => all().collect(),
        (Method::Features | Method::Hrn15Strong | Method::Hrn15Tuned | Method::Ours, ..) => {
            FEW.to_vec()
        }
        _ => Vec::new(),
    }
}

/// The name of an assignment: the swapped levels, such as `24`, or `none`.
pub(super) fn name(swapped_levels: [bool; 4]) -> String {
    let levels = (1..).zip(swapped_levels).filter(|(_, swapped)| *swapped);
    let name: String = levels
        .map(|(level, _): (u8, _)| level.to_string())
        .collect();
    if name.is_empty() {
        "none".to_owned()
    } else {
        name
    }
}

/// The possible runs with swapped materials.
#[derive(Debug)]
pub(super) struct Swaps {
    every: Vec<(Recipe, [bool; 4])>,
    /// The settings of the data sets, without the roles.
    settings: DatasetSettings,
}

impl Swaps {
    /// The runs with swapped materials of all `recipes`, or `None` if the plan requests none of
    /// them.
    ///
    /// # Errors
    ///
    /// Fails if the data does not carry its simulation settings.
    pub(super) fn of(plan: &Plan, recipes: &[Recipe]) -> anyhow::Result<Option<Self>> {
        let every: Vec<(Recipe, [bool; 4])> = recipes
            .iter()
            .flat_map(|recipe| {
                assignments(recipe, plan.profile)
                    .into_iter()
                    .map(|swapped| (*recipe, swapped))
            })
            .collect();
        if !plan.swaps || !every.iter().any(|(recipe, _)| plan.asks(recipe)) {
            return Ok(None);
        }
        let settings = DatasetSettings {
            test_objects: sets::FRESH_OBJECTS,
            ..simulated::settings_of(&plan.data).context("--swaps")?
        };
        Ok(Some(Self { every, settings }))
    }

    /// Every run that the plan requests, and the finished runs of earlier plans. Simulates what
    /// they learn from.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read or written.
    pub(super) fn planned(&self, plan: &Plan) -> anyhow::Result<Vec<SwappedRun>> {
        let directory = plan.out.join("runs");
        let mut parts = None;
        let mut runs = Vec::with_capacity(self.every.len());
        for (recipe, swapped) in &self.every {
            let called = format!("{}-swapped-{}", recipe.name(), name(*swapped));
            let asked = if plan.asks(recipe) { plan.seeds } else { 0 };
            let mut seeds = seeds_in(&directory, &called)?;
            seeds.extend(1..=asked);
            if seeds.is_empty() {
                continue;
            }
            let file = file(plan, self.settings, *swapped, &mut parts)?;
            let dataset = Dataset::read(&file)?;
            for seed in seeds {
                let run = PlannedRun {
                    recipe: *recipe,
                    description: recipe.description(seed, plan.profile, &dataset)?,
                    data: file.clone(),
                    directory: directory.join(format!("{called}-{seed}")),
                    // Without a swap, the training is the comparison's own run, judged on more
                    // objects.
                    shares_with: (*swapped == [false; 4])
                        .then(|| format!("{}-{seed}", recipe.name())),
                };
                if (1..=asked).contains(&seed) || run.counts() {
                    runs.push((run, *swapped));
                }
            }
        }
        Ok(runs)
    }

    /// Runs the unfinished runs and writes `swaps.json`.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read or written, or a directory holds a run with other settings.
    pub(super) fn run(&self, plan: &Plan) -> anyhow::Result<Vec<Failure>> {
        let runs = self.planned(plan)?;
        let open = unfinished(runs.iter().map(|(run, _)| run), &plan.out)?;
        let jobs = open.into_iter().map(|(_, job)| job).collect();
        let failures = children::run(jobs, plan.jobs, |_| Ok(()))?;
        let mut entries = Vec::new();
        for (run, swapped_levels) in &runs {
            let test: Option<Evaluation> = read_json(&run.directory.join("evaluation.json"))?;
            if let (true, Some(test)) = (run.is_finished(), test) {
                entries.push(SwapEntry {
                    method: run.description.method.clone(),
                    seed: run.description.seed,
                    labels: run.description.labels,
                    swapped_levels: *swapped_levels,
                    test,
                });
            }
        }
        write_whole(
            &plan.out.join("swaps.json"),
            &serde_json::to_vec_pretty(&entries)?,
        )?;
        Ok(failures)
    }
}

/// A run, and the levels whose materials are swapped in it.
pub(super) type SwappedRun = (PlannedRun, [bool; 4]);

/// The samples without any swap, and with all levels swapped.
type Parts = [Vec<LabelledSample>; 2];

/// The file of an assignment, written unless it exists. `parts` are simulated when first needed.
fn file(
    plan: &Plan,
    settings: DatasetSettings,
    swapped_levels: [bool; 4],
    parts: &mut Option<Parts>,
) -> anyhow::Result<PathBuf> {
    let under = |swapped_levels| DatasetSettings {
        swapped_levels,
        ..settings
    };
    let own = under(swapped_levels);
    let label = format!("swapped-{}", name(swapped_levels));
    let path = sets::file_of(&plan.out.join("data"), &label, &own)?;
    if !path.exists() {
        let parts = parts.get_or_insert_with(|| {
            [false, true]
                .map(|swapped| simulated::simulate(&under([swapped; 4]), simulated::all_cores()))
        });
        write_whole(
            &path,
            &simulated::to_bytes(&own, composed(parts, swapped_levels))?,
        )?;
    }
    Ok(path)
}

/// Composes the samples that the simulator gives for an assignment. Each material comes from the
/// part in which it has its role, and objects are numbered consecutively.
fn composed([none, all]: &Parts, swapped_levels: [bool; 4]) -> Vec<LabelledSample> {
    let mut samples: Vec<LabelledSample> = Vec::new();
    let mut objects = 0;
    for material in Material::ALL {
        let swapped = swapped_levels[usize::from(material.level()) - 1];
        let part = if swapped { all } else { none };
        let mut of_material = part
            .iter()
            .filter(|sample| sample.material == material.index())
            .peekable();
        while let Some(sample) = of_material.next() {
            samples.push(LabelledSample {
                object: objects,
                ..sample.clone()
            });
            let next = of_material.peek();
            objects += u32::from(next.is_none_or(|next| next.object != sample.object));
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_simulator::dataset;

    #[test]
    fn parts_compose_what_the_simulator_gives() {
        let under = |swapped_levels| DatasetSettings {
            objects: 2,
            test_objects: 1,
            presses: 2,
            swapped_levels,
            ..DatasetSettings::default()
        };
        let parts = [false, true].map(|swapped| dataset(&under([swapped; 4]), 2, |_| ()));
        for swapped in [FEW[1], [true, false, false, false]] {
            let expected = dataset(&under(swapped), 2, |_| ());
            assert!(composed(&parts, swapped) == expected, "{swapped:?}");
        }
    }

    #[test]
    fn few_assignments_swap_every_level_twice_and_names_tell_them_apart() {
        for level in 0..4 {
            assert_eq!(FEW.iter().filter(|swapped| swapped[level]).count(), 2);
        }
        assert_eq!(FEW.map(name), ["none", "24", "13", "1234"]);
    }
}
