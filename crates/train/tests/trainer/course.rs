//! The method `course` on a few presses: it learns, and the daemon's own code
//! judges whole presses with its file.

use hardnessd_core::verdict::{BUILT_IN_HRN, Checks, Format, Model};
use hardnessd_simulator::Split;
use hrn_train::data::presses::Presses;
use prost::Message as _;
use serde_json::Value;

use crate::{Desk, MODELS};

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
    let desk = Desk::new();
    // Half of the 20 objects are enough for sets of levels.
    let held_out = format!("held_out = 0.5\n{SETTINGS}\n[reports]\nstretched = 0.0\n");
    desk.write("half.toml", held_out);
    desk.write("slow.toml", "frame_rate_hz = [5, 20]\n");
    let simulate = "simulate --sequences --materials broad --shapes wide --objects 5 --test-objects 2 \
                    --presses 3 --config slow.toml --seed 3 --out d.npz";
    desk.succeeds(simulate);
    let train = "train --method course --data d.npz --config half.toml --seed 1 --out whole";
    let message = desk.succeeds(train);
    assert!(message.contains("Shore OO"), "{message}");

    // The daemon's own code loads the file, and the approach changes its verdicts.
    let hrn = desk.model("whole/hrn.onnx");
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    assert!(hrn.card().conformal.is_some());
    assert_eq!(hrn.card().metrics["not_promised"], Value::Null);
    let (presses, meta) = (desk.presses("d.npz"), desk.meta("d.npz"));
    assert_eq!(meta["materials"][11], "broad-layered");
    assert_eq!(meta["levels"][1]["shore"], "60-70");
    let mut courses = (0..presses.all.len()).map(|press| presses.course(press).moments);
    let is_slow = courses.all(|moments| moments[1].time_s - moments[0].time_s > 0.049);
    assert!(is_slow, "the frame rates are those of the file");
    let mut course = presses.course(0);
    desk.succeeds("inspect whole/hrn.onnx");
    let known = hrn.judge_course(&course).unwrap();
    assert!(known.shore.is_some() && known.levels.is_some());
    for moment in &mut course.moments {
        moment.approach_mm = None;
    }
    course.arm_n_per_mm = 0.0;
    let uninformed = hrn.judge_course(&course).unwrap();
    assert_ne!(known.probabilities, uninformed.probabilities);

    let evaluation = desk.json("evaluate --model whole/hrn.onnx --data d.npz --json");
    let known: Value = serde_json::from_slice(&desk.read("whole/evaluation.json")).unwrap();
    assert_eq!(evaluation["accuracy"], known["accuracy"]);
    let rmse = |evaluation: &Value| evaluation["shore"]["rmse"].as_f64().unwrap() as f32;
    assert!(rmse(&evaluation) < spread_of_shore(&presses));
    // A model of one frame judges each press's best frame of the same file.
    desk.write("m.onnx", BUILT_IN_HRN);
    let evaluation = desk.json("evaluate --model m.onnx --data d.npz --json --verdicts v.csv");
    assert!(rmse(&evaluation) < spread_of_shore(&presses));
    let verdicts = desk.text("v.csv").lines().skip(1).count();
    assert_eq!(evaluation["n"], verdicts);
    assert_eq!(evaluation["sets"], Value::Null);
    assert_eq!(evaluation["n"], known["n"]);

    // The data have no references: neither its figures nor its graph know of presses that it never saw.
    assert_eq!(hrn.most_references(), 0);
    let evaluate = "evaluate --model whole/hrn.onnx --data d.npz";
    let given = desk.succeeds(&format!("{evaluate} --rigid 2"));
    assert_eq!(given, desk.succeeds(evaluate));
    let model = tract_onnx::pb::ModelProto::decode(&*desk.read("whole/hrn.onnx")).unwrap();
    let inputs = model.graph.unwrap().input.into_iter();
    let names: Vec<String> = inputs.map(|input| input.name).collect();
    assert_eq!(names, ["features"]);
}

#[test]
fn a_course_model_takes_the_references_of_each_sensor() {
    let desk = Desk::new();
    desk.write("settings.toml", SETTINGS);
    let sensors = "[sensors]\ncovers = 2\ntest_covers = 1\nelectronics = 2\n";
    desk.write("few.toml", sensors);
    let simulate = "simulate --sequences --sensors broad --materials broad --objects 6 --test-objects 2 \
                    --config few.toml --presses 2 --seed 11 --out d.npz";
    desk.succeeds(simulate);
    let train = "train --method course --data d.npz --config settings.toml --out run";
    let (code, _, errors) = desk.run(train);
    assert_eq!(code, 0, "{errors}");
    let hrn = desk.model("run/hrn.onnx");
    // Two covers are too few for any promise of 90 %.
    let expected = "held-out covers: found 2, expected at least 9: there are no sets";
    assert!(errors.contains(expected), "{errors}");
    let not_promised = &hrn.card().metrics["not_promised"];
    assert!(not_promised.as_str().unwrap().starts_with(expected));
    assert_eq!(hrn.card().conformal, None);
    let format = (hrn.card().format.as_str(), hrn.most_references());
    assert_eq!(format, ("3", 32));
    assert_eq!(hrn.card().range.pitch_mm, Some([2.0, 7.0]));
    let Checks::Courses(checks) = hrn.checks() else {
        panic!("a model of courses has check presses");
    };
    // Half of the check presses were judged with two presses on each piece.
    let identified = checks.presses.iter().filter(|press| press.identified);
    assert_eq!((checks.references.len(), identified.count()), (4, 4));

    // A training that starts from it and learns nothing judges as it does, and names it among its data.
    let still = format!("{SETTINGS}    weight_decay = 0.0\n    learning_rate = 1e-9\n");
    desk.write("still.toml", still);
    let start = "train --method course --data d.npz --config still.toml --out again --start";
    desk.succeeds(&format!("{start} run/hrn.onnx"));
    let again = desk.model("again/hrn.onnx");
    for press in &checks.presses {
        let [one, other] = [&hrn, &again].map(|hrn| hrn.judge_course(&press.course).unwrap());
        let mut pairs = one.probabilities.iter().zip(&other.probabilities);
        assert!(pairs.all(|(one, other)| (one - other).abs() < 1e-4));
    }
    let data = &again.card().data;
    assert!(data.contains("hrn.onnx"), "{data}");
    desk.write("m.onnx", BUILT_IN_HRN);
    let expected = "m.onnx: not a model of the method course";
    desk.fails(&format!("{start} m.onnx"), 1, expected);

    let count = |given: &str| {
        let evaluate = format!("evaluate --model run/hrn.onnx --data d.npz --json {given}");
        desk.json(&evaluate)["n"].as_u64().unwrap()
    };
    let all = count("");
    assert_eq!(count("--rigid 2"), all);
    // Objects that are references are not judged.
    assert!(count("--labelled 1") < all);
}

#[test]
fn the_committed_model_is_the_one_of_its_card() {
    let [model, card] = ["onnx", "md"].map(|ending| format!("{MODELS}/course.{ending}"));
    let hrn = Model::load(&std::fs::read(model).unwrap()).unwrap();
    assert_eq!(hrn.format(), Format::Course { most_frames: 48 });
    let card = std::fs::read_to_string(card).unwrap();
    assert!(card.contains(hrn.sha256()), "{}", hrn.sha256());
}
