//! The settings of a simulated data set.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::broad::Laws;
use super::level::Borders;
use super::material::{Material, Split};
use super::object::Shapes;
use super::press::COVER_YOUNG_MPA;
use super::sensor::SensorProfile;

/// The materials of the objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Materials {
    /// The eight materials of the paper's Table 1.
    Named,
    /// Each object has a material of its own.
    Broad,
}

/// The settings of a simulated data set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DatasetSettings {
    /// The seed of everything random.
    pub seed: u64,
    /// The materials of the objects.
    pub materials: Materials,
    /// The laws that broad materials are drawn from.
    pub laws: Laws,
    /// Whether broad materials avoid the levels' borders.
    pub borders: Borders,
    /// The number of objects of each training material. Broad materials have four times as many
    /// objects, each of a material of its own.
    pub objects: u32,
    /// The number of objects of each test material. Broad materials have four times as many
    /// objects.
    pub test_objects: u32,
    /// Whether all eight named materials are test materials.
    pub all_test: bool,
    /// The number of presses of each object. All postures under all nominal forces are 48 presses.
    /// Fewer presses are a part of those, spread over postures and forces.
    pub presses: u32,
    /// The least of the eight nominal forces. The greatest is 25 N (paper).
    pub lowest_force_n: f32,
    /// Distribution of shapes.
    pub shapes: Shapes,
    /// Spread of the sensors.
    pub profile: SensorProfile,
    /// The seed of the sensors' gains, thresholds and dead taxels. `None` takes `seed`.
    pub sensor_seed: Option<u64>,
    /// Whether all presses of both splits are on one sensor.
    pub one_sensor: bool,
    /// Young's modulus of the sensors' cover, MPa.
    pub cover_young_mpa: f64,
    /// Whether the sensors are calibrated with weights: a count is then worth what makes the mean sum
    /// the force, and not 0.04 N.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub calibrated: bool,
    /// Whether the two materials of each level swap roles, from level 1. The paper's test material
    /// then trains.
    pub swapped_levels: [bool; 4],
}

impl Default for DatasetSettings {
    /// The paper's data set: 10,000 + 1,000 samples.
    fn default() -> Self {
        Self {
            seed: 0,
            materials: Materials::Named,
            laws: Laws::default(),
            borders: Borders::Touching,
            objects: 50,
            test_objects: 5,
            all_test: false,
            presses: 50,
            lowest_force_n: 1.0,
            shapes: Shapes::Matched,
            profile: SensorProfile::Clean,
            sensor_seed: None,
            one_sensor: false,
            cover_young_mpa: COVER_YOUNG_MPA,
            calibrated: false,
            swapped_levels: [false; 4],
        }
    }
}

impl DatasetSettings {
    /// The most objects of a material, and the most presses of an object.
    pub const MOST: u32 = 10_000;

    /// The range of the least nominal force, N.
    pub const LOWEST_FORCES_N: RangeInclusive<f32> = 0.01..=25.0;

    /// The range of the cover's Young's modulus, MPa: from that of a gel to that of a hard plastic.
    pub const COVERS_MPA: RangeInclusive<f64> = 0.05..=100.0;

    /// Whether the numbers of objects and presses, the least force and the cover lie within their
    /// ranges.
    pub fn is_possible(&self) -> bool {
        self.objects.max(self.test_objects) <= Self::MOST
            && (1..=Self::MOST).contains(&self.presses)
            && Self::LOWEST_FORCES_N.contains(&self.lowest_force_n)
            && Self::COVERS_MPA.contains(&self.cover_young_mpa)
    }

    /// The split of a material: the paper's, or the other one if the material's level is swapped.
    /// An object's draws follow from the seed and the object's split, material and number. So all
    /// data sets of a seed contain the same objects of a material if it has the same role.
    pub fn split(&self, material: Material) -> Split {
        if self.all_test {
            return Split::Test;
        }
        let swapped = self.swapped_levels[usize::from(material.level()) - 1];
        match (material.split(), swapped) {
            (Split::Train, false) | (Split::Test, true) => Split::Train,
            (Split::Test, false) | (Split::Train, true) => Split::Test,
        }
    }
}
