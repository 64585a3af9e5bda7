//! Exports a trained network of courses to a model file of format 3, and judges presses with it.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::ensure;
use burn::tensor::Device;
use serde_json::json;

use super::evaluated::{Case, Evaluated};
use super::export::{checked, data, metrics, range, validation};
use super::file;
use crate::data::courses::{self, Courses};
use crate::data::dataset::{self, Source};
use crate::learn::conformal::{ALPHA, Calibration};
use crate::learn::course::{Drawn, Press, Trained, piece};
use crate::net::course::{self, FRAMES};
use crate::run::{Description, Run};
use hardnessd_core::verdict::{
    Borders, Card, CheckedCourse, Checks, Conformal, Course, CourseCheck, CourseMoment, Format,
    Hrn, Piece, Range, ReferencePress, Verdict,
};
use hardnessd_simulator::Split;

/// The references of its sensor that a model is given beside a press.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Given {
    /// Presses of each rigid piece.
    pub rigid: usize,
    /// Objects of each level. Their presses are not judged.
    pub labelled: usize,
}

impl Given {
    /// No references.
    pub const NONE: Self = Self {
        rigid: 0,
        labelled: 0,
    };
    /// What a run's evaluation gives a model: two presses of each piece.
    const USUAL: Self = Self {
        rigid: 2,
        labelled: 0,
    };
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
    (trained, borders): (&Trained, &Borders),
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels_of(&description.data);
    let Calibration {
        temperature,
        threshold,
        ..
    } = trained.calibration;
    let mut metrics = metrics(temperature);
    if let Some(missing) = trained.calibration.missing() {
        metrics["not_promised"] = json!(missing);
    }
    let checks = checks(courses, (presses, train), (trained, borders), device);
    let best_frame = |&press: &usize| courses.frame(courses.presses[press].best as usize);
    let learnt = train.iter().map(|&press| &presses[press]);
    let of_presses = description.settings.reports.ranges(learnt);
    let mut card = Card {
        format: "3".to_owned(),
        levels: levels.clone(),
        pitch_mm: dataset::pitch_mm(&description.data) as f32,
        method: description.method.clone(),
        data: data(&description.data)?,
        metrics,
        validation: validation(&courses.validated(&description.data)).to_owned(),
        range: Range {
            pitch_mm: pitches_mm(&description.data),
            ..range(train.iter().map(best_frame)).with_presses(of_presses)
        },
        conformal: (threshold > 0.0).then_some(Conformal {
            alpha: ALPHA,
            threshold,
        }),
    };
    let write = |card: &Card| {
        let (graph, raw_bins) = course::graph(&trained.weights, &trained.standard);
        let lifts = trained.lifts.clone();
        let outputs = file::Outputs::Bins { raw_bins, lifts };
        file::write(graph, &outputs, temperature, card, &checks)
    };
    let hrn = Hrn::load(&write(&card)?)?;
    let test = verdicts(&hrn, courses, Split::Test, Given::USUAL, |course| course)?;
    let evaluation = (!test.is_empty()).then(|| Evaluated::of(&cases(&test), levels.len()));
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation);
        let json = serde_json::to_vec_pretty(evaluation)?;
        run.write("evaluation.json", &json)?;
    }
    run.write("hrn.onnx", &write(&card)?)?;
    Ok(evaluation)
}

/// The distances between the taxels of the sensors that the presses were made on, if these differ.
fn pitches_mm(sources: &[Source]) -> Option<[f32; 2]> {
    sources.iter().find(|source| source.pitches_mm.is_some())?;
    let of = |source: &Source| {
        let own = source.pitch_mm.unwrap_or(dataset::PITCH_MM);
        source.pitches_mm.unwrap_or([own; 2])
    };
    let both = |[least, most]: [f64; 2], [low, high]: [f64; 2]| [least.min(low), most.max(high)];
    let pitches = sources.iter().map(of).reduce(both)?;
    Some(pitches.map(|mm| mm as f32))
}

/// The check presses, every second with references, and what the trainer's network says of them.
fn checks(
    courses: &Courses,
    (presses, train): (&[Press], &[usize]),
    (trained, borders): (&Trained, &Borders),
    device: &Device,
) -> Checks {
    let first = train[0];
    let identified = train.iter().find(|&&place| {
        let of_sensor = rigid(courses, courses.presses[place].sensor, Given::USUAL);
        !of_sensor.is_empty()
    });
    let sensor = courses.presses[*identified.unwrap_or(&first)].sensor;
    let references = rigid(courses, sensor, Given::USUAL);
    let checked = checked(train, |press| courses.presses[press].level);
    let of_press = |(number, place): (usize, usize)| {
        let identified = number % 2 == 1 && !references.is_empty();
        let given = references.iter().filter(|_| identified);
        let drawn = Drawn {
            presses: vec![presses[place].clone()],
            references: given
                .map(|&(place, piece)| (presses[place].clone(), piece))
                .collect(),
        };
        let logits = &trained.judge(&[drawn], device)[0];
        let judged = trained.distribution(logits, trained.calibration.temperature);
        CheckedCourse {
            course: course_of(courses, place),
            probabilities: judged.levels(borders),
            shore: judged.shore(borders),
            identified,
        }
    };
    Checks::Courses(CourseCheck {
        presses: checked.into_iter().enumerate().map(of_press).collect(),
        references: references
            .iter()
            .map(|&(place, piece)| ReferencePress {
                course: course_of(courses, place),
                piece,
            })
            .collect(),
    })
}

/// As many presses of each rigid piece on a sensor as are given.
fn rigid(courses: &Courses, sensor: u32, given: Given) -> Vec<(usize, Piece)> {
    let of_sensor = courses.presses.iter().enumerate();
    let pieces = of_sensor.filter(|(_, press)| press.sensor == sensor);
    let pieces = pieces.filter_map(|(place, press)| Some((place, piece(press.reference?))));
    let is_ball = |(_, piece): &(usize, Piece)| matches!(piece, Piece::Ball { .. });
    let (balls, flats): (Vec<_>, Vec<_>) = pieces.partition(is_ball);
    // The simulator presses harder each time, so presses that lie apart differ in force.
    let spread = |of_piece: Vec<(usize, Piece)>| {
        let count = given.rigid.min(of_piece.len());
        let last = of_piece.len();
        (1..=count).map(move |number| of_piece[number * last / count - 1])
    };
    spread(flats).chain(spread(balls)).collect()
}

/// The model with the references of each sensor, and the objects that serve as such.
type Identified = (BTreeMap<u32, Hrn>, BTreeSet<u32>);

/// The model with the references of each sensor with presses of a split.
fn identified(
    hrn: &Hrn,
    courses: &Courses,
    split: Split,
    given: Given,
) -> anyhow::Result<Identified> {
    let (mut models, mut objects) = (BTreeMap::new(), BTreeSet::new());
    if hrn.most_references() == 0 || given == Given::NONE {
        return Ok((models, objects));
    }
    let mut by_sensor = BTreeMap::<u32, Vec<usize>>::new();
    for place in courses.labelled(split) {
        let sensor = courses.presses[place].sensor;
        by_sensor.entry(sensor).or_default().push(place);
    }
    for (sensor, presses) in by_sensor {
        let mut own = rigid(courses, sensor, given);
        let mut of_level = BTreeMap::<u8, BTreeSet<u32>>::new();
        for &place in &presses {
            let press = &courses.presses[place];
            let of_level = of_level.entry(press.level).or_default();
            if of_level.len() < given.labelled && of_level.insert(press.object) {
                objects.insert(press.object);
                let range = [press.shore; 2];
                let is_measured = press.shore.is_finite();
                own.extend(is_measured.then_some((place, Piece::Shore { range })));
            }
        }
        let presses: Vec<ReferencePress> = own
            .into_iter()
            .take(hrn.most_references())
            .map(|(place, piece)| ReferencePress {
                course: course_of(courses, place),
                piece,
            })
            .collect();
        let references = hrn.references(&presses)?;
        models.insert(sensor, hrn.identified(references)?);
    }
    Ok((models, objects))
}

/// The verdicts of a model on the labelled presses of a split, after `change` has changed each
/// course, beside the references of each press's sensor. A model of format 1 judges each press's
/// best frame.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a press.
pub fn verdicts(
    hrn: &Hrn,
    courses: &Courses,
    split: Split,
    given: Given,
    change: impl Fn(Course) -> Course,
) -> anyhow::Result<Vec<(courses::Press, Verdict)>> {
    let (identified, objects) = identified(hrn, courses, split, given)?;
    let mut verdicts = Vec::new();
    for place in courses.labelled(split) {
        let press = courses.presses[place];
        if objects.contains(&press.object) {
            continue;
        }
        ensure!(
            usize::from(press.level) <= hrn.card().levels.len(),
            "the model has {} levels, and the data has a press of level {}",
            hrn.card().levels.len(),
            press.level
        );
        let verdict = match hrn.format() {
            Format::Frame => hrn.judge(&courses.frame(press.best as usize))?,
            Format::Course { .. } => {
                let of_sensor = identified.get(&press.sensor).unwrap_or(hrn);
                of_sensor.judge_course(&change(course_of(courses, place)))?
            }
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
