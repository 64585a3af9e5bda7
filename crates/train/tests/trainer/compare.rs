//! `hrn-train compare` on tiny data: the files that it writes, and the runs that it does not repeat.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::OnceLock;

use serde_json::Value;

use crate::{data, errors, hrn_train_in, json_in, succeed_in};

/// The directory of the data.
fn at() -> &'static Path {
    data().0.path()
}

const COMPARE: &str = "compare --profile smoke --data tiny.npz";

fn compare(more: &str) -> Output {
    hrn_train_in(at(), &format!("{COMPARE} {more}"))
}

fn json(path: &str) -> Vec<Value> {
    serde_json::from_slice(&std::fs::read(at().join(path)).unwrap()).unwrap()
}

/// A comparison that several tests share.
fn whole() -> PathBuf {
    static WHOLE: OnceLock<String> = OnceLock::new();
    WHOLE.get_or_init(|| {
        let of = "--methods hrn100,features --labels 24 --seeds 2 --jobs 2 --out whole";
        let printed = succeed_in(at(), &format!("{COMPARE} {of}"));
        assert!(printed.starts_with("# Comparison"), "{printed}");
        printed
    });
    at().join("whole")
}

#[test]
fn the_counts_of_objects_add_up_to_the_accuracies() {
    let csv = std::fs::read_to_string(whole().join("objects.csv")).unwrap();
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
    whole();
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
    assert_eq!(json_in(at(), model), results[0]["paper_split"]);
}

#[test]
fn tables_stand_beside_the_papers_and_can_be_made_again() {
    let tables = std::fs::read_to_string(whole().join("tables.md")).unwrap();
    let line = |heading: &str| {
        let mut sections = tables.split("\n## ");
        let section = sections.find(|part| part.starts_with(heading)).unwrap();
        let mut lines = section.lines();
        let line = lines.find(|line| line.starts_with("| hrn100, 160 labels |"));
        line.unwrap_or_else(|| panic!("{section}")).to_owned()
    };
    let accuracies = line("Table 2");
    for paper in ["(97.6)", "(94.4)", "(92.4)", "(99.2)", "(95.9)"] {
        assert!(accuracies.contains(paper), "{accuracies}");
    }
    assert!(line("Table 3: kappa").contains("(0.9453)"));
    let confusion = line("Table 3: confusion");
    assert!(confusion.ends_with("| 244 | 5 | 1 | 0 |"), "{confusion}");
    assert!(tables.contains("| features, 24 labels |"), "{tables}");

    // From the results alone, as from an archive.
    std::fs::create_dir(at().join("copy")).unwrap();
    let to = at().join("copy/results.json");
    std::fs::copy(whole().join("results.json"), to).unwrap();
    assert_eq!(succeed_in(at(), "compare --out copy"), tables);
    let none = hrn_train_in(at(), "compare --out nothing");
    assert!(errors(&none).contains("no finished run"), "{none:?}");
}

#[test]
fn what_is_done_is_not_done_again_and_what_fails_is_named() {
    let two = "--methods features,hrn100 --seeds 1 --out again";
    // A run of other settings is in the way of one.
    let other = "train --method features --data tiny.npz --profile smoke --seed 7 --out again/runs/hrn100-1";
    succeed_in(at(), other);
    std::fs::remove_file(at().join("again/runs/hrn100-1/hrn.onnx")).unwrap();
    let first = compare(two);
    let message = errors(&first);
    assert!(!first.status.success(), "{message}");
    assert!(message.contains("features-1: done"), "{message}");
    assert!(message.contains("hrn100-1: "), "{message}");
    assert!(message.contains("again/logs"), "{message}");

    // The other run counts.
    let results = json("again/results.json");
    assert_eq!(
        (results.len(), &results[0]["run"]),
        (1, &"features-1".into())
    );
    let model = at().join("again/runs/features-1/hrn.onnx");
    let written = || model.metadata().unwrap().modified().unwrap();
    let before = written();
    std::fs::remove_dir_all(at().join("again/runs/hrn100-1")).unwrap();
    let second = compare(two);
    assert!(second.status.success(), "{second:?}");
    assert!(!errors(&second).contains("features-1: begun"), "{second:?}");
    assert_eq!((written(), json("again/results.json").len()), (before, 2));

    // A comparison of fewer runs keeps the results of the others.
    let third = compare("--methods hrn100 --seeds 1 --out again");
    assert!(third.status.success(), "{third:?}");
    assert!(errors(&third).is_empty(), "{third:?}");
    assert_eq!(json("again/results.json").len(), 2);
}

#[test]
fn a_plan_has_a_line_for_each_run_that_is_not_done() {
    let of = "--methods features,ours --labels 8 --out planned";
    let plan = succeed_in(at(), &format!("{COMPARE} {of} --plan"));
    assert!(!at().join("planned").exists());
    let lines: Vec<&str> = plan.lines().collect();
    assert_eq!(lines.len(), 4, "{plan}");
    let is_run = |line: &&str| line.contains(" hrn-train train --resume");
    assert!(lines.iter().all(is_run), "{plan}");
    // Another program runs a line.
    let line = lines
        .iter()
        .find(|line| line.contains("features-8-1"))
        .unwrap();
    let (_, arguments) = line.split_once("hrn-train ").unwrap();
    succeed_in(at(), arguments);
    let rest = succeed_in(at(), &format!("{COMPARE} {of} --plan"));
    assert_eq!(rest.lines().count(), 3, "{rest}");
}
