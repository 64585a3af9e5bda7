use std::collections::{BTreeMap, BTreeSet};

use super::super::courses;
use super::*;
use crate::settings::Materials;

fn small(shard: u32) -> CourseSettings {
    CourseSettings {
        objects: DatasetSettings {
            seed: 6,
            materials: Materials::Broad,
            objects: 3,
            test_objects: 2,
            presses: 2,
            ..DatasetSettings::default()
        },
        arm_error: 0.15,
        sensors: Some(BroadSensors {
            designs: SensorDesigns::Broad,
            covers: 2,
            test_covers: 9,
            electronics: 3,
            shard,
            shards: 2,
        }),
        ..CourseSettings::default()
    }
}

#[test]
fn shards_have_whole_sensors_with_their_references_and_threads_do_not_show() {
    let shards = [small(0), small(1)];
    let mut sensors = BTreeSet::new();
    let mut total = 0;
    for settings in &shards {
        let most = AtomicUsize::new(0);
        let made = courses(settings, 2, |done| {
            most.fetch_max(done, Ordering::Relaxed);
        });
        assert_eq!(most.into_inner() as u64, settings.presses());
        // Shore hardness of a reference is NaN, which is not equal to itself.
        let labels = |course: &LabelledCourse| (course.sensor, course.object, course.best);
        let again = courses(settings, 1, |_| ());
        assert!(
            made.iter().map(labels).eq(again.iter().map(labels)),
            "threads show"
        );
        let moments = |course: &LabelledCourse| course.moments.clone();
        assert!(
            made.iter().map(moments).eq(again.iter().map(moments)),
            "threads show"
        );
        total += made.len();
        let mut own: BTreeMap<u32, Vec<&LabelledCourse>> = BTreeMap::new();
        for course in &made {
            own.entry(course.sensor).or_default().push(course);
        }
        // A cover of each split, under three electronics each.
        assert_eq!(own.len(), 6);
        let split = |presses: &[&LabelledCourse]| presses[0].split as u8;
        assert_eq!(
            own.values().map(|own| u32::from(split(own))).sum::<u32>(),
            3
        );
        for (sensor, presses) in own {
            assert!(sensors.insert(sensor), "sensor {sensor} is in both");
            assert!(presses.iter().all(|press| press.split == presses[0].split));
            for is_ball in [false, true] {
                let kind = |press: &&&LabelledCourse| match press.reference {
                    Some(Reference::Ball { .. }) => is_ball,
                    Some(Reference::Flat { .. }) => !is_ball,
                    None => false,
                };
                let references: Vec<_> = presses.iter().filter(kind).collect();
                assert!(
                    references.len() >= 2,
                    "sensor {sensor}: {}",
                    references.len()
                );
                let unlabelled = |r: &&&&LabelledCourse| r.level == 0 && r.shore.is_nan();
                assert_eq!(
                    references.iter().filter(unlabelled).count(),
                    references.len()
                );
            }
            assert!(
                presses.iter().any(|press| press.level > 0),
                "sensor {sensor}"
            );
            let arms: BTreeSet<u32> = presses.iter().map(|p| p.arm_n_per_mm.to_bits()).collect();
            assert_eq!(arms.len(), 1, "one arm a sensor");
            let rates: BTreeSet<u32> = presses.iter().map(|p| p.frame_rate_hz.to_bits()).collect();
            assert_eq!(rates.len(), 1, "one rate a sensor");
        }
    }
    let wanted: u64 = shards.iter().map(CourseSettings::presses).sum();
    assert_eq!(wanted, 4 * 3 * 10 + 4 * (3 + 2) * 2 * 3);
    assert!(total as u64 > wanted * 7 / 10, "{total} of {wanted}");
    let materials = shards[0].material_names();
    assert_eq!(materials.last(), Some(&"rigid"));
}

#[test]
fn objects_and_sensors_of_a_split_are_its_own() {
    let made = courses(&small(0), 2, |_| ());
    let of = |split: Split, number: fn(&LabelledCourse) -> u32| -> BTreeSet<u32> {
        let own = made.iter().filter(|course| course.split == split);
        own.map(number).collect()
    };
    for number in [
        (|course| course.object) as fn(&LabelledCourse) -> u32,
        |course| course.sensor,
    ] {
        let (train, test) = (of(Split::Train, number), of(Split::Test, number));
        assert!(!train.is_empty() && !test.is_empty() && train.is_disjoint(&test));
    }
}
