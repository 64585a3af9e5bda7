//! The subjects of presses: objects with their bodies, the sensors they are pressed on, and the
//! streams that all of these are drawn from.
//!
//! An object's draws follow from the seed, its kind and its number. So all data sets of a seed
//! contain the same objects, whatever the number of objects.

use super::broad;
use super::level::LEVELS;
use super::material::{Body, Material, Split};
use super::object::{self, Face, Object, Pose, Shapes};
use super::press::{Specimen, draw_patch};
use super::sensor::{Design, Sensor};
use super::settings::{DatasetSettings, Materials};
use super::texture::Patch;
use crate::random::Stream;

/// The number of groups of broad objects. It equals the number of levels, so that named and broad
/// materials make equally many samples.
const GROUPS: u8 = LEVELS.len() as u8;
/// The number of sensors that each split's objects are distributed over.
const SENSORS: u32 = 8;
/// Factor on the force when a press was too light to begin.
const HARDER: f64 = 1.5;
/// The number of attempts at a press.
const TRIES: usize = 8;

/// The forces at which a press is tried, until a sensor feels it.
pub(super) fn harder_and_harder(force_n: f64) -> impl Iterator<Item = f64> {
    let forces = std::iter::successors(Some(force_n), |force_n| Some(HARDER * force_n));
    forces.take(TRIES)
}

/// What a press is labelled with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Labels {
    /// Hardness level, 1 to 4; 0 for a rigid piece.
    pub level: u8,
    /// Number of the object, unique in the data set.
    pub object: u32,
    /// Index of the material among [`super::material_names`].
    pub material: u8,
    /// The split of the object.
    pub split: Split,
    /// The object's Shore hardness; NaN for a rigid piece.
    pub shore: f32,
}

/// One object of a data set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unit {
    /// Its number, unique in the data set.
    pub(super) object: u32,
    /// Its material; `None` for a broad one.
    material: Option<Material>,
    /// The index of its material, or of its group of broad objects. Test objects of the same number
    /// share their geometry over these.
    kind: u8,
    pub(super) split: Split,
    pub(super) number: u32,
}

/// The objects of a data set, in the order of materials (as in [`Material::ALL`]) or of split and
/// group.
pub(super) fn units(settings: &DatasetSettings) -> Vec<Unit> {
    let named = Material::ALL.map(|material| match settings.all_test {
        true => (Some(material), material.index(), Split::Test),
        false => (Some(material), material.index(), material.split()),
    });
    let groups = |split| (0..GROUPS).map(move |group| (None, group, split));
    let kinds = match settings.materials {
        Materials::Named => named.to_vec(),
        Materials::Broad => groups(Split::Train).chain(groups(Split::Test)).collect(),
    };
    let mut units = Vec::new();
    for (material, kind, split) in kinds {
        let count = match split {
            Split::Train => settings.objects,
            Split::Test => settings.test_objects,
        };
        let objects = units.len() as u32..;
        units.extend(objects.zip(0..count).map(|(object, number)| Unit {
            object,
            material,
            kind,
            split,
            number,
        }));
    }
    units
}

/// The streams of one object: one for its geometry, poses and forces, and one for its material. The first
/// of test objects of the same number does not depend on the material, except for the paper's shapes.
/// This pairs the test objects.
fn streams(settings: &DatasetSettings, unit: &Unit) -> [Stream; 2] {
    let split = match (unit.material, unit.split) {
        (Some(_), Split::Train) => "train",
        (Some(_), Split::Test) => "test",
        (None, Split::Train) => "broad train",
        (None, Split::Test) => "broad test",
    };
    let is_paired = unit.split == Split::Test && settings.shapes != Shapes::Paper;
    let geometry = match is_paired {
        true => Material::ALL.len() as u64,
        false => unit.kind.into(),
    };
    let root = Stream::new(settings.seed, split).child(unit.number.into());
    [
        root.child(0).child(geometry),
        root.child(1).child(unit.kind.into()),
    ]
}

/// An object with its material, the sensor it is pressed on, and its streams.
pub(super) struct Subject {
    unit: Unit,
    body: Body,
    object: Object,
    pub(super) sensor: Sensor,
    pub(super) geometry: Stream,
    pub(super) draws: Stream,
}

impl Subject {
    /// Draws a subject. A share of the objects has flat faces, whatever the shapes of the others.
    pub(super) fn draw(settings: &DatasetSettings, unit: Unit, flat_share: f64) -> Self {
        let [geometry, draws] = streams(settings, &unit);
        let body = broad::body_of(unit.material, &mut draws.child(0));
        // Different stream names keep the splits' sensors apart.
        let sensors = match unit.split {
            Split::Train => "train sensor",
            Split::Test => "test sensor",
        };
        let of_sensor = Stream::new(settings.seed, sensors).child((unit.number % SENSORS).into());
        let object = if geometry.child(4).uniform() < flat_share {
            object::flat(&mut geometry.child(5))
        } else {
            object::draw(settings.shapes, body.level, &mut geometry.child(0))
        };
        Self {
            unit,
            object,
            body,
            sensor: Sensor::draw(Design::jx255n(settings.profile), &of_sensor),
            geometry,
            draws,
        }
    }

    /// The face of a posture, with its roughness.
    pub(super) fn face(&self, posture: usize) -> (Face, Patch) {
        let face = self.object[posture];
        let mut roughness = self.draws.child(1).child(posture as u64);
        let patch = draw_patch(&self.body.substance.texture, face.roughness, &mut roughness);
        (face, patch)
    }

    /// A face in a pose.
    pub(super) fn specimen(&self, (face, patch): &(Face, Patch), pose: &Pose) -> Specimen {
        Specimen::new(self.body.substance, self.body.young_mpa, face, pose, patch)
    }

    pub(super) fn labels(&self) -> Labels {
        Labels {
            level: self.body.level,
            object: self.unit.object,
            material: self.body.material,
            split: self.unit.split,
            shore: self.body.shore as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn test_objects_are_paired_over_materials_but_for_the_papers_shapes() {
        let foam = (Some(Material::Foam), 5);
        let mat = (Some(Material::YogaMat), 7);
        for shapes in [Shapes::Matched, Shapes::Wide, Shapes::Flat, Shapes::Paper] {
            let settings = DatasetSettings {
                shapes,
                ..DatasetSettings::default()
            };
            let draw = |(material, kind), split, number| {
                let unit = Unit {
                    object: 0,
                    material,
                    kind,
                    split,
                    number,
                };
                let stream = &mut streams(&settings, &unit)[0].child(0);
                format!("{:?}", object::draw(shapes, 4, stream))
            };
            for [one, other] in [[foam, mat], [(None, 2), (None, 4)]] {
                let first = draw(one, Split::Test, 1);
                let is_paired = first == draw(other, Split::Test, 1);
                assert_eq!(is_paired, shapes != Shapes::Paper, "{shapes:?}");
                assert_ne!(first, draw(one, Split::Test, 0));
                let train = draw(one, Split::Train, 1);
                assert_ne!(train, draw(other, Split::Train, 1));
            }
        }
    }
}
