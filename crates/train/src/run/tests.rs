//! Tests of what a run's directory keeps.

use super::*;
use crate::run::history::{Metrics, Taken};

fn description(name: &str, sha256: &str) -> Description {
    Description {
        method: "nahrn".to_owned(),
        profile: Profile::Smoke,
        seed: 1,
        labels: 4,
        settings: Settings::default(),
        data: vec![Source {
            name: name.to_owned(),
            sha256: sha256.to_owned(),
            ..Source::default()
        }],
    }
}

#[test]
fn a_run_goes_on_with_its_data_under_another_name_and_with_no_other() {
    let directory = tempfile::tempdir().unwrap();
    let open = |name, sha256| Run::open(directory.path(), &description(name, sha256), true);
    drop(open("a.npz", "12").unwrap());
    drop(open("b.npz", "12").unwrap());
    let error = open("a.npz", "34").unwrap_err().to_string();
    let expected = "other settings or data; found `sha256 = \"34\"`, expected `sha256 = \"12\"`; give --resume";
    assert!(error.contains(expected), "{error}");
    // What is no run is left as it is, but for what a killed run leaves.
    let other = tempfile::tempdir().unwrap();
    let open = || Run::open(other.path(), &description("a.npz", "12"), true);
    let notes = other.path().join("notes.txt");
    fs::write(&notes, "").unwrap();
    fs::write(other.path().join(".settings.toml.part"), "").unwrap();
    let error = open().err().unwrap().to_string();
    let expected = "has notes.txt but no settings.toml, so there is no run";
    assert!(error.contains(expected), "{error}");
    assert_eq!(fs::read_dir(other.path()).unwrap().count(), 2);
    fs::remove_file(notes).unwrap();
    open().unwrap();
}

#[test]
fn every_program_that_had_a_part_in_a_run_is_named_once() {
    let directory = tempfile::tempdir().unwrap();
    let open =
        |resume| drop(Run::open(directory.path(), &description("a.npz", "12"), resume).unwrap());
    let path = directory.path().join("revision");
    open(false);
    let own = fs::read_to_string(&path).unwrap();
    fs::write(&path, "0.1 (aa)\n").unwrap();
    open(true);
    open(true);
    assert_eq!(
        fs::read_to_string(&path).unwrap(),
        format!("0.1 (aa)\n{own}")
    );
}

#[test]
fn the_cost_of_a_run_is_that_of_its_checkpoints() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path();
    assert_eq!(Run::cost(path).unwrap(), (0, 0.0));
    fs::create_dir(path.join("checkpoints")).unwrap();
    for (stage, step, seconds) in [("ustgan", 3, 1.5), ("hrn", 4, 2.0)] {
        let stage = path.join("checkpoints").join(stage);
        let done = Checkpoint {
            step,
            seconds,
            ..Checkpoint::default()
        };
        done.write(&stage).unwrap();
    }
    assert_eq!(Run::cost(path).unwrap(), (7, 3.5));
}

#[test]
fn a_checkpoint_comes_back_whole_or_not_at_all() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hrn");
    assert!(Checkpoint::read(&path).unwrap().is_none());
    // A number may have the byte of the line's end.
    let line_end = f32::from_le_bytes(*b"\n\n\n\n");
    let numbers = vec![0.1, -0.0, line_end, f32::MIN_POSITIVE / 2.0];
    let written = Checkpoint {
        epoch: 2,
        step: 7,
        seconds: 1.5,
        ..Checkpoint::first(b"seed = 1", numbers)
    };
    written.write(&path).unwrap();
    let read = Checkpoint::read(&path).unwrap().unwrap();
    let of = |of: &Checkpoint| (of.origin.clone(), of.epoch, of.step, of.seconds);
    assert_eq!(of(&read), of(&written));
    let bits = |of: &Checkpoint| of.numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&read), bits(&written));
    let whole = fs::read(&path).unwrap();
    for length in 0..whole.len() {
        fs::write(&path, &whole[..length]).unwrap();
        let error = format!("{:#}", Checkpoint::read(&path).unwrap_err());
        assert!(error.starts_with(&path.display().to_string()), "{error}");
    }
}

#[test]
fn a_resumed_stage_writes_its_rows_again_and_no_others() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("metrics.csv");
    let rows = |stage, from, steps: &[u64]| {
        let mut metrics = Metrics::open(&path, stage, from).unwrap();
        for &step in steps {
            let done = Checkpoint {
                step,
                ..Checkpoint::default()
            };
            metrics.add(&done, 1e-3, &Taken::default(), None).unwrap();
        }
        fs::read_to_string(&path).unwrap()
    };
    rows("first", 0, &[10, 20, 30]);
    let whole = rows("second", 0, &[5]);
    let steps = |text: &str| -> Vec<String> {
        let cells = text.lines().skip(1).map(|row| row.split(',').take(2));
        cells
            .map(|cells| cells.collect::<Vec<_>>().join(" "))
            .collect()
    };
    // The run was killed after step 30 and continues from the checkpoint of step 20.
    let text = rows("first", 20, &[30]);
    assert_eq!(
        steps(&text),
        ["first 10", "first 20", "second 5", "first 30"]
    );
    assert_eq!(whole.lines().next(), text.lines().next());

    // A row that a full disk broke off is dropped. A file that is not text stays unchanged.
    fs::write(&path, text.clone() + "sec").unwrap();
    assert_eq!(rows("first", 30, &[]), text);
    fs::write(&path, b"\xff").unwrap();
    let error = format!("{:#}", Metrics::open(&path, "first", 30).unwrap_err());
    assert!(error.contains("metrics.csv"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"\xff");
}
