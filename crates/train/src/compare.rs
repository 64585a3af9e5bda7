//! Trains methods under seeds and numbers of labels, and writes the paper's Tables 2 and 3.
//!
//! In: data. Out, in a directory: `data/` with the test sets, `runs/` with a run's directory for each method,
//! number of labels and seed, `logs/`, `results.json`, `objects.csv` and `tables.md`. This process trains
//! nothing: each run is a call of `hrn-train train`, so that runs can be stopped, resumed and spread over
//! machines. A run that has its model is not done again.

mod sets;
pub mod tables;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, ensure};
use clap::ValueEnum as _;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::data::presses::Presses;
use crate::data::source::papers_levels;
use crate::judge::evaluated::Evaluated;
use crate::model::verdicts::{self, Given};
use crate::recipe::{self, Kind, Recipe};
use crate::run::Run;
use crate::run::disk::{load, lock, read_if_there, refuse_foreign, write_whole};
use crate::settings::Profile;
use hardnessd_core::verdict::Level;
use hardnessd_simulator::Split;
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
struct Planned {
    name: String,
    /// The words after `hrn-train` that make or continue it.
    words: Vec<String>,
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
        let labels = self.labels.iter().copied().map(Some);
        let labels: Vec<Option<usize>> = [None].into_iter().chain(labels).collect();
        let mut runs = Vec::new();
        for recipe in methods {
            for &labels in &labels {
                runs.extend((1..=self.seeds).map(|seed| self.run(&recipe.name, labels, seed)));
            }
        }
        runs
    }

    fn run(&self, method: &str, labels: Option<usize>, seed: u64) -> Planned {
        let part = labels.map_or_else(String::new, |labels| format!("-{labels}"));
        let name = format!("{method}{part}-{seed}");
        let path = |path: &Path| path.display().to_string();
        let mut words = ["train", "--resume", "--method", method, "--data"]
            .map(str::to_owned)
            .to_vec();
        words.extend(self.data.iter().map(|data| path(data)));
        let mut option = |name: &str, value: String| words.extend([name.to_owned(), value]);
        option("--out", path(&self.directory(&name)));
        option("--seed", seed.to_string());
        let profile = self.profile.to_possible_value();
        let profile = profile.expect("no profile is hidden");
        option("--profile", profile.get_name().to_owned());
        if let Some(labels) = labels {
            option("--labels", labels.to_string());
        }
        Planned { name, words }
    }

    /// Refuses a run of the directory that learnt from other data, or for another time.
    fn check_before(&self, name: &str, presses: &Presses) -> anyhow::Result<()> {
        let directory = self.directory(name);
        let Some(before) = Run::description_at(&directory)? else {
            return Ok(());
        };
        let [found, expected] =
            [&before.data, &presses.sources].map(|of| of.iter().map(|one| &one.sha256));
        ensure!(
            before.profile == self.profile && found.eq(expected),
            "{}: this run has another --data or --profile: give the same ones, or choose another --out",
            directory.display()
        );
        Ok(())
    }

    fn directory(&self, name: &str) -> PathBuf {
        self.out.join("runs").join(name)
    }
}

/// Does the runs that are not done, judges all runs of the directory on all sets, and writes results and tables.
/// Without data, only writes the tables of the results that are there. Returns the tables, or the command lines
/// of the runs if only these are asked for.
///
/// # Errors
///
/// Fails if the data cannot be read or have other levels than the paper's, the directory cannot be written or is in use by another process, or at the
/// end if a run failed.
pub fn compare(plan: &Plan) -> anyhow::Result<String> {
    if plan.data.is_empty() {
        return write_tables(&plan.out);
    }
    refuse_foreign(&plan.out, "results.json", &["objects.csv", "tables.md"])?;
    let presses = Presses::read(&plan.data)?;
    let names = |levels: Vec<Level>| -> Vec<String> {
        levels.into_iter().map(|level| level.label).collect()
    };
    let (found, expected) = (names(presses.levels()), names(papers_levels()));
    ensure!(
        found == expected,
        "{}: found the levels {}, expected {}, as the fresh objects have",
        presses.shown_paths(),
        found.join(", "),
        expected.join(", ")
    );
    let mut open = plan.runs(presses.are_over_time());
    for run in &open {
        plan.check_before(&run.name, &presses)?;
    }
    open.retain(|run| !plan.directory(&run.name).join("hrn.onnx").exists());
    if plan.plan {
        let line = |run: &Planned| {
            let words = shlex::try_join(run.words.iter().map(String::as_str))?;
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
        runs.map(|run| do_run(plan, run))
            .collect::<anyhow::Result<_>>()
    })?;
    write_results(&plan.out, &sets)?;
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
fn do_run(plan: &Plan, Planned { name, words }: &Planned) -> anyhow::Result<Option<String>> {
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

/// What the model of a run reached.
struct Judged {
    /// The entry of the run in `results.json`.
    entry: Value,
    /// Its lines in `objects.csv`.
    objects: String,
}

/// Judges a run that is done on every set.
fn judge(run: &Path, sets: &[TestSet]) -> anyhow::Result<Judged> {
    let description = Run::description_at(run)?;
    let description = description.with_context(|| format!("{}: no run", run.display()))?;
    let (hrn, _) = load(&run.join("hrn.onnx"))?;
    let (steps, seconds) = Run::cost(run)?;
    let name = run.file_name().unwrap_or_default().to_string_lossy();
    let mut entry = json!({
        "method": description.method,
        "seed": description.seed,
        "profile": description.profile,
        "labels": description.labels,
        "steps": steps,
        "seconds": seconds,
        "run": name,
        sets::PAPER_SPLIT: null,
    });
    let mut objects = String::new();
    for (set, presses) in sets {
        let places: Vec<usize> = presses.labelled(Split::Test).collect();
        let cases = verdicts::of(&hrn, presses, &places, Given::USUAL)?;
        entry[set] = serde_json::to_value(Evaluated::of(&cases, &hrn.card().levels))?;
        let mut counts = BTreeMap::<(u8, u32), (u64, u64)>::new();
        for case in cases {
            let Some(object) = case.object else {
                continue;
            };
            let (right, all) = counts.entry((case.level, object)).or_default();
            *right += u64::from(case.is_right());
            *all += 1;
        }
        for ((level, object), (right, all)) in counts {
            let geometry = match *set {
                "matched" => (object % FRESH_OBJECTS).to_string(),
                _ => String::new(),
            };
            objects += &format!("{name},{set},{level},{object},{geometry},{right},{all}\n");
        }
    }
    Ok(Judged { entry, objects })
}

/// Writes `results.json` and `objects.csv`, with every run of the directory that is done. `geometry` is there
/// where the objects of one number are pressed alike in all materials.
fn write_results(out: &Path, sets: &[TestSet]) -> anyhow::Result<()> {
    let runs = out.join("runs");
    let of_runs = fs::read_dir(&runs).with_context(|| runs.display().to_string())?;
    let of_runs = of_runs.map(|run| Ok::<_, anyhow::Error>(run?.path()));
    let mut paths: Vec<PathBuf> = of_runs.collect::<Result<_, _>>()?;
    paths.retain(|run| run.join("hrn.onnx").exists());
    let all = paths.par_iter().map(|run| judge(run, sets));
    let mut all: Vec<Judged> = all.collect::<anyhow::Result<_>>()?;
    all.sort_by_key(|Judged { entry, .. }| {
        let method = recipe::all()
            .iter()
            .position(|recipe| entry["method"] == recipe.name);
        let [labels, seed] = ["labels", "seed"].map(|key| entry[key].as_u64());
        (method, Reverse(labels), seed)
    });
    let head = "run,set,level,object,geometry,right,samples\n";
    let objects = all.iter().map(|judged| judged.objects.as_str());
    let csv: String = [head].into_iter().chain(objects).collect();
    let entries: Vec<&Value> = all.iter().map(|judged| &judged.entry).collect();
    let json = serde_json::to_vec_pretty(&entries)?;
    write_whole(&out.join("results.json"), &json)?;
    write_whole(&out.join("objects.csv"), csv.as_bytes())
}

/// Writes `tables.md` from `results.json`, and returns it.
fn write_tables(out: &Path) -> anyhow::Result<String> {
    let path = out.join("results.json");
    let shown = || path.display().to_string();
    let bytes = read_if_there(&path)?.unwrap_or(b"[]".to_vec());
    let entries: Vec<tables::Entry> = serde_json::from_slice(&bytes).with_context(shown)?;
    ensure!(
        !entries.is_empty(),
        "{}: has no finished run: give --data, to train some",
        shown()
    );
    let text = tables::markdown(&entries);
    write_whole(&out.join("tables.md"), text.as_bytes())?;
    Ok(text)
}
