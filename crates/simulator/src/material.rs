//! The eight materials of the paper's Table 1: stiffness, laws, creep, texture.
//!
//! Young's modulus E of levels 2 to 4 follows from the Shore OO hardness by simulating the
//! durometer with the same laws ([`super::durometer`]). This file holds the resulting moduli, and a
//! test repeats the simulation.

use serde::Deserialize;

use super::substance::{Creep, Law, Substance, Texture};
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u8)]
pub enum Split {
    /// Training; 0 in the data set's file.
    #[default]
    Train = 0,
    /// Test; 1 in the data set's file.
    Test = 1,
}

impl Split {
    /// `train` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Test => "test",
        }
    }
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
        if self.index() < 4 {
            Split::Train
        } else {
            Split::Test
        }
    }

    /// The name used in commands and files.
    pub fn name(self) -> &'static str {
        self.properties().name
    }

    /// Index in [`Material::ALL`].
    pub fn index(self) -> u8 {
        self as u8
    }

    pub(super) fn properties(self) -> &'static Properties {
        &PROPERTIES[usize::from(self.index())]
    }
}

/// The properties of a material: a row of the table.
#[derive(Debug)]
pub(super) struct Properties {
    name: &'static str,
    pub(super) shore: Shore,
    /// Young's modulus in MPa, from the durometer, at the lowest, the mean and the highest hardness.
    /// Wood and hard plastic are too hard for the Shore OO scale to tell them apart.
    young_mpa: [f64; 3],
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
#[derive(Debug, Clone, Copy)]
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

const fn shore(mean: f64, sd: f64, low: f64, high: f64) -> Shore {
    Shore {
        mean,
        sd,
        low,
        high,
    }
}

const fn creep(j: f64, tau_s: f64) -> Creep {
    Creep { j, tau_s }
}

const fn foam(exponent: f64, plateau: f64, strain: f64) -> Law {
    Law::Foam {
        exponent,
        plateau,
        strain,
    }
}

/// A texture of these numbers: rms in um, shortest and longest wavelength in mm, Hurst exponent, anisotropy.
const fn texture(numbers: [f64; 5]) -> Texture {
    let [rms_um, shortest_mm, longest_mm, hurst, anisotropy] = numbers;
    Texture {
        rms_um,
        shortest_mm,
        longest_mm,
        hurst,
        anisotropy,
    }
}

/// A row of the table: the name, the hardness with the moduli that belong to it, and the substance.
const fn row(
    name: &'static str,
    (shore, young_mpa): (Shore, [f64; 3]),
    nu: f64,
    law: Law,
    creep: [Creep; 2],
    texture: Texture,
) -> Properties {
    Properties {
        name,
        shore,
        young_mpa,
        substance: Substance {
            nu,
            law,
            creep,
            texture,
        },
    }
}

const PROPERTIES: [Properties; 8] = [
    row(
        "wood",
        (shore(87.0, 1.5, 82.0, 95.0), [600.0; 3]),
        0.35,
        Law::Solid,
        [creep(0.03, 1.0), Creep::NONE],
        texture([55.0, 2.5, 18.0, 0.4, 2.0]),
    ),
    row(
        "rubber",
        (shore(66.0, 1.2, 61.5, 69.5), [0.4673, 0.5870, 0.7126]),
        0.49,
        Law::Solid,
        [creep(0.10, 0.3), creep(0.06, 3.0)],
        texture([35.0, 3.0, 40.0, 0.9, 1.0]),
    ),
    row(
        "plasticine",
        (shore(52.0, 1.0, 51.0, 56.0), [1.1336, 1.1638, 1.3005]),
        0.45,
        Law::Plastic {
            hardness: 1.0 / 12.0,
        },
        [creep(0.10, 0.5), Creep::NONE],
        texture([90.0, 4.0, 30.0, 0.9, 1.0]),
    ),
    row(
        "sponge",
        (shore(32.0, 2.0, 25.0, 40.0), [0.2041, 0.2784, 0.3985]),
        0.10,
        foam(2.5, 0.12, 0.50),
        [creep(0.12, 0.3), creep(0.08, 3.0)],
        texture([160.0, 2.0, 10.0, 0.5, 1.0]),
    ),
    row(
        "hard-plastic",
        (shore(88.0, 1.5, 82.0, 95.0), [2200.0; 3]),
        0.38,
        Law::Solid,
        [creep(0.03, 1.0), Creep::NONE],
        texture([55.0, 4.0, 22.0, 0.6, 1.0]),
    ),
    row(
        "foam",
        (shore(63.0, 1.2, 61.2, 67.0), [0.6990, 0.7628, 0.9340]),
        0.25,
        foam(2.5, 0.35, 0.35),
        [creep(0.12, 0.3), creep(0.06, 3.0)],
        texture([50.0, 3.0, 30.0, 0.7, 1.0]),
    ),
    row(
        "soft-candy",
        (shore(55.0, 1.2, 51.5, 59.0), [0.3417, 0.3971, 0.4757]),
        0.48,
        Law::Solid,
        [creep(0.30, 0.2), creep(0.30, 2.0)],
        texture([80.0, 5.0, 30.0, 0.9, 1.0]),
    ),
    row(
        "yoga-mat",
        (shore(38.0, 2.0, 32.0, 44.0), [0.2464, 0.3179, 0.4121]),
        0.15,
        foam(2.0, 0.15, 0.42),
        [creep(0.12, 0.3), creep(0.06, 3.0)],
        texture([110.0, 3.0, 8.0, 0.5, 1.0]),
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_and_splits_are_those_of_the_papers_table_1() {
        let levels = Material::ALL.map(Material::level);
        assert_eq!(levels, [1, 2, 3, 4, 1, 2, 3, 4]);
        assert_eq!(Material::Sponge.split(), Split::Train);
        assert_eq!(Material::HardPlastic.split(), Split::Test);
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
