//! References: made of recordings and of presses that are made now, judged with, and recorded.

use std::fs;

use crate::bench::{Bench, HRN, sensor};
use serde_json::{Value, json};

const IDENTIFY: &str = "identify --config hardnessd.toml --out r.npz";

fn forearm() -> String {
    sensor("forearm", "port", 20)
}

/// A bench with raw bytes of two presses on wood, and configurations without and with references.
fn bench() -> Bench {
    let bench = Bench::new();
    bench.write("plain.toml", forearm());
    let identified = format!("{}references = \"r.npz\"\n", forearm());
    bench.write("hardnessd.toml", &identified);
    // The paper's network takes no references.
    bench.write("hrn.toml", identified + "[model]\nbuilt_in = \"hrn\"\n");
    bench.succeeds("simulate --fps 20 --presses 2 --material wood --seed 3 --to wood.bin");
    bench
}

fn has_note(event: &Value, note: &str) -> bool {
    event["notes"].as_array().unwrap().contains(&json!(note))
}

#[test]
fn references_of_raw_bytes_are_judged_with_and_change_verdicts() {
    let bench = bench();
    let text = bench.succeeds(&format!("{IDENTIFY} --as unknown wood.bin"));
    assert!(text.contains("unknown presses left out 2"), "{text}");
    let alike = &bench.finals("wood.bin --config hardnessd.toml")[0];
    assert!(alike["references"] == "none" && has_note(alike, "references_ignored"));
    fs::remove_file(bench.path("r.npz")).unwrap();
    let text = bench.succeeds(&format!("{IDENTIFY} --as level:1 wood.bin"));
    for part in ["known hardness 2", "references = \"r.npz\""] {
        assert!(text.contains(part), "{text}");
    }
    let without = bench.finals("wood.bin --config plain.toml");
    let with = bench.finals("wood.bin --config hardnessd.toml");
    assert_eq!((without.len(), with.len()), (2, 2));
    for (without, with) in without.iter().zip(&with) {
        assert_eq!(without["references"], "none");
        assert_eq!(with["references"], "labelled");
        assert!(has_note(without, "not_identified") && !has_note(with, "not_identified"));
        assert_ne!(without["probabilities"], with["probabilities"]);
    }
    let of_hrn = bench.finals("wood.bin --config hrn.toml");
    assert_eq!(of_hrn[0]["references"], "none");
    assert_eq!(of_hrn[0]["notes"], json!([]));

    // Rigid pieces beside the objects, with positions of the arm.
    let way = (0..200).map(|n| format!("{},{}\n", 0.05 * f64::from(n), 0.1 * f64::from(n)));
    bench.write(
        "m.csv",
        format!("time_s,approach_mm\n{}", way.collect::<String>()),
    );
    let text = bench.succeeds(&format!(
        "{IDENTIFY} --append --as flat:20 --motion m.csv wood.bin"
    ));
    for part in [
        "rigid flat piece 2, rigid ball 0, known hardness 2",
        "without the arm's approach 2:",
    ] {
        assert!(text.contains(part), "{text}");
    }
    let with = bench.finals("wood.bin --config hardnessd.toml");
    assert_eq!(with[0]["references"], "rigid+labelled");
}

#[test]
fn what_cannot_be_a_reference_is_refused_in_one_line() {
    let bench = bench();
    bench.succeeds("identify --config plain.toml --out r.npz --as ball:10 wood.bin");
    let before = fs::read(bench.path("r.npz")).unwrap();
    bench.write("text.npz", "no references");
    bench.write("still.bin", [0; 10]);
    // The directory is missed before anything is pressed, and here before the sensor is.
    bench.fails_each(
        "
        identify --config plain.toml --out r.npz --as ball:10 wood.bin | 74 | r.npz exists already
        identify --config plain.toml --out r.npz --append --as flat:20 wood.bin | 1 | r.npz would have presses twice
        identify --config plain.toml --out twice.npz --as flat:20 wood.bin wood.bin | 1 | twice.npz would have presses twice
        identify --config plain.toml --out n.npz --as flat:20 /dev/zero | 1 | /dev/zero: found a device
        identify --config plain.toml --out text.npz --append --as ball:10 wood.bin | 1 | text.npz: found no .npz file
        identify --config plain.toml --out n.npz wood.bin | 1 | wood.bin: found no label `reference`, `shore` or `level`
        identify --config plain.toml --out n.npz --as level:5 wood.bin | 2 | level:N with 1 to 4
        identify --config plain.toml --out n.npz --as flat:20 still.bin | 1 | still.bin: no whole frame
        identify --config plain.toml --out n.npz | 2 | --as: found nothing
        identify --config plain.toml --out no/where.npz --as flat:20 | 74 | no/where.npz: the directory no does not exist",
    );
    assert_eq!(fs::read(bench.path("r.npz")).unwrap(), before);
    assert!(!bench.path("n.npz").exists());

    // The daemon says which file and why.
    bench.write("r.npz", "no references");
    let parts = ["sensor.references of \"forearm\"", "no .npz file"];
    bench.fails("check --config hardnessd.toml", 78, &parts);
}

#[test]
fn levels_of_ones_own_replace_those_of_the_model() {
    let bench = bench();
    let level =
        |label: &str, shore: &str| format!("[[level]]\nlabel = \"{label}\"\nshore = {shore}\n");
    let own = forearm() + &level("stiff", "[60, 100]") + &level("soft", "[0, 60]");
    bench.write("own.toml", &own);
    for verdict in bench.finals("wood.bin --config own.toml") {
        assert_eq!(verdict["probabilities"].as_array().unwrap().len(), 2);
        assert_eq!(verdict["label"], "stiff", "{verdict}");
        let shore = verdict["shore"]["value"].as_f64().unwrap();
        assert!((60.0..=100.0).contains(&shore), "{verdict}");
    }
    bench.write("hrn.toml", own + "[model]\nbuilt_in = \"hrn\"\n");
    bench.fails(
        "check --config hrn.toml",
        78,
        &["level: found levels, expected none"],
    );
}

#[test]
fn a_recording_keeps_the_references_that_presses_of_now_gave() {
    let bench = bench();
    // It ends after the third press, and so does the recording. A busy machine may miss the second one.
    let _sensor = bench.sensor("--seed 5 --presses 3 --speed 0.5");
    let (code, text, message) = bench.run(&format!("{IDENTIFY} --as flat:20 --presses 1"));
    assert_eq!(code, 0, "{message}");
    assert!(text.contains("rigid flat piece 1"), "{text}");
    assert!(
        message.contains("press it 1 times, harder each time"),
        "{message}"
    );

    // It ends when the sensor is gone.
    bench.run("record --config hardnessd.toml --out take.mcap");
    fs::remove_file(bench.path("r.npz")).unwrap();
    let alone = bench.finals("take.mcap");
    assert_eq!(alone[0]["references"], "rigid", "{alone:?}");
    // Another model judges without them.
    let of_hrn = bench.finals(&format!("take.mcap --model {HRN}"));
    assert_eq!(of_hrn[0]["references"], "none");
}

#[test]
fn references_that_make_verdicts_worse_are_not_used_and_everybody_says_so() {
    let bench = bench();
    let simulate = "simulate --fps 20 --piece flat:40 --seed";
    bench.succeeds(&format!("{simulate} 1 --presses 8 --to flat.bin"));
    bench.succeeds(&format!("{simulate} 5 --presses 20 --to again.bin"));
    let text = bench.succeeds(&format!("{IDENTIFY} --as flat:40 flat.bin"));
    assert!(text.contains("the daemon will not use them"), "{text}");
    let (code, _, warnings) = bench.run("check --config hardnessd.toml");
    assert!(code == 0 && warnings.contains("sensor.references of \"forearm\": not used"));

    // The piece is pressed again: verdicts are those without the file, and none is wrong.
    let without = bench.finals("again.bin --config plain.toml");
    let with = bench.finals("again.bin --config hardnessd.toml");
    assert_eq!(with.len(), 20);
    for (without, with) in without.iter().zip(&with) {
        assert_eq!(with["probabilities"], without["probabilities"]);
        let ignored = "references_ignored";
        assert!(has_note(with, ignored) != has_note(without, ignored));
        assert!(with["level"].is_null() || with["level"] == 1, "{with}");
    }
}
