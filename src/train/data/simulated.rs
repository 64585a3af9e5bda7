//! Simulated data sets as files.
//!
//! In: the simulator's settings. Out: `.npz` files that carry them in `meta.settings`, so that the
//! same objects can be pressed again under other conditions.

use std::io::Cursor;
use std::path::Path;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use crate::simulator::{self, DatasetSettings, LabelledSample, Material};
use crate::train::data::dataset::{self, SIMULATOR, Sample};

/// Simulates on all cores, with a bar on a terminal.
pub fn simulate(settings: &DatasetSettings) -> Vec<LabelledSample> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let objects = u64::from(settings.objects) + u64::from(settings.test_objects);
    let total = (4 * objects).saturating_mul(settings.presses.into());
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} samples, {per_sec}, {eta} left")
        .expect("the template is right");
    let bar = ProgressBar::new(total).with_style(style);
    let samples = simulator::dataset(settings, threads, |done| bar.set_position(done as u64));
    bar.finish_and_clear();
    samples
}

/// The bytes of a file of samples that `settings` made.
///
/// # Errors
///
/// If the archive cannot be built.
pub fn to_bytes(
    settings: &DatasetSettings,
    samples: Vec<LabelledSample>,
) -> anyhow::Result<Vec<u8>> {
    let meta = json!({
        "materials": Material::ALL.map(Material::name),
        "levels": dataset::levels(),
        "seed": settings.seed,
        "generator": format!("{SIMULATOR} {}", env!("CARGO_PKG_VERSION")),
        "settings": settings,
    });
    let samples: Vec<Sample> = samples.into_iter().map(Sample::from).collect();
    Ok(dataset::write(Cursor::new(Vec::new()), &samples, &meta)?.into_inner())
}

/// What a file was simulated with.
///
/// # Errors
///
/// If the file cannot be read, or says nothing of it.
pub fn settings_of(path: &Path) -> anyhow::Result<DatasetSettings> {
    let meta = dataset::meta(path)?;
    serde_json::from_value(meta["settings"].clone()).with_context(|| {
        format!(
            "{}: `meta.settings`: found {}, expected the simulator's settings",
            path.display(),
            meta["settings"]
        )
    })
}
