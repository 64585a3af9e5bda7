//! The trainer's binary on tiny data: it learns, resumes exactly, and its files are usable.

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Presses, meta, read_one};
use rustix::process::{Pid, Signal};
use serde_json::{Value, json};

use crate::{data, errors, few, hrn_train_in, json_in, succeed_in, trainer, write_data};

/// Settings with Adam on small batches: enough steps in few epochs to learn something.
const SETTINGS: &str = "
    held_out = 0.25
    [training]
    epochs = 6
    batch = 16
    averaging = 0.9
    rule = \"adam\"
    learning_rate = 0.005
    schedule = \"cosine\"
    [augmentation]
    symmetries = true
    shift_taxels = 2
";

/// Settings for all stages of the method in seconds.
const GAN_SETTINGS: &str = "
    [ustgan]
    epochs = 4
    averaging = 0.5
";

/// A run in the directory of the data, with a name of its own, because tests run in parallel.
struct Trial {
    out: PathBuf,
    command: String,
}

impl Trial {
    /// A run of a method on `data`, a file in the directory.
    fn on(data_name: &str, method: &str, name: &str, settings: &str) -> Self {
        let directory = data().0.path();
        fs::write(directory.join(format!("{name}.toml")), settings).unwrap();
        Self {
            out: directory.join(name),
            command: format!(
                "train --method {method} --profile smoke --data {data_name} --out {name} --config {name}.toml"
            ),
        }
    }

    fn of(method: &str, name: &str, settings: &str) -> Self {
        Self::on("tiny.npz", method, name, settings)
    }

    fn output(&self, more: &str) -> Output {
        hrn_train_in(data().0.path(), &format!("{} {more}", self.command))
    }

    #[track_caller]
    fn train(&self, more: &str) {
        succeed_in(data().0.path(), &format!("{} {more}", self.command));
    }

    fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.out.join(name)).unwrap()
    }

    fn metrics(&self) -> String {
        String::from_utf8(self.read("metrics.csv")).unwrap()
    }

    /// The names of the checkpoints.
    fn checkpoints(&self) -> Vec<String> {
        let Ok(directory) = fs::read_dir(self.out.join("checkpoints")) else {
            return Vec::new();
        };
        let names = directory.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.collect()
    }
}

#[test]
fn a_run_learns_and_leaves_what_it_promises() {
    let at = data().0.path();
    let trial = Trial::of("hrn100", "whole-run", SETTINGS);
    let message = errors(&trial.output(""));
    assert!(!message.contains("warning"), "{message}");

    let rows = trial.metrics();
    let losses = rows
        .lines()
        .skip(1)
        .map(|row| row.split(',').nth(3).unwrap());
    let losses: Vec<f64> = losses.map(|loss| loss.parse().unwrap()).collect();
    assert!(losses.len() == 6 && losses[5] < 0.8 * losses[0], "{rows}");
    let hrn = Model::load(&trial.read("hrn.onnx")).unwrap();
    assert_eq!(hrn.card().method, "hrn100");
    assert_eq!(hrn.card().validation, "simulated data only");
    assert!(hrn.card().data.contains("\"seed\":5"));
    for name in ["settings.toml", "revision", "evaluation.json"] {
        assert!(!trial.read(name).is_empty(), "{name}");
    }

    // `evaluate` measures the same on an exported copy as the run recorded.
    succeed_in(at, "export whole-run --out copy.onnx");
    assert_eq!(
        fs::read(at.join("copy.onnx")).unwrap(),
        trial.read("hrn.onnx")
    );
    let printed = json_in(at, "evaluate --model copy.onnx --data tiny.npz --json");
    let written: Value = serde_json::from_slice(&trial.read("evaluation.json")).unwrap();
    assert_eq!(printed, written);
    assert_eq!(printed["n"], 40);
    let inspected = succeed_in(at, "inspect copy.onnx");
    let temperature = hrn.card().metrics["temperature"].as_f64().unwrap();
    for line in [
        "simulated data only",
        &format!("\ntemperature   {temperature:.3}\n"),
    ] {
        assert!(inspected.contains(line), "{inspected}");
    }
}

#[test]
fn the_whole_method_interrupted_between_stages_resumes_bit_for_bit() {
    let whole = Trial::of("ours", "whole-method", GAN_SETTINGS);
    whole.train("--seed 6");
    // Ends the run once the second STGAN has a checkpoint, wherever it is by then.
    let ended = Trial::of("ours", "ended-method", GAN_SETTINGS);
    let command = format!("{} --seed 6 --resume", ended.command);
    let mut process: Command = trainer(&command.split(' ').collect::<Vec<_>>());
    let process = process.current_dir(data().0.path()).stderr(Stdio::piped());
    let mut process = process.spawn().unwrap();
    while !ended.checkpoints().contains(&"stgan2".to_owned()) {
        let status = process.try_wait().unwrap();
        assert!(status.is_none(), "ended before it could be interrupted");
        std::thread::yield_now();
    }
    rustix::process::kill_process(Pid::from_child(&process), Signal::TERM).unwrap();
    let output = process.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{output:?}");
    let expected = format!(
        "; to continue: {} {command}\n",
        env!("CARGO_BIN_EXE_hrn-train")
    );
    assert!(errors(&output).contains(&expected), "{output:?}");
    assert!(!ended.out.join("hrn.onnx").exists());
    ended.train("--seed 6 --resume");
    assert!(ended.read("hrn.onnx") == whole.read("hrn.onnx"));

    // A row has the losses of generator and discriminator.
    let metrics = whole.metrics();
    let columns: Vec<&str> = metrics.lines().next().unwrap().split(',').collect();
    for stage in ["ustgan", "stgan1", "stgan4"] {
        let row = metrics.lines().rfind(|row| row.starts_with(stage)).unwrap();
        let row: Vec<&str> = row.split(',').collect();
        for name in ["loss", "generator_loss"] {
            let place = columns.iter().position(|column| *column == name).unwrap();
            let found: f64 = row[place].parse().unwrap();
            assert!(found.is_finite(), "{stage} {name}");
        }
    }
    // Some of the generated presses can be looked at.
    let generated = read_one(&whole.out.join("samples/generated.npz")).unwrap();
    let levels: Vec<u8> = generated.all.iter().map(|press| press.level).collect();
    assert!(levels.is_sorted() && levels.first() == Some(&1) && levels.last() == Some(&4));
}

#[test]
fn a_training_that_diverges_ends_where_it_does() {
    let one_step = "epochs = 1\nbatch = 1000\n";
    for (method, table, more, rate, expected) in [
        ("sgan", "ustgan", "", 1e30, "sgan: epoch 1: loss: found NaN"),
        // The weights become infinite or NaN in the very last step.
        (
            "hrn100",
            "training",
            one_step,
            1e300,
            "hrn: epoch 1: weights: found ",
        ),
        // Nothing is infinite, but no network learns with a loss of millions.
        (
            "hrn15",
            "training",
            "epochs = 30\n",
            100.0,
            "expected at most 1e6",
        ),
    ] {
        let settings = format!("[{table}]\n{more}learning_rate = {rate:e}\n");
        let trial = Trial::of(method, &format!("diverging-{method}"), &settings);
        let output = trial.output("");
        let error = errors(&output);
        assert_eq!(output.status.code(), Some(1), "{method}: {error}");
        let last = error.lines().last().unwrap();
        assert!(last.contains(expected), "{method}: {error}");
        assert!(last.ends_with(": the training has diverged"), "{error}");
        assert!(!trial.checkpoints().contains(&"hrn".to_owned()), "{method}");
    }
}

#[test]
fn methods_with_parts_of_their_own_make_models_that_the_loader_reproduces() {
    let mut presses = read_one(&data().1).unwrap();
    // Two presses of each object become unlabelled, so the first presses of all are.
    for (number, press) in presses.all.iter_mut().enumerate() {
        press.level *= u8::from(number % 10 > 1);
    }
    write_data(
        &data().0.path().join("unlabelled.npz"),
        &presses,
        &json!({}),
    );
    // Discriminators learn from unlabelled samples too. `hrn` has a logarithmic image, and means beside the greatest
    // values.
    for method in ["sgan", "igan", "hrn"] {
        let trial = Trial::on(
            "unlabelled.npz",
            method,
            &format!("unlabelled-{method}"),
            GAN_SETTINGS,
        );
        trial.train("");
        let hrn = Model::load(&trial.read("hrn.onnx")).unwrap();
        assert_eq!(hrn.card().method, method);
    }
}

#[test]
fn a_reader_that_goes_ends_it_quietly() {
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = trainer(&["inspect", model])
        .stdout(writer)
        .output()
        .unwrap();
    let error = errors(&output);
    assert!(output.status.success() && error.is_empty(), "{error}");
}

#[test]
fn another_seed_gives_other_weights_and_a_run_is_not_overwritten() {
    let [first, other] = ["3", "4"].map(|seed| {
        let trial = Trial::of("hrn100", &format!("seed-{seed}"), SETTINGS);
        trial.train(&format!("--seed {seed}"));
        trial
    });
    assert!(first.read("hrn.onnx") != other.read("hrn.onnx"));
    let refused = |more: &str, expected: &str| {
        let output = first.output(more);
        let error = errors(&output);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(error.contains(expected), "{error}");
    };
    refused("--seed 3", "continue it with --resume");
    refused("--seed 5 --resume", "found `seed = 5`, expected `seed = 3`");
    // Two processes cannot continue the same run.
    let locked = hrn_train::run::disk::lock(&first.out).unwrap();
    refused(
        "--seed 3 --resume",
        "seed-3: another process is at work here",
    );
    drop(locked);
    // A run does not continue from a checkpoint of another run, also if that began with the same weights.
    let slower = SETTINGS.replace("0.005", "0.004");
    let slower = Trial::of("hrn100", "seed-3-slower", &slower);
    slower.train("--seed 3");
    for other in [&other, &slower] {
        for name in first.checkpoints() {
            let place = |trial: &Trial| trial.out.join("checkpoints").join(&name);
            fs::copy(place(other), place(&first)).unwrap();
        }
        refused("--seed 3 --resume", "hrn: the checkpoint is of another run");
    }
}

#[test]
fn broad_data_say_their_levels() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let few = "--shapes wide --presses 2 --objects 2 --test-objects 1";
    succeed_in(at, &format!("simulate --materials broad {few} --out d.npz"));
    let (samples, meta) = (
        read_one(&at.join("d.npz")).unwrap().all,
        meta(&at.join("d.npz")).unwrap(),
    );
    assert_eq!(samples.len(), 4 * 3 * 2);
    assert_eq!(meta["materials"][11], "broad-layered");
    assert_eq!(meta["levels"][1]["shore"], "60-70");
    for sample in &samples {
        let shore = sample.shore.unwrap();
        let borders = [70.0, 60.0, 50.0];
        let expected = 1 + borders.iter().filter(|&&border| shore < border).count();
        assert_eq!(usize::from(sample.level), expected, "Shore {shore}");
    }
    fs::write(at.join("m.onnx"), BUILT_IN_HRN).unwrap();
    let evaluate = "evaluate --model m.onnx --data d.npz --split train --json --verdicts v.csv";
    let evaluation = json_in(at, evaluate);
    assert!(evaluation["shore"]["rmse"].is_number(), "{evaluation}");
    let verdicts = fs::read_to_string(at.join("v.csv")).unwrap();
    assert_eq!(verdicts.lines().count(), 1 + 16, "{verdicts}");
}

#[test]
fn forces_far_from_those_of_the_training_are_said() {
    let (directory, path) = few();
    let own = read_one(&path).unwrap();
    let mut millinewtons = Presses::default();
    for (place, press) in own.all.iter().enumerate() {
        let newtons = own.frame(place).newtons.map(|newtons| 1000.0 * newtons);
        millinewtons.push(press.clone(), [(0.0, None, newtons)]);
    }
    write_data(&directory.path().join("mn.npz"), &millinewtons, &json!({}));
    fs::write(directory.path().join("m.onnx"), BUILT_IN_HRN).unwrap();
    for (data, expected) in [("d.npz", false), ("mn.npz", true)] {
        let evaluate = format!("evaluate --model m.onnx --data {data} --split train");
        let said = errors(&hrn_train_in(directory.path(), &evaluate));
        assert_eq!(
            said.contains("presses are far from the "),
            expected,
            "{said}"
        );
    }
}

#[test]
fn rare_settings_of_simulated_presses_are_those_of_a_file() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let simulate = "simulate --sequences --materials broad --objects 1 --test-objects 1 --presses 2 --out d.npz";
    let rate = "frame_rate_hz = [20, 20]\n[objects]\ntest_objects = 0\n";
    fs::write(at.join("own.toml"), rate).unwrap();
    succeed_in(at, &format!("{simulate} --config own.toml"));
    let presses: Presses = read_one(&at.join("d.npz")).unwrap();
    assert!((6..=8).contains(&presses.all.len()));
    for press in 0..presses.all.len() {
        let moments = presses.course(press).moments;
        let times: Vec<f32> = moments.iter().map(|moment| moment.time_s).collect();
        let frame_s = times[1] - times[0];
        assert!(
            times.len() == 48 || (frame_s - 0.05).abs() < 1e-4,
            "{times:?}"
        );
    }
    for (config, expected) in [
        ("fps = 20", "own.toml: unknown field `fps`"),
        (
            "frame_rate_hz = [5, 1e9]",
            "frame_rate_hz: found [5.0, 1000000000.0], expected 1 to 200",
        ),
        (
            "objects.lowest_force_n = nan",
            "objects.lowest_force_n: found NaN",
        ),
    ] {
        fs::write(at.join("own.toml"), config).unwrap();
        let output = hrn_train_in(at, &format!("{simulate} --config own.toml"));
        assert_eq!(output.status.code(), Some(78), "{output:?}");
        assert!(errors(&output).contains(expected), "{output:?}");
    }
}

#[test]
fn bad_input_has_its_exit_code_and_one_line() {
    let at = data().0.path();
    fs::write(at.join("text.toml"), "epoch = 3\n").unwrap();
    fs::write(at.join("zero.toml"), "[training]\nepochs = 0\n").unwrap();
    fs::write(at.join("log.toml"), "log_above_n = 1e-40\n").unwrap();
    fs::write(at.join("model.onnx"), BUILT_IN_HRN).unwrap();
    let mut presses = read_one(&data().1).unwrap();
    presses.all.retain(|press| press.split == Split::Train);
    write_data(&at.join("untested.npz"), &presses, &json!({}));
    for press in &mut presses.all {
        press.level *= u8::from(press.level != 3);
    }
    write_data(&at.join("without-3.npz"), &presses, &json!({}));
    fs::create_dir(at.join("corrupt")).unwrap();
    fs::write(
        at.join("corrupt/settings.toml"),
        b"method = \"hrn100\"\nprof\xff",
    )
    .unwrap();
    // The exit code, the command, and what it says.
    let cases = "
        66 | train hrn100 missing | missing
        66 | train hrn100 tiny.npz --config missing | missing
        78 | train hrn100 tiny.npz --config text.toml | text.toml: line 1, column 1, `epoch = 3`: unknown field `epoch`
        78 | train hrn100 tiny.npz --config /dev/zero | /dev/zero: found more than 1048576 bytes
        78 | fit tiny.npz --out m.onnx --config /dev/zero | /dev/zero: found more than 1048576 bytes
        78 | train hrn100 tiny.npz --config zero.toml | zero.toml: training.epochs: found 0
        78 | train hrn100 tiny.npz --config log.toml | log.toml: log_above_n: found 1e-40
        2 | train hrn100 tiny.npz --labels 3 | --labels: found 3, expected at least 4
        2 | train hrn100 tiny.npz --seed 9223372036854775808 | --seed
        2 | train hrn100 tiny.npz --start model.onnx | --start: only the method course starts from a model
        78 | train hrn100 tiny.npz --resume --out corrupt | corrupt/settings.toml: line 2
        74 | train hrn15 tiny.npz --out /dev/null/no | /dev/null/no
        1 | train ours tiny.npz --labels 160 | no unlabelled training presses are left
        1 | train course tiny.npz | has single frames, not whole presses
        1 | train ours without-3.npz | no labelled training presses of level 3 for its STGAN
        1 | evaluate --model model.onnx --data untested.npz | untested.npz: no press of the test split has a level: add
        2 | fit tiny.npz --out m.txt | --out: found m.txt, expected a name that ends with .onnx
        74 | fit tiny.npz --out tiny.onnx | --out tiny.onnx: references would be written beside it
        2 | simulate --out refused --objects 0 --test-objects 0 | found 0 and 0, expected one or more
        74 | simulate --presses 1 --out /dev/null/no | /dev/null/no
        78 | inspect text.toml | not an ONNX model
        66 | export corrupt --out refused | corrupt/hrn.onnx:";
    for line in cases.trim().lines() {
        let [code, command, expected] = line.split(" | ").collect::<Vec<_>>()[..] else {
            panic!("{line}");
        };
        let words: Vec<&str> = command.split(' ').collect();
        let command = match words[..] {
            ["train", method, data, ref more @ ..] => {
                let out = if more.contains(&"--out") {
                    ""
                } else {
                    "--out refused"
                };
                let more = more.join(" ");
                format!("train --method {method} --data {data} {out} {more}")
            }
            _ => command.to_owned(),
        };
        let output = hrn_train_in(at, &command);
        let error = errors(&output);
        let code: i32 = code.trim().parse().unwrap();
        assert_eq!(output.status.code(), Some(code), "{command}: {error}");
        assert!(error.contains(expected), "{command}: {error}");
        assert!(code != 2 || error.lines().count() == 1, "{error}");
    }
    // If a stage cannot be done, nothing is trained, and no run is begun.
    assert!(!at.join("refused").exists());
}
