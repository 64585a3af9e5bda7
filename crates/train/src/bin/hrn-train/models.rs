//! The commands on a model file: `evaluate`, `export`, `inspect` and `check-model`.

use std::path::Path;

use hardnessd_core::trial;
use hardnessd_core::verdict::{MAX_FILE_BYTES, Model};
use hardnessd_core::{exit, wording};
use hrn_train::data::findings;
use hrn_train::data::presses::{Presses, read_one};
use hrn_train::exit::coded;
use hrn_train::judge::evaluated::{Case, Difference, Evaluated};
use hrn_train::model::verdicts;
use hrn_train::run::disk::{check_new, load, read, write_new};

use super::account;
use super::arguments::Evaluate;

pub(super) fn evaluate(arguments: &Evaluate) -> anyhow::Result<String> {
    let models = arguments.model.iter().map(|path| Ok(load(path)?.0));
    let models: Vec<Model> = models.collect::<anyhow::Result<_>>()?;
    anyhow::ensure!(
        models.len() <= 2 && (models.len() == 1 || arguments.verdicts.is_none()),
        "--model: found {}, expected one, or two without --verdicts",
        models.len()
    );
    if let Some(path) = &arguments.verdicts {
        check_new(path)?;
    }
    let presses = read_one(&arguments.data)?;
    if let Some(text) = findings::beyond_contacts(&presses) {
        hardnessd_core::stderr_line!("warning: {}: {text}", arguments.data.display());
    }
    let judged = models.iter().map(|hrn| judge(arguments, &presses, hrn));
    let judged: Vec<Vec<Case>> = judged.collect::<anyhow::Result<_>>()?;
    let evaluated = |(hrn, cases): (&Model, &Vec<Case>)| Evaluated::of(cases, &hrn.card().levels);
    let evaluations: Vec<Evaluated> = models.iter().zip(&judged).map(evaluated).collect();
    if let Some(path) = &arguments.verdicts {
        write_new(path, account::csv(&judged[0]).as_bytes())?;
    }
    let [first, second] = &judged[..] else {
        return Ok(match arguments.json {
            true => wording::json_escaped(&serde_json::to_string(&evaluations[0])?) + "\n",
            false => account::of_evaluated(&evaluations[0]),
        });
    };
    let presses = |cases: &[Case]| cases.iter().map(|case| case.press).collect::<Vec<_>>();
    anyhow::ensure!(
        presses(first) == presses(second) && models[0].card().levels == models[1].card().levels,
        "the two models have other levels, or judge other presses: they cannot be compared"
    );
    let difference = Difference::of(first, second);
    if arguments.json {
        let both = serde_json::json!({"models": evaluations, "difference": difference});
        return Ok(wording::json_escaped(&both.to_string()) + "\n");
    }
    let mut text = String::new();
    for (path, of) in arguments.model.iter().zip(&evaluations) {
        text += &format!("{}\n{}\n", path.display(), account::of_evaluated(of));
    }
    Ok(text + &account::of_difference(&difference))
}

/// A model's verdicts on the presses that the arguments choose.
fn judge(arguments: &Evaluate, presses: &Presses, hrn: &Model) -> anyhow::Result<Vec<Case>> {
    warn_of_pitch(&arguments.data, presses, hrn);
    anyhow::ensure!(
        hrn.card().method != "course" || presses.are_over_time(),
        "{}: has single frames, and the model judges whole presses: make data with `simulate --sequences` \
         or `collect --sequences`",
        arguments.data.display()
    );
    let places = presses.some_labelled(arguments.split)?;
    warn_of_force(&arguments.data, presses, &places, hrn);
    let cases = verdicts::of(hrn, presses, &places, arguments.given)?;
    anyhow::ensure!(
        !cases.is_empty(),
        "{}: no press is left to judge: give fewer --labelled",
        arguments.data.display()
    );
    Ok(cases)
}

/// Prints a warning if most presses have forces that the model was not trained with.
fn warn_of_force(data: &Path, presses: &Presses, places: &[usize], hrn: &Model) {
    let [least_n, most_n] = hrn.card().range.force_n;
    let is_outside = |&&place: &&usize| {
        let newtons = presses.force_n(place);
        newtons < 0.5 * least_n || newtons > 2.0 * most_n
    };
    let outside = places.iter().filter(is_outside).count();
    if 2 * outside > places.len() {
        hardnessd_core::stderr_line!(
            "warning: {}: {outside} of {} presses are far from the {least_n} to {most_n} N of the model's training: \
             is the unit right?",
            data.display(),
            places.len()
        );
    }
}

/// Prints a warning if the model takes the frames of its own array as they are, and the data are of another pitch.
/// Other models have them resampled, as the daemon does.
fn warn_of_pitch(data: &Path, presses: &Presses, hrn: &Model) {
    let Some(of_data) = presses.grid().filter(|_| hrn.card().grid.is_some()) else {
        return;
    };
    let (of_data, of_model) = (of_data.pitch_mm as f32, hrn.card().pitch_mm);
    if of_model != of_data {
        hardnessd_core::stderr_line!(
            "warning: {}: taxel pitch: found {of_data} mm, expected {of_model} mm, that of the model",
            data.display()
        );
    }
}

pub(super) fn export_run(run: &Path, out: &Path) -> anyhow::Result<String> {
    let (hrn, bytes) = load(&run.join("hrn.onnx"))?;
    write_new(out, &bytes)?;
    Ok(format!("{}: sha256 {}\n", out.display(), hrn.sha256()))
}

/// Checks a model file. The time limit for a verdict follows from the frame rate.
pub(super) fn check_model(path: &Path, frame_rate_hz: f64) -> anyhow::Result<String> {
    let bytes = read(path, MAX_FILE_BYTES)?;
    let shown = path.display();
    // Try to run it as the daemon does, with its memory and time.
    let most = trial::verdict_most(frame_rate_hz);
    match trial::load(&bytes, Some(most)) {
        Ok(_) => Ok(format!(
            "{shown}: a model that hardnessd loads, for sensors of up to {frame_rate_hz} frames/s\n"
        )),
        Err(problem) => Err(coded(
            exit::CONFIG,
            format_args!(
                "{shown}: {}; `python3 -m hardnessd.adopt IN.onnx --out M.onnx` mends names, shapes and metadata of \
                 a model of one frame; docs/formats.md has the format",
                wording::line(&problem)
            ),
        )),
    }
}
