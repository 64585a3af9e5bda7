//! Exports a trained network of courses to a model file of format 2, and evaluates that file.

use anyhow::ensure;
use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::export::{data, range, validation};
use super::file;
use crate::simulator::Split;
use crate::train::data::courses::{self, Courses};
use crate::train::data::dataset;
use crate::train::judge::metrics::{Evaluation, Judged};
use crate::train::learn::conformal::{ALPHA, Calibration};
use crate::train::learn::course::{Press, Trained};
use crate::train::learn::fit;
use crate::train::net::course::{self, FRAMES};
use crate::train::run::{Description, Run};
use crate::verdict::{
    Card, CheckedCourse, Checks, Conformal, Course, CourseCheck, CourseMoment, Format, Hrn, Shore,
    Verdict,
};

/// Check presses per level (`docs/formats.md`).
const CHECKS_A_LEVEL: usize = 2;

/// The evaluation of a model on whole presses, which `evaluate --json` prints for data of whole
/// presses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CourseEvaluation {
    /// The evaluation of the levels.
    #[serde(flatten)]
    pub levels: Evaluation,
    /// Share of presses whose level is off by more than one.
    pub beyond_neighbour: f64,
    /// The evaluation of the Shore hardness; null for a model or data without it.
    pub shore: Option<ShoreEvaluation>,
    /// The evaluation of the sets of levels; null for a model without them.
    pub sets: Option<SetEvaluation>,
}

/// The evaluation of the Shore hardness.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShoreEvaluation {
    /// Root mean square error, in Shore OO.
    pub rmse: f64,
    /// Root mean square error of each level; null for a level without presses.
    pub rmse_by_level: Vec<Option<f64>>,
    /// Share of presses whose interval contains the true hardness. The model promises 0.9.
    pub coverage: f64,
    /// Mean width of the intervals, in Shore OO.
    pub width: f64,
}

/// The evaluation of the sets of levels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetEvaluation {
    /// Share of presses whose set contains the true level. The model promises 0.9.
    pub coverage: f64,
    /// Share of presses whose set has more than one level. Such verdicts are rejected as ambiguous.
    pub ambiguous: f64,
    /// Accuracy on the presses that are not ambiguous; null if there are none.
    pub accuracy_of_others: Option<f64>,
}

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
) -> anyhow::Result<Option<CourseEvaluation>> {
    let levels = dataset::levels();
    let Calibration {
        temperature,
        widths,
        threshold,
        ..
    } = trained.calibration;
    let mut metrics = json!({ "temperature": temperature });
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
    let probabilities = fit::probabilities(&logits, temperature, device);
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
        validation: validation(&description.data).to_owned(),
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
    let evaluation = (!test.is_empty()).then(|| CourseEvaluation::of(&test, levels.len()));
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation);
        let json = serde_json::to_vec_pretty(evaluation)?;
        run.write("evaluation.json", &json)?;
    }
    run.write("hrn.onnx", &write(&card)?)?;
    Ok(evaluation)
}

/// The verdicts of a model on the labelled presses of a split, after `told` has changed each
/// course. A model of format 1 judges each press's best frame.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a press.
pub fn verdicts(
    hrn: &Hrn,
    courses: &Courses,
    split: Split,
    told: impl Fn(Course) -> Course,
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
            Format::Course { .. } => hrn.judge_course(&told(course_of(courses, place)))?,
        };
        verdicts.push((press, verdict));
    }
    Ok(verdicts)
}

/// The verdicts in the form that the metrics take.
pub fn judged(verdicts: &[(courses::Press, Verdict)]) -> Vec<Judged> {
    let judged = |(press, verdict): &(courses::Press, Verdict)| Judged {
        level: press.level,
        probabilities: verdict.probabilities.clone(),
        object: Some(press.object),
    };
    verdicts.iter().map(judged).collect()
}

impl CourseEvaluation {
    /// Evaluates verdicts on labelled presses; there must be at least one.
    pub fn of(verdicts: &[(courses::Press, Verdict)], levels: usize) -> Self {
        let n = verdicts.len() as f64;
        let far = verdicts
            .iter()
            .filter(|(press, verdict)| press.level.abs_diff(verdict.level) > 1);
        Self {
            levels: Evaluation::of(&judged(verdicts), levels),
            beyond_neighbour: far.count() as f64 / n,
            shore: shore(verdicts, levels),
            sets: sets(verdicts),
        }
    }
}

/// The evaluation of the Shore hardness of verdicts; `None` for a model or presses without it.
pub fn shore(verdicts: &[(courses::Press, Verdict)], levels: usize) -> Option<ShoreEvaluation> {
    let both = |(press, verdict): &(courses::Press, Verdict)| {
        let shore = verdict.shore?;
        press
            .shore
            .is_finite()
            .then_some((press.level, f64::from(press.shore), shore))
    };
    let told: Vec<(u8, f64, Shore)> = verdicts.iter().filter_map(both).collect();
    if told.is_empty() {
        return None;
    }
    let rmse = |of: &dyn Fn(u8) -> bool| {
        let errors: Vec<f64> = told
            .iter()
            .filter(|(level, ..)| of(*level))
            .map(|(_, truth, shore)| (f64::from(shore.value) - truth).powi(2))
            .collect();
        (!errors.is_empty()).then(|| (errors.iter().sum::<f64>() / errors.len() as f64).sqrt())
    };
    let n = told.len() as f64;
    let held = told
        .iter()
        .filter(|(_, truth, shore)| (f64::from(shore.low)..=f64::from(shore.high)).contains(truth));
    Some(ShoreEvaluation {
        rmse: rmse(&|_| true).expect("there are presses"),
        rmse_by_level: (1..=levels as u8)
            .map(|level| rmse(&|of| of == level))
            .collect(),
        coverage: held.count() as f64 / n,
        width: told
            .iter()
            .map(|(.., shore)| f64::from(shore.high - shore.low))
            .sum::<f64>()
            / n,
    })
}

fn sets(verdicts: &[(courses::Press, Verdict)]) -> Option<SetEvaluation> {
    let of = |(press, verdict): &(courses::Press, Verdict)| {
        let set = verdict.levels.clone()?;
        Some((set.contains(&press.level), set.len() > 1))
    };
    let sets: Vec<(bool, bool)> = verdicts.iter().filter_map(of).collect();
    if sets.is_empty() {
        return None;
    }
    let n = sets.len() as f64;
    let share = |count: usize| count as f64 / n;
    let single: Vec<bool> = sets.iter().filter(|set| !set.1).map(|set| set.0).collect();
    let right = single.iter().filter(|&&holds| holds).count();
    Some(SetEvaluation {
        coverage: share(sets.iter().filter(|set| set.0).count()),
        ambiguous: share(sets.len() - single.len()),
        accuracy_of_others: (!single.is_empty()).then(|| right as f64 / single.len() as f64),
    })
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
