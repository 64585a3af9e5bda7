//! The trainer's binary on tiny data: it learns, resumes exactly, and its files are usable.

use std::fs;
use std::path::PathBuf;
use std::process::Stdio;

use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Layout, Presses, read_one};
use rustix::process::{Pid, Signal};
use serde_json::{Value, json};

use crate::{Desk, MODELS, TRAINER, data};

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
        data().write(&format!("{name}.toml"), settings);
        Self {
            out: data().path(name),
            command: format!(
                "train --method {method} --profile smoke --data {data_name} --out {name} --config {name}.toml"
            ),
        }
    }

    fn of(method: &str, name: &str, settings: &str) -> Self {
        Self::on("tiny.npz", method, name, settings)
    }

    #[track_caller]
    fn train(&self, more: &str) {
        data().succeeds(&format!("{} {more}", self.command));
    }

    #[track_caller]
    fn fails(&self, more: &str, part: &str) -> String {
        data().fails(&format!("{} {more}", self.command), 1, part)
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
    let desk = data();
    let trial = Trial::of("hrn100", "whole-run", SETTINGS);
    let (code, _, message) = desk.run(&trial.command);
    assert!(code == 0 && !message.contains("warning"), "{message}");

    let rows = trial.metrics();
    let losses = rows.lines().skip(1).map(|row| row.split(',').nth(3));
    let losses: Vec<f64> = losses.map(|loss| loss.unwrap().parse().unwrap()).collect();
    assert!(losses.len() == 6 && losses[5] < 0.8 * losses[0], "{rows}");
    let hrn = Model::load(&trial.read("hrn.onnx")).unwrap();
    assert_eq!(hrn.card().method, "hrn100");
    assert_eq!(hrn.card().validation, "simulated data only");
    assert!(hrn.card().data.contains("\"seed\":5"));
    for name in ["settings.toml", "revision", "evaluation.json"] {
        assert!(!trial.read(name).is_empty(), "{name}");
    }

    // `evaluate` measures the same on an exported copy as the run recorded.
    desk.succeeds("export whole-run --out copy.onnx");
    assert_eq!(desk.read("copy.onnx"), trial.read("hrn.onnx"));
    let printed = desk.json("evaluate --model copy.onnx --data tiny.npz --json");
    let written: Value = serde_json::from_slice(&trial.read("evaluation.json")).unwrap();
    assert_eq!(printed, written);
    assert_eq!(printed["n"], 40);
    let inspected = desk.succeeds("inspect copy.onnx");
    let temperature = &hrn.card().metrics["temperature"];
    for part in [
        "\nvalidation    simulated data only\n",
        &format!("\"temperature\":{temperature}"),
    ] {
        assert!(inspected.contains(part), "{inspected}");
    }
}

#[test]
fn the_whole_method_interrupted_between_stages_resumes_bit_for_bit() {
    let whole = Trial::of("ours", "whole-method", GAN_SETTINGS);
    whole.train("--seed 6");
    // Ends the run once the second STGAN has a checkpoint, wherever it is by then.
    let ended = Trial::of("ours", "ended-method", GAN_SETTINGS);
    let command = format!("{} --seed 6 --resume", ended.command);
    let mut process = data().command(&command);
    let mut process = process.stderr(Stdio::piped()).spawn().unwrap();
    while !ended.checkpoints().contains(&"stgan2".to_owned()) {
        let status = process.try_wait().unwrap();
        assert!(status.is_none(), "ended before it could be interrupted");
        std::thread::yield_now();
    }
    rustix::process::kill_process(Pid::from_child(&process), Signal::TERM).unwrap();
    let output = process.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    let expected = format!("; to continue: {TRAINER} {command}\n");
    assert!(said.contains(&expected), "{said}");
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
    let check = |method: &str, settings: &str, expected: &str| {
        let trial = Trial::of(method, &format!("diverging-{method}"), settings);
        let error = trial.fails("", expected);
        assert!(error.ends_with(": the training has diverged"), "{error}");
        assert!(!trial.checkpoints().contains(&"hrn".to_owned()), "{method}");
    };
    let settings = "[ustgan]\nlearning_rate = 1e30";
    check("sgan", settings, "sgan: epoch 1: loss: found NaN");
    // The weights become infinite or NaN in the very last step.
    let settings = "[training]\nepochs = 1\nbatch = 1000\nlearning_rate = 1e300";
    check("hrn100", settings, "hrn: epoch 1: weights: found ");
    // Nothing is infinite, but no network learns with a loss of millions.
    let settings = "[training]\nepochs = 30\nlearning_rate = 100.0";
    check("hrn15", settings, "expected at most 1e6");
}

#[test]
fn methods_with_parts_of_their_own_make_models_that_the_loader_reproduces() {
    let mut presses = data().presses("tiny.npz");
    // Two presses of each object become unlabelled, so the first presses of all are.
    for (number, press) in presses.all.iter_mut().enumerate() {
        press.level *= u8::from(number % 10 > 1);
    }
    data().write_presses("unlabelled.npz", Layout::Frames, &presses, &json!({}));
    // Discriminators learn from unlabelled samples too. `hrn` has a logarithmic image, and means beside the greatest
    // values.
    for method in ["sgan", "igan", "hrn"] {
        let name = format!("unlabelled-{method}");
        let trial = Trial::on("unlabelled.npz", method, &name, GAN_SETTINGS);
        trial.train("");
        let hrn = Model::load(&trial.read("hrn.onnx")).unwrap();
        assert_eq!(hrn.card().method, method);
    }
}

#[test]
fn a_reader_that_goes_ends_it_quietly() {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let desk = Desk::new();
    let mut inspect = desk.command(&format!("inspect {MODELS}/hrn.onnx"));
    let output = inspect.stdout(writer).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
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
    first.fails("--seed 3", "continue it with --resume");
    first.fails("--seed 5 --resume", "started with other settings or data");
    // Two processes cannot continue the same run.
    let locked = hrn_train::run::disk::lock(&first.out).unwrap();
    let expected = "seed-3: another process is at work here";
    first.fails("--seed 3 --resume", expected);
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
        let expected = "hrn: the checkpoint is of another run";
        first.fails("--seed 3 --resume", expected);
    }
}

#[test]
fn forces_far_from_those_of_the_training_are_said() {
    let desk = Desk::with_few_presses();
    let own = desk.presses("d.npz");
    let mut millinewtons = Presses::default();
    for (place, press) in own.all.iter().enumerate() {
        let newtons = own.frame(place).newtons.map(|newtons| 1000.0 * newtons);
        millinewtons.push(press.clone(), [(0.0, None, newtons)]);
    }
    desk.write_presses("mn.npz", Layout::Frames, &millinewtons, &json!({}));
    desk.write("m.onnx", BUILT_IN_HRN);
    for (data, expected) in [("d.npz", false), ("mn.npz", true)] {
        let evaluate = format!("evaluate --model m.onnx --data {data} --split train");
        let (_, _, said) = desk.run(&evaluate);
        let is_said = said.contains("presses are far from the ");
        assert_eq!(is_said, expected, "{said}");
    }
}

#[test]
fn bad_input_has_its_exit_code_and_one_line() {
    let desk = data();
    desk.write("text.toml", "epoch = 3\n");
    desk.write("zero.toml", "[training]\nepochs = 0\n");
    desk.write("fps.toml", "fps = 20");
    desk.write("rate.toml", "frame_rate_hz = [5, 1e9]");
    desk.write("force.toml", "objects.lowest_force_n = nan");
    desk.write("model.onnx", BUILT_IN_HRN);
    let mut presses = desk.presses("tiny.npz");
    presses.all.retain(|press| press.split == Split::Train);
    desk.write_presses("untested.npz", Layout::Frames, &presses, &json!({}));
    for press in &mut presses.all {
        press.level *= u8::from(press.level != 3);
    }
    desk.write_presses("without-3.npz", Layout::Frames, &presses, &json!({}));
    desk.write("corrupt/settings.toml", b"method = \"hrn100\"\nprof\xff");
    let table = "
        train --method hrn100 --out refused --data missing | 66 | missing
        train of hrn100 --config missing | 66 | missing
        train of hrn100 --config text.toml | 78 | text.toml: line 1, column 1, `epoch = 3`: unknown field `epoch`
        train of hrn100 --config /dev/zero | 78 | /dev/zero: found more than 1048576 bytes
        fit tiny.npz --out m.onnx --config /dev/zero | 78 | /dev/zero: found more than 1048576 bytes
        train of hrn100 --config zero.toml | 78 | zero.toml: training.epochs: found 0
        train of hrn100 --labels 3 | 2 | --labels: found 3, expected at least 4
        train of hrn100 --seed 9223372036854775808 | 2 | --seed
        train of hrn100 --start model.onnx | 2 | --start: only the method course starts from a model
        train --method hrn100 --data tiny.npz --resume --out corrupt | 78 | corrupt/settings.toml: line 2
        train --method hrn15 --data tiny.npz --out /dev/null/no | 74 | /dev/null/no
        train of ours --labels 160 | 1 | no unlabelled training presses are left
        train of course | 1 | has single frames, not whole presses
        train --method ours --out refused --data without-3.npz | 1 | no labelled training presses of level 3 for its STGAN
        compare --out nothing | 1 | nothing/results.json: has no finished run
        evaluate --model model.onnx --data untested.npz | 1 | untested.npz: no press of the test split has a level: add
        fit tiny.npz --out m.txt | 2 | --out: found m.txt, expected a name that ends with .onnx
        fit tiny.npz --out tiny.onnx | 74 | --out tiny.onnx: references would be written beside it
        simulate --out refused --objects 0 --test-objects 0 | 2 | found 0 and 0, expected one or more
        simulate --sequences --out refused --config fps.toml | 78 | fps.toml: unknown field `fps`
        simulate --sequences --out refused --config rate.toml | 78 | frame_rate_hz: found [5.0, 1000000000.0], expected 1
        simulate --sequences --out refused --config force.toml | 78 | objects.lowest_force_n: found NaN
        simulate --presses 1 --out /dev/null/no | 74 | /dev/null/no
        inspect text.toml | 78 | not an ONNX model
        export corrupt --out refused | 66 | corrupt/hrn.onnx:";
    let train = "train --data tiny.npz --out refused --method";
    desk.fails_each(&table.replace("train of", train));
    // If a stage cannot be done, nothing is trained, and no run is begun.
    assert!(!desk.path("refused").exists());
}
