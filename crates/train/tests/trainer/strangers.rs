//! Files that a stranger sends, and files that a command must not replace: one line each, and
//! nothing is lost.

use std::fs;
use std::path::Path;

use hardnessd_core::verdict::BUILT_IN_HRN;
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Press, Presses, meta, read_one};

use crate::{few, hrn_train_in, json_in, write_data};

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
        ("collect --level 1 press.bin --out", "taken"),
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
}

#[test]
fn a_directory_of_something_else_stays_as_it_is() {
    let directory = bench();
    let at = directory.path();
    let features = "train --method features --profile smoke --data d.npz --out";
    for (name, arguments) in [
        ("hrn.onnx", features),
        ("metrics.csv", features),
        // Also a run that lost its settings.
        ("checkpoints", features),
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
fn data_are_looked_through_before_anything_is_learnt() {
    let directory = bench();
    let at = directory.path();
    let data = at.join("d.npz");
    let presses = read_one(&data).unwrap();
    // Some presses of the training are also in the test.
    let mut leaked = Presses::default();
    leaked.sources.clone_from(&presses.sources);
    for (place, press) in presses.all.iter().enumerate() {
        let is_first = place < 3;
        for split in [press.split, Split::Test]
            .into_iter()
            .take(1 + usize::from(is_first))
        {
            let press = Press {
                split,
                ..press.clone()
            };
            leaked.push(press, [(0.0, None, presses.frame(place).newtons)]);
        }
    }
    write_data(&at.join("leaked.npz"), &leaked, &meta(&data).unwrap());
    fs::copy(&data, at.join("d\u{202e}.npz")).unwrap();
    let train = "train --method features --profile smoke --out run --data";
    for (data, code, expected) in [
        ("leaked.npz", 1, "3 presses in training and in test"),
        (
            "d\u{202e}.npz",
            78,
            "the model could not name the files of --data",
        ),
    ] {
        refused(at, &format!("{train} {data}"), code, expected);
        assert!(!at.join("run").exists(), "{data}");
    }
    let output = hrn_train_in(at, &format!("{train} d.npz --labels 30"));
    assert!(output.status.success(), "{output:?}");
    let findings = fs::read_to_string(at.join("run/findings.txt")).unwrap();
    assert!(
        findings.contains("30 of 48 labelled training presses"),
        "{findings}"
    );
    assert!(String::from_utf8_lossy(&output.stderr).contains(findings.trim_end()));
    // A model is as good as itself.
    let two = json_in(
        at,
        "evaluate --model m.onnx --model m.onnx --data d.npz --json",
    );
    assert_eq!(two["models"][0], two["models"][1]);
    let difference = serde_json::to_string(&two["difference"]).unwrap();
    assert!(difference.contains("\"accuracy\""), "{difference}");
}
