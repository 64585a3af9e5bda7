//! Compares models of whole presses, models of one frame and simpler controls on the same presses
//! (`hrn-train compare --course`).
//!
//! In: presses to fit the controls on, sets of test presses, model files. Out, in a directory:
//! `course.json`, `course.md` and `course.html`, with the accuracy and its interval, the difference
//! from the first model on the same presses, and the verdicts of a model of format 2 before the end
//! of a press.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use super::course_results::{self, CourseRow, OnSet};
use super::hertz;
use super::report::{self, Curve};
use super::table::Table;
use super::{sets, so_far};
use crate::data::courses::Courses;
use crate::data::{dataset, simulated};
use crate::judge::baseline::Baseline;
use crate::judge::metrics::{self, Clusters, Evaluation, Judged};
use crate::learn::course::{self, Press};
use crate::learn::frame::LEVEL_BALANCE;
use crate::model::course as model;
use crate::model::evaluated;
use crate::run::disk::{refuse_foreign, write_whole};
use hardnessd_core::verdict::features::{FRAME, Moment, force_n};
use hardnessd_core::verdict::{Course, Format, Hrn, argmax};
use hardnessd_simulator::Split;

/// Presses of a level in the picture of force against approach. More would hide each other.
const CURVES_A_LEVEL: usize = 8;

/// The request for a comparison.
#[derive(Debug)]
pub struct CoursePlan {
    /// Presses that the controls are fitted on.
    pub data: Vec<PathBuf>,
    /// The sets of test presses.
    pub tests: Vec<PathBuf>,
    /// Models with their names, at least one. The others are compared with the first.
    pub models: Vec<(String, Hrn)>,
    /// The directory of the tables.
    pub out: PathBuf,
}

/// A control: a logistic regression on one kind of features of a press.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Control {
    Frame,
    Hertz,
    Press,
    PressAlone,
}

impl Control {
    const ALL: [Self; 4] = [Self::Frame, Self::Hertz, Self::PressAlone, Self::Press];

    fn name(self) -> &'static str {
        match self {
            Self::Frame => "features of the frame of greatest force",
            Self::Hertz => "Hertz's fit",
            Self::PressAlone => "features of the press, arm unknown",
            Self::Press => "features of the press",
        }
    }

    fn row(self, press: &Press) -> Vec<f32> {
        match self {
            Self::Frame => press.features()[..FRAME].to_vec(),
            Self::Hertz => hertz::row(press).to_vec(),
            Self::Press => press.features().to_vec(),
            Self::PressAlone => press.clone().without_arm().features().to_vec(),
        }
    }
}

/// A set of test presses.
struct TestSet {
    name: String,
    /// What is drawn together for intervals.
    clusters: Clusters,
    courses: Courses,
    presses: Vec<Press>,
}

impl TestSet {
    fn read(path: &Path) -> anyhow::Result<Self> {
        let (courses, _) = Courses::read_all(&[path.to_owned()])?;
        ensure!(
            courses.labelled(Split::Test).next().is_some(),
            "{}: no press of the test split has a level: choose other --test presses",
            path.display()
        );
        let name = path.file_stem().unwrap_or(path.as_os_str());
        Ok(Self {
            name: name.to_string_lossy().into_owned(),
            clusters: sets::clusters_of(simulated::settings_of_courses(path)?.as_ref()),
            presses: course::presses(&courses),
            courses,
        })
    }
}

/// Judges every set by every control and model, writes the tables and returns the first as text.
///
/// # Errors
///
/// Fails if a file cannot be read or judged, or the directory cannot be written.
pub fn compare_courses(plan: &CoursePlan) -> anyhow::Result<String> {
    let sets: Vec<TestSet> = plan
        .tests
        .iter()
        .map(|path| TestSet::read(path))
        .collect::<anyhow::Result<_>>()?;
    std::fs::create_dir_all(&plan.out).with_context(|| plan.out.display().to_string())?;
    refuse_foreign(&plan.out, "course.json", &["course.md", "course.html"])?;

    let mut rows = controls(&plan.data, &sets)?;
    for (name, hrn) in &plan.models {
        rows.extend(of_model(name, hrn, &sets)?);
    }
    compare_with_first(&mut rows, &plan.models[0].0, &sets);
    let json = serde_json::to_vec_pretty(&rows)?;
    write_whole(&plan.out.join("course.json"), &json)?;
    let tables = course_results::tables(&rows);
    let text: Vec<String> = tables.iter().map(Table::section).collect();
    write_whole(&plan.out.join("course.md"), text.join("\n").as_bytes())?;
    let page = report::courses(&rows, &plan.models[0].0, &curves(&sets));
    write_whole(&plan.out.join("course.html"), page.as_bytes())?;
    Ok(tables[0].text())
}

/// Curves of force against approach: of each level the first press of several objects, from the first
/// set whose presses all have a known approach.
fn curves(sets: &[TestSet]) -> Option<(&str, Vec<Curve>)> {
    let is_known = |press: &Press| {
        press
            .moments
            .iter()
            .all(|moment| moment.approach_mm.is_some())
    };
    let set = sets.iter().find(|set| set.presses.iter().all(is_known))?;
    let mut drawn: BTreeMap<u8, BTreeSet<u32>> = BTreeMap::new();
    let mut curves = Vec::new();
    for place in set.courses.labelled(Split::Test) {
        let press = &set.presses[place];
        let objects = drawn.entry(press.level).or_default();
        if objects.len() == CURVES_A_LEVEL || !objects.insert(press.object) {
            continue;
        }
        let point = |moment: &Moment| {
            let approach_mm = moment.approach_mm.unwrap_or_default();
            (f64::from(approach_mm), f64::from(force_n(&moment.frame)))
        };
        curves.push(Curve {
            level: press.level,
            points: press.moments.iter().map(point).collect(),
        });
    }
    Some((&set.name, curves))
}

/// Fits the controls and judges the sets with them.
fn controls(data: &[PathBuf], sets: &[TestSet]) -> anyhow::Result<Vec<CourseRow>> {
    let (courses, _) = Courses::read_all(data)?;
    let presses = course::presses(&courses);
    let learnt: Vec<&Press> = courses
        .labelled(Split::Train)
        .map(|place| &presses[place])
        .collect();
    ensure!(
        !learnt.is_empty(),
        "--data: no press of the training split has a level: name presses to learn from"
    );
    let levels = dataset::levels().len();
    let level_of: Vec<usize> = learnt
        .iter()
        .map(|press| usize::from(press.level) - 1)
        .collect();
    // Raise the weights of levels with few presses, as the method `course` does.
    let lifts: Vec<f32> = (0..levels)
        .map(|level| level_of.iter().filter(|&&of| of == level).count())
        .map(|count| (count.max(1) as f32).powf(-LEVEL_BALANCE as f32))
        .collect();
    let row_of = |control: Control| {
        let rows: Vec<Vec<f32>> = learnt.iter().map(|press| control.row(press)).collect();
        let fitted = Baseline::fit(&rows, &level_of, levels);
        let on = |set: &TestSet| {
            let judged: Vec<Judged> = set
                .courses
                .labelled(Split::Test)
                .map(|place| Judged {
                    level: set.presses[place].level,
                    probabilities: lifted(
                        fitted.probabilities(&control.row(&set.presses[place])),
                        &lifts,
                    ),
                    object: Some(set.presses[place].object),
                })
                .collect();
            on_set(set, &judged, levels, None)
        };
        CourseRow {
            name: control.name().to_owned(),
            sets: sets.iter().map(on).collect(),
        }
    };
    Ok(Control::ALL.into_iter().map(row_of).collect())
}

/// Multiplies each probability by its level's lift, and normalises the sum to 1.
fn lifted(mut probabilities: Vec<f32>, lifts: &[f32]) -> Vec<f32> {
    probabilities
        .iter_mut()
        .zip(lifts)
        .for_each(|(p, lift)| *p *= lift);
    let sum: f32 = probabilities.iter().sum();
    probabilities.iter_mut().for_each(|p| *p /= sum);
    probabilities
}

/// A model's row. A model of format 2 also gets a row of its verdicts without the arm's motion.
fn of_model(name: &str, hrn: &Hrn, sets: &[TestSet]) -> anyhow::Result<Vec<CourseRow>> {
    let row = |name: String, change: &dyn Fn(Course) -> Course, is_whole: bool| {
        let on = |set: &TestSet| {
            let verdicts =
                model::verdicts(hrn, &set.courses, Split::Test, model::Given::NONE, change)?;
            let levels = hrn.card().levels.len();
            let cases = model::cases(&verdicts);
            let rmse = evaluated::shore(&cases, levels).map(|shore| shore.rmse);
            let mut on = on_set(set, &evaluated::judged(&cases), levels, rmse);
            if is_whole {
                on.so_far = Some(so_far::of(
                    hrn,
                    &set.courses,
                    set.courses.labelled(Split::Test),
                    &verdicts,
                )?);
            }
            Ok(on)
        };
        anyhow::Ok(CourseRow {
            name,
            sets: sets.iter().map(on).collect::<anyhow::Result<_>>()?,
        })
    };
    match hrn.format() {
        Format::Frame => Ok(vec![row(name.to_owned(), &|course| course, false)?]),
        Format::Course { .. } => Ok(vec![
            row(format!("{name}, arm unknown"), &without_arm, false)?,
            row(name.to_owned(), &|course| course, true)?,
        ]),
    }
}

/// The course of a press without the arm's motion and stiffness, as from a robot that reports none.
fn without_arm(mut course: Course) -> Course {
    course.arm_n_per_mm = 0.0;
    for moment in &mut course.moments {
        moment.approach_mm = None;
    }
    course
}

fn on_set(set: &TestSet, judged: &[Judged], levels: usize, shore_rmse: Option<f64>) -> OnSet {
    let is_far =
        |one: &&Judged| (argmax(&one.probabilities).0 + 1).abs_diff(usize::from(one.level)) > 1;
    let objects = metrics::by_object(judged).unwrap_or_default();
    let accuracy = metrics::accuracy_by_object(&[&objects], set.clusters);
    OnSet {
        set: set.name.clone(),
        interval: accuracy.and_then(|estimate| estimate.interval),
        levels: Evaluation::of(judged, levels),
        calibration: metrics::calibration(judged),
        beyond_neighbour: judged.iter().filter(is_far).count() as f64 / judged.len() as f64,
        shore_rmse,
        objects,
        less_first: None,
        so_far: None,
    }
}

/// Fills in the differences to the row called `first`.
fn compare_with_first(rows: &mut [CourseRow], first: &str, sets: &[TestSet]) {
    let Some(reference) = rows.iter().find(|row| row.name == first).cloned() else {
        return;
    };
    for row in rows.iter_mut().filter(|row| row.name != first) {
        for ((own, others), set) in row.sets.iter_mut().zip(&reference.sets).zip(sets) {
            let pair = (own.objects.as_slice(), others.objects.as_slice());
            own.less_first = metrics::difference_by_object(&[pair], set.clusters);
        }
    }
}
