use super::super::object::Shapes;
use super::super::sensor::Design;
use super::super::settings::Materials;
use super::*;
use hardnessd_core::verdict::{self, BUILT_IN, Course, Hrn, ModelFrame};

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

/// The total force that the best frame reads, in newtons.
fn force_read_n(course: &LabelledCourse) -> f64 {
    let taxels = course.moments[course.best].millinewtons.iter();
    1e-3 * taxels.map(|&taxel| f64::from(taxel)).sum::<f64>()
}

#[test]
fn threads_do_not_show_and_courses_are_whole() {
    let settings = small();
    let made = courses(&settings, 2, |_| ());
    assert!(made == courses(&settings, 1, |_| ()), "threads show");
    assert!(made.len() >= 8 * 4 - 2, "{} presses begin", made.len());
    for course in &made {
        let times: Vec<f32> = course.moments.iter().map(|m| m.time_s).collect();
        assert!(times.is_sorted_by(|a, b| a < b), "{times:?}");
        let begin = times.iter().position(|&time_s| time_s == 0.0).unwrap();
        assert!(begin <= BEFORE && times.len() - begin <= COURSE_FRAMES.1);
        let area = |place: usize| {
            let taxels = course.moments[place].millinewtons.iter();
            let contact = taxels.filter(|&&taxel| taxel >= 70);
            contact.count()
        };
        assert!(area(begin) >= 3 && (0..begin).all(|place| area(place) < 3));
        assert!((0..times.len()).all(|place| area(place) <= area(course.best)));
        // The approach is 0 at the begin, and stays within bounds.
        let approach: Vec<f32> = course.moments.iter().map(|m| m.approach_mm).collect();
        assert_eq!(approach[begin], 0.0);
        assert!(
            approach.iter().all(|mm| (-15.0..30.0).contains(mm)),
            "{approach:?}"
        );
        let most = approach.iter().copied().fold(0.0, f32::max);
        assert!(most <= course.speed_mm_s * times.last().unwrap() + 1e-3);
        assert!((3.0..=30.0).contains(&course.arm_n_per_mm));
        let names = crate::material_names(Materials::Broad);
        let is_layered = names[usize::from(course.material)] == "broad-layered";
        assert_eq!(course.layered, is_layered);
        let ratio = force_read_n(course) / f64::from(course.force_n);
        assert!((0.1..1.6).contains(&ratio), "reads {ratio} of the force");
    }
    // Test presses of the same number are paired over the objects, except those that never
    // begin.
    let motion = |object: u32| {
        let own = made.iter().filter(move |course| course.object == object);
        own.map(|course| (course.speed_mm_s, course.frame_rate_hz))
            .collect::<Vec<_>>()
    };
    assert_eq!(motion(5), motion(7));
}

#[test]
fn arrays_of_other_pitches_mostly_agree() {
    for (materials, shapes, least) in [
        (Materials::Named, Shapes::Matched, [0.95, 0.93, 0.78]),
        (Materials::Broad, Shapes::Matched, [0.90, 0.88, 0.75]),
        (Materials::Broad, Shapes::Wide, [0.90, 0.88, 0.72]),
    ] {
        levels_agree(materials, shapes, least);
    }
}

/// Asserts how often the built-in model gives the level of a 3.5 mm array to presses that other
/// arrays read, with the electronics of the JX255N and forces by area: another array of 3.5 mm,
/// one of 1.75 mm and one of 7 mm.
fn levels_agree(materials: Materials, shapes: Shapes, least: [f64; 3]) {
    // The second is another instance of the first: a level near a border changes with the noise.
    const PITCHES_MM: [f64; 4] = [3.5, 3.5, 1.75, 7.0];
    let model = Hrn::load(BUILT_IN).unwrap();
    let settings = CourseSettings {
        objects: DatasetSettings {
            seed: 411,
            materials,
            shapes,
            objects: 0,
            test_objects: 10,
            presses: 6,
            ..DatasetSettings::default()
        },
        ..CourseSettings::default()
    };
    let of = &settings.objects;
    let sensors: Vec<Sensor> = (0_u64..)
        .zip(PITCHES_MM)
        .map(|(k, pitch_mm)| {
            let design = Design::jx255n(of.profile).at_pitch(pitch_mm);
            Sensor::draw(design, &Stream::new(of.seed, "pitches").child(k))
        })
        .collect();
    let mut bench = Bench::default();
    let mut levels = Vec::new();
    for unit in units(of) {
        let subject = Subject::draw(of, unit, 0.0);
        for press in 0..of.presses.into() {
            let mut paired = subject.draws.geometry.child(3).child(press);
            let plan = Plan::draw(&settings, ARM_N_PER_MM, &mut paired);
            let arm_n_per_mm = plan.arm.n_per_mm as f32;
            let read = subject.pressed(&mut bench, &plan, press, |solved, _, noise| {
                let read = |sensor| read_press(sensor, solved, plan.reading, noise);
                sensors.iter().map(read).collect::<Option<Vec<_>>>()
            });
            levels.extend(read.map(|presses| {
                presses
                    .iter()
                    .map(|press| model.judge_course(&course_of(press, arm_n_per_mm)))
                    .map(|verdict| verdict.unwrap().level)
                    .collect::<Vec<_>>()
            }));
        }
    }
    let alike = |sensor: usize| {
        let same = levels.iter().filter(|own| own[sensor] == own[0]);
        same.count() as f64 / levels.len() as f64
    };
    let shares = [alike(1), alike(2), alike(3)];
    println!(
        "{materials:?} materials, {shapes:?} shapes, {} presses: the level of a 3.5 mm array by \
         another one, at 1.75 mm and at 7 mm: {shares:.3?}",
        levels.len()
    );
    assert!(
        shares
            .iter()
            .zip(least)
            .all(|(&share, least)| share > least),
        "{shares:?}"
    );
}

fn course_of(press: &ReadPress, arm_n_per_mm: f32) -> Course {
    let moments = press.moments.iter().filter(|moment| moment.time_s >= 0.0);
    Course {
        moments: moments
            .map(|moment| verdict::Sample {
                time_s: moment.time_s,
                approach_mm: Some(moment.approach_mm),
                frame: ModelFrame {
                    newtons: std::array::from_fn(|k| 1e-3 * f32::from(moment.millinewtons[k])),
                },
            })
            .collect(),
        arm_n_per_mm,
    }
}
