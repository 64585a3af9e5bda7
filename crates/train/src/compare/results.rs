//! The results of a comparison: `results.json`, and the other files that tables and report read.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::digits::thousands;
use super::sets::{self, FRESH, MATCHED, PAPER_SPLIT, SHIFTS, TestSet, WORLDS};
use crate::data::dataset::LabelChoice;
use crate::judge::metrics::{self, Bin, Clusters, Evaluation, Judged, ObjectCount};
use crate::model::{evaluated, export};
use crate::run::disk::write_whole;
use crate::run::history::History;
use crate::run::{Description, Run};
use crate::settings::Profile;
use hardnessd_core::trial;
use hardnessd_core::verdict::sha256_hex;

/// A finished run and the evaluation of its exported model: an element of `results.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// The method's name, such as `hrn100`.
    pub method: String,
    /// The seed of everything random in the run.
    pub seed: u64,
    /// The profile of the run.
    pub profile: Profile,
    /// The number of labelled samples that the run used.
    pub labels: usize,
    /// How the labels were chosen.
    pub label_choice: LabelChoice,
    /// The steps of all stages of the run.
    pub steps: u64,
    /// The seconds of all stages of the run, including those before a restart.
    pub seconds: f64,
    /// The evaluation on the data set's own test split; null without one.
    pub paper_split: Option<Evaluation>,
    /// The evaluation on fresh objects of `paper` shapes.
    pub fresh: Evaluation,
    /// The evaluation on fresh objects of `matched` shapes.
    pub matched: Evaluation,
    /// The evaluations on the fresh objects of `paper` shapes under other sensors, and on those of
    /// other shapes and materials, by the set's name.
    pub shifts: BTreeMap<String, Evaluation>,
    /// The run's directory under `runs/`.
    pub run: String,
}

/// A finished run with some levels' materials swapped: an element of `swaps.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwapEntry {
    /// The method's name, such as `features`.
    pub method: String,
    /// The seed of everything random in the run.
    pub seed: u64,
    /// The number of labelled samples that the run used.
    pub labels: usize,
    /// Whether the two materials of each level changed roles, from level 1.
    pub swapped_levels: [bool; 4],
    /// The evaluation on 20 objects of each material in the test's role.
    pub test: Evaluation,
}

/// The results of a model on one test set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// The SHA-256 of the test set's file.
    data_sha256: String,
    /// The evaluation, as `evaluate --json` prints it.
    pub evaluation: Evaluation,
    /// The bins of its calibration error.
    pub calibration: Vec<Bin>,
    /// The calibration error before the fitted temperature; null without one.
    pub ece_before_temperature: Option<f64>,
    /// The correct verdicts of each object; null without objects.
    pub objects: Option<Vec<ObjectCount>>,
}

/// The results of a model on every test set: `compared.json` in a run's directory.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Worth {
    model_sha256: String,
    /// The results by the set's name.
    pub sets: BTreeMap<String, Measured>,
}

impl Worth {
    /// Reads a run's `compared.json`. A file that is missing or unreadable counts as empty, because
    /// the results can be measured again.
    fn read(run: &Path) -> Self {
        let worth = read_json(&run.join("compared.json"));
        worth.ok().flatten().unwrap_or_default()
    }

    /// Whether a run's directory has results, with or without the model.
    pub(super) fn is_kept(run: &Path) -> bool {
        !Self::read(run).sets.is_empty()
    }

    fn knows_all(&self, sets: &[TestSet]) -> bool {
        sets.iter().all(|set| {
            let measured = self.sets.get(set.name);
            measured.is_some_and(|measured| measured.data_sha256 == set.sha256())
        })
    }

    /// Judges every set with the run's model, unless all results are known already. Then the model
    /// may be missing.
    pub(super) fn measure(run: &Path, sets: &[TestSet]) -> anyhow::Result<Self> {
        let model = run.join("hrn.onnx");
        let mut worth = Self::read(run);
        let bytes = match std::fs::read(&model) {
            Err(error) if error.kind() == ErrorKind::NotFound && worth.knows_all(sets) => {
                return Ok(worth);
            }
            read => read.with_context(|| {
                format!(
                    "{}: needed, because compared.json does not have the results on all test sets",
                    model.display()
                )
            })?,
        };
        let model_sha256 = sha256_hex(&bytes);
        if worth.model_sha256 != model_sha256 {
            worth = Self {
                model_sha256,
                sets: BTreeMap::new(),
            };
        }
        if worth.knows_all(sets) {
            return Ok(worth);
        }
        let hrn = trial::load(&bytes, None).with_context(|| model.display().to_string())?;
        // Every model of this trainer states its temperature. For a model without one, 1 means that
        // there is no error before the temperature to report.
        let temperature = hrn.card().metrics["temperature"].as_f64().unwrap_or(1.0);
        for set in sets {
            let cases = export::cases(&hrn, &set.dataset, &set.indices)?;
            let judged = evaluated::judged(&cases);
            let before = |one: &Judged| one.before_temperature(temperature);
            let before: Vec<Judged> = judged.iter().map(before).collect();
            let measured = Measured {
                data_sha256: set.sha256().to_owned(),
                evaluation: Evaluation::of(&judged, hrn.card().levels.len()),
                calibration: metrics::calibration(&judged),
                ece_before_temperature: (temperature != 1.0)
                    .then(|| metrics::calibration_error(&before)),
                objects: metrics::by_object(&judged),
            };
            worth.sets.insert(set.name.to_owned(), measured);
        }
        write_whole(&run.join("compared.json"), &serde_json::to_vec(&worth)?)?;
        Ok(worth)
    }

    fn evaluation(&self, set: &str) -> Option<Evaluation> {
        Some(self.sets.get(set)?.evaluation.clone())
    }
}

impl Entry {
    fn evaluations(&self) -> impl Iterator<Item = &Evaluation> {
        let own = [&self.fresh, &self.matched].into_iter();
        own.chain(&self.paper_split).chain(self.shifts.values())
    }

    /// Reads the entry of a finished run.
    pub(super) fn of(
        run: &Path,
        description: &Description,
        sets: &[TestSet],
    ) -> anyhow::Result<Self> {
        let worth = Worth::measure(run, sets)?;
        let history = History::read(run)?;
        let simulated = "every comparison has the simulated sets";
        let shifts = SHIFTS
            .iter()
            .chain(&WORLDS)
            .filter_map(|(name, _)| Some(((*name).to_owned(), worth.evaluation(name)?)));
        Ok(Self {
            method: description.method.clone(),
            seed: description.seed,
            profile: description.profile,
            labels: description.labels,
            label_choice: description.label_choice,
            steps: history.steps(),
            seconds: history.seconds(),
            paper_split: worth.evaluation(PAPER_SPLIT),
            fresh: worth.evaluation(FRESH).expect(simulated),
            matched: worth.evaluation(MATCHED).expect(simulated),
            shifts: shifts.collect(),
            run: run
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned(),
        })
    }
}

/// The contents of a comparison's directory.
#[derive(Debug)]
pub struct Comparison {
    /// Every finished run, by method and then by seed.
    pub entries: Vec<Entry>,
    /// Further details of each entry's run; empty where `runs/` is missing.
    pub details: Vec<Details>,
    /// Runs with swapped materials; empty without any.
    pub swaps: Vec<SwapEntry>,
}

/// The contents of a run's directory.
#[derive(Debug, Default)]
pub struct Details {
    /// The run's directory.
    pub directory: PathBuf,
    /// The run's description.
    pub description: Option<Description>,
    /// The program revisions that made the run, one per line.
    pub revisions: String,
    /// The results on each test set.
    pub worth: Worth,
    /// The metrics of its training.
    pub history: History,
}

impl Details {
    /// Reads a run's directory. Missing files leave their fields empty.
    ///
    /// # Errors
    ///
    /// Fails if a file exists but cannot be read or parsed.
    pub fn read(directory: &Path) -> anyhow::Result<Self> {
        let revisions = std::fs::read_to_string(directory.join("revision")).unwrap_or_default();
        let worth = Worth::read(directory);
        ensure_square(directory, worth.sets.values().map(|set| &set.evaluation))?;
        Ok(Self {
            directory: directory.to_owned(),
            description: Run::description_at(directory)?,
            revisions: revisions.trim().to_owned(),
            worth,
            history: History::read(directory)?,
        })
    }
}

/// The runs of one method under several seeds, all with the same number of labels and the same way
/// of choosing them: a row of the tables.
#[derive(Debug)]
pub struct Row<'a> {
    /// The row's name in tables: the method, and what distinguishes it from the method's other
    /// rows.
    pub title: String,
    /// Each seed's entry and details.
    pub runs: Vec<(&'a Entry, &'a Details)>,
}

impl Comparison {
    /// Reads a comparison's directory; `None` if it holds none.
    ///
    /// # Errors
    ///
    /// Fails if a file exists but cannot be read or parsed.
    pub fn read(directory: &Path) -> anyhow::Result<Option<Self>> {
        let Some(entries) = read_json::<Vec<Entry>>(&directory.join("results.json"))? else {
            return Ok(None);
        };
        let swaps: Vec<SwapEntry> = read_json(&directory.join("swaps.json"))?.unwrap_or_default();
        let all = entries.iter().flat_map(Entry::evaluations);
        let all = all.chain(swaps.iter().map(|swap| &swap.test));
        ensure_square(directory, all)?;
        let runs = directory.join("runs");
        let details = entries
            .iter()
            .map(|entry| Details::read(&runs.join(&entry.run)));
        Ok(Some(Self {
            details: details.collect::<anyhow::Result<_>>()?,
            swaps,
            entries,
        }))
    }

    /// The correct verdicts of every run on each object, as CSV. All intervals can be computed from
    /// them. `geometry` is empty where objects of different levels are not pressed alike.
    pub fn objects(&self) -> String {
        let mut csv = "run,set,level,object,geometry,right,samples\n".to_owned();
        for (entry, details) in self.entries.iter().zip(&self.details) {
            for (set, measured) in &details.worth.sets {
                for count in measured.objects.iter().flatten() {
                    let geometry = match sets::clusters(set) {
                        Clusters::Objects => String::new(),
                        Clusters::Geometries(number) => (count.object % number).to_string(),
                    };
                    let ObjectCount {
                        level,
                        object,
                        right,
                        samples,
                    } = count;
                    csv += &format!(
                        "{},{set},{level},{object},{geometry},{right},{samples}\n",
                        entry.run
                    );
                }
            }
        }
        csv
    }

    /// The tables' rows in the order of the entries.
    pub fn rows(&self) -> Vec<Row<'_>> {
        let key = |entry: &Entry| (entry.method.clone(), entry.labels, entry.label_choice);
        let mut rows: Vec<Row> = Vec::new();
        for run in self.entries.iter().zip(&self.details) {
            match rows.iter_mut().find(|row| key(row.runs[0].0) == key(run.0)) {
                Some(row) => row.runs.push(run),
                None => rows.push(Row {
                    title: String::new(),
                    runs: vec![run],
                }),
            }
        }
        let labels_of = |method: &str| -> BTreeSet<usize> {
            let of_method = self.entries.iter().filter(|entry| entry.method == method);
            of_method.map(|entry| entry.labels).collect()
        };
        for row in &mut rows {
            let entry = row.runs[0].0;
            row.title.clone_from(&entry.method);
            if labels_of(&entry.method).len() > 1 {
                row.title += &format!(", {} labels", thousands(entry.labels as u64));
            }
            if entry.label_choice == LabelChoice::Random {
                row.title += ", labels at random";
            }
        }
        rows
    }
}

/// Returns an error if an evaluation in a directory is damaged. All have the same number of levels.
pub(super) fn ensure_square<'a>(
    directory: &Path,
    evaluations: impl Iterator<Item = &'a Evaluation>,
) -> anyhow::Result<()> {
    let mut levels = None;
    for evaluation in evaluations {
        let own = evaluation.confusion.len();
        ensure!(
            evaluation.is_square() && *levels.get_or_insert(own) == own,
            "{}: an evaluation is damaged: `confusion` is not square, or of other levels",
            directory.display()
        );
    }
    Ok(())
}

/// Reads a JSON file; `None` if the file does not exist.
pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> anyhow::Result<Option<T>> {
    match std::fs::read(path) {
        Ok(bytes) => {
            let value = serde_json::from_slice(&bytes);
            Ok(Some(value.with_context(|| path.display().to_string())?))
        }
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| path.display().to_string()),
    }
}
