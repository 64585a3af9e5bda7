//! `hrn-train compare` on tiny data: the files that it writes, and the runs that it does not repeat.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use serde_json::Value;

use crate::{Desk, data};

const COMPARE: &str = "compare --profile smoke --data tiny.npz";

fn json(path: &str) -> Vec<Value> {
    serde_json::from_slice(&data().read(path)).unwrap()
}

/// The desk of the data, with a comparison that several tests share, `whole`.
fn compared() -> &'static Desk {
    static WHOLE: OnceLock<()> = OnceLock::new();
    WHOLE.get_or_init(|| {
        let of = "--methods hrn100,features --labels 24 --seeds 2 --jobs 2 --out whole";
        let printed = data().succeeds(&format!("{COMPARE} {of}"));
        assert!(printed.starts_with("# Comparison"), "{printed}");
    });
    data()
}

#[test]
fn the_counts_of_objects_add_up_to_the_accuracies() {
    let csv = compared().text("whole/objects.csv");
    let mut lines = csv.lines();
    let head = "run,set,level,object,geometry,right,samples";
    assert_eq!(lines.next(), Some(head));
    let mut sums = BTreeMap::<(&str, &str), [f64; 2]>::new();
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        let [run, set, _, _, geometry, right, samples] = fields[..] else {
            panic!("{line}");
        };
        // Only these objects are pressed alike in all materials.
        assert_eq!(set == "matched", !geometry.is_empty(), "{line}");
        let sum = sums.entry((run, set)).or_default();
        sum[0] += right.parse::<f64>().unwrap();
        sum[1] += samples.parse::<f64>().unwrap();
    }
    for result in json("whole/results.json") {
        for set in ["paper_split", "fresh", "matched"] {
            let [right, samples] = sums[&(result["run"].as_str().unwrap(), set)];
            assert_eq!(result[set]["accuracy"], right / samples, "{set}");
        }
    }
}

#[test]
fn results_have_the_documented_fields_and_agree_with_evaluate() {
    let desk = compared();
    let results = json("whole/results.json");
    let row = |result: &Value| {
        let number = |key: &str| result[key].as_u64().unwrap();
        let method = result["method"].as_str().unwrap().to_owned();
        (method, number("labels"), number("seed"))
    };
    let found: Vec<_> = results.iter().map(row).collect();
    let expected = ["hrn100", "features"].map(|method| {
        let of = |labels, seed| (method.to_owned(), labels, seed);
        [of(160, 1), of(160, 2), of(24, 1), of(24, 2)]
    });
    assert_eq!(found, expected.concat());
    for result in &results {
        assert_eq!(result["profile"], "smoke");
        assert!(result["steps"].as_u64().unwrap() > 0, "{result}");
        assert!(result["seconds"].as_f64().is_some(), "{result}");
        // There are 20 fresh objects a material, with one press each in this profile.
        for (set, samples) in [("paper_split", 40), ("fresh", 80), ("matched", 80)] {
            assert_eq!(result[set]["n"], samples, "{set}");
            // The test split has one object a level, too few for an interval.
            let ends = (set != "paper_split").then_some(2);
            let interval = result[set]["accuracy_interval_by_object"].as_array();
            assert_eq!(interval.map(Vec::len), ends, "{set}");
        }
    }
    let model = "evaluate --json --model whole/runs/hrn100-1/hrn.onnx --data tiny.npz";
    assert_eq!(desk.json(model), results[0]["paper_split"]);
}

#[test]
fn what_is_done_is_not_done_again_and_what_fails_is_named() {
    let desk = data();
    let compare = |of: &str| desk.run(&format!("{COMPARE} {of} --seeds 1 --out again"));
    let two = "--methods features,hrn100";
    // A run of other settings is in the way of one.
    let other = "train --method features --data tiny.npz --profile smoke --seed 7 --out again/runs/hrn100-1";
    desk.succeeds(other);
    std::fs::remove_file(desk.path("again/runs/hrn100-1/hrn.onnx")).unwrap();
    let (code, _, message) = compare(two);
    assert_ne!(code, 0, "{message}");
    for part in ["features-1: done", "hrn100-1: ", "again/logs"] {
        assert!(message.contains(part), "{message}");
    }

    // The other run counts.
    let results = json("again/results.json");
    let runs: Vec<&Value> = results.iter().map(|result| &result["run"]).collect();
    assert_eq!(runs, ["features-1"]);
    let model = desk.path("again/runs/features-1/hrn.onnx");
    let written = || model.metadata().unwrap().modified().unwrap();
    let before = written();
    std::fs::remove_dir_all(desk.path("again/runs/hrn100-1")).unwrap();
    let (code, _, message) = compare(two);
    let is_repeated = message.contains("features-1: begun");
    assert!(code == 0 && !is_repeated, "{message}");
    assert_eq!((written(), json("again/results.json").len()), (before, 2));

    // A comparison of fewer runs keeps the results of the others.
    let (code, _, message) = compare("--methods hrn100");
    assert_eq!((code, &*message), (0, ""));
    assert_eq!(json("again/results.json").len(), 2);
}

#[test]
fn a_plan_has_a_line_for_each_run_that_is_not_done() {
    let of = "--methods features,ours --labels 8 --out planned";
    let desk = data();
    let plan = desk.succeeds(&format!("{COMPARE} {of} --plan"));
    assert!(!desk.path("planned").exists());
    let lines: Vec<&str> = plan.lines().collect();
    assert_eq!(lines.len(), 4, "{plan}");
    let is_run = |line: &&str| line.contains(" hrn-train train --resume");
    assert!(lines.iter().all(is_run), "{plan}");
    // Another program runs a line.
    let line = lines.iter().find(|line| line.contains("features-8-1"));
    let (_, arguments) = line.unwrap().split_once("hrn-train ").unwrap();
    desk.succeeds(arguments);
    let rest = desk.succeeds(&format!("{COMPARE} {of} --plan"));
    assert_eq!(rest.lines().count(), 3, "{rest}");
}
