//! Tests of what a run's directory keeps.

use super::*;
use crate::run::history::Row;

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
fn seconds_go_on_from_the_row_of_the_checkpoint() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("metrics.csv");
    let file = MetricsFile::of(directory.path());
    let row = |step, seconds| Row {
        step,
        epoch: 1,
        loss: 1.0,
        seconds,
        ..Row::default()
    };
    let mut metrics = file.open("first", 0).unwrap();
    metrics.add(&row(10, 2.0)).unwrap();
    metrics.add(&row(20, 4.0)).unwrap();
    metrics.add(&row(30, 9.0)).unwrap();
    file.open("second", 0).unwrap().add(&row(5, 1.0)).unwrap();
    // The run was killed after step 30 and continues from the checkpoint of step 20.
    let mut metrics = file.open("first", 20).unwrap();
    metrics.add(&row(30, 3.5)).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    let seconds: Vec<&str> = text
        .lines()
        .skip(1)
        .filter(|row| row.starts_with("first"))
        .map(|row| row.rsplit(',').next().unwrap())
        .collect();
    assert_eq!(seconds, ["2.0", "4.0", "7.5"], "{text}");
    assert!(text.contains("second,5,"), "{text}");

    // A row that a full disk broke off is dropped. A file that is not text stays unchanged.
    fs::write(&path, text.clone() + "sec").unwrap();
    file.open("first", 30).unwrap();
    assert_eq!(fs::read_to_string(&path).unwrap(), text);
    fs::write(&path, b"\xff").unwrap();
    let error = format!("{:#}", file.open("first", 30).unwrap_err());
    assert!(error.contains("metrics.csv"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"\xff");
}
