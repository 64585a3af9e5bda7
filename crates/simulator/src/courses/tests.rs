use super::super::object::Shapes;
use super::super::settings::{DatasetSettings, Materials};
use super::*;

fn small() -> CourseSettings {
    CourseSettings {
        objects: DatasetSettings {
            seed: 4,
            materials: Materials::Broad,
            shapes: Shapes::Wide,
            objects: 1,
            test_objects: 1,
            presses: 4,
            ..DatasetSettings::default()
        },
        ..CourseSettings::default()
    }
}

#[test]
fn courses_are_whole() {
    let settings = small();
    let made = courses(&settings).into_iter();
    let made: Vec<_> = made.flat_map(|make| make()).collect();
    assert_eq!(made.len(), 8 * 4);
    let made: Vec<LabelledCourse> = made.into_iter().flatten().collect();
    assert!(made.len() >= 8 * 4 - 2, "{} presses begin", made.len());
    for course in &made {
        let frames = course.moments.len();
        let begin = course.moments.iter().position(|m| m.time_s == 0.0).unwrap();
        assert!(begin <= BEFORE && frames - begin <= COURSE_FRAMES.1);
        let area = |place: usize| {
            let taxels = course.moments[place].millinewtons.iter();
            let contact = taxels.filter(|&&taxel| taxel >= 70);
            contact.count()
        };
        assert!(area(begin) >= 3 && (0..begin).all(|place| area(place) < 3));
        assert!((0..frames).all(|place| area(place) <= area(course.best)));
        // The approach is 0 at the begin, and stays within bounds.
        let approach: Vec<f32> = course.moments.iter().map(|m| m.approach_mm).collect();
        assert_eq!(approach[begin], 0.0);
        assert!(
            approach.iter().all(|mm| (-15.0..30.0).contains(mm)),
            "{approach:?}"
        );
        let taxels = course.moments[course.best].millinewtons.iter();
        let read_n = 1e-3 * taxels.map(|&taxel| f64::from(taxel)).sum::<f64>();
        let ratio = read_n / f64::from(course.force_n);
        assert!((0.1..1.6).contains(&ratio), "reads {ratio} of the force");
    }
    // Test presses of the same number are paired over the objects, except those that never
    // begin.
    let motion = |object: u32| {
        let own = made
            .iter()
            .filter(move |course| course.labels.object == object);
        own.map(|course| course.arm_n_per_mm).collect::<Vec<_>>()
    };
    assert_eq!(motion(5), motion(7));
}
