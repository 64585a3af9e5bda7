//! The commands on a model file: `evaluate`, `export`, `inspect`, `check-model` and `adopt`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use hardnessd_core::trial;
use hardnessd_core::verdict::{Format as ModelFormat, Hrn};
use hardnessd_core::{exit, wording};
use hrn_train::data::courses::{self, Courses};
use hrn_train::data::dataset::{self, Dataset};
use hrn_train::model::adopt::{self, Stated};
use hrn_train::model::course::{self, Given};
use hrn_train::model::evaluated::{Case, Evaluated};
use hrn_train::model::export;
use hrn_train::model::review::{self, Format, Review};

use super::account;
use super::arguments::{Adopt, Evaluate};
use super::failure::{NoRun, exit_code};
use super::files::{check_new, load, load_with_bytes, read, write};

pub(super) fn evaluate(arguments: &Evaluate) -> anyhow::Result<String> {
    let hrn = load(&arguments.model)?;
    let outputs = [&arguments.verdicts, &arguments.features];
    let outputs = outputs.into_iter().flatten();
    outputs.map(PathBuf::as_path).try_for_each(check_new)?;
    if Courses::is_at(&arguments.data)? {
        return evaluate_courses(arguments, &hrn);
    }
    anyhow::ensure!(
        hrn.format() == ModelFormat::Frame,
        "{}: found single frames, expected presses over time, which the model judges (`--sequences`)",
        arguments.data.display()
    );
    let dataset = Dataset::read(&arguments.data)?;
    warn_of_pitch(&arguments.data, dataset.pitch_mm(), &hrn);
    dataset.warn_of_object_in_both_splits();
    let indices = dataset.labelled(arguments.split)?;
    evaluation_of(arguments, &hrn, &export::cases(&hrn, &dataset, &indices)?)
}

/// Writes the verdicts if that is asked for. Returns the evaluation as text.
fn evaluation_of(arguments: &Evaluate, hrn: &Hrn, cases: &[Case]) -> anyhow::Result<String> {
    if let Some(path) = &arguments.verdicts {
        write(path, account::csv(cases).as_bytes())?;
    }
    let evaluation = Evaluated::of(cases, hrn.card().levels.len());
    Ok(if arguments.json {
        serde_json::to_string(&evaluation)? + "\n"
    } else {
        account::of_evaluated(&evaluation)
    })
}

/// Prints a warning if the data are of a sensor with another pitch than the model's.
fn warn_of_pitch(data: &Path, pitch_mm: f64, hrn: &Hrn) {
    let (of_model, of_data) = (hrn.card().pitch_mm, pitch_mm as f32);
    if of_model != of_data {
        hardnessd_core::stderr_line!(
            "warning: {}: taxel pitch: found {of_data} mm, expected {of_model} mm, that of the model",
            data.display()
        );
    }
}

fn evaluate_courses(arguments: &Evaluate, hrn: &Hrn) -> anyhow::Result<String> {
    let (courses, sources) = Courses::read_all(std::slice::from_ref(&arguments.data))?;
    warn_of_pitch(&arguments.data, dataset::pitch_mm(&sources), hrn);
    let given = Given {
        rigid: arguments.rigid,
        labelled: arguments.labelled,
    };
    let verdicts = course::verdicts(hrn, &courses, arguments.split, given, |course| course)?;
    anyhow::ensure!(
        !verdicts.is_empty(),
        "{}: no press of this split has a level: choose the other --split, or other data",
        arguments.data.display()
    );
    if let Some(path) = &arguments.features {
        write(path, account::features_csv(&courses).as_bytes())?;
    }
    evaluation_of(arguments, hrn, &course::cases(&verdicts))
}

pub(super) fn export_run(run: &Path, out: &Path) -> anyhow::Result<String> {
    let model = run.join("hrn.onnx");
    if run.is_dir() && !model.try_exists().unwrap_or(true) {
        let hint = if run.join("settings.toml").exists() {
            "it was stopped: `hrn-train train --resume` with its options finishes it"
        } else {
            "it has no hrn.onnx"
        };
        return Err(NoRun(run.to_owned(), hint).into());
    }
    let (hrn, bytes) = load_with_bytes(&model)?;
    write(out, &bytes)?;
    Ok(format!("{}: sha256 {}\n", out.display(), hrn.sha256()))
}

pub(super) fn inspect(path: &Path) -> anyhow::Result<String> {
    Ok(account::of_model(path, &load(path)?))
}

/// The frame rate, in frames/s, from which the time limit for a verdict follows.
const SLOWEST_HZ: f64 = 5.0;

/// Checks a model file. The lines of the check are the output of the command, so they go to stdout
/// even if the model does not pass.
pub(super) fn check_model(path: &Path) -> ExitCode {
    let checked = read(path).map_err(anyhow::Error::from).and_then(|bytes| {
        let Review { format, findings } = review::review(&bytes);
        let mut lines = format!("{}: {}\n", path.display(), format.wanted());
        for finding in &findings {
            lines += &format!("{finding}\n");
        }
        let mut passes = findings.iter().all(|finding| finding.problem.is_none());
        if passes {
            // Try the memory and time of a verdict, as the daemon does.
            let most = trial::verdict_most(SLOWEST_HZ);
            match trial::load(&bytes, Some(most)) {
                Ok(_) => lines += "ok       memory and time of a verdict\n",
                Err(error) => {
                    passes = false;
                    lines += &format!("missing  memory and time of a verdict: {error}\n");
                }
            }
        } else if findings.iter().all(|f| f.problem.is_none() || f.is_mended) {
            lines += &format!(
                "`hrn-train adopt {} --data D.npz --out H.onnx` adds what is missing\n",
                path.display()
            );
        } else if format != Format::Frame {
            lines += "`hrn-train adopt` takes models of one frame only: add what is missing yourself \
                      (docs/formats.md)\n";
        }
        super::print(&lines)?;
        Ok(passes)
    });
    match checked {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(exit::CONFIG),
        Err(error) => {
            hardnessd_core::stderr_line!("hrn-train: {}", wording::line(error.as_ref()));
            ExitCode::from(exit_code(&error))
        }
    }
}

pub(super) fn adopt_model(arguments: &Adopt) -> anyhow::Result<String> {
    let bytes = read(&arguments.model)?;
    check_new(&arguments.out)?;
    let dataset = courses::single_frames(&arguments.data)?;
    let name = arguments.model.file_name().unwrap_or_default();
    let stated = Stated {
        method: arguments
            .method
            .clone()
            .unwrap_or_else(|| format!("adopted from {}", name.display())),
        validation: arguments.validation.clone(),
    };
    let adopted = adopt::adopt(&bytes, &dataset, &stated);
    let (model, done, evaluation) =
        adopted.with_context(|| arguments.model.display().to_string())?;
    let hrn = trial::load(&model, None).with_context(|| arguments.model.display().to_string())?;
    write(&arguments.out, &model)?;
    let mut account = String::new();
    for change in done {
        account += &format!("changed  {change}\n");
    }
    account += &format!("{}: sha256 {}\n", arguments.out.display(), hrn.sha256());
    if let Some(evaluation) = evaluation {
        account += &account::of_evaluated(&evaluation);
    }
    Ok(account)
}
