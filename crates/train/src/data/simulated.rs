//! Simulated data sets as files.
//!
//! In: the simulator's settings. Out: `.npz` files that carry the settings in `meta.settings`, so
//! that the same objects can be pressed again under other conditions.

use std::fmt::Write;
use std::io::Cursor;

use indicatif::{ProgressBar, ProgressState, ProgressStyle};
use serde_json::json;

use crate::data::presses::{self, Layout, Presses};
use crate::data::source::{self, SIMULATOR};
use hardnessd_core::verdict::Level;
use hardnessd_simulator::{
    self, Borders, CourseSettings, DatasetSettings, Family, LEVELS, LabelledCourse, LabelledSample,
    LevelRange, Materials,
};

/// Simulates samples on `jobs` threads, with a progress bar on a terminal.
pub fn simulate(settings: &DatasetSettings, jobs: usize) -> Vec<LabelledSample> {
    with_bar(settings.samples(), "samples", |progress| {
        hardnessd_simulator::dataset(settings, jobs, progress)
    })
}

/// Like [`simulate`], for whole presses.
pub fn simulate_courses(settings: &CourseSettings, jobs: usize) -> Vec<LabelledCourse> {
    with_bar(settings.presses(), "presses", |progress| {
        hardnessd_simulator::courses(settings, jobs, progress)
    })
}

/// The number of cores.
pub fn all_cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn with_bar<T>(total: u64, what: &str, make: impl FnOnce(&(dyn Fn(usize) + Sync)) -> T) -> T {
    let style = format!("{{bar:30}} {{pos}}/{{len}} {what}, {{rate}} a second, {{eta}} left");
    let bar = ProgressBar::new(total).with_style(with_rate(&style));
    let made = make(&|done| bar.set_position(done as u64));
    bar.finish_and_clear();
    made
}

/// A bar's style, with `{rate}`: steps a second in as many digits as mean something.
pub(crate) fn with_rate(template: &str) -> ProgressStyle {
    let style = ProgressStyle::with_template(template).expect("the template is right");
    style.with_key("rate", |state: &ProgressState, out: &mut dyn Write| {
        let rate = state.per_sec();
        let digits = if rate < 10.0 { 1 } else { 0 };
        let _ = write!(out, "{rate:.digits$}");
    })
}

/// The levels with their intervals of Shore. Those of the named materials are the paper's.
fn levels(settings: &DatasetSettings) -> Vec<Level> {
    let touching = |range: &LevelRange| source::level(range, range.touching);
    match (settings.materials, settings.borders) {
        (Materials::Broad, Borders::Touching) => LEVELS.iter().map(touching).collect(),
        (Materials::Named, _) | (_, Borders::Gaps) => source::papers_levels(),
    }
}

/// The bytes of a file of samples that `settings` made.
///
/// # Errors
///
/// Returns an error if the archive cannot be built.
pub fn to_bytes(
    settings: &DatasetSettings,
    samples: Vec<LabelledSample>,
) -> anyhow::Result<Vec<u8>> {
    let names = hardnessd_simulator::material_names(settings.materials);
    let meta = meta(settings, &names, &json!(settings));
    let (out, all) = (Cursor::new(Vec::new()), Presses::of_samples(samples));
    Ok(presses::write(out, &all, Layout::Frames, &meta)?.into_inner())
}

/// The bytes of a file of whole presses that `settings` made.
///
/// # Errors
///
/// Returns an error if the archive cannot be built.
pub fn courses_to_bytes(
    settings: &CourseSettings,
    courses: &[LabelledCourse],
) -> anyhow::Result<Vec<u8>> {
    let names = settings.material_names();
    let mut meta = meta(&settings.objects, &names, &json!(settings));
    meta["shapes"] = json!(Family::NAMES);
    let (out, all) = (Cursor::new(Vec::new()), Presses::of_courses(courses));
    Ok(presses::write(out, &all, Layout::OverTime, &meta)?.into_inner())
}

fn meta(
    objects: &DatasetSettings,
    materials: &[&str],
    settings: &serde_json::Value,
) -> serde_json::Value {
    json!({
        "materials": materials,
        "levels": levels(objects),
        "seed": objects.seed,
        "generator": format!("{SIMULATOR} {}", env!("CARGO_PKG_VERSION")),
        "settings": settings,
    })
}
