//! Exports a trained network of courses to a model file of format 2, and judges presses with it.

use anyhow::ensure;
use burn::tensor::Device;
use serde_json::json;

use super::evaluated::{Case, Evaluated};
use super::export::{data, metrics, range, validation};
use super::file;
use crate::data::courses::{self, Courses};
use crate::data::dataset;
use crate::learn::conformal::{ALPHA, Calibration};
use crate::learn::course::{Press, Trained};
use crate::learn::temperature;
use crate::net::course::{self, FRAMES};
use crate::run::{Description, Run};
use hardnessd_core::verdict::{
    Card, CheckedCourse, Checks, Conformal, Course, CourseCheck, CourseMoment, Format, Hrn, Shore,
    Verdict,
};
use hardnessd_simulator::Split;

/// Check presses per level (`docs/formats.md`).
const CHECKS_A_LEVEL: usize = 2;

/// Writes the model and its evaluation on the test split to the run's directory. `train` are the
/// indices of the training presses.
///
/// # Errors
///
/// Fails if the daemon's loader refuses the file, or the directory cannot be written.
pub fn finish(
    run: &Run,
    description: &Description,
    courses: &Courses,
    (presses, train): (&[Press], &[usize]),
    trained: &Trained,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels_of(&description.data);
    let Calibration {
        temperature,
        widths,
        threshold,
        ..
    } = trained.calibration;
    let mut metrics = metrics(description, temperature, trained.standard.force_factor);
    if let Some(missing) = trained.calibration.missing() {
        metrics["not_promised"] = json!(missing);
    }
    let checked: Vec<usize> = check_presses(courses, train);
    let of_checked: Vec<Press> = checked
        .iter()
        .map(|&place| presses[place].clone())
        .collect();
    let judged = trained.judge(&of_checked, levels.len(), device);
    let logits: Vec<Vec<f32>> = judged.iter().map(|(logits, _)| logits.clone()).collect();
    let probabilities = temperature::probabilities(&logits, temperature, device);
    let check = |((&place, probabilities), (_, shore)): ((&usize, Vec<f32>), &(_, [f32; 3]))| {
        CheckedCourse {
            course: course_of(courses, place),
            probabilities,
            shore: Shore::from(*shore),
        }
    };
    let presses_checked = checked.iter().zip(probabilities).zip(&judged).map(check);
    let checks = Checks::Courses(CourseCheck {
        presses: presses_checked.collect(),
    });
    let best_frame = |&press: &usize| courses.frame(courses.presses[press].best as usize);
    let learnt = train.iter().map(|&press| &presses[press]);
    let of_presses = description.settings.reports.ranges(learnt);
    let mut card = Card {
        format: "2".to_owned(),
        levels: levels.clone(),
        pitch_mm: dataset::pitch_mm(&description.data) as f32,
        method: description.method.clone(),
        data: data(&description.data)?,
        metrics,
        validation: validation(&courses.validated(&description.data)).to_owned(),
        range: range(train.iter().map(best_frame)).with_presses(of_presses),
        conformal: (threshold > 0.0).then_some(Conformal {
            alpha: ALPHA,
            threshold,
        }),
    };
    let write = |card: &Card| {
        let (graph, raw_logits, shore) =
            course::graph(&trained.weights, &trained.standard, levels.len(), widths);
        let outputs = file::Outputs {
            raw_logits,
            temperature,
            shore: Some(shore),
        };
        file::write(graph, &outputs, card, &checks)
    };
    let hrn = Hrn::load(&write(&card)?)?;
    let test = verdicts(&hrn, courses, Split::Test, |course| course)?;
    let evaluation = (!test.is_empty()).then(|| Evaluated::of(&cases(&test), levels.len()));
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation);
        let json = serde_json::to_vec_pretty(evaluation)?;
        run.write("evaluation.json", &json)?;
    }
    run.write("hrn.onnx", &write(&card)?)?;
    Ok(evaluation)
}

/// The verdicts of a model on the labelled presses of a split, after `change` has changed each
/// course. A model of format 1 judges each press's best frame.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a press.
pub fn verdicts(
    hrn: &Hrn,
    courses: &Courses,
    split: Split,
    change: impl Fn(Course) -> Course,
) -> anyhow::Result<Vec<(courses::Press, Verdict)>> {
    let mut verdicts = Vec::new();
    for place in courses.labelled(split) {
        let press = courses.presses[place];
        ensure!(
            usize::from(press.level) <= hrn.card().levels.len(),
            "the model has {} levels, and the data has a press of level {}",
            hrn.card().levels.len(),
            press.level
        );
        let verdict = match hrn.format() {
            Format::Frame => hrn.judge(&courses.frame(press.best as usize))?,
            Format::Course { .. } => hrn.judge_course(&change(course_of(courses, place)))?,
        };
        verdicts.push((press, verdict));
    }
    Ok(verdicts)
}

/// Verdicts on presses in the form that is evaluated.
pub fn cases(verdicts: &[(courses::Press, Verdict)]) -> Vec<Case> {
    let case = |(press, verdict): &(courses::Press, Verdict)| Case {
        level: press.level,
        shore: Some(press.shore).filter(|shore| shore.is_finite()),
        object: Some(press.object),
        verdict: verdict.clone(),
    };
    verdicts.iter().map(case).collect()
}

/// The course of a press as the daemon would give it to a model.
pub fn course_of(courses: &Courses, press: usize) -> Course {
    let rows = courses
        .rows(press)
        .filter(|&row| courses.time_s[row] >= 0.0);
    let moment = |row: usize| CourseMoment {
        time_s: courses.time_s[row],
        approach_mm: (courses.known[row] == 1).then_some(courses.approach_mm[row]),
        frame: courses.frame(row),
    };
    Course {
        moments: rows.take(FRAMES).map(moment).collect(),
        arm_n_per_mm: courses.presses[press].arm_n_per_mm,
    }
}

/// Two presses of each level: those one third and two thirds through its presses.
fn check_presses(courses: &Courses, train: &[usize]) -> Vec<usize> {
    let mut checked = Vec::new();
    for level in dataset::levels() {
        let of_level = |press: &usize| courses.presses[*press].level == level.level;
        let presses: Vec<usize> = train.iter().copied().filter(of_level).collect();
        // A level without presses is checked on presses of other levels.
        let presses = if presses.is_empty() {
            train.to_vec()
        } else {
            presses
        };
        for part in 1..=CHECKS_A_LEVEL {
            checked.push(presses[presses.len() * part / (CHECKS_A_LEVEL + 1)]);
        }
    }
    checked
}
