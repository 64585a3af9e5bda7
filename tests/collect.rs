//! Recordings to a data set: the frames that the daemon would judge, labelled.
#![cfg(feature = "train")]
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use bench::{BINARY, Bench, hardnessd};
use hardnessd::simulator::{self, DatasetSettings, Split};
use hardnessd::train::dataset::{Dataset, Sample, meta};
use hardnessd::train::simulated;
use serde_json::Value;

fn collect(out: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(["collect", "--out"])
        .arg(out)
        .args(arguments)
        .output()
        .unwrap()
}

fn collected(out: &Path, arguments: &[&str]) -> Vec<Sample> {
    let output = collect(out, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    Dataset::read(out).unwrap().samples
}

/// Area and force of each final verdict of a replay.
fn judged(capture: &Path) -> Vec<(u64, f64)> {
    let replay = hardnessd(&["replay", capture.to_str().unwrap()]);
    let text = String::from_utf8(replay.stdout).unwrap();
    let events = text
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    events
        .filter(|event| event["phase"] == "final")
        .map(|event| {
            let area = event["contact_area_taxels"].as_u64().unwrap();
            (area, event["force_n"].as_f64().unwrap())
        })
        .collect()
}

fn assert_are_those(samples: &[Sample], judged: &[(u64, f64)]) {
    assert_eq!(samples.len(), judged.len());
    for (sample, (area, force_n)) in samples.iter().zip(judged) {
        let threshold_n = hardnessd::press::Settings::default().contact_threshold_n;
        assert_eq!(
            u64::from(sample.frame.contact_area_taxels(threshold_n)),
            *area
        );
        assert!((sample.frame.force_n() - force_n).abs() < 1e-3);
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn samples_are_the_frames_that_the_daemon_judges() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/foam.5hz.bin");
    let out = bench.path("bytes.npz");
    let samples = collected(&out, &["--level", "2", "--object", "9", text(&fixture)]);
    assert!(!samples.is_empty());
    assert!(samples.iter().all(|s| s.level == 2 && s.object == Some(9)));
    assert_are_those(&samples, &judged(&fixture));

    // The same of a recording, which says itself what was pressed.
    let config = bench.configure("record.toml", "events.sock", "");
    let capture = bench.path("a.mcap");
    let _sensor = bench.sensor(&[]);
    let recorded = Command::new(BINARY)
        .args(["record", "--config", text(&config), "--out", text(&capture)])
        .args([
            "--label",
            "level=1",
            "--label",
            "object=7",
            "--label",
            "material=oak",
            "--seconds",
            "12",
        ])
        .output()
        .unwrap();
    assert!(recorded.status.success(), "{recorded:?}");
    let out = bench.path("own.npz");
    let samples = collected(&out, &[text(&capture)]);
    assert!(samples.iter().all(|s| s.level == 1 && s.object == Some(7)));
    assert!(samples.iter().all(|s| s.split == Split::Train));
    assert_are_those(&samples, &judged(&capture));
    // What it is made of stands beside it, by its place among the names.
    assert!(samples.iter().all(|s| s.material == Some(0)));
    assert_eq!(meta(&out).unwrap()["materials"], serde_json::json!(["oak"]));
    assert!(
        meta(&out).unwrap()["generator"]
            .as_str()
            .unwrap()
            .starts_with("hrn-train collect")
    );

    // What is added says the same of what was there; what is given goes before labels.
    let more = [
        "--append",
        "--split",
        "test",
        "--level",
        "3",
        text(&capture),
    ];
    let both = collected(&out, &more);
    assert_eq!(both[..samples.len()], samples);
    let added = &both[samples.len()..];
    assert_eq!(added.len(), samples.len());
    assert!(
        added
            .iter()
            .all(|s| (s.level, s.object) == (3, Some(7)) && s.split == Split::Test)
    );
    assert_eq!(meta(&out).unwrap()["captures"].as_array().unwrap().len(), 2);
    // Without a number an object is a new one.
    let new = collected(&out, &["--append", "--level", "4", text(&fixture)]);
    assert_eq!(new.last().unwrap().object, Some(8));
    // That one is of no known material, and the array is for all or for none.
    assert!(new.iter().all(|sample| sample.material.is_none()));

    // After simulated samples a material keeps its place, and a new one is put behind.
    let settings = DatasetSettings {
        objects: 1,
        test_objects: 1,
        presses: 1,
        ..DatasetSettings::default()
    };
    let simulated = simulator::dataset(&settings, 1, |_| {});
    let simulated = simulated::to_bytes(&settings, simulated).unwrap();
    std::fs::write(&out, simulated).unwrap();
    let both = collected(&out, &["--append", text(&capture)]);
    assert_eq!(both[0].material, Some(0));
    assert_eq!(both.last().unwrap().material, Some(8));
    assert_eq!(meta(&out).unwrap()["materials"][8], "oak");
}

#[test]
fn what_cannot_be_collected_is_said_and_nothing_is_written() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/foam.5hz.bin");
    let fixture = text(&fixture);
    let out = bench.path("own.npz");
    let none = bench.path("none.mcap");
    let empty = bench.path("empty.bin");
    std::fs::write(&empty, [0; 100]).unwrap();
    let noise: PathBuf = bench.path("noise.mcap");
    std::fs::write(&noise, [7; 1000]).unwrap();
    for (arguments, code, part) in [
        (&[fixture][..], 1, "level: found none"),
        (&["--level", "5", fixture], 2, "5"),
        (&["--level", "1", text(&none)], 66, "none.mcap"),
        (&["--level", "1", text(&empty)], 1, "no press"),
        (&["--level", "1", text(&noise)], 1, "no MCAP"),
        (
            &["--level", "1", "--config", text(&none), fixture],
            66,
            "none.mcap",
        ),
    ] {
        let output = collect(&out, arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(said.contains(part), "{said}");
        assert!(!out.exists());
    }
}
