use std::collections::{BTreeMap, BTreeSet};

use super::super::courses;
use super::*;
use crate::settings::{DatasetSettings, Materials};

#[test]
fn sensors_have_their_references() {
    let settings = CourseSettings {
        objects: DatasetSettings {
            seed: 6,
            materials: Materials::Broad,
            objects: 3,
            test_objects: 2,
            presses: 2,
            ..DatasetSettings::default()
        },
        sensors: Some(BroadSensors {
            designs: SensorDesigns::Broad,
            covers: 2,
            test_covers: 9,
            electronics: 3,
        }),
        ..CourseSettings::default()
    };
    let made = courses(&settings).into_iter();
    let made: Vec<_> = made.flat_map(|make| make()).collect();
    let wanted = made.len();
    assert_eq!(wanted, 4 * 3 * 10 + 4 * (3 + 2) * 2 * 3);
    let made: Vec<LabelledCourse> = made.into_iter().flatten().collect();
    assert!(made.len() > wanted * 7 / 10, "{}", made.len());
    assert_eq!(settings.material_names().last(), Some(&"rigid"));

    let mut sensors: BTreeMap<u32, Vec<&LabelledCourse>> = BTreeMap::new();
    for press in &made {
        sensors.entry(press.sensor).or_default().push(press);
    }
    // Two covers of each split, under three electronics each.
    assert_eq!(sensors.len(), 12);
    for (sensor, presses) in sensors {
        let of_sensor: BTreeSet<_> = presses
            .iter()
            .map(|p| (p.labels.split, p.arm_n_per_mm.to_bits()))
            .collect();
        assert_eq!(of_sensor.len(), 1, "one split and arm a sensor");
        let kinds = presses.iter().map(|press| match press.reference {
            Some(reference) => {
                assert!(press.labels.level == 0 && press.labels.shore.is_nan());
                1 + usize::from(matches!(reference, Piece::Ball { .. }))
            }
            None => 0,
        });
        let mut counts = [0; 3];
        kinds.for_each(|kind| counts[kind] += 1);
        let [objects, flats, balls] = counts;
        assert!(
            objects >= 1 && flats >= 2 && balls >= 2,
            "{sensor}: {counts:?}"
        );
    }
    let objects = |split: Split| -> BTreeSet<u32> {
        let own = made.iter().filter(|press| press.labels.split == split);
        own.map(|press| press.labels.object).collect()
    };
    assert!(objects(Split::Train).is_disjoint(&objects(Split::Test)));
}
