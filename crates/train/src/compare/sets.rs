//! The test sets of a comparison.
//!
//! In: the data set that the models learn from. Out: its own test split, 20 fresh objects of each
//! test material, the same objects under other sensors, and objects of other shapes and materials.
//! The fresh objects are simulated once and kept. No model may ever learn from their seeds.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use crate::data::dataset::{Dataset, PITCH_MM};
use crate::data::simulated;
use crate::judge::metrics::Clusters;
use crate::run::disk::write_whole;
use crate::settings::Profile;
use hardnessd_core::verdict::sha256_hex;
use hardnessd_simulator::{
    self, Borders, DatasetSettings, Materials, SensorProfile, Shapes, Split,
};

/// Seeds of the fresh objects of `paper` shapes, of `matched` shapes, and of [`WORLDS`].
const FRESH_SEEDS: [u64; 3] = [2_019_001, 2_019_002, 2_019_004];
/// Seed of the other gain map.
const OTHER_SENSORS_SEED: u64 = 2_019_003;
/// The number of fresh objects of each test material.
pub(super) const FRESH_OBJECTS: u32 = 20;
/// The softer cover's modulus as a share of the usual cover's.
const SOFTER: f64 = 0.5;

/// Labelled samples to judge.
#[derive(Debug)]
pub(super) struct TestSet {
    /// The key of the set in the results.
    pub(super) name: &'static str,
    /// The data set that the indices refer to.
    pub(super) dataset: Dataset,
    /// The indices of the samples to judge.
    pub(super) indices: Vec<usize>,
}

impl TestSet {
    /// The SHA-256 of the set's file.
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
/// Keys of the fresh objects of `paper` shapes under another sensor, each with the difference.
pub(super) const SHIFTS: [(&str, &str); 3] = [
    ("gain_map", "other gains, thresholds and dead taxels"),
    ("soft_cover", "a cover half as stiff"),
    ("raw", "taxels as uneven as on a raw film array"),
];

/// Keys of fresh objects of other shapes and materials than the paper's, each with a description.
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

/// What is drawn together for the interval of an accuracy on a set. Except for the `paper` shapes,
/// the test objects with the same number are pressed alike in every material.
pub(super) fn clusters(set: &str) -> Clusters {
    let worlds = WORLDS.iter().map(|(name, _)| *name);
    if worlds.chain([MATCHED]).any(|paired| paired == set) {
        Clusters::Geometries(FRESH_OBJECTS)
    } else {
        Clusters::Objects
    }
}

/// The same for the test presses of a file that `settings` made, or that no simulator made.
pub(super) fn clusters_of(settings: Option<&DatasetSettings>) -> Clusters {
    let Some(settings) = settings else {
        return Clusters::Objects;
    };
    // An object's number counts all objects before it: the test objects of a material then begin at a
    // multiple of their number only if the training objects do.
    let (train, test) = (settings.objects, settings.test_objects);
    let begin_at_multiples =
        settings.materials == Materials::Broad || train.is_multiple_of(test.max(1));
    if settings.shapes != Shapes::Paper && begin_at_multiples && test > 0 {
        Clusters::Geometries(test)
    } else {
        Clusters::Objects
    }
}

/// Checks that no model learns from the fresh objects.
///
/// # Errors
///
/// Fails if the data was simulated with a seed of the fresh objects.
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

/// Warns if the data's taxel pitch differs from the simulated sensor's, which is fixed. Results on
/// fresh objects then say little.
pub(super) fn warn_of_pitch(dataset: &Dataset) {
    let pitch_mm = dataset.pitch_mm();
    if pitch_mm != PITCH_MM {
        hardnessd_core::stderr_line!(
            "warning: {}: taxel pitch: found {pitch_mm} mm, expected {PITCH_MM} mm, that of the \
             simulated test objects",
            dataset.path().display()
        );
    }
}

/// All sets in order. The simulated ones are kept in `directory`. The first set is left out if
/// `dataset` has no labelled test samples.
///
/// # Errors
///
/// Fails if a file cannot be read or written.
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

/// The simulated sets of all comparisons of a profile.
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

/// The file of the samples of `settings`, which is simulated unless it exists. Its name contains a
/// hash of the settings.
fn simulated(directory: &Path, name: &str, settings: &DatasetSettings) -> anyhow::Result<PathBuf> {
    let path = file_of(directory, name, settings)?;
    if !path.exists() {
        hardnessd_core::stderr_line!("simulating {}", path.display());
        let samples = simulated::simulate(settings, simulated::all_cores());
        write_whole(&path, &simulated::to_bytes(settings, samples)?)?;
    }
    Ok(path)
}

/// The file of the samples of `settings`. Another simulator version or other settings give another
/// file. Raise [`hardnessd_simulator::VERSION`] with every change of the simulator's output.
pub(super) fn file_of(
    directory: &Path,
    name: &str,
    settings: &DatasetSettings,
) -> anyhow::Result<PathBuf> {
    let settings_json = serde_json::to_string(settings).context("the simulator's settings")?;
    let hash = sha256_hex(format!("{} {settings_json}", hardnessd_simulator::VERSION).as_bytes());
    Ok(directory.join(format!("{name}-{}.npz", &hash[..8])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn test_objects_are_drawn_together_where_they_are_pressed_alike() {
        let settings = |materials, shapes, objects| DatasetSettings {
            materials,
            shapes,
            objects,
            test_objects: 5,
            ..DatasetSettings::default()
        };
        let (named, broad) = (Materials::Named, Materials::Broad);
        let alike = Clusters::Geometries(5);
        for (settings, expected) in [
            (Some(settings(broad, Shapes::Wide, 0)), alike),
            (Some(settings(broad, Shapes::Matched, 3)), alike),
            (Some(settings(named, Shapes::Wide, 10)), alike),
            (Some(settings(named, Shapes::Wide, 3)), Clusters::Objects),
            (Some(settings(broad, Shapes::Paper, 0)), Clusters::Objects),
            (None, Clusters::Objects),
        ] {
            assert_eq!(clusters_of(settings.as_ref()), expected, "{settings:?}");
        }
    }

    #[test]
    fn the_test_objects_of_a_cluster_have_one_shape() {
        let settings = DatasetSettings {
            materials: Materials::Broad,
            shapes: Shapes::Wide,
            objects: 1,
            test_objects: 2,
            presses: 1,
            ..DatasetSettings::default()
        };
        let Clusters::Geometries(number) = clusters_of(Some(&settings)) else {
            panic!("wide shapes are alike");
        };
        let samples = hardnessd_simulator::dataset(&settings, 1, |_| {});
        let tested: Vec<_> = samples
            .iter()
            .filter(|sample| sample.split == Split::Test)
            .collect();
        assert_eq!(tested.len(), 8);
        // Objects of one shape are pressed with the same force; other shapes with another.
        for one in &tested {
            for other in &tested {
                let is_alike = one.object % number == other.object % number;
                assert_eq!(
                    one.force_n == other.force_n,
                    is_alike,
                    "{} {}",
                    one.object,
                    other.object
                );
            }
        }
    }
}
