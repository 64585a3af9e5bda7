//! The method `course` on a few presses: it learns and resumes exactly, and the daemon's own code
//! judges whole presses with its file.

use std::path::Path;

use hardnessd_core::verdict::{Checks, Course, Format, Hrn, ReferenceKinds, References};
use hardnessd_simulator::{
    self, CourseSettings, DatasetSettings, LawName, Materials, Shapes, Split,
};
use hrn_train::compare::hertz;
use hrn_train::data::courses::{Courses, single_frames};
use hrn_train::learn::course;
use hrn_train::model::course::course_of;
use serde_json::Value;

use crate::{hrn_train_in, succeed_in};

const SETTINGS: &str = "
    [training]
    epochs = 4
    checkpoint_every_epochs = 1
    batch = 16
    averaging = 0.9
";

/// The standard deviation of the Shore hardness of the test presses: the error of a model that always
/// says their mean.
fn spread_of_shore(courses: &Courses) -> f32 {
    let tests = courses.labelled(Split::Test);
    let truths: Vec<f32> = tests.map(|press| courses.presses[press].shore).collect();
    let mean = truths.iter().sum::<f32>() / truths.len() as f32;
    let squares: f32 = truths.iter().map(|truth| (truth - mean).powi(2)).sum();
    (squares / truths.len() as f32).sqrt()
}

#[test]
fn a_course_model_is_trained_resumed_and_judged_by_the_daemon() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    std::fs::write(at.join("settings.toml"), SETTINGS).unwrap();
    // Half of the 20 objects are enough for sets of levels.
    let held_out = format!("{SETTINGS}\n[validation]\nshare = 0.5\n");
    std::fs::write(at.join("half.toml"), held_out).unwrap();
    let simulate = "simulate --sequences --materials broad --shapes wide --objects 5 --test-objects 2 \
                    --presses 3 --fps 5..20 --seed 3 --out d.npz";
    succeed_in(at, simulate);
    let train = "train --method course --data d.npz --config half.toml --seed 1";
    let message = succeed_in(at, &format!("{train} --out whole"));
    assert!(message.contains("Shore OO"), "{message}");

    // A run without its end and its last checkpoint continues to the same file.
    succeed_in(at, &format!("{train} --out cut"));
    let checkpoints = at.join("cut/checkpoints");
    let mut names: Vec<_> = std::fs::read_dir(&checkpoints)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    names.sort();
    std::fs::remove_file(names.last().unwrap()).unwrap();
    std::fs::remove_file(at.join("cut/hrn.onnx")).unwrap();
    succeed_in(at, &format!("{train} --out cut --resume"));
    let [whole, cut] =
        ["whole", "cut"].map(|run| std::fs::read(at.join(run).join("hrn.onnx")).unwrap());
    assert!(whole == cut, "the resumed run has another model");

    // The daemon's own code loads the file, and the approach changes its verdicts.
    let hrn = Hrn::load(&whole).unwrap();
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    assert_eq!(hrn.card().metrics["not_promised"], Value::Null);
    let courses = Courses::read(&at.join("d.npz")).unwrap();
    let mut course = course_of(&courses, 0);
    // The file says on which presses the model was trained: at 2 to 20 mm/s, 5 to 20 frames/s and
    // with arms of 3 to 30 N/mm.
    let range = hrn.card().range;
    assert!(range.of_presses().iter().all(Option::is_some), "{range:?}");
    assert!(range.speed_mm_s.unwrap()[1] < 25.0 && range.arm_n_per_mm.unwrap()[1] < 45.0);
    let all = (0..courses.presses.len()).map(|press| course_of(&courses, press));
    let held: Vec<_> = all.filter(|course| range.holds(course)).collect();
    assert!(4 * held.len() > 3 * courses.presses.len(), "{range:?}");
    let went = |course: &&Course| course.extents()[3].is_some_and(|[mm, _]| mm > 0.5);
    let seen = held.iter().find(went).unwrap();
    let mut long = seen.clone();
    long.moments.last_mut().unwrap().time_s = 60.0;
    let mut fast = seen.clone();
    for moment in &mut fast.moments {
        moment.approach_mm = moment.approach_mm.map(|mm| 100.0 * mm);
    }
    let mut soft = seen.clone();
    soft.arm_n_per_mm = 0.5;
    for other in [long, fast, soft] {
        assert!(!range.holds(&other), "{other:?}");
    }
    let inspected = succeed_in(at, "inspect whole/hrn.onnx");
    assert!(inspected.contains(" mm/s in training\n"), "{inspected}");
    let known = hrn.judge_course(&course).unwrap();
    assert!(known.shore.is_some() && known.levels.is_some());
    course
        .moments
        .iter_mut()
        .for_each(|moment| moment.approach_mm = None);
    course.arm_n_per_mm = 0.0;
    let uninformed = hrn.judge_course(&course).unwrap();
    assert_ne!(known.probabilities, uninformed.probabilities);

    let json = succeed_in(at, "evaluate --model whole/hrn.onnx --data d.npz --json");
    let evaluation: Value = serde_json::from_str(&json).unwrap();
    let known: Value =
        serde_json::from_slice(&std::fs::read(at.join("whole/evaluation.json")).unwrap()).unwrap();
    assert_eq!(evaluation["accuracy"], known["accuracy"]);
    let rmse = |evaluation: &Value| evaluation["shore"]["rmse"].as_f64().unwrap() as f32;
    assert!(rmse(&evaluation) < spread_of_shore(&courses), "{json}");
    // A model of one frame judges each press's best frame of the same file.
    let json = succeed_in(
        at,
        "evaluate --model ../../models/hrn.onnx --data d.npz --json"
            .replace("../..", concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
            .as_str(),
    );
    let evaluation: Value = serde_json::from_str(&json).unwrap();
    assert!(rmse(&evaluation) < spread_of_shore(&courses), "{json}");
    assert_eq!(evaluation["sets"], Value::Null);
    assert_eq!(evaluation["n"], known["n"]);

    compare(at, &known);
}

/// Compares a model of whole presses, one of a frame, and the controls on the same presses, and
/// checks the tables.
fn compare(at: &Path, known: &Value) {
    let models = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("models/hrn.onnx");
    let command = format!(
        "compare --course --data d.npz --test d.npz --model whole/hrn.onnx {} --out c",
        models.display()
    );
    let table = succeed_in(at, &command);
    let json = std::fs::read(at.join("c/course.json")).unwrap();
    let rows: Vec<Value> = serde_json::from_slice(&json).unwrap();
    let name = |row: &Value| row["name"].as_str().unwrap().to_owned();
    let names: Vec<String> = rows.iter().map(name).collect();
    assert_eq!(names.len(), 7, "{names:?}");
    assert!(names.iter().all(|name| table.contains(name)), "{table}");
    let set_of = |name: &str| {
        let row = rows.iter().find(|row| row["name"] == name).unwrap();
        row["sets"][0].clone()
    };
    let model = set_of("whole/hrn.onnx");
    assert_eq!(model["levels"]["accuracy"], known["accuracy"]);
    assert_eq!(model["less_first"], Value::Null);
    let less = set_of("Hertz's fit");
    let difference = less["levels"]["accuracy"].as_f64().unwrap()
        - model["levels"]["accuracy"].as_f64().unwrap();
    assert!((less["less_first"]["mean"].as_f64().unwrap() - difference).abs() < 1e-12);
    let page = std::fs::read_to_string(at.join("c/course.html")).unwrap();
    for section in ["accuracy", "curves", "time", "calibration"] {
        assert!(page.contains(&format!("id=\"{section}\"")), "{section}");
    }
    let count = |title: &str| page.matches(&format!("aria-label=\"{title}")).count();
    assert!(count("force against approach, level ") >= 2, "{page}");
    assert_eq!(count("accuracy against time, d"), 1);
    assert_eq!(count("accuracy against force, d"), 1);
    assert_eq!(count("calibration of d"), 1);
    // Most presses have ended after 6.4 s, so most verdicts of that time are final.
    let so_far = model["so_far"]["after"].as_array().unwrap();
    let going_on = |after: &Value| after["going_on"].as_f64().unwrap();
    assert!(
        going_on(&so_far[0]) > 0.9 && going_on(&so_far[6]) < 0.5,
        "{so_far:?}"
    );
    assert!(so_far.is_sorted_by(|a, b| going_on(a) >= going_on(b)));
    // Every press reaches 0.5 N, and fewer reach more.
    let at_force = model["so_far"]["at_force"].as_array().unwrap();
    let reached = |at: &Value| at["reached"].as_f64().unwrap();
    assert!(reached(&at_force[0]) > 0.9, "{at_force:?}");
    assert!(at_force.is_sorted_by(|a, b| reached(a) >= reached(b)));

    for (model, code) in [("missing.onnx", 66), ("d.npz", 78)] {
        let command = format!("compare --course --data d.npz --test d.npz --model {model} --out c");
        assert_eq!(
            hrn_train_in(at, &command).status.code(),
            Some(code),
            "{model}"
        );
    }
    let output = hrn_train_in(at, "compare --course --data d.npz --out c");
    assert_eq!(output.status.code(), Some(2));
    let output = hrn_train_in(at, "compare --data d.npz d.npz --out c");
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_model_that_never_knew_the_arm_states_no_range_of_it() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let unknown = format!("{SETTINGS}\n[reports]\nunknown = 1.0\n");
    std::fs::write(at.join("settings.toml"), unknown).unwrap();
    let simulate = "simulate --sequences --materials broad --objects 3 --test-objects 1 --presses 2 --fps 10 \
                    --speed 8 --arm 10 --seed 4 --out d.npz";
    succeed_in(at, simulate);
    let train = "train --method course --data d.npz --config settings.toml --out one";
    let output = hrn_train_in(at, train);
    assert!(output.status.success(), "{output:?}");
    // Two of the twelve objects are held out: too few for any promise of 90 %.
    let errors = String::from_utf8(output.stderr).unwrap();
    let expected = "held-out objects: found 2, expected at least 9: there are no sets";
    assert!(errors.contains(expected), "{errors}");
    let hrn = Hrn::load(&std::fs::read(at.join("one/hrn.onnx")).unwrap()).unwrap();
    assert_eq!(hrn.card().conformal, None);
    let not_promised = &hrn.card().metrics["not_promised"];
    assert!(not_promised.as_str().unwrap().starts_with(expected));
    let range = hrn.card().range;
    assert!(range.duration_s.is_some() && range.frame_period_s.is_some());
    assert_eq!((range.speed_mm_s, range.arm_n_per_mm), (None, None));
}

#[test]
fn a_method_of_single_frames_learns_from_the_best_frame_of_each_press() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let simulate = "simulate --sequences --materials broad --objects 4 --test-objects 2 --presses 3 --out d.npz";
    succeed_in(at, simulate);
    let courses = Courses::read(&at.join("d.npz")).unwrap();
    let dataset = single_frames(&at.join("d.npz")).unwrap();
    assert_eq!(dataset.samples.len(), courses.presses.len());
    for (sample, press) in dataset.samples.iter().zip(&courses.presses) {
        assert_eq!(sample.frame, courses.frame(press.best as usize));
        let of_press = (press.level, Some(press.object), Some(press.shore));
        assert_eq!((sample.level, sample.object, sample.shore), of_press);
    }
}

#[test]
fn levels_weigh_as_the_network_says_unless_the_settings_do() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    succeed_in(
        at,
        "simulate --sequences --materials broad --shapes matched --objects 5 --test-objects 0 --presses 2 \
         --fps 5..20 --seed 4 --out d.npz",
    );
    for method in ["frame", "course"] {
        let model = |balance: Option<&str>| {
            let line = balance.map(|balance| format!("level_balance = {balance}"));
            let text = format!("[training]\nepochs = 1\n{}", line.unwrap_or_default());
            std::fs::write(at.join("settings.toml"), text).unwrap();
            let out = format!("{method}-{}", balance.unwrap_or("own"));
            succeed_in(
                at,
                &format!("train --method {method} --data d.npz --config settings.toml --out {out}"),
            );
            std::fs::read(at.join(out).join("hrn.onnx")).unwrap()
        };
        let of_the_network = model(None);
        assert!(of_the_network == model(Some("1.0")), "{method} 1.0");
        assert!(of_the_network != model(Some("0.0")), "{method} 0.0");
    }
}

#[test]
fn what_does_not_go_together_is_wrong_usage() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let output = hrn_train_in(at, "compare --data d.npz --out c --methods course");
    assert_eq!(output.status.code(), Some(2));
    let simulate = "simulate --objects 1 --test-objects 1 --presses 2 --out frames.npz";
    succeed_in(at, simulate);
    let output = hrn_train_in(at, "train --method course --data frames.npz --out r");
    assert_eq!(output.status.code(), Some(1));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        errors.contains("has single frames, not whole presses") && errors.lines().count() == 1,
        "{errors}"
    );
}

#[test]
fn a_course_model_takes_the_references_of_each_sensor() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    std::fs::write(at.join("settings.toml"), SETTINGS).unwrap();
    let simulate = "simulate --sequences --sensors broad --materials broad --objects 6 --test-objects 2 \
                    --covers 2 --test-covers 1 --electronics 2 --presses 2 --seed 11 --out d.npz";
    succeed_in(at, simulate);
    succeed_in(
        at,
        "train --method course --data d.npz --config settings.toml --out run",
    );
    let bytes = std::fs::read(at.join("run/hrn.onnx")).unwrap();
    let hrn = Hrn::load(&bytes).unwrap();
    assert_eq!(
        (hrn.card().format.as_str(), hrn.most_references()),
        ("3", 32)
    );
    assert_eq!(hrn.card().range.pitch_mm, Some([2.0, 7.0]));
    let Checks::Courses(checks) = hrn.checks() else {
        panic!("a model of courses has check presses");
    };
    // Half of the check presses were judged with two presses on each piece.
    let identified = checks.presses.iter().filter(|press| press.identified);
    assert_eq!((checks.references.len(), identified.count()), (4, 4));

    // References change a verdict, and come back from a recording's text as they were.
    let press = &checks.presses[0].course;
    let references = hrn.references(&checks.references).unwrap();
    assert_eq!(references.kinds(), ReferenceKinds::Rigid);
    let text = serde_json::to_string(&references).unwrap();
    let read: References = serde_json::from_str(&text).unwrap();
    assert_eq!(read, references);
    let identified = hrn.identified(read).unwrap();
    let [with, without] = [&identified, &hrn].map(|hrn| hrn.judge_course(press).unwrap());
    assert_ne!(with.probabilities, without.probabilities);

    let accuracy = |given: &str| {
        let evaluate = format!("evaluate --model run/hrn.onnx --data d.npz --json {given}");
        let evaluation: Value = serde_json::from_str(&succeed_in(at, &evaluate)).unwrap();
        evaluation["n"].as_u64().unwrap()
    };
    let all = accuracy("");
    assert_eq!(accuracy("--rigid 2"), all);
    // Objects that are references are not judged.
    assert!(accuracy("--labelled 1") < all);
}

#[test]
fn the_committed_model_is_the_one_of_its_card() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("models");
    let hrn = Hrn::load(&std::fs::read(models.join("course.onnx")).unwrap()).unwrap();
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    let card = std::fs::read_to_string(models.join("course.md")).unwrap();
    assert!(card.contains(hrn.sha256()), "{}", hrn.sha256());
}

/// Checks the simulated courses against a law that the simulator does not use: Hertz's, fitted to
/// what a robot would know of a press of a solid.
#[test]
fn the_modulus_that_hertz_finds_in_a_press_is_that_of_the_material() {
    for (shapes, least) in [(Shapes::Matched, 0.9), (Shapes::Wide, 0.85)] {
        let (fits, correlation) = moduli_by_hertz(shapes);
        println!("{shapes:?}: {fits} of 100 presses, correlation {correlation:.3}");
        assert!(
            fits > 80 && correlation > least,
            "{shapes:?}: {fits} {correlation}"
        );
    }
}

/// The number of presses of 100 solids that have a fit, and the correlation of the logarithms of the
/// fitted and the true modulus.
fn moduli_by_hertz(shapes: Shapes) -> (usize, f64) {
    let settings = CourseSettings {
        objects: DatasetSettings {
            seed: 9,
            materials: Materials::Broad,
            laws: vec![LawName::Solid].try_into().unwrap(),
            shapes,
            objects: 25,
            test_objects: 0,
            presses: 1,
            ..DatasetSettings::default()
        },
        frame_rate_hz: [20.0, 20.0],
        ..CourseSettings::default()
    };
    let simulated = hardnessd_simulator::courses(&settings, 2, |_| {});
    let presses = course::presses(&Courses::of(&simulated));
    let pairs: Vec<(f64, f64)> = presses
        .iter()
        .zip(&simulated)
        .filter_map(|(press, made)| {
            let fit = hertz::row(press);
            (fit[0] == 1.0).then(|| (f64::from(fit[1]), f64::from(made.young_mpa.ln())))
        })
        .collect();
    let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / pairs.len() as f64;
    let (x, y) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let sum = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
        pairs.iter().map(|pair| of(pair.0 - x, pair.1 - y)).sum()
    };
    let both = (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt();
    let correlation = sum(&|a, b| a * b) / both;
    (pairs.len(), correlation)
}
