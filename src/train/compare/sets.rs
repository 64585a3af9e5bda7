//! What every model of a comparison is judged on.
//!
//! In: the data set that the models learn from. Out: its own test split, 20 fresh objects of each
//! test material, the same objects under other sensors, and objects of other shapes and materials. The fresh ones are simulated once and
//! kept; no model may ever learn from their seeds.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use crate::simulator::{self, Borders, DatasetSettings, Materials, SensorProfile, Shapes, Split};
use crate::train::data::dataset::{Dataset, PITCH_MM};
use crate::train::data::simulated;
use crate::train::run::disk::write_whole;
use crate::train::settings::Profile;
use crate::verdict::sha256_hex;

/// Seeds of the fresh objects: of `paper` and of `matched` shapes, and of other worlds.
const FRESH_SEEDS: [u64; 3] = [2_019_001, 2_019_002, 2_019_004];
/// Seed of the other gain map.
const OTHER_SENSORS_SEED: u64 = 2_019_003;
/// Fresh objects of each test material.
pub(super) const FRESH_OBJECTS: u32 = 20;
/// A softer cover has this part of the usual one's modulus.
const SOFTER: f64 = 0.5;

/// Labelled samples to judge.
#[derive(Debug)]
pub(super) struct TestSet {
    /// Its key in results.
    pub(super) name: &'static str,
    /// Where the samples are.
    pub(super) dataset: Dataset,
    /// Which they are.
    pub(super) indices: Vec<usize>,
}

impl TestSet {
    /// SHA-256 of its file.
    pub(super) fn sha256(&self) -> &str {
        &self.dataset.sources[0].sha256
    }
}

/// Key of the data set's own test split.
pub(super) const PAPER_SPLIT: &str = "paper_split";
/// Key of the fresh objects of `paper` shapes.
pub(super) const FRESH: &str = "fresh";
/// Key of the fresh objects of `matched` shapes.
pub(super) const MATCHED: &str = "matched";
/// Keys of the fresh objects of `paper` shapes under another sensor, and what is other about it.
pub(super) const SHIFTS: [(&str, &str); 3] = [
    ("gain_map", "other gains, thresholds and dead taxels"),
    ("soft_cover", "a cover half as stiff"),
    ("raw", "taxels as uneven as on a raw film array"),
];

/// Keys of fresh objects of other shapes and materials than the paper's, and what they are.
pub(super) const WORLDS: [(&str, &str); 3] = [
    (
        "wide",
        "the test materials with radii from 8 to 60 mm, edges and points",
    ),
    (
        "broad",
        "as many random materials, Shore OO even from 15 to 95",
    ),
    (
        "broad_wide",
        "random materials with those radii, edges and points",
    ),
];

/// Makes sure that no model learns from the fresh objects.
///
/// # Errors
///
/// If the data has a seed of theirs.
pub(super) fn check_seed(dataset: &Dataset) -> anyhow::Result<()> {
    let seed = dataset.sources[0].seed;
    ensure!(
        !FRESH_SEEDS.iter().any(|&fresh| seed == Some(fresh)),
        "{}: found seed {}, expected another than the fresh test objects'",
        dataset.path().display(),
        seed.unwrap_or_default()
    );
    Ok(())
}

/// Says so if the data are of another sensor than what is simulated, whose pitch is fixed: figures on
/// fresh objects then say little.
pub(super) fn warn_of_pitch(dataset: &Dataset) {
    let pitch_mm = dataset.pitch_mm();
    if pitch_mm != PITCH_MM {
        eprintln!(
            "warning: {}: taxel pitch: found {pitch_mm} mm, expected {PITCH_MM} mm, that of the \
             simulated test objects",
            dataset.path().display()
        );
    }
}

/// All sets in order; those that are simulated lie in `directory`. The first is left out where
/// `dataset` has no labelled test samples.
///
/// # Errors
///
/// If a file cannot be read or written.
pub(super) fn all(
    dataset: Dataset,
    profile: Profile,
    directory: &Path,
) -> anyhow::Result<Vec<TestSet>> {
    let mut sets = Vec::new();
    if let Ok(indices) = dataset.labelled(Split::Test) {
        sets.push(TestSet {
            name: PAPER_SPLIT,
            dataset,
            indices,
        });
    }
    for (name, settings) in simulations(profile) {
        let dataset = Dataset::read(&simulated(directory, name, &settings)?)?;
        let indices = dataset.labelled(Split::Test)?;
        sets.push(TestSet {
            name,
            dataset,
            indices,
        });
    }
    Ok(sets)
}

/// What is simulated for all comparisons of a profile.
fn simulations(profile: Profile) -> [(&'static str, DatasetSettings); 8] {
    let fresh = |seed, shapes| DatasetSettings {
        seed,
        shapes,
        objects: 0,
        test_objects: FRESH_OBJECTS,
        presses: match profile {
            Profile::Smoke => 1,
            Profile::Paper | Profile::Quick => DatasetSettings::default().presses,
        },
        ..DatasetSettings::default()
    };
    let [paper_seed, matched_seed, worlds_seed] = FRESH_SEEDS;
    let paper = fresh(paper_seed, Shapes::Paper);
    let [(wide, _), (broad, _), (broad_wide, _)] = WORLDS;
    let of_broad = |shapes| DatasetSettings {
        materials: Materials::Broad,
        borders: Borders::Gaps,
        ..fresh(worlds_seed, shapes)
    };
    let [(gain_map, _), (soft_cover, _), (raw, _)] = SHIFTS;
    [
        (FRESH, paper),
        (MATCHED, fresh(matched_seed, Shapes::Matched)),
        (
            gain_map,
            DatasetSettings {
                sensor_seed: Some(OTHER_SENSORS_SEED),
                ..paper
            },
        ),
        (
            soft_cover,
            DatasetSettings {
                cover_young_mpa: SOFTER * paper.cover_young_mpa,
                ..paper
            },
        ),
        (
            raw,
            DatasetSettings {
                profile: SensorProfile::Raw,
                ..paper
            },
        ),
        (wide, fresh(worlds_seed, Shapes::Wide)),
        (broad, of_broad(Shapes::Matched)),
        (broad_wide, of_broad(Shapes::Wide)),
    ]
}

/// The file of what `settings` make, simulated unless it is there. Its name tells the settings.
fn simulated(directory: &Path, name: &str, settings: &DatasetSettings) -> anyhow::Result<PathBuf> {
    let path = file_of(directory, name, settings)?;
    if !path.exists() {
        eprintln!("simulating {}", path.display());
        let samples = simulated::simulate(settings);
        write_whole(&path, &simulated::to_bytes(settings, samples)?)?;
    }
    Ok(path)
}

/// Where the samples of `settings` are kept: another simulator or other settings, another file.
/// Whoever changes what the simulator makes raises [`simulator::VERSION`].
pub(super) fn file_of(
    directory: &Path,
    name: &str,
    settings: &DatasetSettings,
) -> anyhow::Result<PathBuf> {
    let told = serde_json::to_string(settings).context("the simulator's settings")?;
    let hash = sha256_hex(format!("{} {told}", simulator::VERSION).as_bytes());
    Ok(directory.join(format!("{name}-{}.npz", &hash[..8])))
}
