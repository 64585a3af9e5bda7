//! The settings of a simulated data set.

use serde::{Deserialize, Serialize};

use super::object::Shapes;
use super::sensor::{BROAD_PITCHES_MM, SensorProfile};
use hardnessd_core::frame::Pitch;
use hardnessd_core::range::{self, OutOfRange, from_to};
use hardnessd_core::settings;

/// The materials of the objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Materials {
    /// The eight materials of the paper's Table 1.
    Named,
    /// Each object has a material of its own.
    Broad,
}

/// What the sensors of a data set have in common.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SensorDesigns {
    /// Nothing: each is of a design of its own, under a cover of its own.
    #[default]
    Broad,
    /// The simulated JX255N under its usual cover. Its users state the right newtons.
    Jx255n,
}

impl SensorDesigns {
    /// The distances between the taxels of the sensors, in mm.
    pub fn pitches_mm(self) -> [f64; 2] {
        match self {
            Self::Broad => BROAD_PITCHES_MM,
            Self::Jx255n => [Pitch::JX255N.rows_mm; 2],
        }
    }
}

/// The most objects of a material, presses of an object, and sensors: more than fit in any memory, but few enough
/// that all presses can be counted.
const MOST: f64 = 10_000.0;

settings! {
    /// The settings of a simulated data set. By default it is the paper's: 10,000 + 1,000 samples.
    #[derive(Copy)]
    pub struct DatasetSettings {
        /// The seed of everything random.
        pub seed: u64 = 0;
        /// The materials of the objects.
        pub materials: Materials = Materials::Named;
        /// The number of objects of each training material. Broad materials have four times as many
        /// objects, each of a material of its own.
        pub objects: u32 = 50, in from_to((0.0, MOST), "");
        /// The number of objects of each test material. Broad materials have four times as many
        /// objects.
        pub test_objects: u32 = 5, in from_to((0.0, MOST), "");
        /// Whether all eight named materials are test materials.
        pub all_test: bool = false;
        /// The number of presses of each object. All postures under all nominal forces are 48 presses.
        /// Fewer presses are a part of those, spread over postures and forces.
        pub presses: u32 = 50, in from_to((1.0, MOST), "");
        /// The least of the eight nominal forces. The greatest is 25 N (paper).
        pub lowest_force_n: f32 = 1.0, in from_to((0.01, 25.0), "N");
        /// Distribution of shapes.
        pub shapes: Shapes = Shapes::Matched;
        /// Spread of the sensors.
        pub profile: SensorProfile = SensorProfile::Clean;
    }
}

settings! {
    /// The sensors of a data set that has many, each with references. By default these are 1,600 + 160.
    #[derive(Copy)]
    pub struct BroadSensors {
        /// What the sensors have in common.
        pub designs: SensorDesigns = SensorDesigns::Broad;
        /// The number of covers that training objects are pressed on, at most one for each object of a
        /// material.
        pub covers: u32 = 200, in from_to((1.0, MOST), "");
        /// The number of covers for test objects.
        pub test_covers: u32 = 20, in from_to((1.0, MOST), "");
        /// The number of electronics that read the presses on each cover.
        pub electronics: u32 = 8, in from_to((1.0, MOST), "");
    }
}

settings! {
    /// The settings of a simulated data set of presses. By default it has 200 + 20 objects of the named materials in
    /// matched shapes, with 6 presses each.
    #[derive(Copy)]
    pub struct CourseSettings {
        /// Objects, materials, shapes, sensors. `lowest_force_n` is the least force of an arm that
        /// stops by force.
        pub objects: DatasetSettings = DatasetSettings {
            presses: 6,
            ..DatasetSettings::default()
        };
        /// Least and greatest frame rate, drawn log-uniformly.
        pub frame_rate_hz: [f64; 2] = [5.0, 100.0];
        /// The sensors, if each is another one.
        #[serde(skip_serializing_if = "Option::is_none")]
        pub sensors: Option<BroadSensors>;
    }
}

impl CourseSettings {
    /// Checks that each value is in its range.
    ///
    /// # Errors
    ///
    /// Names the first one that is not.
    pub fn check(&self) -> Result<(), OutOfRange> {
        let objects = self.objects.check_ranges();
        objects.map_err(|error| error.within("objects"))?;
        let sensors = self.sensors.as_ref().map(BroadSensors::check_ranges);
        let sensors = sensors.transpose();
        sensors.map_err(|error| error.within("sensors"))?;
        let [least, most] = self.frame_rate_hz;
        let fits = 1.0 <= least && least <= most && most <= 200.0;
        let expected = "1 to 200, ascending";
        range::check("frame_rate_hz", self.frame_rate_hz, fits, expected)
    }
}
