//! Files that a stranger sends, and files that a command must not replace: one line each, and
//! nothing is lost.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::process::Command;

use burn::tensor::Device;
use hardnessd_core::verdict::BUILT_IN_HRN;
use hrn_train::data::presses::{Presses, read_one};
use hrn_train::run::checkpoint::Checkpoint;
use serde_json::{Value, json};

use crate::{few, hrn_train_in, succeed_in, write_data};

/// The last line of stderr says `expected`, and the exit code is `code`.
fn refused(at: &Path, arguments: &str, code: i32, expected: &str) {
    let output = hrn_train_in(at, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments}: {errors}");
    let last = errors.lines().last().unwrap_or_default();
    assert!(last.contains(expected), "{arguments}: {errors}");
}

/// A directory with `d.npz`, the single frames of a few presses, and the built-in model `m.onnx`.
fn bench() -> tempfile::TempDir {
    let (directory, _) = few();
    fs::write(directory.path().join("m.onnx"), BUILT_IN_HRN).unwrap();
    directory
}

#[test]
fn no_output_replaces_a_file() {
    let directory = bench();
    let at = directory.path();
    let fixture = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/foam.5hz.bin");
    fs::copy(fixture, at.join("press.bin")).unwrap();
    fs::create_dir(at.join("run")).unwrap();
    fs::copy(at.join("m.onnx"), at.join("run/hrn.onnx")).unwrap();
    fs::write(at.join("taken"), "somebody's").unwrap();
    std::os::unix::fs::symlink("nowhere", at.join("link")).unwrap();
    let files = || {
        let entries = fs::read_dir(at).unwrap().map(|entry| entry.unwrap().path());
        let files = entries.filter(|path| path.is_file());
        let mut files: Vec<_> = files.map(|path| (fs::read(&path).unwrap(), path)).collect();
        files.sort();
        files
    };
    let before = files();
    for (arguments, taken) in [
        ("evaluate --model m.onnx --data d.npz --verdicts", "d.npz"),
        ("evaluate --model m.onnx --data d.npz --verdicts", "m.onnx"),
        ("export run --out", "taken"),
        ("simulate --presses 1 --out", "taken"),
        ("simulate --presses 1 --out", "link"),
        (
            "simulate --sequences --presses 1 --objects 1 --out",
            "taken",
        ),
    ] {
        let expected = format!("{taken}: a file or link is there already: name another one");
        refused(at, &format!("{arguments} {taken}"), 74, &expected);
        assert!(before == files(), "{arguments}");
    }
    refused(
        at,
        "collect --level 1 --out press.bin press.bin",
        2,
        "--out: ",
    );
    assert!(before == files());
}

#[test]
fn a_directory_of_something_else_stays_as_it_is() {
    let directory = bench();
    let at = directory.path();
    let features = "train --method features --profile smoke --data d.npz --out";
    for (name, arguments) in [
        ("hrn.onnx", features),
        ("metrics.csv", features),
        (
            "tables.md",
            "compare --methods features --profile smoke --data d.npz --out",
        ),
    ] {
        let other = at.join("other");
        fs::create_dir(&other).unwrap();
        fs::write(other.join(name), "somebody's").unwrap();
        refused(at, &format!("{arguments} other"), 1, "choose another --out");
        let names: Vec<_> = fs::read_dir(&other)
            .unwrap()
            .map(|file| file.unwrap().file_name())
            .collect();
        assert_eq!(names, [name]);
        assert_eq!(fs::read(other.join(name)).unwrap(), b"somebody's");
        fs::remove_dir_all(&other).unwrap();
    }
}

#[test]
fn a_directory_with_a_strange_name_does_not_end_a_comparison() {
    let directory = bench();
    let at = directory.path();
    for name in ["hrn15-0-1", "hrn15-99999999999999-1"] {
        let strange = at.join("cmp/runs").join(name);
        fs::create_dir_all(&strange).unwrap();
        fs::write(strange.join("hrn.onnx"), "somebody's").unwrap();
    }
    succeed_in(
        at,
        "compare --methods features --profile smoke --data d.npz --out cmp --plan",
    );
}

#[test]
fn what_a_model_could_not_state_is_refused_before_the_training() {
    let directory = bench();
    let at = directory.path();
    let presses = read_one(&at.join("d.npz")).unwrap();
    let write = |presses: &Presses, meta: &Value| write_data(&at.join("bad.npz"), presses, meta);
    let train = "train --method features --profile smoke --data bad.npz --out run";
    for (meta, expected) in [
        (json!({"pitch_mm": 1e300}), "array `meta`: found pitch_mm"),
        (json!({"seed": u64::MAX}), "array `meta`: found seed"),
        (json!({"levels": [1, 2, 3]}), "array `meta`: found levels"),
    ] {
        write(&presses, &meta);
        refused(at, train, 1, expected);
        assert!(!at.join("run").exists());
    }
    for shore in [3e38, -1.0] {
        let mut presses = presses.clone();
        for press in &mut presses.all {
            press.shore = Some(shore);
        }
        write(&presses, &json!({}));
        refused(at, train, 1, "array `shore`: found");
    }
    // The simulator's settings may be anything in a stranger's file.
    for meta in [json!([1]), json!("x"), json!({"settings": 5})] {
        write(&presses, &meta);
        assert!(read_one(&at.join("bad.npz")).is_ok(), "{meta}");
    }
}

#[test]
fn a_checkpoint_of_another_network_is_refused_or_left_alone() {
    let directory = bench();
    let at = directory.path();
    let train = "train --method hrn15 --profile smoke --data d.npz --labels 24 --out";
    succeed_in(at, &format!("{train} run"));
    let model = fs::read(at.join("run/hrn.onnx")).unwrap();
    let paths: Vec<_> = fs::read_dir(at.join("run/checkpoints"))
        .unwrap()
        .map(|file| file.unwrap().path())
        .collect();
    let whole = Checkpoint::read(&paths[0], &Device::flex()).unwrap();
    let mut missing = whole.clone();
    missing.lists[0].1.entries.remove(0);
    let mut shorter = whole;
    let weight = &mut shorter.lists[0].1.entries[0];
    weight.dims = vec![3];
    weight.values = weight.values.clone().narrow(0, 0, 3);
    for damaged in [missing, shorter] {
        let name = damaged.lists[0].0.clone();
        for path in &paths {
            fs::write(path, damaged.to_bytes().unwrap()).unwrap();
        }
        fs::remove_file(at.join("run/hrn.onnx")).ok();
        let expected = format!("array `{name}/");
        refused(at, &format!("{train} run --resume"), 1, &expected);
        // A run that may take its stages from this one trains them itself.
        succeed_in(at, &format!("{train} new --from run"));
        assert!(fs::read(at.join("new/hrn.onnx")).unwrap() == model);
        fs::remove_dir_all(at.join("new")).unwrap();
    }
}

#[test]
fn options_that_change_nothing_or_break_a_run_are_wrong_usage() {
    let directory = bench();
    let at = directory.path();
    succeed_in(
        at,
        "simulate --sequences --objects 1 --test-objects 1 --presses 1 --out s.npz",
    );
    for (arguments, expected) in [
        (
            "train --method hrn15 --data d.npz --out r --seed 9223372036854775808",
            "--seed",
        ),
        ("simulate --out r --seed 18446744073709551615", "--seed"),
        (
            "compare --data d.npz --out r --seeds 100000000 --plan",
            "--seeds",
        ),
        (
            "train --method course --data s.npz --out r --labels 4",
            "--labels",
        ),
    ] {
        refused(at, arguments, 2, expected);
        assert!(!at.join("r").exists(), "{arguments}");
    }
    // A name that is no text.
    let output = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(["train", "--method", "features", "--out", "r", "--data"])
        .arg(OsStr::from_bytes(b"s\xff.npz"))
        .current_dir(at)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(66), "{output:?}");
}
