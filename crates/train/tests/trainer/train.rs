//! The trainer's binary on tiny data: it learns, resumes exactly, and its files are usable.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, Split};
use hrn_train::data::courses::Courses;
use hrn_train::data::dataset::{self, Dataset};
use rustix::process::{Pid, Signal};
use serde_json::{Value, json};

use crate::{data, hrn_train, succeed, write_data};

/// Settings with Adam on small batches: enough steps in few epochs to learn something.
const SETTINGS: &str = "
    [training]
    epochs = 6
    batch = 16
    averaging = 0.9
    checkpoint_every_epochs = 1
    [training.optimiser]
    rule = \"adam\"
    learning_rate = 0.005
    schedule = \"cosine\"
    [training.augmentation]
    symmetries = true
    shift_taxels = 2
    [validation]
    share = 0.25
    every_epochs = 2
    keep = \"best\"
";

/// Settings for all stages of the method in seconds. Pictures and measures of generated samples
/// take longest.
const GAN_SETTINGS: &str = "
    [ustgan]
    epochs = 4
    checkpoint_every_epochs = 1
    picture_every_epochs = 2
    gradient_penalty = 0.001
    generator_averaging = 0.5
    keep = \"best\"
    [stgan]
    picture_every_epochs = 1000
    [pretraining]
    checkpoint_every_epochs = 1
";

struct Trial {
    method: &'static str,
    data: PathBuf,
    out: PathBuf,
    config: PathBuf,
}

impl Trial {
    fn new(name: &str) -> Self {
        Self::of("hrn100", name, SETTINGS)
    }

    fn of(method: &'static str, name: &str, settings: &str) -> Self {
        let directory = data().0.path();
        // Tests run in parallel, so each has its own file, and none reads a half-written one.
        let out = directory.join(format!("trial {name}"));
        let config = directory.join(format!("trial {name}.toml"));
        std::fs::write(&config, settings).unwrap();
        Self {
            method,
            data: data().1.clone(),
            out,
            config,
        }
    }

    fn arguments(&self, seed: &'static str) -> Vec<String> {
        let mut arguments: Vec<String> = [
            "train",
            "--method",
            self.method,
            "--profile",
            "smoke",
            "--seed",
            seed,
        ]
        .map(str::to_owned)
        .to_vec();
        for (flag, path) in [
            ("--data", &self.data),
            ("--out", &self.out),
            ("--config", &self.config),
        ] {
            arguments.extend([flag.to_owned(), path.to_str().unwrap().to_owned()]);
        }
        arguments
    }

    fn output(&self, seed: &'static str, more: &[&str]) -> Output {
        let arguments = self.arguments(seed);
        let own = arguments.iter().map(String::as_str);
        hrn_train(&own.chain(more.iter().copied()).collect::<Vec<_>>())
    }

    #[track_caller]
    fn train(&self, seed: &'static str, more: &[&str]) {
        let output = self.output(seed, more);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{:?}: {errors}", self.out);
    }

    fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.out.join(name)).unwrap()
    }

    /// The names of the checkpoints, sorted.
    fn checkpoints(&self) -> Vec<String> {
        let Ok(directory) = std::fs::read_dir(self.out.join("checkpoints")) else {
            return Vec::new();
        };
        let mut names: Vec<String> = directory
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|name| name.ends_with(".npz"))
            .collect();
        names.sort();
        names
    }

    /// Asserts that both runs have the same checkpoints and model, byte for byte.
    #[track_caller]
    fn assert_same(&self, other: &Self) {
        assert_eq!(self.checkpoints(), other.checkpoints());
        for name in self.checkpoints() {
            let name = format!("checkpoints/{name}");
            assert!(self.read(&name) == other.read(&name), "{name} differs");
        }
        assert!(
            self.read("hrn.onnx") == other.read("hrn.onnx"),
            "models differ"
        );
    }
}

#[test]
fn a_run_learns_and_leaves_what_it_promises() {
    let trial = Trial::new("whole");
    trial.train("1", &[]);

    let metrics = String::from_utf8(trial.read("metrics.csv")).unwrap();
    let losses: Vec<f64> = metrics
        .lines()
        .skip(1)
        .map(|row| row.split(',').nth(3).unwrap().parse().unwrap())
        .collect();
    assert_eq!(losses.len(), 6, "{metrics}");
    assert!(
        losses[5] < 0.8 * losses[0],
        "the loss should fall: {losses:?}"
    );

    let hrn = Hrn::load(&trial.read("hrn.onnx")).unwrap();
    assert_eq!(hrn.card().method, "hrn100");
    assert_eq!(hrn.card().validation, "simulated data only");
    assert!(
        hrn.card().data.contains("\"seed\":5"),
        "{}",
        hrn.card().data
    );
    for name in ["settings.toml", "revision", "evaluation.json"] {
        assert!(!trial.read(name).is_empty(), "{name}");
    }

    // `evaluate` measures the same on an exported copy as the run recorded.
    let (copy, data) = (trial.out.join("copy.onnx"), data().1.to_str().unwrap());
    let copy = copy.to_str().unwrap();
    succeed(&["export", trial.out.to_str().unwrap(), "--out", copy]);
    assert_eq!(std::fs::read(copy).unwrap(), trial.read("hrn.onnx"));
    let printed = succeed(&["evaluate", "--model", copy, "--data", data, "--json"]);
    let printed: Value = serde_json::from_str(&printed).unwrap();
    let written: Value = serde_json::from_slice(&trial.read("evaluation.json")).unwrap();
    assert_eq!(printed, written);
    assert_eq!(printed["n"], 40);
    let inspected = succeed(&["inspect", copy]);
    assert!(inspected.contains("simulated data only"), "{inspected}");
    let temperature = hrn.card().metrics["temperature"].as_f64().unwrap();
    let line = format!("\ntemperature   {temperature:.3}\n");
    assert!(inspected.contains(&line), "{inspected}");
}

/// Starts or resumes a run, and sends `signal` once `stage` has a checkpoint of at least `steps`
/// steps, wherever the run is by then. Returns the exit code, if there is one, and the line of
/// stderr about the interruption. A line of progress may follow it.
fn interrupted(
    trial: &Trial,
    seed: &'static str,
    (stage, steps): (&str, u64),
    signal: Signal,
) -> (Option<i32>, String) {
    let mut process = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(trial.arguments(seed))
        .arg("--resume")
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let awaited = format!("{stage}-{steps:010}");
    let is_there = |name: &String| name.starts_with(stage) && *name >= awaited;
    while !trial.checkpoints().iter().any(is_there) {
        let ended = process.try_wait().unwrap();
        assert!(ended.is_none(), "ended before it could be interrupted");
        std::thread::yield_now();
    }
    rustix::process::kill_process(Pid::from_child(&process), signal).unwrap();
    let output = process.wait_with_output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    let about = message.lines().find(|line| line.starts_with("hrn-train: "));
    (output.status.code(), about.unwrap_or_default().to_owned())
}

#[test]
fn an_interrupted_run_resumes_to_the_same_weights_bit_for_bit() {
    let whole = Trial::new("uninterrupted");
    whole.train("2", &[]);
    for (name, signal, code) in [
        ("killed", Signal::KILL, None),
        ("terminated", Signal::TERM, Some(143)),
        ("interrupted", Signal::INT, Some(130)),
    ] {
        let trial = Trial::new(name);
        // After two epochs.
        let (ended, message) = interrupted(&trial, "2", ("hrn", 16), signal);
        assert_eq!(ended, code, "{name}");
        if code.is_some() {
            assert!(
                message.starts_with("hrn-train: interrupted; to continue: "),
                "{message}"
            );
            assert!(message.ends_with(" --resume"), "{message}");
        }
        assert!(!trial.out.join("hrn.onnx").exists(), "{name}");
        trial.train("2", &["--resume"]);
        trial.assert_same(&whole);
    }
}

#[test]
fn the_whole_method_killed_in_any_stage_resumes_bit_for_bit_and_shares_its_stages() {
    let whole = Trial::of("ours", "whole method", GAN_SETTINGS);
    whole.train("6", &[]);
    let killed = Trial::of("ours", "killed method", GAN_SETTINGS);
    // The third checkpoint of USTGAN holds the weights that were best after two epochs.
    for (stage, steps) in [("ustgan", 6), ("stgan2", 1), ("pretraining", 1)] {
        interrupted(&killed, "6", (stage, steps), Signal::KILL);
        assert!(!killed.out.join("hrn.onnx").exists(), "{stage}");
    }
    killed.train("6", &["--resume"]);
    killed.assert_same(&whole);

    // A row has the losses of generator and discriminator and sigma. The last one has the likeness
    // of each stage.
    let metrics = String::from_utf8(whole.read("metrics.csv")).unwrap();
    let last = |stage: &str| -> Vec<String> {
        let row = metrics.lines().rfind(|row| row.starts_with(stage)).unwrap();
        row.split(',').map(str::to_owned).collect()
    };
    let columns: Vec<&str> = metrics.lines().next().unwrap().split(',').collect();
    for stage in ["ustgan", "stgan1", "stgan4"] {
        let row = last(stage);
        for name in [
            "loss",
            "generator_loss",
            "sigma_min",
            "pixel_std",
            "feature_distance",
        ] {
            let place = columns.iter().position(|column| *column == name).unwrap();
            assert!(
                row[place].parse::<f64>().unwrap().is_finite(),
                "{stage} {name}"
            );
        }
        let number: u32 = row[2].parse().unwrap();
        assert!(
            !whole
                .read(&format!("samples/{stage}-{number:06}.png"))
                .is_empty()
        );
    }
    for name in ["samples/generated.png", "samples/mistakes.png"] {
        assert!(!whole.read(name).is_empty(), "{name}");
    }

    // NAHRN has the same USTGAN and takes it over, so none of it is trained again.
    let sharing = Trial::of("nahrn", "sharing", GAN_SETTINGS);
    sharing.train("6", &["--from", whole.out.to_str().unwrap()]);
    let of_ustgan = |trial: &Trial| -> Vec<String> {
        let text = String::from_utf8(trial.read("metrics.csv")).unwrap();
        let rows = text.lines().filter(|row| row.starts_with("ustgan"));
        rows.map(str::to_owned).collect()
    };
    assert_eq!(of_ustgan(&sharing), of_ustgan(&whole));
    assert_eq!(of_ustgan(&sharing).len(), 4);
    assert!(!sharing.out.join("samples/ustgan-000004.png").exists());
    // Training USTGAN alone gives the same model. With another seed, USTGAN is trained anew.
    let alone = Trial::of("nahrn", "alone", GAN_SETTINGS);
    alone.train("6", &[]);
    assert!(alone.read("hrn.onnx") == sharing.read("hrn.onnx"));
    let other = Trial::of("nahrn", "other seed", GAN_SETTINGS);
    other.train("7", &["--from", whole.out.to_str().unwrap()]);
    assert!(other.out.join("samples/ustgan-000004.png").exists());
    // Metrics of another version are not an error: the stage is trained here.
    std::fs::write(whole.out.join("metrics.csv"), "stage,other\n").unwrap();
    let foreign = Trial::of("nahrn", "foreign metrics", GAN_SETTINGS);
    foreign.train("6", &["--from", whole.out.to_str().unwrap()]);
    foreign.assert_same(&alone);
}

#[test]
fn settings_of_recognisers_do_not_change_a_gan() {
    let [plain, augmented] = [("plain", ""), ("augmented", AUGMENTED)].map(|(name, more)| {
        let trial = Trial::of("sgan", name, &format!("{GAN_SETTINGS}{more}"));
        trial.train("1", &[]);
        trial
    });
    plain.assert_same(&augmented);
}

/// Settings that SGAN and IGAN have no stage for.
const AUGMENTED: &str = "
    [training]
    batch = 16
    augmentation.symmetries = true
    augmentation.shift_taxels = 2
";

#[test]
fn held_out_objects_are_used_or_it_is_said() {
    for (method, settings, code, expected) in [
        (
            "sgan",
            "share = 0.25",
            78,
            "`validation.share`: found 0.25, expected 0: sgan and igan",
        ),
        (
            "igan",
            "share = 0.25\nkeep = \"best\"",
            78,
            "`validation.share`: found 0.25, expected 0: sgan and igan",
        ),
        (
            "frame",
            "share = 0.25\nkeep = \"best\"",
            78,
            "`validation.keep`: found best, expected last",
        ),
        // There are four objects a level.
        (
            "hrn100",
            "share = 0.1\nkeep = \"best\"",
            78,
            "`validation.share`: found 0.1, expected one that, with `validation.keep` best, rounds",
        ),
        (
            "hrn100",
            "share = 0.1",
            0,
            "`validation.share`: 0.1 of the labelled objects of each level rounds to none",
        ),
    ] {
        let name = format!("held out {method} {code}");
        let trial = Trial::of(method, &name, &format!("[validation]\n{settings}\n"));
        let output = trial.output("1", &[]);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert_eq!(error.matches(expected).count(), 1, "{error}");
        assert_eq!(trial.out.exists(), code == 0, "{name}");
        let _ = std::fs::remove_dir_all(trial.out);
    }
}

#[test]
fn a_training_that_diverges_ends_where_it_does() {
    let one_step = "epochs = 1\nbatch = 1000\n";
    for (name, method, settings, rate, expected) in [
        (
            "loss",
            "hrn100",
            "[training]\n",
            1e30,
            "hrn: epoch 1: loss: found NaN",
        ),
        (
            "GAN's loss",
            "sgan",
            "[ustgan]\n",
            1e30,
            "sgan: epoch 1: loss: found NaN",
        ),
        // The weights become NaN in the very last step.
        (
            "weight",
            "hrn100",
            &format!("[training]\n{one_step}"),
            1e300,
            "hrn: epoch 1: conv1.kernel: found ",
        ),
        (
            "GAN's weight",
            "nahrn",
            &format!("[ustgan]\n{one_step}"),
            1e300,
            "ustgan: epoch 1: ",
        ),
        (
            "logit",
            "hrn100",
            &format!("[training]\n{one_step}"),
            1e30,
            "hrn: epoch 1: logit: found NaN",
        ),
    ] {
        let settings = format!("{settings}optimiser.learning_rate = {rate:e}\n");
        let trial = Trial::of(method, &format!("diverging {name}"), &settings);
        let output = trial.output("1", &[]);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {error}");
        let last = error.lines().last().unwrap();
        assert!(
            last.contains(expected) && last.ends_with(": the training has diverged"),
            "{name}: {error}"
        );
        assert_eq!(trial.checkpoints().is_empty(), name != "logit", "{name}");
    }
}

#[test]
fn presses_are_counted_by_level_and_levels_counted_from_0_are_warned_of() {
    let trial = Trial::new("counted");
    let message = String::from_utf8(trial.output("1", &[]).stderr).unwrap();
    let counts = "training presses: level 1 40, level 2 40, level 3 40, level 4 40, unlabelled";
    assert!(message.contains(counts), "{message}");
    assert!(!message.contains("warning"), "{message}");

    let mut dataset = Dataset::read(&data().1).unwrap();
    for sample in &mut dataset.samples {
        sample.level -= 1;
    }
    let shifted = trial.out.with_extension("npz");
    let samples = std::mem::take(&mut dataset.samples);
    write_data(&shifted, &samples, &json!({}));
    let out = trial.out.with_extension("shifted");
    let (data, out) = (shifted.to_str().unwrap(), out.to_str().unwrap());
    let arguments = ["train", "--method", "features", "--profile", "smoke"];
    let paths = ["--data", data, "--out", out];
    let message = hrn_train(&[&arguments[..], &paths].concat()).stderr;
    let message = String::from_utf8(message).unwrap();
    assert!(
        message.contains("were the levels counted from 0?"),
        "{message}"
    );
}

#[test]
fn every_method_leaves_a_model() {
    for method in [
        "nihrn",
        "sgan",
        "igan",
        "hrn15",
        "hrn50",
        "hrn15-long",
        "hrn15-tuned",
        "hrn15-strong",
    ] {
        let trial = Trial::of(method, method, GAN_SETTINGS);
        trial.train("1", &["--label-choice", "random"]);
        let card = Hrn::load(&trial.read("hrn.onnx")).unwrap().card().clone();
        assert_eq!(card.method, method);
        let settings = String::from_utf8(trial.read("settings.toml")).unwrap();
        // These are 15 or 50 % of 160.
        let labels = if method == "hrn50" { 80 } else { 24 };
        if method == "hrn15-long" {
            // In this setting: 400 generated samples twice, in 4 steps each; 24 labelled ones
            // twice, in one step.
            let metrics = String::from_utf8(trial.read("metrics.csv")).unwrap();
            let last = metrics.lines().last().unwrap();
            assert!(last.starts_with("hrn,10,10,"), "{last}");
        }
        assert!(
            settings.contains(&format!("labels = {labels}\n")),
            "{settings}"
        );
    }
}

#[test]
fn a_discriminator_learns_from_unlabelled_samples_too() {
    let mut samples = Dataset::read(&data().1).unwrap().samples;
    // Two presses of each object become unlabelled, so the first samples of all are.
    for (number, sample) in samples.iter_mut().enumerate() {
        sample.level *= u8::from(number % 10 > 1);
    }
    let path = data().0.path().join("unlabelled.npz");
    write_data(&path, &samples, &json!({}));
    for method in ["sgan", "igan"] {
        let trial = Trial {
            data: path.clone(),
            ..Trial::of(method, &format!("unlabelled {method}"), GAN_SETTINGS)
        };
        trial.train("1", &[]);
        assert!(Hrn::load(&trial.read("hrn.onnx")).is_ok(), "{method}");
    }
}

#[test]
fn a_reader_that_goes_ends_it_quietly() {
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(["inspect", model])
        .stdout(writer)
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && error.is_empty(), "{error}");
}

#[test]
fn a_name_does_not_control_the_terminal() {
    let directory = tempfile::tempdir().unwrap();
    let run = directory.path().join("run");
    let run = run.to_str().unwrap();
    let data = data().1.to_str().unwrap();
    succeed(&[
        "train",
        "--method",
        "features",
        "--profile",
        "smoke",
        "--data",
        data,
        "--out",
        run,
    ]);
    let model = directory.path().join("m\u{1b}[2J.onnx");
    let message = succeed(&["export", run, "--out", model.to_str().unwrap()]);
    let shown = model.to_str().unwrap().replace('\u{1b}', "\\u{1b}");
    assert!(
        message.starts_with(&format!("{shown}: sha256 ")),
        "{message}"
    );
}

#[test]
fn a_full_disk_is_an_error_and_leaves_the_last_checkpoint_intact() {
    let whole = Trial::new("ample disk");
    whole.train("8", &[]);
    let trial = Trial::new("full disk");
    interrupted(&trial, "8", ("hrn", 1), Signal::KILL);
    let before = trial.checkpoints();
    // No file may grow beyond 64 blocks of 512 bytes. A process that tries gets an error and is not
    // killed, as on a full disk. A checkpoint is larger.
    let output = Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 64; exec \"$@\"", "sh"])
        .arg(env!("CARGO_BIN_EXE_hrn-train"))
        .args(trial.arguments("8"))
        .arg("--resume")
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    let error = error.lines().last().unwrap();
    assert_eq!(output.status.code(), Some(74), "{error}");
    assert!(error.contains("checkpoints/hrn-"), "{error}");
    assert!(error.contains("File too large"), "{error}");
    assert_eq!(trial.checkpoints(), before);
    trial.train("8", &["--resume"]);
    trial.assert_same(&whole);
}

#[test]
fn another_seed_gives_other_weights_and_a_run_is_not_overwritten() {
    let (first, other) = (Trial::new("seed 3"), Trial::new("seed 4"));
    first.train("3", &[]);
    other.train("4", &[]);
    assert!(first.read("hrn.onnx") != other.read("hrn.onnx"));

    let refused = |seed, more: &[&str], expected: &str| {
        let output = first.output(seed, more);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(error.contains(expected), "{error}");
    };
    refused("3", &[], "continue it with --resume");
    refused("5", &["--resume"], "`seed`: found 5, expected 3");
    // Two processes cannot continue the same run.
    let other_process = std::fs::File::open(&first.out).unwrap();
    let lock = rustix::fs::FlockOperation::LockExclusive;
    rustix::fs::flock(&other_process, lock).unwrap();
    refused(
        "3",
        &["--resume"],
        "seed 3: another process is at work here",
    );
    drop(other_process);
    // A run does not continue from a checkpoint of another run.
    for name in first.checkpoints() {
        let place = |trial: &Trial| trial.out.join("checkpoints").join(&name);
        std::fs::copy(place(&other), place(&first)).unwrap();
    }
    refused("3", &["--resume"], "hrn: the checkpoint is of other frames");
}

#[test]
fn the_baseline_is_a_model_like_any_other() {
    let out = data().0.path().join("features");
    let (out, data) = (out.to_str().unwrap(), data().1.to_str().unwrap());
    succeed(&[
        "train", "--method", "features", "--data", data, "--out", out,
    ]);
    let model = Path::new(out).join("hrn.onnx");
    assert_eq!(
        Hrn::load(&std::fs::read(&model).unwrap())
            .unwrap()
            .card()
            .method,
        "features"
    );
    let mistakes = std::fs::read(Path::new(out).join("samples/mistakes.png")).unwrap();
    assert!(mistakes.starts_with(b"\x89PNG"));
    let model = model.to_str().unwrap();
    let train = [
        "evaluate", "--model", model, "--data", data, "--split", "train", "--json",
    ];
    let evaluation: Value = serde_json::from_str(&succeed(&train)).unwrap();
    let accuracy = evaluation["accuracy"].as_f64().unwrap();
    assert!(accuracy > 0.7, "on what it was fitted to: {accuracy}");
}

#[test]
fn swapped_levels_train_on_the_other_material() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("swapped.npz");
    let out = path.to_str().unwrap();
    let few = ["--objects", "1", "--test-objects", "1", "--presses", "1"];
    succeed(
        &[
            &["simulate", "--out", out, "--swapped-levels", "42"],
            &few[..],
        ]
        .concat(),
    );
    let samples = Dataset::read(&path).unwrap().samples;
    assert_eq!(samples.len(), 8);
    for sample in samples {
        let material = Material::ALL[usize::from(sample.material.unwrap())];
        let swapped = [2, 4].contains(&sample.level);
        assert_eq!(sample.split != material.split(), swapped, "{material:?}");
    }
}

#[test]
fn broad_data_say_their_levels_and_laws() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("broad.npz");
    let out = path.to_str().unwrap();
    let broad = ["--materials", "broad", "--shapes", "wide", "--presses", "2"];
    let few = ["--objects", "2", "--test-objects", "1", "--out", out];
    let simulate = |more: &[&str]| {
        let _ = std::fs::remove_file(&path);
        succeed(&[&["simulate"][..], &broad, &few, more].concat());
        let dataset = Dataset::read(&path).unwrap();
        (dataset.samples, dataset::meta(&path).unwrap())
    };
    let (samples, meta) = simulate(&[]);
    assert_eq!(samples.len(), 4 * 3 * 2);
    assert_eq!(meta["materials"][11], "broad-layered");
    assert_eq!(meta["levels"][1]["shore"], "60-70");
    for sample in &samples {
        let shore = sample.shore.unwrap();
        let expected = match shore {
            70.0.. => 1,
            60.0.. => 2,
            50.0.. => 3,
            _ => 4,
        };
        assert_eq!(sample.level, expected, "Shore {shore}");
    }
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let csv = directory.path().join("v.csv");
    let evaluate = [
        "evaluate",
        "--model",
        model,
        "--data",
        out,
        "--split",
        "train",
        "--json",
        "--verdicts",
        csv.to_str().unwrap(),
    ];
    let evaluation: Value = serde_json::from_str(&succeed(&evaluate)).unwrap();
    assert!(evaluation["shore"]["rmse"].is_number(), "{evaluation}");
    let verdicts = std::fs::read_to_string(csv).unwrap();
    assert_eq!(verdicts.lines().count(), 1 + 16, "{verdicts}");
    let sheet = directory.path().join("sheet.png");
    let sheet = [
        "--gaps",
        "--laws",
        "solid,foam",
        "--sheet",
        sheet.to_str().unwrap(),
    ];
    let (samples, meta) = simulate(&sheet);
    assert_eq!(meta["levels"][1]["shore"], "61-70");
    assert_eq!(meta["settings"]["laws"], json!(["solid", "foam"]));
    assert!(
        samples
            .iter()
            .all(|s| [8, 10].contains(&s.material.unwrap()))
    );
}

#[test]
fn presses_over_time_are_data_too() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("courses.npz");
    let sheet = directory.path().join("sheet.png");
    let printed = succeed(&[
        "simulate",
        "--sequences",
        "--materials",
        "broad",
        "--fps",
        "20",
        "--objects",
        "1",
        "--test-objects",
        "1",
        "--presses",
        "2",
        "--out",
        path.to_str().unwrap(),
        "--sheet",
        sheet.to_str().unwrap(),
    ]);
    assert!(printed.contains("presses, "), "{printed}");
    assert!(std::fs::read(&sheet).unwrap().starts_with(b"\x89PNG"));
    let courses = Courses::read(&path).unwrap();
    assert!((14..=16).contains(&courses.presses.len()), "{printed}");
    for press in 0..courses.presses.len() {
        let times = &courses.time_s[courses.rows(press)];
        let frame_s = times[1] - times[0];
        assert!(
            times.len() > 48 || (frame_s - 0.05).abs() < 1e-4,
            "{times:?}"
        );
    }
}

#[test]
fn presses_on_many_sensors_are_files_of_whole_sensors() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let (out, sheet) = (path("w.npz"), path("w.png"));
    let options = "simulate --sequences --sensors broad --materials broad --objects 2 --test-objects 1 \
                   --presses 1 --covers 2 --test-covers 1 --electronics 2 --shards 2 --jobs 2";
    let files = [
        "--out",
        out.to_str().unwrap(),
        "--sheet",
        sheet.to_str().unwrap(),
    ];
    let arguments: Vec<&str> = options.split_whitespace().chain(files).collect();
    let message = succeed(&arguments);
    assert_eq!(message.lines().count(), 2, "{message}");
    assert!(std::fs::read(&sheet).unwrap().starts_with(b"\x89PNG"));
    let (first, second) = (path("w-0.npz"), path("w-1.npz"));
    let bytes = [&first, &second].map(|path| std::fs::read(path).unwrap());
    for path in [&first, &second, &sheet] {
        std::fs::remove_file(path).unwrap();
    }
    succeed(&arguments);
    assert!(bytes == [&first, &second].map(|path| std::fs::read(path).unwrap()));
    // Covers 0 and 2 are in the first file: sensors 0, 1, 4 and 5.
    let courses = Courses::read(&first).unwrap();
    let mut sensors: Vec<u32> = courses.presses.iter().map(|press| press.sensor).collect();
    sensors.dedup();
    sensors.sort_unstable();
    sensors.dedup();
    assert_eq!(sensors, [0, 1, 4, 5]);
    let (all, _) = Courses::read_all(&[first, second]).unwrap();
    let references = all.presses.iter().filter(|press| press.reference.is_some());
    assert!((40..=60).contains(&references.count()), "{message}");
}

#[test]
fn bad_input_has_its_exit_code_and_one_line() {
    let path = |name: &str| data().0.path().join(name).to_str().unwrap().to_owned();
    let (data, missing, text, out) = (
        path("tiny.npz"),
        path("missing"),
        path("text.toml"),
        path("refused"),
    );
    std::fs::write(&text, "epoch = 3\n").unwrap();
    let method = |name: &str, more: &[&str]| {
        let mut arguments = vec!["train", "--method", name];
        arguments.extend(more);
        hrn_train(&arguments)
    };
    let train = |more: &[&str]| method("hrn100", &[&["--out", &out], more].concat());
    let no_gan = path("no gan");
    let lowest = |force: &str| {
        let force = format!("--lowest-force={force}");
        hrn_train(&["simulate", &force, "--out", &out])
    };
    let model = path("model.onnx");
    std::fs::write(&model, hardnessd_core::verdict::BUILT_IN_HRN).unwrap();
    let mut samples = Dataset::read(Path::new(&data)).unwrap().samples;
    samples.retain(|sample| sample.split == Split::Train);
    let untested = path("untested.npz");
    write_data(Path::new(&untested), &samples, &json!({}));
    for sample in &mut samples {
        sample.level *= u8::from(sample.level != 3);
    }
    let without_level_3 = path("without level 3.npz");
    write_data(Path::new(&without_level_3), &samples, &json!({}));
    let empty_split = format!("{untested}: no sample of the test split has a level: add some");
    let corrupt = path("corrupt");
    std::fs::create_dir(&corrupt).unwrap();
    std::fs::write(
        path("corrupt/settings.toml"),
        b"method = \"hrn100\"\nprof\xff",
    )
    .unwrap();
    let simulate = |more: &[&str]| hrn_train(&[&["simulate", "--out", &out], more].concat());
    let no_run = format!("hrn-train: {missing}/hrn.onnx: ");
    let beside = path("beside.npz");
    let sheet = ["--sheet", "/dev/null/no", "--out", &beside];
    let cases = [
        (
            hrn_train(&[&["simulate", "--presses", "1"], &sheet[..]].concat()),
            74,
            "/dev/null/no",
        ),
        (train(&["--data", &missing]), 66, "missing"),
        (train(&["--data", &text]), 1, "not an .npz file"),
        (
            train(&["--data", &data, "--config", &missing]),
            66,
            "missing",
        ),
        (
            train(&["--data", &data, "--config", &text]),
            78,
            "line 1, column 1, `epoch = 3`: unknown field `epoch`",
        ),
        (train(&["--data", &data, "--from", &missing]), 66, "missing"),
        (
            method("hrn100", &["--data", &data, "--out", &corrupt, "--resume"]),
            78,
            "corrupt/settings.toml: line 2",
        ),
        (
            hrn_train(&["evaluate", "--model", &model, "--data", &untested]),
            1,
            &empty_split,
        ),
        (
            simulate(&["--objects", "4294967295"]),
            2,
            "not in 0..=10000",
        ),
        (simulate(&["--presses", "0"]), 2, "not in 1..=10000"),
        (
            simulate(&["--swapped-levels", "25"]),
            2,
            "expected levels from 1 to 4, such as 24",
        ),
        (
            simulate(&["--laws", "foam"]),
            2,
            "--laws: works with `--materials broad` only",
        ),
        (
            simulate(&["--materials", "broad", "--all-test"]),
            2,
            "--all-test: works with `--materials named` only",
        ),
        (
            simulate(&["--materials", "broad", "--laws", "liquid"]),
            2,
            "unknown variant `liquid`, expected one of `solid`, `plastic`, `foam`, `layered`",
        ),
        (
            simulate(&["--shapes", "round"]),
            2,
            "expected one of `matched`, `wide`, `paper`",
        ),
        (
            simulate(&["--objects", "0", "--test-objects", "0"]),
            2,
            "found 0 and 0, expected one or more",
        ),
        (
            train(&["--data", &data, "--labels", "3"]),
            2,
            "--labels: found 3, expected at least 4",
        ),
        (
            train(&["--data", &data, "--labels", "161"]),
            2,
            "at most the data's 160",
        ),
        (train(&["--data", &data, "--labels=-1"]), 2, "--labels"),
        #[cfg(not(feature = "cuda"))]
        (
            train(&["--data", &data, "--device", "cuda"]),
            69,
            "this build has no CUDA: build with --features cuda",
        ),
        (lowest("nan"), 2, "expected newtons from 0.01 to 25"),
        (lowest("inf"), 2, "expected newtons from 0.01 to 25"),
        (lowest("-5"), 2, "expected newtons from 0.01 to 25"),
        (lowest("1e9"), 2, "expected newtons from 0.01 to 25"),
        (hrn_train(&["inspect", &text]), 78, "not an ONNX model"),
        (hrn_train(&["inspect", &missing]), 66, "missing"),
        (hrn_train(&["export", &missing, "--out", &out]), 66, &no_run),
        (
            hrn_train(&["export", &corrupt, "--out", &out]),
            66,
            "it was stopped: `hrn-train train --resume`",
        ),
        (
            hrn_train(&["evaluate", "--model", &text, "--data", &data]),
            78,
            "not an ONNX model",
        ),
        (hrn_train(&["train", "--method", "alchemy"]), 2, "alchemy"),
        (
            method("hrn15", &["--data", &data, "--out", "/dev/null/no"]),
            74,
            "/dev/null/no",
        ),
        (
            method(
                "ours",
                &["--data", &data, "--out", &no_gan, "--labels", "160"],
            ),
            1,
            "no unlabelled training samples are left",
        ),
        (
            method("ours", &["--data", &without_level_3, "--out", &no_gan]),
            1,
            "no labelled training samples of level 3 for its STGAN",
        ),
        (
            hrn_train(&["simulate", "--presses", "1", "--out", "/dev/null/no"]),
            74,
            "/dev/null/no",
        ),
    ];
    for (output, code, expected) in cases {
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(error.contains(expected), "{error}");
        assert!(code != 2 || error.lines().count() == 1, "{error}");
    }
    // If a stage cannot be done, nothing is trained, and no run is begun.
    assert!(!Path::new(&no_gan).exists());
    // If a picture cannot be written, nothing is simulated.
    assert!(!Path::new(&beside).exists());
}

/// This test takes minutes: run it by hand.
#[test]
#[ignore = "heavy"]
fn a_training_killed_a_hundred_times_ends_with_the_same_bits() {
    let (directory, data) = data();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let settings = "[training]\nepochs = 400\nbatch = 16\ncheckpoint_every_epochs = 1\n";
    std::fs::write(path("killed.toml"), settings).unwrap();
    let arguments = |out: &str| {
        let arguments = [
            "train",
            "--method",
            "frame",
            "--resume",
            "--data",
            data.to_str().unwrap(),
        ];
        let arguments = arguments.into_iter().map(str::to_owned);
        let more = [
            "--config".to_owned(),
            path("killed.toml"),
            "--out".to_owned(),
            path(out),
        ];
        arguments.chain(more).collect::<Vec<String>>()
    };
    let model = |out: &str| std::fs::read(Path::new(&path(out)).join("hrn.onnx")).unwrap();
    let whole: Vec<String> = arguments("never killed");
    succeed(&whole.iter().map(String::as_str).collect::<Vec<_>>());

    let mut moments = Stream::new(2, "moments of death");
    let (mut kills, mut run) = (0, 0);
    while kills < 100 {
        let out = format!("killed {run}");
        let mut training = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
            .args(arguments(&out))
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_secs_f64(1.5 * moments.uniform()));
        if let Some(status) = training.try_wait().unwrap() {
            assert!(status.success(), "{status:?} after {kills} kills");
            assert!(
                model(&out) == model("never killed"),
                "models differ after {kills} kills"
            );
            run += 1;
            continue;
        }
        rustix::process::kill_process(Pid::from_child(&training), Signal::KILL).unwrap();
        training.wait().unwrap();
        kills += 1;
    }
    let last: Vec<String> = arguments(&format!("killed {run}"));
    succeed(&last.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(
        model(&format!("killed {run}")) == model("never killed"),
        "models differ"
    );
    println!(
        "100 kills over {} runs: all end with the same bits",
        run + 1
    );
}
