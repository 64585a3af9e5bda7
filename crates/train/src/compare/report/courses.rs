//! The page of `hrn-train compare --course`, with its pictures.

use super::Page;
use super::figures;
use super::plot::{Anchor, Scale, Svg, axes};
use crate::compare::course_results::{self, CourseRow, OnSet};
use crate::compare::so_far::{After, AtForce, SoFar};

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
    let x = Scale::linear((0.0, most_mm), (38.0, 244.0));
    let y = Scale::linear((0.0, most_n), (146.0, 40.0));
    let mut levels: Vec<u8> = curves.iter().map(|curve| curve.level).collect();
    levels.sort_unstable();
    levels.dedup();
    let panel = |level: u8| {
        let mut svg = Svg::new(260.0, 181.0);
        let title = format!("level {level}");
        svg.text("name", (0.0, 12.0), Anchor::Start, &title);
        axes(&mut svg, (&x, "approach, mm"), (&y, "force, N"), (4, 4));
        for curve in curves.iter().filter(|curve| curve.level == level) {
            let points = curve
                .points
                .iter()
                .map(|point| (x.at(point.0), y.at(point.1)));
            svg.path("train", &points.collect::<Vec<_>>());
        }
        svg.finish(&format!("force against approach, {title}"))
    };
    levels.into_iter().map(panel).collect()
}

/// Accuracy against the time since a press began.
fn against_time(so_far: &SoFar, set: &str) -> String {
    let point = |after: &After| Point {
        at: f64::from(after.seconds),
        accuracy: after.accuracy,
        presses: after.going_on,
        tip: format!(
            "after {} s: {:.1} % correct, {:.1} % still pressed",
            after.seconds,
            100.0 * after.accuracy,
            100.0 * after.going_on
        ),
    };
    let points: Vec<Point> = so_far.after.iter().map(point).collect();
    shares(
        &points,
        "seconds",
        &format!("accuracy against time, {set}"),
        set,
    )
}

/// Accuracy against the force that a press has reached.
fn against_force(so_far: &SoFar, set: &str) -> String {
    let point = |at: &AtForce| {
        let accuracy = at.accuracy?;
        Some(Point {
            at: at.newtons,
            accuracy,
            presses: at.reached,
            tip: format!(
                "from {} N: {:.1} % correct, {:.1} % reach it",
                at.newtons,
                100.0 * accuracy,
                100.0 * at.reached
            ),
        })
    };
    let points: Vec<Point> = so_far.at_force.iter().filter_map(point).collect();
    shares(
        &points,
        "newtons",
        &format!("accuracy against force, {set}"),
        set,
    )
}

/// A point of [`shares`].
struct Point {
    at: f64,
    accuracy: f64,
    presses: f64,
    tip: String,
}

/// Accuracy (a line with marks) and a share of presses (dashed) on a logarithmic axis.
fn shares(points: &[Point], axis: &str, title: &str, set: &str) -> String {
    let (least, most) = points
        .iter()
        .fold((1.0_f64, 1.0_f64), |(least, most), point| {
            (least.min(point.at), most.max(point.at))
        });
    // With a margin, so that the ends of the axis show decades.
    let x = Scale::logarithmic((0.8 * least, 1.6 * most), (38.0, 244.0));
    let y = Scale::linear((0.0, 100.0), (146.0, 40.0));
    let mut svg = Svg::new(260.0, 181.0);
    svg.text("name", (0.0, 12.0), Anchor::Start, set);
    axes(&mut svg, (&x, axis), (&y, "%"), (3, 4));
    let place = |point: &Point, share: f64| (x.at(point.at), y.at(100.0 * share));
    let path = |of: fn(&Point) -> f64| -> Vec<(f64, f64)> {
        points.iter().map(|point| place(point, of(point))).collect()
    };
    svg.path("diagonal", &path(|point| point.presses));
    svg.path("train", &path(|point| point.accuracy));
    for point in points {
        svg.dot("mark", place(point, point.accuracy), 3.0, &point.tip);
    }
    svg.finish(title)
}
