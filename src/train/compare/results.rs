//! What a comparison found: `results.json`, and what tables and report take besides.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::digits::thousands;
use super::sets::{FRESH, MATCHED, PAPER_SPLIT, SHIFTS, TestSet, WORLDS};
use crate::train::data::dataset::LabelChoice;
use crate::train::judge::metrics::{self, Bin, Evaluation, Judged, ObjectCount};
use crate::train::model::export;
use crate::train::run::disk::write_whole;
use crate::train::run::history::History;
use crate::train::run::{Description, Run};
use crate::train::settings::Profile;
use crate::trial;
use crate::verdict::sha256_hex;

/// A finished run and what its exported model is worth: an element of `results.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Such as `hrn100`.
    pub method: String,
    /// Everything random in it followed from it.
    pub seed: u64,
    /// How long it was given.
    pub profile: Profile,
    /// Labelled samples it used.
    pub labels: usize,
    /// How they were chosen.
    pub label_choice: LabelChoice,
    /// Steps of all its stages.
    pub steps: u64,
    /// Seconds of all its stages, over restarts.
    pub seconds: f64,
    /// On the data set's own test split; null without one.
    pub paper_split: Option<Evaluation>,
    /// On fresh objects of `paper` shapes.
    pub fresh: Evaluation,
    /// On fresh objects of `matched` shapes.
    pub matched: Evaluation,
    /// On the fresh objects of `paper` shapes under other sensors, and on those of other shapes and
    /// materials.
    pub shifts: BTreeMap<String, Evaluation>,
    /// The run's directory under `runs/`.
    pub run: String,
}

/// A finished run with some levels' materials swapped: an element of `swaps.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwapEntry {
    /// Such as `features`.
    pub method: String,
    /// Everything random in it followed from it.
    pub seed: u64,
    /// Labelled samples it used.
    pub labels: usize,
    /// Levels, from 1, whose two materials changed roles.
    pub swapped_levels: [bool; 4],
    /// On 20 objects of each material that had the test's role.
    pub test: Evaluation,
}

/// A model on one test set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Of the test set's file.
    data_sha256: String,
    /// As `evaluate --json`.
    pub evaluation: Evaluation,
    /// The bins of its calibration error.
    pub calibration: Vec<Bin>,
    /// What the calibration error was before the fitted temperature; null without one.
    pub ece_before_temperature: Option<f64>,
    /// How each object was judged; null without objects.
    pub objects: Option<Vec<ObjectCount>>,
}

/// A model on every test set, by name: `compared.json` in a run's directory.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Worth {
    model_sha256: String,
    /// By the set's name.
    pub sets: BTreeMap<String, Measured>,
}

impl Worth {
    /// What a run's directory holds of it. What an older version wrote is as good as nothing: it
    /// is only measured again.
    fn read(run: &Path) -> Self {
        let worth = read_json(&run.join("compared.json"));
        worth.ok().flatten().unwrap_or_default()
    }

    /// Judges every set with the run's model, but for what is known already.
    pub(super) fn measure(run: &Path, sets: &[TestSet]) -> anyhow::Result<Self> {
        let model = run.join("hrn.onnx");
        let bytes = std::fs::read(&model).with_context(|| model.display().to_string())?;
        let mut worth = Self::read(run);
        let model_sha256 = sha256_hex(&bytes);
        if worth.model_sha256 != model_sha256 {
            worth = Self {
                model_sha256,
                sets: BTreeMap::new(),
            };
        }
        let known = |worth: &Self, set: &TestSet| {
            let measured = worth.sets.get(set.name);
            measured.is_some_and(|measured| measured.data_sha256 == set.sha256())
        };
        if sets.iter().all(|set| known(&worth, set)) {
            return Ok(worth);
        }
        let hrn = trial::load(&bytes, None).with_context(|| model.display().to_string())?;
        // Every model of ours says its own; of another's that does not, 1 gives no figure before it.
        let temperature = hrn.card().metrics["temperature"].as_f64().unwrap_or(1.0);
        for set in sets {
            let judged = export::judge(&hrn, &set.dataset, &set.indices)?;
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
    /// Reads the entry of a finished run.
    pub(super) fn of(run: &Path, told: &Description, sets: &[TestSet]) -> anyhow::Result<Self> {
        let worth = Worth::measure(run, sets)?;
        let history = History::read(run)?;
        let simulated = "every comparison has the simulated sets";
        let shifts = SHIFTS
            .iter()
            .chain(&WORLDS)
            .filter_map(|(name, _)| Some(((*name).to_owned(), worth.evaluation(name)?)));
        Ok(Self {
            method: told.method.clone(),
            seed: told.seed,
            profile: told.profile,
            labels: told.labels,
            label_choice: told.label_choice,
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

/// A comparison's directory, read.
#[derive(Debug)]
pub struct Comparison {
    /// Every finished run, by method and then by seed.
    pub entries: Vec<Entry>,
    /// What is known of each entry's run beyond its entry; empty where `runs/` is missing.
    pub details: Vec<Details>,
    /// Runs with swapped materials; empty without any.
    pub swaps: Vec<SwapEntry>,
}

/// A run's files.
#[derive(Debug, Default)]
pub struct Details {
    /// Its directory.
    pub directory: PathBuf,
    /// What it was told.
    pub told: Option<Description>,
    /// What made it, a line each.
    pub revisions: String,
    /// On each test set.
    pub worth: Worth,
    /// How it trained.
    pub history: History,
}

impl Details {
    /// Reads a run's directory; what is missing is left empty.
    ///
    /// # Errors
    ///
    /// If a file is there and is not as it should be.
    pub fn read(directory: &Path) -> anyhow::Result<Self> {
        let revisions = std::fs::read_to_string(directory.join("revision")).unwrap_or_default();
        Ok(Self {
            directory: directory.to_owned(),
            told: Run::told(directory)?,
            revisions: revisions.trim().to_owned(),
            worth: Worth::read(directory),
            history: History::read(directory)?,
        })
    }
}

/// The runs of one method under several seeds, all with as many labels chosen alike: a row of the
/// tables.
#[derive(Debug)]
pub struct Row<'a> {
    /// Its name in tables: the method, and what tells it from the method's other rows.
    pub title: String,
    /// Each seed's entry and details.
    pub runs: Vec<(&'a Entry, &'a Details)>,
}

impl Comparison {
    /// Reads a comparison's directory; `None` if it holds none.
    ///
    /// # Errors
    ///
    /// If a file is there and is not as it should be.
    pub fn read(directory: &Path) -> anyhow::Result<Option<Self>> {
        let Some(entries) = read_json::<Vec<Entry>>(&directory.join("results.json"))? else {
            return Ok(None);
        };
        let runs = directory.join("runs");
        let details = entries
            .iter()
            .map(|entry| Details::read(&runs.join(&entry.run)));
        Ok(Some(Self {
            details: details.collect::<anyhow::Result<_>>()?,
            swaps: read_json(&directory.join("swaps.json"))?.unwrap_or_default(),
            entries,
        }))
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

/// Reads JSON; `None` if the file is not there.
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
