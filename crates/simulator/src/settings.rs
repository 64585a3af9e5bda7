//! The settings of a simulated data set.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::object::Shapes;
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
}

impl Default for DatasetSettings {
    /// The paper's data set: 10,000 + 1,000 samples.
    fn default() -> Self {
        Self {
            seed: 0,
            materials: Materials::Named,
            objects: 50,
            test_objects: 5,
            all_test: false,
            presses: 50,
            lowest_force_n: 1.0,
            shapes: Shapes::Matched,
            profile: SensorProfile::Clean,
        }
    }
}

impl DatasetSettings {
    /// The most objects of a material, and the most presses of an object.
    pub const MOST: u32 = 10_000;

    /// The range of the least nominal force, N.
    pub const LOWEST_FORCES_N: RangeInclusive<f32> = 0.01..=25.0;
}
