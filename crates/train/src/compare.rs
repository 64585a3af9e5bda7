//! Trains methods under seeds and numbers of labels, and writes the paper's Tables 2 and 3.
//!
//! In: data. Out, in a directory: `data/` with the test sets, `runs/` with a run's directory for each method,
//! number of labels and seed, `logs/`, `results.json`, `objects.csv` and `tables.md`. This process trains
//! nothing: each run is a call of `hrn-train train`, so that runs can be stopped, resumed and spread over
//! machines. A run that has its model is not done again.

mod sets;
pub mod tables;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

use anyhow::{Context as _, bail, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::data::presses::Presses;
use crate::model::evaluated::{Case, Evaluated, cases};
use crate::model::verdicts::{self, Given};
use crate::recipe::{self, Kind};
use crate::run::Run;
use crate::run::disk::{lock, refuse_foreign, write_whole};
use crate::run::history::MetricsFile;
use crate::settings::Profile;
use hardnessd_core::trial;
use hardnessd_core::verdict::sha256_hex;
use sets::{FRESH_OBJECTS, TestSet};

/// Methods whose first stage is that of another method.
const SHARES: [(&str, &str); 2] = [("nahrn", "ours"), ("nihrn", "ours")];
/// A recipe that is no row of the tables.
const NOT_COMPARED: &str = "hrn";

/// The request for a comparison.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The data to learn from.
    pub data: Vec<PathBuf>,
    /// The directory of the comparison.
    pub out: PathBuf,
    /// The methods to run. If there are none, all that the data suit.
    pub methods: Vec<String>,
    /// Numbers of labels to run each method with, besides its own share.
    pub labels: Vec<usize>,
    /// Runs use the seeds from 1 to this one.
    pub seeds: u64,
    /// The profile of each run.
    pub profile: Profile,
    /// The number of runs at a time.
    pub jobs: usize,
}

/// A run of the plan.
#[derive(Debug, Clone)]
struct Planned {
    method: String,
    labels: Option<usize>,
    seed: u64,
}

impl Planned {
    fn name(&self) -> String {
        let labels = self
            .labels
            .map_or(String::new(), |labels| format!("-{labels}"));
        format!("{}{labels}-{}", self.method, self.seed)
    }

    /// The run whose first stage this one has, too.
    fn shares_with(&self) -> Option<Self> {
        let (_, other) = SHARES.iter().find(|(method, _)| *method == self.method)?;
        Some(Self {
            method: (*other).to_owned(),
            ..self.clone()
        })
    }
}

impl Plan {
    fn runs(&self, are_over_time: bool) -> Vec<Planned> {
        let suits = |recipe: &&recipe::Recipe| {
            recipe.name != NOT_COMPARED && (recipe.learning != Kind::Course || are_over_time)
        };
        let all = recipe::all().iter().filter(suits);
        let methods = match self.methods.is_empty() {
            true => all.map(|recipe| recipe.name.clone()).collect(),
            false => self.methods.clone(),
        };
        let numbers: Vec<Option<usize>> = [None]
            .into_iter()
            .chain(self.labels.iter().copied().map(Some))
            .collect();
        let mut runs = Vec::new();
        for method in &methods {
            for &labels in &numbers {
                runs.extend((1..=self.seeds).map(|seed| Planned {
                    method: method.clone(),
                    labels,
                    seed,
                }));
            }
        }
        runs
    }

    fn directory(&self, run: &Planned) -> PathBuf {
        self.out.join("runs").join(run.name())
    }

    fn is_done(&self, run: &Planned) -> bool {
        self.directory(run).join("hrn.onnx").exists()
    }

    /// The words after `hrn-train` that make or continue a run.
    fn words(&self, run: &Planned) -> Vec<String> {
        let path = |path: &Path| path.display().to_string();
        let mut words: Vec<String> = ["train", "--resume", "--method", &run.method, "--data"]
            .map(str::to_owned)
            .to_vec();
        words.extend(self.data.iter().map(|data| path(data)));
        words.extend(["--out".to_owned(), path(&self.directory(run))]);
        words.extend(["--seed".to_owned(), run.seed.to_string()]);
        words.extend(["--profile".to_owned(), self.profile.name().to_owned()]);
        if let Some(labels) = run.labels {
            words.extend(["--labels".to_owned(), labels.to_string()]);
        }
        words
    }

    /// The runs that are not done, in groups that each do one after the other: a run that shares a stage
    /// with another comes after it, and takes the stage.
    fn open(&self, runs: &[Planned]) -> Vec<Vec<Vec<String>>> {
        let open = |run: &&Planned| !self.is_done(run);
        let mut groups: Vec<(String, Vec<Vec<String>>)> = Vec::new();
        let mut ordered: Vec<&Planned> = runs.iter().filter(open).collect();
        ordered.sort_by_key(|run| run.shares_with().is_some());
        for run in ordered {
            let mut words = self.words(run);
            let other = run.shares_with().filter(|other| {
                let name = other.name();
                runs.iter().any(|run| run.name() == name) || self.is_done(other)
            });
            let group = other.as_ref().unwrap_or(run).name();
            if let Some(other) = other {
                words.extend([
                    "--from".to_owned(),
                    self.directory(&other).display().to_string(),
                ]);
            }
            match groups.iter_mut().find(|(name, _)| *name == group) {
                Some((_, of_group)) => of_group.push(words),
                None => groups.push((group, vec![words])),
            }
        }
        groups.into_iter().map(|(_, group)| group).collect()
    }
}

/// The command lines of the runs that are not done, for GNU parallel, Slurm or Ray: each line is
/// independent of the others.
///
/// # Errors
///
/// Fails if the data cannot be read, or the directory is of something else.
pub fn plan(plan: &Plan) -> anyhow::Result<String> {
    let presses = checked(plan)?;
    let mut lines = String::new();
    for group in plan.open(&plan.runs(presses.are_over_time())) {
        let commands = group.iter().map(|words| {
            let words = std::iter::once("hrn-train").chain(words.iter().map(String::as_str));
            Ok(format!("RAYON_NUM_THREADS=1 {}", shlex::try_join(words)?))
        });
        let commands: anyhow::Result<Vec<String>> = commands.collect();
        let _ = writeln!(lines, "{}", commands?.join(" && "));
    }
    Ok(lines)
}

fn checked(plan: &Plan) -> anyhow::Result<Presses> {
    refuse_foreign(&plan.out, "results.json", &["objects.csv", "tables.md"])?;
    Ok(Presses::read(&plan.data)?)
}

/// Does the runs that are not done, judges all runs of the plan on all sets, and writes results and tables.
/// Without data, only writes the tables of the results that are there. Returns the tables.
///
/// # Errors
///
/// Fails if the data cannot be read, the directory cannot be written or is in use by another process, or at the
/// end if a run failed.
pub fn compare(plan: &Plan) -> anyhow::Result<String> {
    if plan.data.is_empty() {
        return write_tables(&plan.out);
    }
    let presses = checked(plan)?;
    let runs = plan.runs(presses.are_over_time());
    for part in ["data", "runs", "logs"] {
        let part = plan.out.join(part);
        std::fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
    }
    let _lock = lock(&plan.out)?;
    let sets = sets::all(presses, plan.profile, &plan.out.join("data"))?;
    let results = Mutex::new(());
    let judged = || {
        let _one = results.lock().expect("nobody panics with it");
        judge(plan, &runs, &sets)
    };
    judged()?;
    let failures = do_groups(plan, plan.open(&runs), &judged)?;
    let text = write_tables(&plan.out)?;
    ensure!(
        failures.is_empty(),
        "{} failed (logs in {}): {}",
        if failures.len() == 1 { "a run" } else { "runs" },
        plan.out.join("logs").display(),
        failures.join("; ")
    );
    Ok(text)
}

/// Does groups of runs, some at a time. Returns the names of those that failed, with the reason. After each
/// run, `done` is called.
fn do_groups(
    plan: &Plan,
    groups: Vec<Vec<Vec<String>>>,
    done: &(impl Fn() -> anyhow::Result<()> + Sync),
) -> anyhow::Result<Vec<String>> {
    let open = Mutex::new(groups.into_iter());
    let (failures, errors) = (Mutex::new(Vec::new()), Mutex::new(Vec::new()));
    let next = || open.lock().expect("nobody panics with it").next();
    let work = || {
        while let Some(group) = next() {
            for words in group {
                let outcome = do_run(plan, &words).map(|failure| match failure {
                    Some(failure) => failures
                        .lock()
                        .expect("nobody panics with it")
                        .push(failure),
                    None => {
                        let noted = done().err();
                        errors.lock().expect("nobody panics with it").extend(noted);
                    }
                });
                errors
                    .lock()
                    .expect("nobody panics with it")
                    .extend(outcome.err());
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..plan.jobs {
            scope.spawn(work);
        }
    });
    match errors
        .into_inner()
        .expect("nobody panics with it")
        .into_iter()
        .next()
    {
        Some(error) => Err(error),
        None => Ok(failures.into_inner().expect("nobody panics with it")),
    }
}

/// Does a run. Returns its name and the last line of its log, if it fails.
fn do_run(plan: &Plan, words: &[String]) -> anyhow::Result<Option<String>> {
    let out = words.iter().skip_while(|word| *word != "--out").nth(1);
    let name = Path::new(out.map_or("", String::as_str))
        .file_name()
        .unwrap_or_default();
    let name = name.to_string_lossy().into_owned();
    let path = plan.out.join("logs").join(format!("{name}.log"));
    let log = File::create(&path).with_context(|| path.display().to_string())?;
    hardnessd_core::stderr_line!("{name}: begun");
    let status = Command::new(std::env::current_exe()?)
        .args(words)
        .arg("--parent")
        .arg(std::process::id().to_string())
        .env("RAYON_NUM_THREADS", "1")
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .status()
        .context("hrn-train train")?;
    if status.success() {
        hardnessd_core::stderr_line!("{name}: done");
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    let reason = text.lines().last().unwrap_or("no word").to_owned();
    Ok(Some(format!("{name}: {reason}")))
}

/// What a run's model reached on a set, in the run's `compared.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Compared {
    model_sha256: String,
    data_sha256: String,
    evaluation: Value,
    /// Level, object, right presses and presses.
    objects: Vec<(u8, u32, u64, u64)>,
}

/// Judges every run of the plan that is done on every set, and writes `results.json` and `objects.csv`.
/// Entries of other runs stay.
fn judge(plan: &Plan, runs: &[Planned], sets: &[TestSet]) -> anyhow::Result<()> {
    let mut entries = entries(&plan.out)?;
    for run in runs.iter().filter(|run| plan.is_done(run)) {
        let entry = judged(plan, run, sets)?;
        let same = |other: &&mut Value| other["run"] == entry["run"];
        match entries.iter_mut().find(same) {
            Some(other) => *other = entry,
            None => entries.push(entry),
        }
    }
    // Runs end in any order, and those of an earlier plan stay last.
    let place = |entry: &Value| runs.iter().position(|run| entry["run"] == run.name());
    entries.sort_by_key(|entry| place(entry).unwrap_or(usize::MAX));
    let json = serde_json::to_vec_pretty(&entries)?;
    write_whole(&plan.out.join("results.json"), &json)?;
    write_objects(&plan.out, &entries)
}

/// The entry of a run in `results.json`.
fn judged(plan: &Plan, run: &Planned, sets: &[TestSet]) -> anyhow::Result<Value> {
    let directory = plan.directory(run);
    let path = directory.join("hrn.onnx");
    let description = Run::description_at(&directory)?;
    let description = description.with_context(|| format!("{}: no run", directory.display()))?;
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    let model_sha256 = sha256_hex(&bytes);
    let mut known = compared(&directory)?;
    let is_known = |known: &BTreeMap<String, Compared>, set: &TestSet| {
        known.get(set.name).is_some_and(|found| {
            (found.model_sha256.as_str(), found.data_sha256.as_str())
                == (model_sha256.as_str(), set.sha256())
        })
    };
    if !sets.iter().all(|set| is_known(&known, set)) {
        let hrn = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
        for set in sets {
            let verdicts = verdicts::of(&hrn, &set.presses, &set.places, Given::USUAL)?;
            let cases = cases(&set.presses, &verdicts);
            let evaluation = Evaluated::of(&cases, &hrn.card().levels);
            let found = Compared {
                model_sha256: model_sha256.clone(),
                data_sha256: set.sha256().to_owned(),
                evaluation: serde_json::to_value(evaluation)?,
                objects: by_object(&cases),
            };
            known.insert(set.name.to_owned(), found);
        }
        let json = serde_json::to_vec(&known)?;
        write_whole(&directory.join("compared.json"), &json)?;
    }
    let (steps, seconds) = MetricsFile::of(&directory).cost()?;
    let mut entry = json!({
        "method": run.method,
        "seed": run.seed,
        "profile": plan.profile,
        "labels": description.labels,
        "steps": steps,
        "seconds": seconds,
        "run": run.name(),
        sets::PAPER_SPLIT: null,
    });
    for set in sets {
        entry[set.name] = known[set.name].evaluation.clone();
    }
    Ok(entry)
}

fn compared(run: &Path) -> anyhow::Result<BTreeMap<String, Compared>> {
    let path = run.join("compared.json");
    match std::fs::read(&path) {
        // What cannot be read is measured again.
        Ok(bytes) => Ok(serde_json::from_slice(&bytes).unwrap_or_default()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(BTreeMap::new()),
        Err(error) => Err(error).with_context(|| path.display().to_string()),
    }
}

fn by_object(cases: &[Case]) -> Vec<(u8, u32, u64, u64)> {
    let mut objects = BTreeMap::<(u8, u32), (u64, u64)>::new();
    for case in cases {
        let Some(object) = case.object else {
            return Vec::new();
        };
        let (right, all) = objects.entry((case.level, object)).or_default();
        *right += u64::from(case.verdict.level == case.level);
        *all += 1;
    }
    let count = |((level, object), (right, all))| (level, object, right, all);
    objects.into_iter().map(count).collect()
}

/// The entries of `results.json`; none if there is no such file.
fn entries(out: &Path) -> anyhow::Result<Vec<Value>> {
    let path = out.join("results.json");
    match std::fs::read(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes).with_context(|| path.display().to_string()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error).with_context(|| path.display().to_string()),
    }
}

/// Writes the right verdicts of every run on each object. `geometry` is there where the objects of one number
/// are pressed alike in all materials.
fn write_objects(out: &Path, entries: &[Value]) -> anyhow::Result<()> {
    let mut csv = "run,set,level,object,geometry,right,samples\n".to_owned();
    for run in entries.iter().filter_map(|entry| entry["run"].as_str()) {
        for (set, found) in compared(&out.join("runs").join(run))? {
            for (level, object, right, all) in found.objects {
                let geometry = match set.as_str() {
                    "matched" => (object % FRESH_OBJECTS).to_string(),
                    _ => String::new(),
                };
                let _ = writeln!(csv, "{run},{set},{level},{object},{geometry},{right},{all}");
            }
        }
    }
    write_whole(&out.join("objects.csv"), csv.as_bytes())
}

/// Writes `tables.md` from `results.json`, and returns it.
fn write_tables(out: &Path) -> anyhow::Result<String> {
    let path = out.join("results.json");
    let entries: Vec<tables::Entry> = entries(out)?
        .into_iter()
        .map(serde_json::from_value)
        .collect::<Result<_, _>>()
        .with_context(|| path.display().to_string())?;
    if entries.is_empty() {
        bail!(
            "{}: has no finished run: give --data, to train some",
            path.display()
        );
    }
    let text = tables::markdown(&entries);
    write_whole(&out.join("tables.md"), text.as_bytes())?;
    Ok(text)
}
