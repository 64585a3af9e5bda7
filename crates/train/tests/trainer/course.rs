//! The method `course` on a few presses: it learns, and the daemon's own code
//! judges whole presses with its file.

use std::path::Path;

use hardnessd_core::verdict::{BUILT_IN_HRN, Checks, Format, Model, References};
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Presses, read_one};
use prost::Message as _;
use serde_json::Value;

use crate::{errors, hrn_train_in, json_in, succeed_in};

const SETTINGS: &str = "
    [training]
    epochs = 4
    batch = 16
    averaging = 0.9
";

/// The standard deviation of the Shore hardness of the test presses: the error of a model that always
/// says their mean.
fn spread_of_shore(presses: &Presses) -> f32 {
    let tests = presses.labelled(Split::Test);
    let truths: Vec<f32> = tests
        .map(|press| presses.all[press].shore.unwrap())
        .collect();
    let mean = truths.iter().sum::<f32>() / truths.len() as f32;
    let squares: f32 = truths.iter().map(|truth| (truth - mean).powi(2)).sum();
    (squares / truths.len() as f32).sqrt()
}

#[test]
fn a_course_model_is_trained_and_judged_by_the_daemon() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    // Half of the 20 objects are enough for sets of levels.
    let held_out = format!("held_out = 0.5\n{SETTINGS}\n[reports]\nstretched = 0.0\n");
    std::fs::write(at.join("half.toml"), held_out).unwrap();
    std::fs::write(at.join("slow.toml"), "frame_rate_hz = [5, 20]\n").unwrap();
    let simulate = "simulate --sequences --materials broad --shapes wide --objects 5 --test-objects 2 \
                    --presses 3 --config slow.toml --seed 3 --out d.npz";
    succeed_in(at, simulate);
    let train = "train --method course --data d.npz --config half.toml --seed 1";
    let message = succeed_in(at, &format!("{train} --out whole"));
    assert!(message.contains("Shore OO"), "{message}");

    let whole = std::fs::read(at.join("whole/hrn.onnx")).unwrap();

    // The daemon's own code loads the file, and the approach changes its verdicts.
    let hrn = Model::load(&whole).unwrap();
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    assert_eq!(hrn.card().metrics["not_promised"], Value::Null);
    let presses = read_one(&at.join("d.npz")).unwrap();
    let mut course = presses.course(0);
    succeed_in(at, "inspect whole/hrn.onnx");
    let known = hrn.judge_course(&course).unwrap();
    assert!(known.shore.is_some() && known.levels.is_some());
    course
        .moments
        .iter_mut()
        .for_each(|moment| moment.approach_mm = None);
    course.arm_n_per_mm = 0.0;
    let uninformed = hrn.judge_course(&course).unwrap();
    assert_ne!(known.probabilities, uninformed.probabilities);

    let evaluation = json_in(at, "evaluate --model whole/hrn.onnx --data d.npz --json");
    let known: Value =
        serde_json::from_slice(&std::fs::read(at.join("whole/evaluation.json")).unwrap()).unwrap();
    assert_eq!(evaluation["accuracy"], known["accuracy"]);
    let rmse = |evaluation: &Value| evaluation["shore"]["rmse"].as_f64().unwrap() as f32;
    assert!(rmse(&evaluation) < spread_of_shore(&presses));
    // A model of one frame judges each press's best frame of the same file.
    std::fs::write(at.join("m.onnx"), BUILT_IN_HRN).unwrap();
    let evaluation = json_in(at, "evaluate --model m.onnx --data d.npz --json");
    assert!(rmse(&evaluation) < spread_of_shore(&presses));
    assert_eq!(evaluation["sets"], Value::Null);
    assert_eq!(evaluation["n"], known["n"]);

    // The data have no references: neither its figures nor its graph know of presses that it never saw.
    assert_eq!(hrn.most_references(), 0);
    let evaluate = "evaluate --model whole/hrn.onnx --data d.npz";
    let given = succeed_in(at, &format!("{evaluate} --rigid 2"));
    assert_eq!(given, succeed_in(at, evaluate));
    let model = tract_onnx::pb::ModelProto::decode(&*whole).unwrap();
    let inputs = model.graph.unwrap().input.into_iter();
    let names: Vec<String> = inputs.map(|input| input.name).collect();
    assert_eq!(names, ["features"]);
}

#[test]
fn a_course_model_takes_the_references_of_each_sensor() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    std::fs::write(at.join("settings.toml"), SETTINGS).unwrap();
    let sensors = "[sensors]\ncovers = 2\ntest_covers = 1\nelectronics = 2\n";
    std::fs::write(at.join("few.toml"), sensors).unwrap();
    let simulate = "simulate --sequences --sensors broad --materials broad --objects 6 --test-objects 2 \
                    --config few.toml --presses 2 --seed 11 --out d.npz";
    succeed_in(at, simulate);
    let train = "train --method course --data d.npz --config settings.toml --out run";
    let output = hrn_train_in(at, train);
    assert!(output.status.success(), "{output:?}");
    let bytes = std::fs::read(at.join("run/hrn.onnx")).unwrap();
    let hrn = Model::load(&bytes).unwrap();
    // Two covers are too few for any promise of 90 %.
    let expected = "held-out covers: found 2, expected at least 9: there are no sets";
    assert!(errors(&output).contains(expected), "{output:?}");
    assert_eq!(hrn.card().conformal, None);
    let not_promised = &hrn.card().metrics["not_promised"];
    assert!(not_promised.as_str().unwrap().starts_with(expected));
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

    // A training that starts from it and learns nothing judges as it does, and names it among its data.
    let still = format!("{SETTINGS}    weight_decay = 0.0\n    learning_rate = 1e-9\n");
    std::fs::write(at.join("still.toml"), still).unwrap();
    let start = "train --method course --data d.npz --config still.toml --out again --start";
    succeed_in(at, &format!("{start} run/hrn.onnx"));
    let again = Model::load(&std::fs::read(at.join("again/hrn.onnx")).unwrap()).unwrap();
    let judged = |hrn: &Model, press| hrn.judge_course(press).unwrap().probabilities;
    for press in &checks.presses {
        let pairs = judged(&hrn, &press.course)
            .into_iter()
            .zip(judged(&again, &press.course));
        assert!(
            pairs
                .into_iter()
                .all(|(one, other)| (one - other).abs() < 1e-4)
        );
    }
    assert!(
        again.card().data.contains("hrn.onnx"),
        "{}",
        again.card().data
    );
    std::fs::write(at.join("m.onnx"), BUILT_IN_HRN).unwrap();
    let refused = hrn_train_in(at, &format!("{start} m.onnx"));
    let expected = "m.onnx: not a model of the method course";
    assert!(errors(&refused).contains(expected), "{refused:?}");

    // References change a verdict, and come back from a recording's text as they were.
    let press = &checks.presses[0].course;
    let references = hrn.references(&checks.references).unwrap();
    assert_eq!(references.kinds(), "rigid");
    let text = serde_json::to_string(&references).unwrap();
    let read: References = serde_json::from_str(&text).unwrap();
    assert_eq!(read, references);
    let identified = hrn.identified(read).unwrap();
    let [with, without] = [&identified, &hrn].map(|hrn| hrn.judge_course(press).unwrap());
    assert_ne!(with.probabilities, without.probabilities);

    let count = |given: &str| {
        let evaluate = format!("evaluate --model run/hrn.onnx --data d.npz --json {given}");
        json_in(at, &evaluate)["n"].as_u64().unwrap()
    };
    let all = count("");
    assert_eq!(count("--rigid 2"), all);
    // Objects that are references are not judged.
    assert!(count("--labelled 1") < all);
}

#[test]
fn the_committed_model_is_the_one_of_its_card() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("models");
    let hrn = Model::load(&std::fs::read(models.join("course.onnx")).unwrap()).unwrap();
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    let card = std::fs::read_to_string(models.join("course.md")).unwrap();
    assert!(card.contains(hrn.sha256()), "{}", hrn.sha256());
}
