//! Trains methods under seeds and numbers of labels, and writes the paper's Tables 2 and 3.
//!
//! In: data. Out, in a directory: `data/` with the test sets, `runs/` with a run's directory for each method,
//! number of labels and seed, `logs/`, `results.json`, `objects.csv` and `tables.md`. This process trains
//! nothing: each run is a call of `hrn-train train`, so that runs can be stopped, resumed and spread over
//! machines. A run that has its model is not done again, and one that has its `compared.json` is not judged again.

mod sets;
pub mod tables;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, ensure};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::data::presses::Presses;
use crate::model::evaluated::{Case, Evaluated, cases};
use crate::model::verdicts::{self, Given};
use crate::recipe::{self, Kind, Recipe};
use crate::run::Run;
use crate::run::disk::{lock, refuse_foreign, write_whole};
use crate::run::history::MetricsFile;
use crate::settings::Profile;
use hardnessd_core::trial;
use sets::{FRESH_OBJECTS, TestSet};

/// A recipe that is no row of the tables.
const NOT_COMPARED: &str = "hrn";

/// The request for a comparison.
#[derive(Debug, clap::Args)]
#[command(after_long_help = HELP)]
pub struct Plan {
    /// Data to learn from; several files may be named [default: none, only make the tables of DIR again]
    #[arg(long, value_name = "D.npz", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Directory of the comparison
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Methods to run [default: all but hrn; course only on whole presses]
    #[arg(long, value_name = "M", value_delimiter = ',', num_args = 1.., hide_possible_values = true,
          value_parser = recipe::parser())]
    methods: Vec<&'static Recipe>,
    /// Also run every method with each of these numbers of labels
    #[arg(long, value_name = "N", value_delimiter = ',', num_args = 1..)]
    labels: Vec<usize>,
    /// Train with the seeds 1 to N
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// Length of each training run
    #[arg(long, default_value = "paper")]
    profile: Profile,
    /// Run nothing: print a command line for each run that is not done, for GNU parallel, Slurm or Ray
    #[arg(long, requires = "data")]
    plan: bool,
    /// Runs at a time, each on one thread [default: as many as there are cores]
    #[arg(long, value_name = "J")]
    jobs: Option<NonZeroUsize>,
}

/// What `compare --help` says below the options.
const HELP: &str = "\
    It calls `train` once for each method, number of labels and seed, and leaves out the runs that \
    have their model. Models that take references get two presses of each rigid piece.";

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
}

impl Plan {
    fn runs(&self, are_over_time: bool) -> Vec<Planned> {
        let suits = |recipe: &&Recipe| {
            recipe.name != NOT_COMPARED && (recipe.learning != Kind::Course || are_over_time)
        };
        let methods: Vec<&Recipe> = match self.methods.is_empty() {
            true => recipe::all().iter().filter(suits).collect(),
            false => self.methods.clone(),
        };
        let mut runs = Vec::new();
        for recipe in methods {
            for labels in [None]
                .into_iter()
                .chain(self.labels.iter().copied().map(Some))
            {
                runs.extend((1..=self.seeds).map(|seed| Planned {
                    method: recipe.name.clone(),
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
}

/// Does the runs that are not done, judges all runs of the plan on all sets, and writes results and tables.
/// Without data, only writes the tables of the results that are there. Returns the tables, or the command lines
/// of the runs if only these are asked for.
///
/// # Errors
///
/// Fails if the data cannot be read, the directory cannot be written or is in use by another process, or at the
/// end if a run failed.
pub fn compare(plan: &Plan) -> anyhow::Result<String> {
    if plan.data.is_empty() {
        return write_tables(&plan.out);
    }
    refuse_foreign(&plan.out, "results.json", &["objects.csv", "tables.md"])?;
    let presses = Presses::read(&plan.data)?;
    let runs = plan.runs(presses.are_over_time());
    let open = runs.iter().filter(|run| !plan.is_done(run));
    let open: Vec<Vec<String>> = open.map(|run| plan.words(run)).collect();
    if plan.plan {
        let line = |words: &Vec<String>| {
            let words = shlex::try_join(words.iter().map(String::as_str))?;
            Ok(format!("RAYON_NUM_THREADS=1 hrn-train {words}\n"))
        };
        return open.iter().map(line).collect();
    }
    for part in ["data", "runs", "logs"] {
        let part = plan.out.join(part);
        fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
    }
    let _lock = lock(&plan.out)?;
    let sets = sets::all(presses, plan.profile, &plan.out.join("data"))?;
    // Without a number, as many threads as cores.
    let jobs = plan.jobs.map_or(0, NonZeroUsize::get);
    let jobs = rayon::ThreadPoolBuilder::new().num_threads(jobs).build()?;
    let failures: Vec<Option<String>> = jobs.install(|| {
        let runs = open.par_iter().with_max_len(1);
        runs.map(|words| do_run(plan, words))
            .collect::<anyhow::Result<_>>()
    })?;
    let done = runs.par_iter().filter(|run| plan.is_done(run));
    done.try_for_each(|run| judge(plan, run, &sets))?;
    write_results(&plan.out)?;
    let text = write_tables(&plan.out);
    let failures: Vec<String> = failures.into_iter().flatten().collect();
    ensure!(
        failures.is_empty(),
        "runs failed (logs in {}): {}",
        plan.out.join("logs").display(),
        failures.join("; ")
    );
    text
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
    let text = fs::read_to_string(&path).unwrap_or_default();
    let reason = text.lines().last().unwrap_or("no word");
    Ok(Some(format!("{name}: {reason}")))
}

/// What a run's model reached, in the run's `compared.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Compared {
    /// The SHA-256 of each set.
    data: Vec<String>,
    /// The entry of the run in `results.json`.
    entry: Value,
    /// For each set the level, object, right presses and presses of each object.
    objects: BTreeMap<String, Vec<(u8, u32, u64, u64)>>,
}

/// The file of a run, which is `None` if it is not there or of another version.
fn compared(run: &Path) -> Option<Compared> {
    let bytes = fs::read(run.join("compared.json")).ok()?;
    serde_json::from_slice(&bytes).ok()
}

/// Judges a run that is done on every set, unless it was.
fn judge(plan: &Plan, run: &Planned, sets: &[TestSet]) -> anyhow::Result<()> {
    let directory = plan.directory(run);
    let data: Vec<String> = sets.iter().map(|set| set.sha256().to_owned()).collect();
    if compared(&directory).is_some_and(|known| known.data == data) {
        return Ok(());
    }
    let path = directory.join("hrn.onnx");
    let description = Run::description_at(&directory)?;
    let description = description.with_context(|| format!("{}: no run", directory.display()))?;
    let bytes = fs::read(&path).with_context(|| path.display().to_string())?;
    let hrn = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
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
    let mut objects = BTreeMap::new();
    for set in sets {
        let verdicts = verdicts::of(&hrn, &set.presses, &set.places, Given::USUAL)?;
        let cases = cases(&set.presses, &verdicts);
        entry[set.name] = serde_json::to_value(Evaluated::of(&cases, &hrn.card().levels))?;
        objects.insert(set.name.to_owned(), by_object(&cases));
    }
    let found = Compared {
        data,
        entry,
        objects,
    };
    write_whole(
        &directory.join("compared.json"),
        &serde_json::to_vec(&found)?,
    )
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

/// Writes `results.json` and `objects.csv`, with every run of the directory that was judged. `geometry` is there
/// where the objects of one number are pressed alike in all materials.
fn write_results(out: &Path) -> anyhow::Result<()> {
    let runs = out.join("runs");
    let of_runs = fs::read_dir(&runs).with_context(|| runs.display().to_string())?;
    let paths: Result<Vec<PathBuf>, _> = of_runs
        .map(|run| Ok::<_, anyhow::Error>(run?.path()))
        .collect();
    let mut all: Vec<Compared> = paths?.iter().filter_map(|run| compared(run)).collect();
    all.sort_by_key(|Compared { entry, .. }| {
        let method = recipe::all()
            .iter()
            .position(|recipe| entry["method"] == recipe.name);
        let [labels, seed] = ["labels", "seed"].map(|key| entry[key].as_u64());
        (method, Reverse(labels), seed)
    });
    let mut csv = "run,set,level,object,geometry,right,samples\n".to_owned();
    for Compared { entry, objects, .. } in &all {
        let run = entry["run"].as_str().unwrap_or_default();
        for (set, objects) in objects {
            for &(level, object, right, all) in objects {
                let geometry = match set.as_str() {
                    "matched" => (object % FRESH_OBJECTS).to_string(),
                    _ => String::new(),
                };
                let _ = writeln!(csv, "{run},{set},{level},{object},{geometry},{right},{all}");
            }
        }
    }
    let entries: Vec<&Value> = all.iter().map(|compared| &compared.entry).collect();
    write_whole(
        &out.join("results.json"),
        &serde_json::to_vec_pretty(&entries)?,
    )?;
    write_whole(&out.join("objects.csv"), csv.as_bytes())
}

/// Writes `tables.md` from `results.json`, and returns it.
fn write_tables(out: &Path) -> anyhow::Result<String> {
    let path = out.join("results.json");
    let shown = || path.display().to_string();
    let entries: Vec<tables::Entry> = match fs::read(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes).with_context(shown)?,
        Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(error).with_context(shown),
    };
    ensure!(
        !entries.is_empty(),
        "{}: has no finished run: give --data, to train some",
        shown()
    );
    let text = tables::markdown(&entries);
    write_whole(&out.join("tables.md"), text.as_bytes())?;
    Ok(text)
}
