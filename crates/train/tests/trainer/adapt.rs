//! `train --method frame` and `adapt` on tiny data: the model's outputs, a killed run that
//! continues bit for bit, and refused inputs.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use hardnessd_core::verdict::Hrn;
use hrn_train::data::dataset::{self, Dataset};
use rustix::process::{Pid, Signal, kill_process};

const SETTINGS: &str = "
    [training]
    epochs = 8
    batch = 16
    checkpoint_every_epochs = 1
";
/// Long enough to be killed on the way.
const LONG: &str = "
    [training]
    epochs = 60
    batch = 16
    checkpoint_every_epochs = 1
";

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hrn-train"));
    command.args(arguments);
    command
}

fn succeed(arguments: &[&str]) -> String {
    let output = command(arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// A directory with settings, `start.onnx` of the method `frame`, and `own.npz`, half of whose
/// training presses are unlabelled.
fn bench() -> &'static Path {
    static BENCH: OnceLock<tempfile::TempDir> = OnceLock::new();
    let directory = BENCH.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
        let (wide, own) = (path("wide.npz"), path("own.npz"));
        let simulate = [
            "simulate",
            "--lowest-force",
            "5",
            "--presses",
            "6",
            "--seed",
            "5",
        ];
        let broad = [
            "--materials",
            "broad",
            "--objects",
            "6",
            "--test-objects",
            "1",
        ];
        succeed(&[&simulate[..], &broad, &["--out", &wide]].concat());
        let few = [
            "--objects",
            "2",
            "--test-objects",
            "1",
            "--one-sensor",
            "3",
            "--cover",
            "1",
        ];
        succeed(&[&simulate[..], &few, &["--out", &own]].concat());
        let mut samples = Dataset::read(Path::new(&own)).unwrap().samples;
        for (number, sample) in samples.iter_mut().enumerate() {
            sample.level *= u8::from(number % 2 == 0);
        }
        let file = std::fs::File::create(&own).unwrap();
        dataset::write(file, &samples, &serde_json::json!({})).unwrap();
        std::fs::write(path("settings.toml"), SETTINGS).unwrap();
        std::fs::write(path("long.toml"), LONG).unwrap();
        let run = path("run");
        succeed(&[
            "train",
            "--method",
            "frame",
            "--data",
            &wide,
            "--out",
            &run,
            "--config",
            &path("settings.toml"),
        ]);
        succeed(&["export", &run, "--out", &path("start.onnx")]);
        directory
    });
    directory.path()
}

fn place(name: &str) -> String {
    bench().join(name).to_str().unwrap().to_owned()
}

fn adapt(out: &str, more: &[&str]) -> Command {
    let fixed = [
        "adapt",
        "--data",
        &place("own.npz"),
        "--start",
        &place("start.onnx"),
        "--config",
        &place("long.toml"),
        "--out",
        &place(out),
    ]
    .map(str::to_owned);
    let fixed: Vec<&str> = fixed.iter().map(String::as_str).collect();
    command(&[&fixed[..], more].concat())
}

fn done(command: &mut Command) -> Output {
    let output = command.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    output
}

#[test]
fn a_model_of_frames_gives_shore_hardness_with_its_interval() {
    let hrn = Hrn::load(&std::fs::read(place("start.onnx")).unwrap()).unwrap();
    assert_eq!(
        (hrn.card().method.as_str(), hrn.card().format.as_str()),
        ("frame", "1")
    );
    let samples = Dataset::read(Path::new(&place("wide.npz")))
        .unwrap()
        .samples;
    let (mut held, mut squares, mut truths) = (0, 0.0, Vec::new());
    for sample in &samples {
        let shore = hrn.judge(&sample.frame).unwrap().shore.unwrap();
        let truth = sample.shore.unwrap();
        held += usize::from((shore.low..=shore.high).contains(&truth));
        squares += (shore.value - truth).powi(2);
        truths.push(truth);
    }
    let n = truths.len() as f32;
    let mean = truths.iter().sum::<f32>() / n;
    let spread: f32 = truths.iter().map(|truth| (truth - mean).powi(2)).sum();
    assert!(
        squares < spread,
        "no better than the mean: {squares} against {spread}"
    );
    assert!(2 * held > truths.len(), "{held} of {n} intervals hold");
}

#[test]
fn adapt_killed_at_any_moment_goes_on_bit_for_bit() {
    done(&mut adapt("whole", &[]));
    let mut process = adapt("cut", &[]).stderr(Stdio::null()).spawn().unwrap();
    let checkpoints = PathBuf::from(place("cut")).join("checkpoints");
    let begun = Instant::now();
    // A checkpoint that is being written has another suffix.
    let count = || {
        let entries = std::fs::read_dir(&checkpoints).into_iter().flatten();
        let paths = entries.map(|entry| entry.unwrap().path());
        paths
            .filter(|path| path.extension().is_some_and(|suffix| suffix == "npz"))
            .count()
    };
    while count() == 0 && process.try_wait().unwrap().is_none() {
        assert!(begun.elapsed() < Duration::from_secs(100), "no checkpoint");
        std::thread::sleep(Duration::from_millis(2));
    }
    kill_process(Pid::from_child(&process), Signal::KILL).unwrap();
    process.wait().unwrap();
    let cut = PathBuf::from(place("cut"));
    assert!(
        count() > 0 && !cut.join("hrn.onnx").exists(),
        "killed too late"
    );
    done(&mut adapt("cut", &["--resume"]));
    let model = |run: &str| std::fs::read(Path::new(&place(run)).join("hrn.onnx")).unwrap();
    assert!(model("whole") == model("cut"), "models differ");
    assert!(model("whole") != std::fs::read(place("start.onnx")).unwrap());
    assert_eq!(Hrn::load(&model("whole")).unwrap().card().method, "adapt");
}

#[test]
fn adapt_goes_on_from_the_built_in_model_and_from_what_it_made() {
    let first = place("first");
    let (data, settings) = (place("own.npz"), place("settings.toml"));
    let fixed = ["adapt", "--data", &data, "--config", &settings];
    let told = succeed(&[&fixed[..], &["--out", &first]].concat());
    let built_in = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let of_start = succeed(&["evaluate", "--model", built_in, "--data", &data, "--json"]);
    let of_start: serde_json::Value = serde_json::from_str(&of_start).unwrap();
    let percent = 100.0 * of_start["accuracy"].as_f64().unwrap();
    let last = format!("accuracy of its start  {percent:.1} %\n");
    assert!(told.ends_with(&last), "{told}{last}");
    let model = Path::new(&first).join("hrn.onnx");
    let again = ["--start", model.to_str().unwrap(), "--out", &place("again")].map(str::to_owned);
    let again: Vec<&str> = again.iter().map(String::as_str).collect();
    succeed(&[&fixed[..], &again].concat());
}

#[test]
fn adapt_finds_the_factor_of_newtons_that_are_twice_too_large() {
    let mut samples = Dataset::read(Path::new(&place("own.npz"))).unwrap().samples;
    for sample in &mut samples {
        sample.frame = sample.frame.times(2.0);
    }
    let (data, model) = (place("twice.npz"), place("found/hrn.onnx"));
    let file = std::fs::File::create(&data).unwrap();
    dataset::write(file, &samples, &serde_json::json!({})).unwrap();
    let fixed = [
        "adapt",
        "--data",
        &data,
        "--config",
        &place("settings.toml"),
    ];
    // The factor of the first model is part of the second one's start.
    for more in [
        ["--out", &place("found")].as_slice(),
        &["--start", &model, "--out", &place("found-again")],
    ] {
        let output = done(&mut command(&[&fixed[..], more].concat()));
        let said = String::from_utf8(output.stderr).unwrap();
        let (_, factor) = said.split_once("forces times ").expect(&said);
        let factor: f64 = factor.split_once(':').unwrap().0.parse().unwrap();
        assert!((0.4..0.63).contains(&factor), "{said}");
    }
    let levels_right = |model: &str, frames: &str| {
        let told = succeed(&["evaluate", "--model", model, "--data", frames, "--json"]);
        let told: serde_json::Value = serde_json::from_str(&told).unwrap();
        told["accuracy"].as_f64().unwrap()
    };
    let built_in = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let (before, found) = (levels_right(built_in, &data), levels_right(&model, &data));
    assert!(found > before + 0.1, "{before} {found}");
}

#[test]
fn a_model_of_another_network_is_no_start() {
    let run = place("features");
    let learn = ["train", "--method", "features", "--profile", "smoke"];
    let where_to = ["--data", &place("wide.npz"), "--out", &run];
    succeed(&[learn.as_slice(), &where_to].concat());
    let features = format!("{run}/hrn.onnx");
    for (start, code, said) in [
        (
            features.as_str(),
            78,
            "this one is of features, with 4 levels",
        ),
        (
            "models/course.onnx",
            78,
            "starts from models of single frames (any method but features)",
        ),
        ("Cargo.toml", 78, "not an ONNX model"),
        ("missing.onnx", 66, "No such file"),
    ] {
        let start = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../..")
            .join(start);
        let output = command(&[
            "adapt",
            "--data",
            &place("own.npz"),
            "--out",
            &place("none"),
        ])
        .args(["--start", start.to_str().unwrap()])
        .output()
        .unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(
            error.contains(said) && error.lines().count() == 1,
            "{error}"
        );
        assert!(!Path::new(&place("none")).exists(), "{error}");
    }
}

/// A model of the paper's network that learnt the presses of `wide.npz` by heart.
fn paper_network() -> &'static str {
    static MODEL: OnceLock<String> = OnceLock::new();
    MODEL.get_or_init(|| {
        let (run, settings) = (place("paper-network"), place("by-heart.toml"));
        let by_heart = "
            [training]
            epochs = 60
            batch = 16
            [training.optimiser]
            rule = \"adam\"
            learning_rate = 0.002
        ";
        std::fs::write(&settings, by_heart).unwrap();
        let data = place("wide.npz");
        let fixed = ["train", "--method", "hrn100", "--data", &data];
        succeed(&[&fixed[..], &["--out", &run, "--config", &settings]].concat());
        format!("{run}/hrn.onnx")
    })
}

#[test]
fn adapt_goes_on_from_the_papers_network_and_finds_its_factor_too() {
    let mut samples = Dataset::read(Path::new(&place("wide.npz")))
        .unwrap()
        .samples;
    for sample in &mut samples {
        sample.frame = sample.frame.times(4.0);
    }
    let (data, first) = (place("wide-loud.npz"), place("paper-adapted/hrn.onnx"));
    let file = std::fs::File::create(&data).unwrap();
    dataset::write(file, &samples, &serde_json::json!({})).unwrap();
    // What was made can be a start, and its factor stays.
    for (start, out) in [
        (paper_network(), "paper-adapted"),
        (&first, "paper-adapted-again"),
    ] {
        let (settings, out) = (place("settings.toml"), place(out));
        let output = done(&mut command(&[
            "adapt", "--data", &data, "--start", start, "--config", &settings, "--out", &out,
        ]));
        let said = String::from_utf8(output.stderr).unwrap();
        let (_, factor) = said.split_once("forces times ").expect(&said);
        let factor: f64 = factor.split_once(':').unwrap().0.parse().unwrap();
        assert!((0.24..0.6).contains(&factor), "{said}");
        let model = std::fs::read(Path::new(&out).join("hrn.onnx")).unwrap();
        let card = Hrn::load(&model).unwrap().card().clone();
        assert_eq!(card.method, "adapt");
        let stated = card.metrics["force_factor"].as_f64().unwrap();
        assert!((stated - factor).abs() < 0.01, "{stated} {factor}");
    }
    let right = |model: &str| {
        let split = ["--split", "train", "--json"];
        let told =
            succeed(&[&["evaluate", "--model", model, "--data", &data], &split[..]].concat());
        let told: serde_json::Value = serde_json::from_str(&told).unwrap();
        told["accuracy"].as_f64().unwrap()
    };
    let (before, after) = (right(paper_network()), right(&first));
    assert!(after > before + 0.1, "{before} {after}");
}
