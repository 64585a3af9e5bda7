//! Files that a stranger sends, and files that a command must not replace: one line each, and
//! nothing is lost.

use std::fs;

use hardnessd_core::verdict::BUILT_IN_HRN;
use hardnessd_simulator::Split;
use hrn_train::data::presses::Layout;

use crate::{Desk, FIXTURES};

/// A desk with `d.npz`, the single frames of a few presses, and the built-in model `m.onnx`.
fn desk() -> Desk {
    let desk = Desk::with_few_presses();
    desk.write("m.onnx", BUILT_IN_HRN);
    desk
}

#[test]
fn no_output_replaces_a_file() {
    let desk = desk();
    fs::copy(format!("{FIXTURES}/foam.5hz.bin"), desk.path("press.bin")).unwrap();
    desk.write("run/hrn.onnx", BUILT_IN_HRN);
    desk.write("taken", "somebody's");
    std::os::unix::fs::symlink("nowhere", desk.path("link")).unwrap();
    let files = || {
        let entries = fs::read_dir(desk.0.path()).unwrap();
        let entries = entries.map(|entry| entry.unwrap().path());
        let files = entries.filter(|path| path.is_file());
        let mut files: Vec<_> = files.map(|path| (fs::read(&path).unwrap(), path)).collect();
        files.sort();
        files
    };
    let before = files();
    let sequences = "simulate --sequences --presses 1 --objects 1 --out";
    for (arguments, taken) in [
        ("evaluate --model m.onnx --data d.npz --verdicts", "d.npz"),
        ("evaluate --model m.onnx --data d.npz --verdicts", "m.onnx"),
        ("export run --out", "taken"),
        ("collect --level 1 press.bin --out", "taken"),
        ("simulate --presses 1 --out", "taken"),
        ("simulate --presses 1 --out", "link"),
        (sequences, "taken"),
    ] {
        let expected = format!("{taken}: a file or link is there already: name another one");
        desk.fails(&format!("{arguments} {taken}"), 74, &expected);
        assert!(before == files(), "{arguments}");
    }
}

#[test]
fn a_directory_of_something_else_stays_as_it_is() {
    let desk = desk();
    let train = "train --method features";
    for (name, command) in [
        ("hrn.onnx", train),
        ("metrics.csv", train),
        // Also a run that lost its settings.
        ("checkpoints", train),
        ("tables.md", "compare --methods features"),
    ] {
        let other = desk.path("other");
        desk.write(&format!("other/{name}"), "somebody's");
        let line = format!("{command} --profile smoke --data d.npz --out other");
        desk.fails(&line, 1, "choose another --out");
        let files = fs::read_dir(&other).unwrap();
        let names: Vec<_> = files.map(|file| file.unwrap().file_name()).collect();
        assert_eq!(names, [name]);
        assert_eq!(fs::read(other.join(name)).unwrap(), b"somebody's");
        fs::remove_dir_all(&other).unwrap();
    }
}

#[test]
fn data_are_looked_through_before_anything_is_learnt() {
    let desk = desk();
    // Some presses of the training are also in the test.
    let mut leaked = desk.presses("d.npz");
    let mut first = leaked.all[..3].to_vec();
    first.iter_mut().for_each(|press| press.split = Split::Test);
    leaked.all.extend(first);
    let meta = desk.meta("d.npz");
    desk.write_presses("leaked.npz", Layout::Frames, &leaked, &meta);
    fs::copy(desk.path("d.npz"), desk.path("d\u{202e}.npz")).unwrap();
    let train = "train --method features --profile smoke --out run --data";
    let leaked = "3 presses in training and in test";
    let unnamed = "the model could not name the files of --data";
    for (data, code, expected) in [("leaked.npz", 1, leaked), ("d\u{202e}.npz", 78, unnamed)] {
        desk.fails(&format!("{train} {data}"), code, expected);
        assert!(!desk.path("run").exists(), "{data}");
    }
    let (code, _, errors) = desk.run(&format!("{train} d.npz --labels 30"));
    assert_eq!(code, 0, "{errors}");
    let findings = desk.text("run/findings.txt");
    let expected = "30 of 48 labelled training presses";
    assert!(findings.contains(expected), "{findings}");
    assert!(errors.contains(findings.trim_end()), "{errors}");
    // A model is as good as itself.
    let two = desk.json("evaluate --model m.onnx --model m.onnx --data d.npz --json");
    assert_eq!(two["models"][0], two["models"][1]);
    let difference = serde_json::to_string(&two["difference"]).unwrap();
    assert!(difference.contains("\"accuracy\""), "{difference}");
}
