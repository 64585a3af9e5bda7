//! The test sets of a comparison.
//!
//! In: the data that the methods learn from. Out: its own test split, and 20 fresh objects of each test
//! material, in the paper's shapes and in shapes that are the same for all materials. The fresh objects are
//! simulated once and kept. No model may ever learn from their seeds.

use std::path::Path;

use anyhow::ensure;

use crate::data::presses::{Layout, Presses, read_one};
use crate::data::simulated;
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

/// The key of a set in the results, and presses whose labelled test presses are judged.
pub(super) type TestSet = (&'static str, Presses);

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
            presses.shown_paths()
        );
    }
    let layout = presses.layout();
    let mut sets = vec![(PAPER_SPLIT, presses)];
    sets.retain(|(_, own)| own.labelled(Split::Test).next().is_some());
    for (name, seed, shapes) in FRESH {
        let usual = CourseSettings::default();
        let objects = DatasetSettings {
            seed,
            shapes,
            objects: 0,
            test_objects: FRESH_OBJECTS,
            presses: match (profile, layout) {
                (Profile::Smoke, _) => 1,
                (_, Layout::OverTime) => usual.objects.presses,
                (_, Layout::Frames) => DatasetSettings::default().presses,
            },
            ..usual.objects
        };
        // Whole presses are made on many sensors, with presses of rigid pieces, which are the references of a model
        // that takes some.
        let sensors = BroadSensors {
            designs: SensorDesigns::Jx255n,
            ..BroadSensors::default()
        };
        let settings = CourseSettings {
            objects,
            sensors: Some(sensors).filter(|_| layout == Layout::OverTime),
            ..usual
        };
        sets.push((name, simulated(directory, name, &settings, layout)?));
    }
    Ok(sets)
}

/// Fresh objects, which are simulated unless their file exists. Its name has a hash of the settings and of the
/// simulator's version, so others make another file.
fn simulated(
    directory: &Path,
    name: &str,
    settings: &CourseSettings,
    layout: Layout,
) -> anyhow::Result<Presses> {
    let version = hardnessd_simulator::VERSION;
    let of = format!("{version} {layout:?} {}", serde_json::to_string(settings)?);
    let hash = sha256_hex(of.as_bytes());
    let path = directory.join(format!("{name}-{}.npz", &hash[..8]));
    if !path.exists() {
        hardnessd_core::stderr_line!("simulating {}", path.display());
        let (presses, _) = simulated::simulate(settings, layout);
        write_whole(&path, &simulated::to_bytes(settings, layout, &presses)?)?;
    }
    read_one(&path)
}
