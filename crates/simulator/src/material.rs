//! The eight materials of the paper's Table 1: stiffness, laws, creep, texture.
//!
//! Young's modulus E of levels 2 to 4 follows from the Shore OO hardness by simulating the
//! durometer with the same laws ([`super::durometer`]). `materials.toml` holds the resulting moduli, and a
//! test repeats the simulation.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use super::substance::Substance;
use crate::random::Stream;

/// A reference material (paper, Table 1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Material {
    /// Level 1, training.
    Wood,
    /// Level 2, training.
    Rubber,
    /// Level 3, training.
    Plasticine,
    /// Level 4, training.
    Sponge,
    /// Level 1, test.
    HardPlastic,
    /// Level 2, test.
    Foam,
    /// Level 3, test.
    SoftCandy,
    /// Level 4, test.
    YogaMat,
}

/// The part of a data set that a sample belongs to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u8)]
pub enum Split {
    /// Training; 0 in the data set's file.
    #[default]
    Train = 0,
    /// Test; 1 in the data set's file.
    Test = 1,
}

impl Material {
    /// All eight materials, in the order of their indices.
    pub const ALL: [Material; 8] = [
        Material::Wood,
        Material::Rubber,
        Material::Plasticine,
        Material::Sponge,
        Material::HardPlastic,
        Material::Foam,
        Material::SoftCandy,
        Material::YogaMat,
    ];

    /// Hardness level, 1 (hardest) to 4.
    pub fn level(self) -> u8 {
        self.index() % 4 + 1
    }

    /// The material's split in the paper: training and test use different materials.
    pub fn split(self) -> Split {
        match self.index() {
            0..4 => Split::Train,
            _ => Split::Test,
        }
    }

    /// The name used in commands and files.
    pub fn name(self) -> &'static str {
        &self.properties().name
    }

    /// Index in [`Material::ALL`].
    pub fn index(self) -> u8 {
        self as u8
    }

    pub(super) fn properties(self) -> &'static Properties {
        &PROPERTIES[usize::from(self.index())]
    }
}

/// The properties of a material: a row of `materials.toml`.
#[derive(Debug, Deserialize)]
pub(super) struct Properties {
    name: String,
    pub(super) shore: Shore,
    /// Young's modulus in MPa, from the durometer, at the lowest, the mean and the highest hardness.
    /// Wood and hard plastic are too hard for the Shore OO scale to tell them apart.
    young_mpa: [f64; 3],
    #[serde(flatten)]
    pub(super) substance: Substance,
}

/// The material of one object, with its hardness and level, which are its labels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Body {
    pub(super) substance: Substance,
    pub(super) young_mpa: f64,
    /// Shore OO hardness.
    pub(super) shore: f64,
    /// Hardness level, 1 to 4.
    pub(super) level: u8,
    /// Index in [`super::material_names`].
    pub(super) material: u8,
}

impl Body {
    /// An object of a named material, with a hardness drawn from the material's distribution.
    pub(super) fn named(material: Material, stream: &mut Stream) -> Self {
        let properties = material.properties();
        let shore = properties.shore.draw(stream);
        Self {
            substance: properties.substance,
            young_mpa: properties.young_mpa(shore),
            shore,
            level: material.level(),
            material: material.index(),
        }
    }
}

/// Distribution of the Shore OO hardness over a material's objects.
#[derive(Debug, Clone, Copy, Deserialize)]
pub(super) struct Shore {
    pub(super) mean: f64,
    pub(super) sd: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Shore {
    /// Draws from a normal distribution until the value is within the range.
    pub(super) fn draw(&self, stream: &mut Stream) -> f64 {
        loop {
            let drawn = self.mean + self.sd * stream.normal();
            if (self.low..=self.high).contains(&drawn) {
                return drawn;
            }
        }
    }
}

impl Properties {
    /// Young's modulus in MPa of an object of this Shore OO hardness.
    pub(super) fn young_mpa(&self, shore: f64) -> f64 {
        let at = self.young_mpa.map(f64::ln);
        // ln E is nearly linear in the hardness, so a parabola through three points is enough.
        let Shore {
            mean, low, high, ..
        } = self.shore;
        let basis = |x: f64, y: f64, z: f64| (shore - y) * (shore - z) / ((x - y) * (x - z));
        let ln = at[0] * basis(low, mean, high)
            + at[1] * basis(mean, low, high)
            + at[2] * basis(high, low, mean);
        ln.exp()
    }
}

/// The table of the materials, in the order of [`Material::ALL`].
static PROPERTIES: LazyLock<[Properties; 8]> = LazyLock::new(|| {
    #[derive(Deserialize)]
    struct Table {
        material: [Properties; 8],
    }
    let table = include_str!("../materials.toml");
    toml::from_str::<Table>(table)
        .expect("this crate's own file, which the tests read")
        .material
});

#[cfg(test)]
mod tests {
    use serde::de::IntoDeserializer;
    use serde::de::value::{self, StrDeserializer};

    use super::*;

    #[test]
    fn levels_and_splits_are_those_of_the_papers_table_1() {
        let levels = Material::ALL.map(Material::level);
        assert_eq!(levels, [1, 2, 3, 4, 1, 2, 3, 4]);
        assert_eq!(Material::Sponge.split(), Split::Train);
        assert_eq!(Material::HardPlastic.split(), Split::Test);
    }

    #[test]
    fn rows_have_the_order_of_the_materials() {
        for material in Material::ALL {
            let name: StrDeserializer<'_, value::Error> = material.name().into_deserializer();
            assert_eq!(Material::deserialize(name), Ok(material));
        }
    }

    #[test]
    fn hardness_ranges_stay_inside_their_level() {
        // Table 1: above 70, 61 to 70, 51 to 60, at most 50.
        let bounds = [(70.0, 100.0), (61.0, 70.0), (51.0, 60.0), (0.0, 50.0)];
        for material in Material::ALL {
            let Shore {
                mean, low, high, ..
            } = material.properties().shore;
            let (least, most) = bounds[usize::from(material.level()) - 1];
            assert!(
                least <= low && low < mean && mean < high && high <= most,
                "{material:?}"
            );
        }
    }
}
