//! The test sets of a comparison.
//!
//! In: the data that the methods learn from. Out: its own test split, and 20 fresh objects of each test
//! material, in the paper's shapes and in shapes that are the same for all materials. The fresh objects are
//! simulated once and kept. No model may ever learn from their seeds.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use crate::data::presses::{Presses, read_one};
use crate::data::simulated;
use crate::data::source::PITCH_MM;
use crate::run::disk::write_whole;
use crate::settings::Profile;
use hardnessd_core::verdict::sha256_hex;
use hardnessd_simulator::{
    BroadSensors, CourseSettings, DatasetSettings, SensorDesigns, Shapes, Split,
};

/// The fresh objects of each test material.
pub(super) const FRESH_OBJECTS: u32 = 20;
/// The key of the data's own test split in the results.
pub(super) const PAPER_SPLIT: &str = "paper_split";
/// The other sets: the key, the seed and the shapes.
const FRESH: [(&str, u64, Shapes); 2] = [
    ("fresh", 2_019_001, Shapes::Paper),
    ("matched", 2_019_002, Shapes::Matched),
];

/// Labelled presses to judge.
#[derive(Debug)]
pub(super) struct TestSet {
    /// The key of the set in the results.
    pub(super) name: &'static str,
    pub(super) presses: Presses,
    /// The presses to judge.
    pub(super) places: Vec<usize>,
}

impl TestSet {
    fn of(name: &'static str, presses: Presses) -> Self {
        Self {
            name,
            places: presses.labelled(Split::Test).collect(),
            presses,
        }
    }

    /// The SHA-256 of the set's first file.
    pub(super) fn sha256(&self) -> &str {
        &self.presses.sources[0].sha256
    }
}

/// All sets. The simulated ones are kept in `directory`. The first set is left out if the data have no
/// labelled test presses.
///
/// # Errors
///
/// Fails if the data were simulated with a seed of the fresh objects, or a file cannot be read or written.
pub(super) fn all(
    presses: Presses,
    profile: Profile,
    directory: &Path,
) -> anyhow::Result<Vec<TestSet>> {
    let seeds = presses.sources.iter().filter_map(|source| source.seed);
    for seed in seeds {
        ensure!(
            !FRESH.iter().any(|&(_, fresh, _)| fresh == seed),
            "{}: found seed {seed}, expected another than the fresh test objects'",
            presses.path().display()
        );
    }
    if presses.pitch_mm() != PITCH_MM {
        hardnessd_core::stderr_line!(
            "warning: {}: taxel pitch: found {} mm, expected {PITCH_MM} mm, that of the simulated test objects",
            presses.path().display(),
            presses.pitch_mm()
        );
    }
    let are_over_time = presses.are_over_time();
    let own = TestSet::of(PAPER_SPLIT, presses);
    let mut sets: Vec<TestSet> = [own]
        .into_iter()
        .filter(|own| !own.places.is_empty())
        .collect();
    for (name, seed, shapes) in FRESH {
        let objects = DatasetSettings {
            seed,
            shapes,
            objects: 0,
            test_objects: FRESH_OBJECTS,
            presses: match (profile, are_over_time) {
                (Profile::Smoke, _) => 1,
                (_, true) => CourseSettings::default().objects.presses,
                (_, false) => DatasetSettings::default().presses,
            },
            ..DatasetSettings::default()
        };
        let path = simulated(directory, name, objects, are_over_time)?;
        sets.push(TestSet::of(name, read_one(&path)?));
    }
    Ok(sets)
}

/// The file of fresh objects, which is simulated unless it exists. Its name has a hash of the settings and of
/// the simulator's version, so others make another file. Presses over time are made on many sensors, with
/// presses of rigid pieces, which are the references of a model that takes some.
fn simulated(
    directory: &Path,
    name: &str,
    objects: DatasetSettings,
    over_time: bool,
) -> anyhow::Result<PathBuf> {
    let courses = over_time.then(|| CourseSettings {
        objects,
        sensors: Some(BroadSensors {
            designs: SensorDesigns::Jx255n,
            ..BroadSensors::default()
        }),
        ..CourseSettings::default()
    });
    let settings = match &courses {
        Some(settings) => serde_json::to_string(settings),
        None => serde_json::to_string(&objects),
    };
    let settings = settings.context("the simulator's settings")?;
    let hash = sha256_hex(format!("{} {settings}", hardnessd_simulator::VERSION).as_bytes());
    let path = directory.join(format!("{name}-{}.npz", &hash[..8]));
    if path.exists() {
        return Ok(path);
    }
    hardnessd_core::stderr_line!("simulating {}", path.display());
    let cores = simulated::all_cores();
    let bytes = match &courses {
        Some(settings) => {
            let presses = simulated::simulate_courses(settings, cores);
            simulated::courses_to_bytes(settings, &presses)?
        }
        None => simulated::to_bytes(&objects, simulated::simulate(&objects, cores))?,
    };
    write_whole(&path, &bytes)?;
    Ok(path)
}
