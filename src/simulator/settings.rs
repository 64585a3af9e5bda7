//! What a simulated data set can be told.

use serde::{Deserialize, Serialize};

use super::broad::Laws;
use super::level::Borders;
use super::material::{Material, Split};
use super::object::Shapes;
use super::press::COVER_YOUNG_MPA;
use super::sensor::SensorProfile;

/// Which materials the objects are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Materials {
    /// The eight of the paper's Table 1.
    Named,
    /// Each object of a material of its own.
    Broad,
}

impl std::str::FromStr for Materials {
    type Err = UnknownMaterials;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        match name {
            "named" => Ok(Materials::Named),
            "broad" => Ok(Materials::Broad),
            _ => Err(UnknownMaterials(name.to_owned())),
        }
    }
}

/// A name that is no set of materials.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no materials \"{0}\"; there are named, broad")]
pub struct UnknownMaterials(pub String);

/// What to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DatasetSettings {
    /// Everything random follows from it.
    pub seed: u64,
    /// Which materials the objects are of.
    pub materials: Materials,
    /// Laws of which broad materials are drawn.
    pub laws: Laws,
    /// Whether broad materials avoid the levels' borders.
    pub borders: Borders,
    /// Objects of each training material; of broad materials four times as many, each of its own.
    pub objects: u32,
    /// Objects of each test material; of broad materials four times as many.
    pub test_objects: u32,
    /// Whether all eight named materials are for test.
    pub all_test: bool,
    /// Presses of each object. Of all postures each under all nominal forces are 48; fewer are some
    /// of those, of different postures and forces.
    pub presses: u32,
    /// The least of the eight nominal forces; the greatest is 25 N (paper).
    pub lowest_force_n: f32,
    /// Distribution of shapes.
    pub shapes: Shapes,
    /// Spread of the sensors.
    pub profile: SensorProfile,
    /// Of the sensors' gains, thresholds and dead taxels; `None`: `seed`.
    pub sensor_seed: Option<u64>,
    /// Whether all presses, of both splits, are on one sensor.
    pub one_sensor: bool,
    /// Young's modulus of the sensors' cover, MPa.
    pub cover_young_mpa: f64,
    /// Levels, from 1, whose two materials change roles: the paper's test material trains.
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
            swapped_levels: [false; 4],
        }
    }
}

impl DatasetSettings {
    /// What a material is for: the paper's split, or the other one where its level is swapped. An
    /// object's draws follow from the seed, its split, material and number, so that the same
    /// objects stand in every data set of a seed in which their material has the same role.
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
