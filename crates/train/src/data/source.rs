//! The files that presses are from: what they say of themselves, and whose levels a model states.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use hardnessd_core::frame::{Array, Pitch};
use hardnessd_core::verdict::{COLS, Level, ROWS, sha256_hex};
use hardnessd_simulator::{LEVELS, LevelRange};

/// The distance between taxels, unless a file names another one.
pub const PITCH_MM: f64 = Pitch::JX255N.rows_mm;
/// The name of our simulator in `meta.generator`.
pub const SIMULATOR: &str = "hardnessd simulator";
/// The name of `hrn-train collect` in `meta.generator`.
pub const COLLECTOR: &str = "hrn-train collect";

/// The four hardness levels, each with the interval of Shore that `shore` picks.
pub(super) fn levels(shore: fn(&LevelRange) -> &'static str) -> Vec<Level> {
    let level = |(level, range): (u8, &LevelRange)| Level::new(level, range.label, shore(range));
    (1..).zip(&LEVELS).map(level).collect()
}

/// The four hardness levels of the paper's Table 1.
pub fn papers_levels() -> Vec<Level> {
    levels(|range| range.table)
}

/// What felt a press, with its number in files.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Another program made the press, or the file does not say which.
    #[default]
    Unknown = 0,
    /// Our simulator.
    Simulated = 1,
    /// A sensor.
    Recorded = 2,
}

impl Kind {
    /// All kinds, by their numbers.
    pub const ALL: [Self; 3] = [Self::Unknown, Self::Simulated, Self::Recorded];
}

/// An array of square taxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Its rows and columns.
    pub array: Array,
    /// The distance between its taxels.
    pub pitch_mm: f64,
}

impl Grid {
    /// Whether a data set has the frames as they are, in the middle of its own. A press on a larger array has its
    /// parts beside the frames.
    pub fn is_kept(&self) -> bool {
        self.array.rows <= ROWS && self.array.cols <= COLS
    }
}

/// A file that presses came from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Source {
    /// The file's name without its directory.
    pub name: String,
    /// The simulator's seed, if the file names one.
    pub seed: Option<u64>,
    /// SHA-256 of the file.
    pub sha256: String,
    /// The programs that made the file, separated by commas, if it names any.
    pub generator: Option<String>,
    /// Distance between the sensor's taxels, if the file names one.
    pub pitch_mm: Option<f64>,
    /// The file.
    #[serde(skip)]
    pub path: PathBuf,
    /// The least and the greatest distance between the taxels of the file's sensors, if they differ.
    #[serde(skip)]
    pub pitches_mm: Option<[f64; 2]>,
    /// The array of all presses, if they are of one with square taxels.
    #[serde(skip)]
    pub grid: Option<Grid>,
    /// The levels that the file states.
    #[serde(skip)]
    pub levels: Option<Vec<Level>>,
}

/// The name of a file without its directory.
pub(super) fn name_of(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

impl Source {
    /// A file of this content.
    pub fn of(path: &Path, bytes: &[u8]) -> Self {
        Self {
            name: name_of(path),
            sha256: sha256_hex(bytes),
            path: path.to_owned(),
            ..Self::default()
        }
    }

    /// Whether our own programs made its frames.
    pub fn is_ours(&self) -> bool {
        let generator = self.generator.as_deref().unwrap_or_default();
        self.is_collected() || generator.starts_with(SIMULATOR)
    }

    /// Whether the numbers of its objects are labels of recordings.
    pub fn is_collected(&self) -> bool {
        let generator = self.generator.as_deref();
        generator.is_some_and(|generator| generator.starts_with(COLLECTOR))
    }

    /// Distance between the sensor's taxels, in mm.
    pub fn pitch(&self) -> f64 {
        self.pitch_mm.unwrap_or(PITCH_MM)
    }
}

/// A pressed object. Numbers of objects may begin anew for each level, or for each material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Object {
    /// The object's number.
    pub number: u32,
    /// Index of its material, if the file has materials.
    pub material: Option<u8>,
    /// Its level; 0 if it is not known.
    pub level: u8,
}

impl Object {
    /// Whether both are one object: they have the same number and material, and not two different
    /// levels. An unlabelled one agrees with every level.
    pub fn is_same_as(&self, other: &Self) -> bool {
        let same_level = self.level == other.level || self.level == 0 || other.level == 0;
        self.number == other.number && self.material == other.material && same_level
    }
}
