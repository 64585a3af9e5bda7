//! The subjects of presses: objects with their bodies, the sensors they are pressed on, and the
//! streams that all of these are drawn from.
//!
//! An object's draws follow from the seed, its kind and its number. So all data sets of a seed
//! contain the same objects, whatever the number of objects.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::broad;
use super::level::LEVELS;
use super::material::{Body, Material, Split};
use super::object::{Object, Shapes};
use super::sensor::Sensor;
use super::settings::{DatasetSettings, Materials};
use crate::random::Stream;

/// The number of groups of broad objects. It equals the number of levels, so that named and broad
/// materials make equally many samples.
const GROUPS: u8 = LEVELS.len() as u8;
/// The number of sensors that each split's objects are distributed over.
const SENSORS: u32 = 8;

/// The kind of an object's material.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    Named(Material),
    /// A broad material. Test objects of the same number share their geometry over these groups.
    Broad(u8),
}

/// One object of a data set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unit {
    origin: Origin,
    pub(super) split: Split,
    pub(super) number: u32,
}

/// The objects of a data set, in the order of materials (as in [`Material::ALL`]) or of split and
/// group.
pub(super) fn units(settings: &DatasetSettings) -> Vec<Unit> {
    let count = |split| match split {
        Split::Train => settings.objects,
        Split::Test => settings.test_objects,
    };
    let of = |origin, split| {
        (0..count(split)).map(move |number| Unit {
            origin,
            split,
            number,
        })
    };
    match settings.materials {
        Materials::Named => Material::ALL
            .into_iter()
            .flat_map(|material| {
                let split = match settings.all_test {
                    true => Split::Test,
                    false => material.split(),
                };
                of(Origin::Named(material), split)
            })
            .collect(),
        Materials::Broad => [Split::Train, Split::Test]
            .into_iter()
            .flat_map(|split| (0..GROUPS).map(move |group| (Origin::Broad(group), split)))
            .flat_map(|(origin, split)| of(origin, split))
            .collect(),
    }
}

/// Runs `work` on each unit and its index, on `threads` threads. The results are in the order of
/// the units, whichever thread makes them.
pub(super) fn shared_out<U: Copy + Sync, B, T: Send>(
    units: &[U],
    threads: usize,
    bench: impl Fn() -> B + Sync,
    work: impl Fn(&mut B, u32, U) -> Vec<T> + Sync,
) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let parts: Mutex<Vec<Vec<T>>> = Mutex::new(units.iter().map(|_| Vec::new()).collect());
    std::thread::scope(|scope| {
        for _ in 0..threads.max(1) {
            scope.spawn(|| {
                let mut bench = bench();
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(&unit) = units.get(index) else {
                        break;
                    };
                    let made = work(&mut bench, index as u32, unit);
                    parts
                        .lock()
                        .expect("no thread panics while it holds the lock")[index] = made;
                }
            });
        }
    });
    let parts = parts
        .into_inner()
        .expect("no thread panics while it holds the lock");
    parts.into_iter().flatten().collect()
}

/// The streams of one object: one for its geometry, poses and forces, and one for its material.
pub(super) struct Draws {
    pub(super) geometry: Stream,
    pub(super) body: Stream,
}

impl Draws {
    /// The streams of a unit. Geometry, poses and forces of test objects of the same number do not
    /// depend on the material, except for the paper's shapes. This pairs the test objects.
    fn new(settings: &DatasetSettings, unit: Unit) -> Self {
        let (own, [train, test]) = match unit.origin {
            Origin::Named(material) => (material.index(), ["train", "test"]),
            Origin::Broad(group) => (group, ["broad train", "broad test"]),
        };
        let is_paired = unit.split == Split::Test && settings.shapes != Shapes::Paper;
        let geometry = if is_paired {
            Material::ALL.len() as u64
        } else {
            own.into()
        };
        let split = match unit.split {
            Split::Train => train,
            Split::Test => test,
        };
        let root = Stream::new(settings.seed, split).child(u64::from(unit.number));
        Self {
            geometry: root.child(0).child(geometry),
            body: root.child(1).child(own.into()),
        }
    }
}

/// An object with its material and the sensor it is pressed on.
pub(super) struct Subject {
    pub(super) split: Split,
    pub(super) body: Body,
    pub(super) object: Object,
    pub(super) sensor: Sensor,
    pub(super) draws: Draws,
}

impl Subject {
    /// Draws a subject. A share of the objects has flat faces, whatever the shapes of the others.
    pub(super) fn draw(settings: &DatasetSettings, unit: Unit, flat_share: f64) -> Self {
        let draws = Draws::new(settings, unit);
        let mut hardness = draws.body.child(0);
        let body = match unit.origin {
            Origin::Named(material) => Body::named(material, &mut hardness),
            Origin::Broad(_) => broad::draw(settings.borders, &mut hardness),
        };
        // Different stream names keep the splits' sensors apart.
        let sensors = match unit.split {
            Split::Train => "train sensor",
            Split::Test => "test sensor",
        };
        let of_sensor = Stream::new(settings.seed, sensors).child((unit.number % SENSORS).into());
        let object = if draws.geometry.child(4).uniform() < flat_share {
            Object::flat(&mut draws.geometry.child(5))
        } else {
            Object::draw(settings.shapes, body.level, &mut draws.geometry.child(0))
        };
        Self {
            split: unit.split,
            object,
            body,
            sensor: Sensor::new(settings.profile, &of_sensor),
            draws,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn test_objects_are_paired_over_materials_but_for_the_papers_shapes() {
        let foam = Origin::Named(Material::Foam);
        let mat = Origin::Named(Material::YogaMat);
        for shapes in [Shapes::Matched, Shapes::Wide, Shapes::Flat, Shapes::Paper] {
            let settings = DatasetSettings {
                shapes,
                ..DatasetSettings::default()
            };
            let draw = |origin, split, number| {
                let unit = Unit {
                    origin,
                    split,
                    number,
                };
                let stream = &mut Draws::new(&settings, unit).geometry.child(0);
                format!("{:?}", Object::draw(shapes, 4, stream))
            };
            for [one, other] in [[foam, mat], [Origin::Broad(2), Origin::Broad(4)]] {
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
