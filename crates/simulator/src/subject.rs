//! The subjects of presses: objects with their bodies, the sensors they are pressed on, and the
//! streams that all of these are drawn from.
//!
//! An object's draws follow from the seed, its kind and its number. So all data sets of a seed
//! contain the same objects, whatever the number of objects.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::broad;
use super::level::LEVELS;
use super::material::{Body, Material, Split};
use super::object::{self, Object, Shapes};
use super::sensor::Sensor;
use super::settings::{DatasetSettings, Materials};
use crate::random::Stream;

/// The number of groups of broad objects. It equals the number of levels, so that named and broad
/// materials make equally many samples.
const GROUPS: u8 = LEVELS.len() as u8;
/// The number of sensors that each split's objects are distributed over.
const SENSORS: u32 = 8;

/// One object of a data set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unit {
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
    let units = kinds.into_iter().flat_map(|(material, kind, split)| {
        let count = match split {
            Split::Train => settings.objects,
            Split::Test => settings.test_objects,
        };
        (0..count).map(move |number| Unit {
            material,
            kind,
            split,
            number,
        })
    });
    units.collect()
}

/// Runs `work` on each unit and its index, on `threads` threads. The results are in the order of
/// the units, whichever thread makes them.
pub(super) fn shared_out<U: Sync, B, T: Send>(
    units: &[U],
    threads: usize,
    bench: impl Fn() -> B + Sync,
    work: impl Fn(&mut B, u32, &U) -> Vec<T> + Sync,
) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let take = || {
        let index = next.fetch_add(1, Ordering::Relaxed);
        Some((index as u32, units.get(index)?))
    };
    let share = || {
        let (mut bench, mut made) = (bench(), Vec::new());
        while let Some((index, unit)) = take() {
            made.push((index, work(&mut bench, index, unit)));
        }
        made
    };
    let mut parts: Vec<(u32, Vec<T>)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(share)).collect();
        let shares = threads.into_iter().map(std::thread::ScopedJoinHandle::join);
        shares
            .flat_map(|share| share.expect("no work panics"))
            .collect()
    });
    parts.sort_by_key(|&(index, _)| index);
    parts.into_iter().flat_map(|(_, made)| made).collect()
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
    let geometry = if is_paired {
        Material::ALL.len() as u64
    } else {
        unit.kind.into()
    };
    let root = Stream::new(settings.seed, split).child(unit.number.into());
    [
        root.child(0).child(geometry),
        root.child(1).child(unit.kind.into()),
    ]
}

/// An object with its material, the sensor it is pressed on, and its streams.
pub(super) struct Subject {
    pub(super) split: Split,
    pub(super) body: Body,
    pub(super) object: Object,
    pub(super) sensor: Sensor,
    pub(super) geometry: Stream,
    pub(super) draws: Stream,
}

impl Subject {
    /// Draws a subject. A share of the objects has flat faces, whatever the shapes of the others.
    pub(super) fn draw(settings: &DatasetSettings, unit: &Unit, flat_share: f64) -> Self {
        let [geometry, draws] = streams(settings, unit);
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
            split: unit.split,
            object,
            body,
            sensor: Sensor::new(settings.profile, &of_sensor),
            geometry,
            draws,
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
