//! The trainer's binary on tiny data: it learns, resumes exactly, and its files are usable.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::Split;
use hrn_train::data::presses::{self, read_one};
use rustix::process::{Pid, Signal};
use serde_json::{Value, json};

use crate::{data, hrn_train, succeed, succeed_in, write_data};

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
";

/// Settings for all stages of the method in seconds.
const GAN_SETTINGS: &str = "
    [ustgan]
    epochs = 4
    checkpoint_every_epochs = 1
    averaging = 0.5
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
    let trial = Trial::new("terminated");
    // After two epochs.
    let (ended, message) = interrupted(&trial, "2", ("hrn", 16), Signal::TERM);
    assert_eq!(ended, Some(143));
    assert!(
        message.starts_with("hrn-train: interrupted; to continue: "),
        "{message}"
    );
    assert!(message.ends_with(" --resume"), "{message}");
    assert!(!trial.out.join("hrn.onnx").exists());
    trial.train("2", &["--resume"]);
    trial.assert_same(&whole);
}

#[test]
fn the_whole_method_killed_between_stages_resumes_bit_for_bit_and_shares_its_stages() {
    let whole = Trial::of("ours", "whole method", GAN_SETTINGS);
    whole.train("6", &[]);
    let killed = Trial::of("ours", "killed method", GAN_SETTINGS);
    interrupted(&killed, "6", ("stgan2", 1), Signal::KILL);
    assert!(!killed.out.join("hrn.onnx").exists());
    killed.train("6", &["--resume"]);
    killed.assert_same(&whole);

    // A row has the losses of generator and discriminator, and sigma.
    let metrics = String::from_utf8(whole.read("metrics.csv")).unwrap();
    let columns: Vec<&str> = metrics.lines().next().unwrap().split(',').collect();
    for stage in ["ustgan", "stgan1", "stgan4"] {
        let row = metrics.lines().rfind(|row| row.starts_with(stage)).unwrap();
        let row: Vec<&str> = row.split(',').collect();
        for name in ["loss", "generator_loss", "sigma_min"] {
            let place = columns.iter().position(|column| *column == name).unwrap();
            let found: f64 = row[place].parse().unwrap();
            assert!(found.is_finite(), "{stage} {name}");
        }
    }
    // Some of the generated presses can be looked at.
    let generated = read_one(&whole.out.join("samples/generated.npz")).unwrap();
    let levels: Vec<u8> = generated.all.iter().map(|press| press.level).collect();
    assert!(levels.is_sorted() && levels.first() == Some(&1) && levels.last() == Some(&4));

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
}

#[test]
fn held_out_objects_are_used_or_it_is_said() {
    // There are four objects a level.
    let trial = Trial::of("hrn100", "held out", "[validation]\nshare = 0.1\n");
    let output = trial.output("1", &[]);
    let error = String::from_utf8_lossy(&output.stderr);
    let expected = "`validation.share`: 0.1 of the labelled objects of each level rounds to none";
    assert!(output.status.success(), "{error}");
    assert_eq!(error.matches(expected).count(), 1, "{error}");
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

    let mut presses = read_one(&data().1).unwrap();
    for press in &mut presses.all {
        press.level -= 1;
    }
    let shifted = trial.out.with_extension("npz");
    write_data(&shifted, &presses, &json!({}));
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
fn settings_of_the_user_win_over_those_of_the_recipe() {
    // The recipe has 6 steps in this profile, and Adam.
    let usual = Trial::of("hrn", "usual hrn", "");
    usual.train("1", &[]);
    let given = "[training]\nepochs = 5\noptimiser.rule = \"sgd\"\n";
    let own = Trial::of("hrn", "own hrn", given);
    own.train("1", &[]);
    let last = |trial: &Trial| {
        let metrics = String::from_utf8(trial.read("metrics.csv")).unwrap();
        metrics.lines().last().unwrap().to_owned()
    };
    assert!(last(&usual).starts_with("hrn,6,3,"), "{}", last(&usual));
    assert!(last(&own).starts_with("hrn,10,5,"), "{}", last(&own));
    let settings = |trial: &Trial| String::from_utf8(trial.read("settings.toml")).unwrap();
    assert!(
        settings(&own).contains("rule = \"sgd\""),
        "{}",
        settings(&own)
    );
    assert!(
        settings(&own).contains("learning_rate = 0.002"),
        "{}",
        settings(&own)
    );
    for (trial, epochs) in [(&usual, 3), (&own, 5)] {
        assert!(settings(trial).contains(&format!("epochs = {epochs}\n")));
    }
    assert!(own.read("hrn.onnx") != usual.read("hrn.onnx"));
}

#[test]
fn a_discriminator_learns_from_unlabelled_samples_too() {
    let mut presses = read_one(&data().1).unwrap();
    // Two presses of each object become unlabelled, so the first presses of all are.
    for (number, press) in presses.all.iter_mut().enumerate() {
        press.level *= u8::from(number % 10 > 1);
    }
    let path = data().0.path().join("unlabelled.npz");
    write_data(&path, &presses, &json!({}));
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
    let model = model.to_str().unwrap();
    let train = [
        "evaluate", "--model", model, "--data", data, "--split", "train", "--json",
    ];
    let evaluation: Value = serde_json::from_str(&succeed(&train)).unwrap();
    let accuracy = evaluation["accuracy"].as_f64().unwrap();
    assert!(accuracy > 0.7, "on what it was fitted to: {accuracy}");
}

#[test]
fn broad_data_say_their_levels() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("broad.npz");
    let out = path.to_str().unwrap();
    let broad = ["--materials", "broad", "--shapes", "wide", "--presses", "2"];
    let few = ["--objects", "2", "--test-objects", "1", "--out", out];
    let simulate = |more: &[&str]| {
        let _ = std::fs::remove_file(&path);
        succeed(&[&["simulate"][..], &broad, &few, more].concat());
        (read_one(&path).unwrap().all, presses::meta(&path).unwrap())
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
    let (_, meta) = simulate(&["--gaps"]);
    assert_eq!(meta["levels"][1]["shore"], "61-70");
}

#[test]
fn presses_over_time_are_data_too() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("courses.npz");
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
    ]);
    assert!(printed.contains("presses, "), "{printed}");
    let presses = read_one(&path).unwrap();
    assert!((14..=16).contains(&presses.all.len()), "{printed}");
    for press in 0..presses.all.len() {
        let times = presses.timed(press).moments;
        let frame_s = times[1].0 - times[0].0;
        assert!(
            times.len() == 48 || (frame_s - 0.05).abs() < 1e-4,
            "{times:?}"
        );
        // A simulated press says what was pressed.
        let press = &presses.all[press];
        assert!(press.shape.is_some() && press.layered.is_some());
    }
}

#[test]
fn presses_on_many_sensors_are_the_same_each_time_and_have_references() {
    let directory = tempfile::tempdir().unwrap();
    let simulated = |name: &str| {
        let options = "simulate --sequences --sensors broad --materials broad --objects 2 --test-objects 1 \
                       --presses 1 --covers 2 --test-covers 1 --electronics 2 --jobs 2 --out";
        succeed_in(directory.path(), &format!("{options} {name}"));
        directory.path().join(name)
    };
    let (first, again) = (simulated("a.npz"), simulated("b.npz"));
    assert!(std::fs::read(&first).unwrap() == std::fs::read(again).unwrap());
    let presses = read_one(&first).unwrap();
    let sensors: BTreeSet<u32> = presses.all.iter().map(|press| press.sensor).collect();
    assert_eq!(sensors.len(), 6);
    let references = presses.all.iter().filter(|press| press.reference.is_some());
    assert!((40..=60).contains(&references.count()));
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
    let mut presses = read_one(Path::new(&data)).unwrap();
    presses.all.retain(|press| press.split == Split::Train);
    let untested = path("untested.npz");
    write_data(Path::new(&untested), &presses, &json!({}));
    for press in &mut presses.all {
        press.level *= u8::from(press.level != 3);
    }
    let without_level_3 = path("without level 3.npz");
    write_data(Path::new(&without_level_3), &presses, &json!({}));
    let empty_split = format!("{untested}: no press of the test split has a level: add some");
    let corrupt = path("corrupt");
    std::fs::create_dir(&corrupt).unwrap();
    std::fs::write(
        path("corrupt/settings.toml"),
        b"method = \"hrn100\"\nprof\xff",
    )
    .unwrap();
    let simulate = |more: &[&str]| hrn_train(&[&["simulate", "--out", &out], more].concat());
    let no_run = format!("hrn-train: {missing}/hrn.onnx: ");
    let cases = [
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
            simulate(&["--gaps"]),
            2,
            "--gaps: works with `--materials broad` only",
        ),
        (
            simulate(&["--materials", "broad", "--all-test"]),
            2,
            "--all-test: works with `--materials named` only",
        ),
        (
            simulate(&["--shapes", "round"]),
            2,
            "expected one of `matched`, `wide`, `flat`, `paper`",
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
            "no unlabelled training presses are left",
        ),
        (
            method("ours", &["--data", &without_level_3, "--out", &no_gan]),
            1,
            "no labelled training presses of level 3 for its STGAN",
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
}
