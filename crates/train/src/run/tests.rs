//! Tests of what a run's directory keeps.

use burn::tensor::Tensor;

use super::*;
use crate::net::network::{Weight, Weights};
use crate::run::checkpoint::Progress;
use crate::run::history::Row;

fn description(name: &str, sha256: &str) -> Description {
    Description {
        method: "nahrn".to_owned(),
        profile: Profile::Smoke,
        seed: 1,
        labels: 4,
        settings: Settings::of(Profile::Smoke),
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
    let expected =
        "other settings or data; sha256 of the data: found 34, expected 12; give --resume";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn every_program_that_had_a_part_in_a_run_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let open =
        |name: &str, resume| Run::open(&path(name), &description("a.npz", "12"), resume).unwrap();
    let made_by = |revisions: &str, name: &str| {
        fs::write(path(name).join("revision"), revisions).unwrap();
    };
    let revisions = |name: &str| fs::read_to_string(path(name).join("revision")).unwrap();
    let own = revision();

    // The run was begun by others and is continued by this program, twice.
    drop(open("other", false));
    made_by("0.1 (aa)\n0.1 (bb)\n", "other");
    for _ in 0..2 {
        drop(open("other", true));
        assert_eq!(revisions("other"), format!("0.1 (aa)\n0.1 (bb)\n{own}\n"));
    }

    // A stage that is taken from the other run was made by all of its programs.
    let device = Device::flex();
    let weight = Weight {
        name: "bias".to_owned(),
        dims: vec![1],
        values: Tensor::zeros([1], &device),
    };
    let weights = Weights {
        entries: vec![weight],
    };
    let checkpoint = Checkpoint {
        origin: "same".to_owned(),
        progress: Progress {
            epoch: 3,
            ..Progress::default()
        },
        lists: vec![("weights".to_owned(), weights)],
    };
    let other = open("other", true);
    other.checkpoints.save("ustgan", &checkpoint).unwrap();
    other.metrics.open("ustgan", 0).unwrap();
    let run = open("run", false).taking_from(vec![path("other")]);
    let taken = |origin| {
        run.latest("ustgan", origin, 3, &checkpoint.lists, &device)
            .unwrap()
    };
    assert!(taken("another").is_none());
    assert_eq!(revisions("run"), format!("{own}\n"));
    assert!(taken("same").is_some());
    assert_eq!(revisions("run"), format!("{own}\n0.1 (aa)\n0.1 (bb)\n"));
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
