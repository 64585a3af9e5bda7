//! Simulated data sets as files.
//!
//! In: the simulator's settings. Out: `.npz` files that carry the settings in `meta.settings`, so
//! that the same objects can be pressed again under other conditions.

use std::io::Cursor;

use anyhow::Context as _;
use hardnessd_core::exit::CONFIG;
use hardnessd_core::npz::Writer;
use hardnessd_core::verdict::Level;
use hardnessd_core::wording;
use hardnessd_simulator::{self, CourseSettings, DatasetSettings, Materials};
use rayon::prelude::*;
use serde_json::json;

use crate::data::presses::{self, Layout, Presses};
use crate::data::source::{self, SIMULATOR};
use crate::exit::coded;
use crate::progress;
use crate::settings::overridden;

/// Settings with the values of a file in place of their own.
///
/// # Errors
///
/// Returns an error if the text is not TOML with known keys, or a value lies outside its range.
pub fn configured(settings: &CourseSettings, text: &str) -> anyhow::Result<CourseSettings> {
    let table: Result<toml::Table, _> = toml::from_str(text);
    let table = table.map_err(|error| coded(CONFIG, wording::of_toml(text, &error)))?;
    let settings = overridden(settings, &table)?;
    settings.check().map_err(|error| coded(CONFIG, error))?;
    Ok(settings)
}

/// Simulates presses, with a progress bar on a terminal. Single frames are those of `settings.objects`. Also returns
/// the number of presses that no sensor saw, or that lasted too long.
pub fn simulate(settings: &CourseSettings, layout: Layout) -> (Presses, usize) {
    match layout {
        Layout::Frames => {
            let samples = made(hardnessd_simulator::dataset(&settings.objects));
            (Presses::of_samples(samples), 0)
        }
        Layout::OverTime => {
            let courses = made(hardnessd_simulator::courses(settings));
            let all = courses.len();
            let presses = Presses::of_courses(courses.into_iter().flatten());
            let left_out = all - presses.all.len();
            (presses, left_out)
        }
    }
}

/// What all parts of some work make, in their order.
fn made<T: Send>(work: Vec<impl FnOnce() -> Vec<T> + Send>) -> Vec<T> {
    let bar = progress::bar("{bar:30} {percent} %, {eta} left", work.len());
    let work = work.into_par_iter().with_max_len(1);
    let made = work.flat_map_iter(|make| {
        let made = make();
        bar.inc(1);
        made
    });
    let made = made.collect();
    bar.finish_and_clear();
    made
}

/// The levels with their intervals of Shore. Those of the named materials are the paper's.
fn levels(settings: &DatasetSettings) -> Vec<Level> {
    match settings.materials {
        Materials::Broad => source::levels(|range| range.touching),
        Materials::Named => source::papers_levels(),
    }
}

/// The bytes of a file of presses that `settings` made.
///
/// # Errors
///
/// Returns an error if the archive cannot be built.
pub fn to_bytes(
    settings: &CourseSettings,
    layout: Layout,
    presses: &Presses,
) -> anyhow::Result<Vec<u8>> {
    let objects = &settings.objects;
    let mut meta = json!({
        "levels": levels(objects),
        "seed": objects.seed,
        "generator": format!("{SIMULATOR} {}", env!("CARGO_PKG_VERSION")),
    });
    match layout {
        Layout::Frames => {
            meta["materials"] = json!(hardnessd_simulator::material_names(objects.materials));
            meta["settings"] = json!(objects);
        }
        Layout::OverTime => {
            meta["materials"] = json!(settings.material_names());
            meta["settings"] = json!(settings);
        }
    }
    let npz = Writer::new(Cursor::new(Vec::new()));
    let written = presses::write(npz, presses, layout, &meta);
    Ok(written.context("the archive")?.into_inner())
}
