//! The real trainer on small data.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use hardnessd_core::npz::Writer;
use hrn_train::data::presses::{self, Layout, Presses};
use serde_json::Value;

mod check_model;
mod collect;
mod compare;
mod course;
mod doors;
mod fit;
mod strangers;
mod train;
mod property;

/// The trainer with these arguments.
fn trainer(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hrn-train"));
    command.args(arguments);
    command
}

/// Arguments of one line, for files in `directory`.
fn hrn_train_in(directory: &Path, arguments: &str) -> Output {
    let arguments: Vec<&str> = arguments.split_whitespace().collect();
    let mut trainer = trainer(&arguments);
    let output = trainer.current_dir(directory).output();
    output.expect("cargo built the binary")
}

/// What the trainer says on stdout. It must succeed.
#[track_caller]
fn succeed_in(directory: &Path, arguments: &str) -> String {
    let output = hrn_train_in(directory, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The JSON that the trainer prints.
#[track_caller]
fn json_in(directory: &Path, arguments: &str) -> Value {
    serde_json::from_str(&succeed_in(directory, arguments)).unwrap()
}

fn errors(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn write_data(path: &Path, presses: &Presses, meta: &Value) {
    let file = File::create(path).unwrap();
    presses::write(Writer::new(file), presses, Layout::Frames, meta).unwrap();
}

/// A directory with a data set of few presses, `d.npz`.
fn few() -> (tempfile::TempDir, PathBuf) {
    let directory = tempfile::tempdir().unwrap();
    let simulate = "simulate --objects 2 --test-objects 1 --presses 6 --out d.npz";
    succeed_in(directory.path(), simulate);
    let path = directory.path().join("d.npz");
    (directory, path)
}

/// A directory for the whole process, with a small data set of rigid and soft objects.
fn data() -> &'static (tempfile::TempDir, PathBuf) {
    static DATA: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    DATA.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let simulate = "simulate --seed 5 --objects 4 --test-objects 1 --presses 10 \
                        --lowest-force 5 --shapes paper --out tiny.npz";
        succeed_in(directory.path(), simulate);
        let path = directory.path().join("tiny.npz");
        (directory, path)
    })
}
