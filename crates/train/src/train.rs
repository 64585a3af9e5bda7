//! One training, from data to a model file: read, split once, learn, calibrate, export.

use std::path::PathBuf;

use anyhow::{Context as _, bail, ensure};
use burn::tensor::Device;

use crate::data::findings;
use crate::data::presses::Presses;
use crate::data::split::Parts;
use crate::exit::coded;
use crate::judge::evaluated::Evaluated;
use crate::learn::calibration::Calibration;
use crate::learn::{self, Stage};
use crate::methods::{Stages, last_stage};
use crate::model::export::{self, Learnt};
use crate::progress::ensure_learning;
use crate::recipe::{self, Kind, Recipe};
use crate::run::start::Start;
use crate::run::{Description, Run, disk};
use crate::settings::{self, Profile};
use hardnessd_core::exit::{UNAVAILABLE, USAGE};
use hardnessd_simulator::Split;

/// What to train, on what, and where to.
#[derive(Debug, clap::Args)]
pub struct Train {
    /// What to train
    #[arg(long, value_parser = recipe::parser())]
    method: &'static Recipe,
    /// Data to learn from; several files may be named. All presses of an object must be in one file
    #[arg(long, value_name = "D.npz", required = true, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Directory of the run
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    /// Start from the weights of this course model, not from random ones
    #[arg(long, value_name = "M.onnx")]
    start: Option<PathBuf>,
    /// Seed of everything random
    // TOML, which keeps it, has no larger numbers.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Length of the training
    #[arg(long, default_value = "paper")]
    profile: Profile,
    /// Settings that override the method's; config/hrn-train.toml has every key
    #[arg(long, value_name = "F.toml")]
    config: Option<PathBuf>,
    /// Continue a run that was stopped
    #[arg(long)]
    resume: bool,
    /// Number of labels to use, of whole objects [default: the method's share]
    #[arg(long, value_name = "N")]
    labels: Option<usize>,
    /// Where to compute
    #[arg(long, default_value = "cpu")]
    device: DeviceName,
    /// End when this process ends, the one that started this one
    #[arg(long, hide = true, value_name = "PID")]
    pub parent: Option<i32>,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum DeviceName {
    Cpu,
    /// The first CUDA device; needs a build with `--features cuda`
    Cuda,
}

impl DeviceName {
    fn device(self) -> anyhow::Result<Device> {
        let Self::Cuda = self else {
            return Ok(Device::flex());
        };
        #[cfg(feature = "cuda")]
        if let Some(found) = Device::enumerate(burn::tensor::DeviceType::Cuda)
            .into_iter()
            .next()
        {
            return Ok(found);
        }
        let remedy = match cfg!(feature = "cuda") {
            true => "no CUDA device found: check the device and its driver with nvidia-smi",
            false => "this build has no CUDA: build with --features cuda",
        };
        let text = format!("--device cuda: {remedy}, or use --device cpu");
        Err(coded(UNAVAILABLE, text))
    }
}

/// Trains, and gives the evaluation on the test split, if the data has one. It says what the data are before
/// anything is learnt.
///
/// # Errors
///
/// Fails if the data do not have what the method needs, the directory has another run or cannot be written,
/// or the training diverges.
pub fn train(asked: &Train) -> anyhow::Result<Option<Evaluated>> {
    let (recipe, profile, seed) = (asked.method, asked.profile, asked.seed);
    let given = match &asked.config {
        Some(path) => {
            let text = disk::read_text(path)?;
            settings::parse(&text).with_context(|| path.display().to_string())?
        }
        None => toml::Table::new(),
    };
    let device = asked.device.device()?;
    let start = match &asked.start {
        Some(_) if recipe.learning != Kind::Course => {
            let text = "--start: only the method course starts from a model";
            return Err(coded(USAGE, text));
        }
        Some(path) => Some(Start::read(path, &device)?),
        None => None,
    };
    let presses = Presses::read(&asked.data)?;
    let labels = asked.labels(&presses)?;
    let share = recipe.settings(profile, labels, &given)?.held_out;
    let parts = Parts::of(&presses, labels, share, seed);
    let settings = recipe.settings(profile, parts.train.len(), &given)?;
    check(recipe, &presses, &parts)?;
    let warnings = findings::warnings(&presses, labels)?.into_iter();
    let warnings: String = warnings.map(|text| format!("warning: {text}\n")).collect();
    if !warnings.is_empty() {
        hardnessd_core::stderr_line!("{}", warnings.trim_end());
    }
    let mut data = presses.sources.clone();
    data.extend(start.as_ref().map(|start| start.source.clone()));
    export::check_sources(&data)?;

    let description = Description {
        method: recipe.name.clone(),
        profile,
        seed,
        labels,
        settings,
        data,
    };
    let run = Run::open(&asked.out, &description, asked.resume)?;
    if !warnings.is_empty() {
        run.write("findings.txt", warnings.as_bytes())?;
    }

    let stages = Stages {
        stage: Stage {
            name: &recipe.name,
            presses: &presses,
            parts,
            settings,
            training: settings.training,
            seed,
            device,
        },
        start: start.as_ref(),
        run: Some(&run),
    };
    let learning = &*last_stage(recipe, &stages)?;
    let weights = learn::run(learning, Some(&run))?;
    let stage = learning.stage();
    // Finite weights can still give a logit that is not. One press is enough for this check.
    let first = learn::Question::alone(&stage.parts.train[..1]);
    for logit in learning.judge(&weights, &[first], None).concat() {
        ensure_learning(stage.name, settings.training.epochs, "logit", logit.into())?;
    }
    let calibration = Calibration::of(learning, &weights, &mut stage.stream("calibration"));
    let missing = calibration.missing();
    if let Some(missing) = missing.filter(|_| recipe.learning == Kind::Course) {
        hardnessd_core::stderr_line!("{missing}");
    }
    let learnt = Learnt {
        learning,
        weights: &weights,
        calibration,
    };
    export::finish(&learnt, &run, &description)
}

impl Train {
    /// The number of labels that the run uses: the requested one, or else the method's share.
    fn labels(&self, presses: &Presses) -> anyhow::Result<usize> {
        let labelled = presses.some_labelled(Split::Train)?.len();
        let least = presses.levels().len() * presses.sources.len();
        match self.labels {
            Some(asked) if !(least..=labelled).contains(&asked) => Err(coded(
                USAGE,
                format_args!(
                    "--labels: found {asked}, expected at least {least} (one of each level and file) and at most the \
                     data's {labelled}"
                ),
            )),
            Some(asked) => Ok(asked),
            None => {
                // Hundredths, because 0.15 is not exactly 15 %.
                let percent = (100.0 * self.method.labels).round() as usize;
                Ok((labelled * percent).div_ceil(100).max(least).min(labelled))
            }
        }
    }
}

/// Checks, before anything is written, that the data has what all stages of a method need.
fn check(recipe: &Recipe, presses: &Presses, parts: &Parts) -> anyhow::Result<()> {
    if recipe.learning == Kind::Course && !presses.are_over_time() {
        bail!(
            "{}: has single frames, not whole presses: make it with `simulate --sequences` or `collect \
             --sequences`",
            presses.shown_paths()
        );
    }
    ensure!(
        !recipe.needs_unlabelled() || !parts.unlabelled.is_empty(),
        "no unlabelled training presses are left for {} beside its {} labelled ones and the held-out \
         objects: use fewer with --labels",
        recipe.name,
        parts.train.len()
    );
    for level in presses.levels() {
        let mut levels = presses.of(&parts.train).map(|press| press.level);
        let has_own = levels.any(|own| own == level.level);
        ensure!(
            !recipe.pretrained || has_own,
            "no labelled training presses of level {} for its STGAN: label some, or choose a method \
             without STGANs",
            level.level
        );
    }
    Ok(())
}
