//! Evaluates the verdicts of a model of format 2 before the end of a press.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::data::courses::{Courses, Press};
use crate::judge::metrics::{self, Judged};
use crate::model::course as model;
use hardnessd_core::pipeline::{FIRST_LOOK, look_after};
use hardnessd_core::press;
use hardnessd_core::verdict::{Course, CourseMoment, Hrn, Verdict};

/// The times at which the press so far is judged, in seconds since its begin.
const SECONDS: [f32; 7] = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4];
/// The forces at which the press so far is judged, in newtons.
const NEWTONS: [f64; 6] = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0];
/// The confidence of an early verdict: the default of `[model] early_confidence`.
const CONFIDENCE: f32 = 0.95;

/// The evaluation of verdicts before the end of presses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SoFar {
    /// The evaluation at several times after the begin.
    pub after: Vec<After>,
    /// The evaluation at several forces.
    pub at_force: Vec<AtForce>,
    /// Share of presses with an early verdict before their last frame.
    pub early: f64,
    /// Share of the early verdicts whose level is right; null without early verdicts.
    pub early_accuracy: Option<f64>,
    /// Share of the early verdicts whose final level differs; null without early verdicts.
    pub changed: Option<f64>,
    /// Median time from an early verdict to the last frame, in seconds; null without early
    /// verdicts.
    pub ahead_s: Option<f64>,
    /// Median time from an early verdict to the frame with which the contact has settled, in seconds.
    /// Negative if the contact settles first. Null if no press with an early verdict settles.
    pub before_settled_s: Option<f64>,
}

/// The evaluation of verdicts at one time after the begin, on the frames up to then. For a press
/// that had ended, the final verdict counts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct After {
    /// Seconds since the begin of the press.
    pub seconds: f32,
    /// Share of presses that had not ended.
    pub going_on: f64,
    /// Share of presses whose level is right.
    pub accuracy: f64,
    /// Expected calibration error.
    pub ece: f64,
}

/// The evaluation of verdicts on the frames up to the first one of at least some force. Only the
/// presses that reach this force count.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AtForce {
    /// The force in newtons.
    pub newtons: f64,
    /// Share of presses that reach the force.
    pub reached: f64,
    /// Share of these presses whose level is right; null without such presses.
    pub accuracy: Option<f64>,
    /// Expected calibration error; null without such presses.
    pub ece: Option<f64>,
}

/// The first `frames` frames of a press.
fn until(course: &Course, frames: usize) -> Course {
    Course {
        moments: course.moments[..frames].to_vec(),
        arm_n_per_mm: course.arm_n_per_mm,
    }
}

/// Judges presses before their end. `finals` are the final verdicts on the same presses.
///
/// An early verdict comes as the daemon gives it: the press is judged at the same numbers of frames,
/// and a verdict that is ambiguous does not count. Here the force may be any. The frames are those of
/// the data, which has at most 48 of each press, so a daemon judges a longer press more often than this.
///
/// # Errors
///
/// Fails if the model fails to judge a press.
pub(super) fn of(
    hrn: &Hrn,
    courses: &Courses,
    places: impl Iterator<Item = usize>,
    finals: &[(Press, Verdict)],
) -> anyhow::Result<SoFar> {
    let mut at: Vec<(usize, Vec<Judged>)> = vec![(0, Vec::new()); SECONDS.len()];
    let mut at_force: Vec<Vec<Judged>> = vec![Vec::new(); NEWTONS.len()];
    let (mut early, mut right, mut changed) = (0_usize, 0, 0);
    let (mut ahead, mut before_settled) = (Vec::new(), Vec::new());
    for (place, (press, last)) in places.zip(finals) {
        let course = model::course_of(courses, place);
        let frames = course.moments.len();
        let mut next_look = Some(FIRST_LOOK);
        // The probabilities after each number of frames; those at the end are known.
        let mut of_frames = Vec::with_capacity(frames);
        for count in 1..frames {
            let verdict = hrn.judge_course(&until(&course, count))?;
            let is_ambiguous = verdict.levels.as_ref().is_some_and(|set| set.len() > 1);
            let is_look = next_look == Some(count as u64);
            if is_look {
                next_look = Some(look_after(count as u64));
            }
            if is_look && verdict.confidence >= CONFIDENCE && !is_ambiguous {
                // A press has one early verdict at most.
                next_look = None;
                early += 1;
                right += usize::from(verdict.level == press.level);
                changed += usize::from(verdict.level != last.level);
                let after = |place: usize| {
                    f64::from(course.moments[place].time_s - course.moments[count - 1].time_s)
                };
                ahead.push(after(frames - 1));
                before_settled.extend(settled(&course).map(after));
            }
            of_frames.push(verdict.probabilities);
        }
        of_frames.push(last.probabilities.clone());
        let judged_after = |frames: usize| Judged {
            level: press.level,
            probabilities: of_frames[frames - 1].clone(),
            object: Some(press.object),
        };
        for (seconds, (going_on, judged)) in SECONDS.into_iter().zip(&mut at) {
            let there = course
                .moments
                .iter()
                .filter(|moment| moment.time_s <= seconds);
            let there = there.count().max(1);
            *going_on += usize::from(there < frames);
            judged.push(judged_after(there));
        }
        let forces: Vec<f64> = course.moments.iter().map(|m| m.frame.force_n()).collect();
        for (newtons, judged) in NEWTONS.iter().zip(&mut at_force) {
            let reached = forces.iter().position(|force_n| force_n >= newtons);
            judged.extend(reached.map(|place| judged_after(place + 1)));
        }
    }
    let (n, levels) = (finals.len() as f64, hrn.card().levels.len());
    let after = |(seconds, (going_on, judged)): (f32, (usize, Vec<Judged>))| After {
        seconds,
        going_on: going_on as f64 / n,
        accuracy: metrics::Evaluation::of(&judged, levels).accuracy,
        ece: metrics::calibration_error(&judged),
    };
    let with_force = |(newtons, judged): (f64, Vec<Judged>)| AtForce {
        newtons,
        reached: judged.len() as f64 / n,
        accuracy: (!judged.is_empty()).then(|| metrics::Evaluation::of(&judged, levels).accuracy),
        ece: (!judged.is_empty()).then(|| metrics::calibration_error(&judged)),
    };
    let of_early = |count: usize| (early > 0).then(|| count as f64 / early as f64);
    Ok(SoFar {
        after: SECONDS.into_iter().zip(at).map(after).collect(),
        at_force: NEWTONS.into_iter().zip(at_force).map(with_force).collect(),
        early: early as f64 / n,
        early_accuracy: of_early(right),
        changed: of_early(changed),
        ahead_s: median(ahead),
        before_settled_s: median(before_settled),
    })
}

/// The place of the frame with which the contact has settled, by the daemon's default settings.
fn settled(course: &Course) -> Option<usize> {
    let time =
        |moment: &CourseMoment| Duration::try_from_secs_f32(moment.time_s).unwrap_or_default();
    let frames = course
        .moments
        .iter()
        .map(|moment| (time(moment), &moment.frame.newtons[..]));
    press::first_settled(frames, &press::Thresholds::default())
}

/// The upper median.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The tables of a model's verdicts on the presses of a set before their end: by time, and by force.
pub(super) fn tables(model: &str, set: &str, so_far: &SoFar) -> [Table; 2] {
    let percent = |share: f64| format!("{:.1}", 100.0 * share);
    let or_dash = |share: Option<f64>| share.map_or("-".to_owned(), percent);
    let seconds = |time: Option<f64>| time.map_or("-".to_owned(), |s| format!("{s:.1}"));
    let early = format!(
        "An early verdict (confidence {CONFIDENCE}) came in {} % of the presses, in the median {} s before the \
         last frame and {} s before the contact had settled. {} % of them were right; in {} % the final verdict \
         named another level.",
        percent(so_far.early),
        seconds(so_far.ahead_s),
        seconds(so_far.before_settled_s),
        or_dash(so_far.early_accuracy),
        or_dash(so_far.changed),
    );
    let after = |after: &After| {
        vec![
            format!("{} s", after.seconds),
            percent(after.going_on),
            percent(after.accuracy),
            percent(after.ece),
        ]
    };
    let at_force = |at: &AtForce| {
        vec![
            format!("{} N", at.newtons),
            percent(at.reached),
            or_dash(at.accuracy),
            or_dash(at.ece),
        ]
    };
    let table = |title: &str, note: String, (first, second): (&str, &str), rows| Table {
        title: format!("{model} on {set}, {title}"),
        note,
        head: [first, second, "accuracy, %", "calibration error, %"]
            .map(str::to_owned)
            .to_vec(),
        rows,
    };
    [
        table(
            "before the end",
            early,
            ("after", "still pressed, %"),
            so_far.after.iter().map(after).collect(),
        ),
        table(
            "by force",
            "The press is judged at the first frame of at least this force. Only presses that reach it count."
                .to_owned(),
            ("from", "reached, %"),
            so_far.at_force.iter().map(at_force).collect(),
        ),
    ]
}
