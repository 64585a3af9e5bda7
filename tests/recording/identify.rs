//! References: made of recordings and of presses that are made now, judged with, and recorded.

use std::fs;
use std::process::Command;

use crate::bench::{BINARY, Bench, by_terminal, events, ran};
use serde_json::{Value, json};

/// Runs a command in the directory of the bench. Returns exit code, stdout and stderr.
fn run(bench: &Bench, arguments: &str) -> (i32, String, String) {
    ran(Command::new(BINARY)
        .args(arguments.split_whitespace())
        .current_dir(bench.path(".")))
}

fn succeed(bench: &Bench, arguments: &str) -> String {
    let (code, printed, message) = run(bench, arguments);
    assert_eq!(code, 0, "{arguments}: {message}");
    printed
}

/// What a refused command says, and its exit code.
fn refused(bench: &Bench, arguments: &str) -> (String, i32) {
    let (code, _, message) = run(bench, arguments);
    (message, code)
}

/// The final verdicts of a replay.
fn finals(bench: &Bench, arguments: &str) -> Vec<Value> {
    let text = succeed(bench, &format!("replay --json {arguments}"));
    let mut events = events(&text);
    events.retain(|event| event["phase"] == "final");
    events
}

const SENSOR: &str = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\nframe_rate_hz = 20.0\n";

/// A bench with raw bytes of two presses on wood, and configurations without and with references.
fn bench() -> Bench {
    let bench = Bench::new();
    fs::write(bench.path("plain.toml"), SENSOR).unwrap();
    let identified = format!("{SENSOR}references = \"r.npz\"\n");
    fs::write(bench.path("hardnessd.toml"), identified).unwrap();
    let simulate = "simulate --fps 20 --presses 2 --material wood --seed 3 --to wood.bin";
    succeed(&bench, simulate);
    bench
}

#[test]
fn references_of_raw_bytes_are_judged_with_and_change_verdicts() {
    let bench = bench();
    let identify = "identify --config hardnessd.toml --out r.npz";
    let text = succeed(&bench, &format!("{identify} --as level:1 wood.bin"));
    assert!(text.contains("known hardness 2"), "{text}");
    assert!(text.contains("references = \"r.npz\""), "{text}");

    let without = finals(&bench, "wood.bin --config plain.toml");
    let with = finals(&bench, "wood.bin --config hardnessd.toml");
    assert_eq!((without.len(), with.len()), (2, 2));
    for (without, with) in without.iter().zip(&with) {
        assert_eq!(
            (&without["references"], &with["references"]),
            (&json!("none"), &json!("labelled"))
        );
        let notes = |event: &Value| event["notes"].as_array().unwrap().clone();
        assert!(notes(without).contains(&json!("not_identified")));
        assert!(!notes(with).contains(&json!("not_identified")));
        assert_ne!(without["probabilities"], with["probabilities"]);
    }

    // The paper's network takes no references.
    let hrn = fs::read_to_string(bench.path("hardnessd.toml")).unwrap();
    fs::write(
        bench.path("hrn.toml"),
        hrn + "[model]\nbuilt_in = \"hrn\"\n",
    )
    .unwrap();
    let of_hrn = finals(&bench, "wood.bin --config hrn.toml");
    assert_eq!(of_hrn[0]["references"], "none");
    assert_eq!(of_hrn[0]["notes"], json!([]));

    // Rigid pieces beside the objects, with positions of the arm.
    let csv: String = (0..200)
        .map(|n| format!("{},{}\n", 0.05 * f64::from(n), 0.1 * f64::from(n)))
        .collect();
    fs::write(bench.path("m.csv"), format!("time_s,approach_mm\n{csv}")).unwrap();
    let rigid = format!("{identify} --append --as flat:20 --motion m.csv wood.bin");
    let text = succeed(&bench, &rigid);
    assert!(
        text.contains("rigid flat piece 2, rigid ball 0, known hardness 2"),
        "{text}"
    );
    assert!(text.contains("without the arm's approach 2:"), "{text}");
    let with = finals(&bench, "wood.bin --config hardnessd.toml");
    assert_eq!(with[0]["references"], "rigid+labelled");
}

#[test]
fn what_cannot_be_a_reference_is_refused_in_one_line() {
    let bench = bench();
    let identify = "identify --config plain.toml";
    succeed(
        &bench,
        &format!("{identify} --out r.npz --as ball:10 wood.bin"),
    );
    let before = fs::read(bench.path("r.npz")).unwrap();
    fs::write(bench.path("text.npz"), "no references").unwrap();
    fs::write(bench.path("still.bin"), vec![0; 10]).unwrap();
    let here = "no/where.npz: the directory no does not exist";
    for (arguments, expected, code) in [
        (
            "--out r.npz --as ball:10 wood.bin",
            "r.npz exists already",
            74,
        ),
        (
            "--out text.npz --append --as ball:10 wood.bin",
            "text.npz: found no .npz file",
            1,
        ),
        (
            "--out n.npz wood.bin",
            "wood.bin: found no label `reference`, `shore` or `level`",
            1,
        ),
        (
            "--out n.npz --as level:5 wood.bin",
            "level: found 5, expected 1 to 4",
            1,
        ),
        (
            "--out n.npz --as flat:20 still.bin",
            "still.bin: no whole frame",
            1,
        ),
        ("--out n.npz", "--as: found nothing", 2),
        // It says so before anything is pressed, and here before it finds that there is no sensor.
        ("--out no/where.npz --as flat:20", here, 74),
    ] {
        let (message, found) = refused(&bench, &format!("{identify} {arguments}"));
        assert!(message.contains(expected), "{arguments}: {message}");
        assert_eq!(
            (message.lines().count(), found),
            (1, code),
            "{arguments}: {message}"
        );
    }
    assert_eq!(fs::read(bench.path("r.npz")).unwrap(), before);
    assert!(!bench.path("n.npz").exists());

    // The daemon says which file and why.
    fs::write(bench.path("r.npz"), "no references").unwrap();
    let (message, code) = refused(&bench, "check --config hardnessd.toml");
    assert!(
        message.contains("sensor.references of \"forearm\"") && message.contains("no .npz file"),
        "{message}"
    );
    assert_eq!(code, 78);
}

#[test]
fn levels_of_ones_own_replace_those_of_the_model() {
    let bench = bench();
    let levels = "[[level]]\nlabel = \"stiff\"\nshore = [60, 100]\n[[level]]\nlabel = \"soft\"\nshore = [0, 60]\n";
    let own = format!("{SENSOR}{levels}");
    fs::write(bench.path("own.toml"), own).unwrap();
    for verdict in finals(&bench, "wood.bin --config own.toml") {
        assert_eq!(verdict["probabilities"].as_array().unwrap().len(), 2);
        assert_eq!(verdict["label"], "stiff", "{verdict}");
        let shore = verdict["shore"]["value"].as_f64().unwrap();
        assert!((60.0..=100.0).contains(&shore), "{verdict}");
    }
    let of_hrn = format!("{SENSOR}{levels}[model]\nbuilt_in = \"hrn\"\n");
    fs::write(bench.path("hrn.toml"), of_hrn).unwrap();
    let (message, _) = refused(&bench, "check --config hrn.toml");
    assert!(
        message.contains("level: found levels, expected none"),
        "{message}"
    );
}

#[test]
fn a_recording_keeps_the_references_that_presses_of_now_gave() {
    let bench = bench();
    // It ends after the second press, and so does the recording.
    let _sensor = bench.sensor(&["--seed", "5", "--presses", "2", "--speed", "0.5"]);
    let mut identify = by_terminal();
    identify
        .args(["identify", "--config", "plain.toml", "--out", "r.npz"])
        .args(["--as", "flat:20", "--presses", "1"])
        .current_dir(bench.path("."));
    let (code, text, message) = ran(&mut identify);
    assert_eq!(code, 0, "{message}");
    assert!(text.contains("rigid flat piece 1"), "{text}");
    let asked = "press it 1 times, harder each time";
    assert!(message.contains(asked), "{message}");

    // It ends when the sensor is gone.
    run(&bench, "record --config hardnessd.toml --out take.mcap");
    fs::remove_file(bench.path("r.npz")).unwrap();
    let alone = finals(&bench, "take.mcap");
    assert_eq!(alone[0]["references"], "rigid", "{alone:?}");
    // Another model judges without them.
    let hrn = concat!(env!("CARGO_MANIFEST_DIR"), "/models/hrn.onnx");
    let other = finals(&bench, &format!("take.mcap --model {hrn}"));
    assert_eq!(other[0]["references"], "none");
}

#[test]
fn references_that_make_verdicts_worse_are_not_used_and_everybody_says_so() {
    let bench = bench();
    let simulate = |seed: u32, presses: u32, to: &str| {
        let piece = format!("--piece flat:20 --seed {seed} --presses {presses} --to {to}");
        succeed(&bench, &format!("simulate --fps 20 {piece}"));
    };
    simulate(6, 8, "flat.bin");
    simulate(5, 20, "again.bin");
    let identify = "identify --config hardnessd.toml --out r.npz --as flat:20 flat.bin";
    let text = succeed(&bench, identify);
    assert!(text.contains("the daemon will not use them"), "{text}");
    let (code, _, warnings) = run(&bench, "check --config hardnessd.toml");
    assert!(code == 0 && warnings.contains("sensor.references of \"forearm\": not used"));

    // The piece is pressed again: verdicts are those without the file, and none is wrong.
    let without = finals(&bench, "again.bin --config plain.toml");
    let with = finals(&bench, "again.bin --config hardnessd.toml");
    assert_eq!(with.len(), 20);
    let ignored = json!("references_ignored");
    let notes = |event: &Value| event["notes"].as_array().unwrap().clone();
    for (without, with) in without.iter().zip(&with) {
        assert_eq!(with["probabilities"], without["probabilities"]);
        assert_ne!(
            notes(with).contains(&ignored),
            notes(without).contains(&ignored)
        );
        assert!(with["level"].is_null() || with["level"] == 1, "{with}");
    }
}
