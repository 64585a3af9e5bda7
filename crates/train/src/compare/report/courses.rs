//! The page of `hrn-train compare --course`, with its pictures.

use super::Page;
use super::figures;
use super::plot::{Axis, Chart};
use crate::compare::course_results::{self, CourseRow, OnSet};
use crate::compare::so_far::SoFar;

/// The force of a press against the approach of the arm.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The hardness level of the object.
    pub level: u8,
    /// Approach in mm and total force in N, frame by frame.
    pub points: Vec<(f64, f64)>,
}

/// The page of the results `rows`. The pictures of calibration and of verdicts before the end are
/// those of the row called `first`. `curves` are presses of a set, with its name.
pub fn courses(rows: &[CourseRow], first: &str, curves: &Option<(&str, Vec<Curve>)>) -> String {
    let mut page = Page::default();
    let tables = course_results::tables(rows);
    let (overview, before_end) = tables.split_at(course_results::OVERVIEW.min(tables.len()));
    page.section("accuracy", "Accuracy and errors");
    for table in overview {
        page.subtitle(&table.title);
        page.table(table);
    }
    if let Some((set, curves)) = curves {
        page.section("curves", "Force against approach");
        page.note(&format!(
            "Presses of {set}, one an object. The approach is what the robot reports of its arm, so it \
             includes how far object, cover and arm gave way. A harder object rises more steeply, but so \
             does a blunter one or a stiffer arm."
        ));
        page.panels(force_against_approach(curves));
    }
    let reference = rows.iter().find(|row| row.name == first);
    let sets = || reference.into_iter().flat_map(|row| &row.sets);
    if sets().any(|on| on.so_far.is_some()) {
        page.section("time", "Before the end of a press");
        page.note(&format!(
            "{first}: share of correct levels after each number of seconds (blue), and share of \
             presses that had not ended (dashed). For a press that had ended, the final verdict counts."
        ));
        let picture = |on: &OnSet| Some(against_time(on.so_far.as_ref()?, &on.set));
        page.panels(sets().filter_map(picture).collect());
        page.note(&format!(
            "{first}: share of correct levels at the first frame of at least each force (blue), and share of \
             presses that reach the force (dashed). Only these are judged."
        ));
        let picture = |on: &OnSet| Some(against_force(on.so_far.as_ref()?, &on.set));
        page.panels(sets().filter_map(picture).collect());
        for table in before_end {
            page.subtitle(&table.title);
            page.table(table);
        }
    }
    page.section("calibration", "Calibration");
    page.note(&format!(
        "{first}: share of correct levels against stated confidence. Below the diagonal the model is \
         too sure."
    ));
    let picture = |on: &OnSet| figures::reliability(&on.calibration, &on.set);
    page.panels(sets().map(picture).collect());
    page.finish("Hardness from the course of a press", "")
}

/// A panel a level, all with the same axes.
fn force_against_approach(curves: &[Curve]) -> Vec<String> {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let most_mm = points().fold(0.0_f64, |most, point| most.max(point.0));
    let most_n = points().fold(0.0_f64, |most, point| most.max(point.1));
    let mut levels: Vec<u8> = curves.iter().map(|curve| curve.level).collect();
    levels.sort_unstable();
    levels.dedup();
    let panel = |level: u8| {
        let title = format!("force against approach, level {level}");
        let x = Axis::linear("approach, mm", 0.0, most_mm);
        let y = Axis::linear("force, N", 0.0, most_n);
        let of_level = curves.iter().filter(|curve| curve.level == level);
        of_level
            .fold(Chart::new(&title, x, y), |chart, curve| {
                chart.line("train", &curve.points)
            })
            .svg()
    };
    levels.into_iter().map(panel).collect()
}

/// Accuracy against the time since a press began.
fn against_time(so_far: &SoFar, set: &str) -> String {
    let points = so_far.after.iter();
    let points = points.map(|at| (f64::from(at.seconds), at.accuracy, at.going_on));
    shares("time", "seconds", set, &points.collect::<Vec<_>>())
}

/// Accuracy against the force that a press has reached.
fn against_force(so_far: &SoFar, set: &str) -> String {
    let points = so_far.at_force.iter();
    let points = points.filter_map(|at| Some((at.newtons, at.accuracy?, at.reached)));
    shares("force", "newtons", set, &points.collect::<Vec<_>>())
}

/// Accuracy and the share of presses (dashed) on a logarithmic axis. Each of `points` has its place,
/// the accuracy and the share.
fn shares(of: &str, axis: &str, set: &str, points: &[(f64, f64, f64)]) -> String {
    let places = points.iter().map(|point| point.0);
    let (least, most) = places.fold((1.0_f64, 1.0_f64), |(least, most), at| {
        (least.min(at), most.max(at))
    });
    let title = format!("accuracy against {of}, {set}");
    // With a margin, so that the ends of the axis show decades.
    let x = Axis::logarithmic(axis, 0.8 * least, 1.6 * most);
    let y = Axis::linear("%", 0.0, 100.0);
    let presses: Vec<_> = points
        .iter()
        .map(|point| (point.0, 100.0 * point.2))
        .collect();
    let right: Vec<_> = points
        .iter()
        .map(|point| (point.0, 100.0 * point.1))
        .collect();
    let lines = Chart::new(&title, x, y).line("diagonal", &presses);
    lines.line("train", &right).svg()
}
