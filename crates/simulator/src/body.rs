//! The material of one object, with its hardness and level, which are its labels.

use super::material::Material;
use super::substance::{Substance, Texture};
use super::texture::Patch;
use crate::random::Stream;

/// The material of one object.
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

/// Draws the roughness of one posture's face.
pub(super) fn draw_patch(texture: &Texture, roughness: f64, stream: &mut Stream) -> Patch {
    let factor = roughness * (0.35 * stream.normal()).exp();
    Patch::new(texture, factor, super::press::CELL_MM, stream)
}
