//! References: made of recordings and of presses that are made now, judged with, and recorded.

use std::fs::{self, Permissions};
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::{Command, Output, Stdio};

use crate::bench::{BINARY, Bench, Process, by_terminal, events, wait_for};
use serde_json::{Value, json};

/// Runs a command in the directory of the bench.
fn run(bench: &Bench, arguments: &str) -> Output {
    Command::new(BINARY)
        .args(arguments.split_whitespace())
        .current_dir(bench.path("."))
        .output()
        .unwrap()
}

fn succeed(bench: &Bench, arguments: &str) -> String {
    let output = run(bench, arguments);
    assert!(output.status.success(), "{arguments}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// What a refused command says, and its exit code.
fn refused(bench: &Bench, arguments: &str) -> (String, i32) {
    let output = run(bench, arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    (message, output.status.code().unwrap())
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
    assert_eq!(with[0]["references"], "both");
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
    for (arguments, expected, code) in [
        (
            "--out r.npz --as ball:10 wood.bin",
            "r.npz exists already",
            74,
        ),
        (
            "--out r.npz --append --as ball:10 none.bin",
            "none.bin: cannot read",
            66,
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
            "--out n.npz --as egg:3 wood.bin",
            "expected flat:MM or ball:MM",
            2,
        ),
        (
            "--out n.npz --as flat:20 still.bin",
            "still.bin: no whole frame in 10 bytes",
            1,
        ),
        (
            "--out n.npz --as flat:20 --sensor wrist wood.bin",
            "--sensor: found \"wrist\"",
            2,
        ),
        ("--out n.npz", "--as: found nothing", 2),
        (
            "--out no/where.npz --as flat:20 wood.bin",
            "no/where.npz: the directory no does not exist",
            74,
        ),
        // It says so before anything is pressed, and here before it finds that there is no sensor.
        (
            "--out no/where.npz --as flat:20",
            "no/where.npz: the directory no does not exist",
            74,
        ),
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
fn presses_after_those_that_were_asked_for_do_not_count() {
    let bench = bench();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let config = SENSOR.replace("port = \"port\"", &format!("port = \"{port}\""));
    assert!(config.contains(&port), "{config}");
    let sockets = "[publish.unix]\npath = \"events.sock\"\n";
    fs::write(bench.path("tcp.toml"), config + sockets).unwrap();
    // The arm goes on at once, and presses twenty times in all.
    let bytes = fs::read(bench.path("wood.bin")).unwrap().repeat(10);
    let pressing = std::thread::spawn(move || {
        let (mut peer, _) = listener.accept().unwrap();
        // The connection stays open until the command has ended.
        (peer.write_all(&bytes).is_ok(), peer)
    });
    let identify = "identify --config tcp.toml --out r.npz --as flat:20 --presses 3";
    let text = succeed(&bench, identify);
    assert!(text.contains("rigid flat piece 3,"), "{text}");
    assert!(pressing.join().unwrap().0);
}

/// A pipe is there, and nobody writes to it.
#[test]
fn a_pipe_is_no_file_of_references() {
    let bench = bench();
    bench.fifo("pipe.npz");
    for (append, expected) in [
        (None, "pipe.npz exists already"),
        (Some("--append"), "pipe.npz: found no file"),
    ] {
        let identify = "identify --config plain.toml --out pipe.npz --as ball:10 wood.bin";
        let child = Command::new(BINARY)
            .args(identify.split_whitespace().chain(append))
            .current_dir(bench.path("."))
            .stderr(Stdio::piped())
            .spawn();
        let mut identify = Process(child.unwrap());
        assert_eq!(identify.exit_code(), Some(74));
        let mut message = String::new();
        let mut stderr = identify.0.stderr.take().unwrap();
        stderr.read_to_string(&mut message).unwrap();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn calls_that_add_at_once_take_nothing_from_each_other() {
    let bench = bench();
    let (link, file) = (bench.path("r.npz"), bench.path("own.npz"));
    let pipe = bench.fifo("pipe");
    let append = "identify --config plain.toml --append --out r.npz";
    for expected in [2, 4] {
        let mut slow = Command::new(BINARY);
        slow.args(append.split_whitespace())
            .args(["--as", "flat:20", "pipe"])
            .current_dir(bench.path("."))
            .stdout(Stdio::piped());
        let slow = slow.spawn().unwrap();
        // This waits until the first call reads. By then it has looked at the file.
        let mut bytes = fs::File::options().write(true).open(&pipe).unwrap();
        succeed(&bench, &format!("{append} --as level:1 wood.bin"));
        if !file.exists() {
            // From now on the file lies elsewhere, and only its owner may read it.
            fs::rename(&link, &file).unwrap();
            symlink(&file, &link).unwrap();
            let only_own = Permissions::from_mode(0o600);
            fs::set_permissions(&file, only_own).unwrap();
        }
        bytes
            .write_all(&fs::read(bench.path("wood.bin")).unwrap())
            .unwrap();
        drop(bytes);
        let output = slow.wait_with_output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let all = format!("rigid flat piece {expected}, rigid ball 0, known hardness {expected}");
        assert!(output.status.success() && text.contains(&all), "{text}");
        assert_eq!(fs::read_link(&link).unwrap(), file);
        let mode = fs::metadata(&file).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }
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
    let swapped = format!(
        "{SENSOR}[[level]]\nlabel = \"a\"\nshore = [0, 60]\n[[level]]\nlabel = \"b\"\nshore = [50, 100]\n"
    );
    fs::write(bench.path("swapped.toml"), swapped).unwrap();
    let (message, code) = refused(&bench, "check --config swapped.toml");
    assert!(
        message.contains("level: found level 2 (50-100), which is not softer"),
        "{message}"
    );
    assert_eq!(code, 78);
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
    let _sensor = bench.sensor(&["--seed", "5", "--presses", "2", "--rest", "3"]);
    let identify = by_terminal()
        .args(["identify", "--config", "plain.toml", "--out", "r.npz"])
        .args(["--as", "flat:20", "--presses", "1"])
        .current_dir(bench.path("."))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let output = identify.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("rigid flat piece 1"), "{text}");
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        message.contains("press it 1 times, harder each time"),
        "{message}"
    );

    let mut record = Process(
        by_terminal()
            .args(["record", "--config", "hardnessd.toml", "--out", "take.mcap"])
            .current_dir(bench.path("."))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap(),
    );
    wait_for("the end of the recording", || {
        record.0.try_wait().unwrap().is_some()
    });
    fs::remove_file(bench.path("r.npz")).unwrap();
    let alone = finals(&bench, "take.mcap");
    assert_eq!(alone[0]["references"], "rigid", "{alone:?}");
    // Another model judges without them.
    let hrn = concat!(env!("CARGO_MANIFEST_DIR"), "/models/hrn.onnx");
    let other = finals(&bench, &format!("take.mcap --model {hrn}"));
    assert_eq!(other[0]["references"], "none");
}
