//! The real trainer on small data.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

use std::fs::{self, File};
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

use hardnessd_core::npz::Writer;
use hardnessd_core::verdict::Model;
use hrn_train::data::presses::{self, Layout, Presses, read_one};
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

const TRAINER: &str = env!("CARGO_BIN_EXE_hrn-train");
const MODELS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models");
const FIXTURES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures");

/// A directory of data sets, models and runs, and the trainer in it.
struct Desk(tempfile::TempDir);

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// A desk with a data set of few presses, `d.npz`.
    fn with_few_presses() -> Self {
        let desk = Self::new();
        desk.succeeds("simulate --objects 2 --test-objects 1 --presses 6 --out d.npz");
        desk
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    fn write_presses(&self, name: &str, layout: Layout, presses: &Presses, meta: &Value) {
        let file = File::create(self.path(name)).unwrap();
        presses::write(Writer::new(file), presses, layout, meta).unwrap();
    }

    fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    fn text(&self, name: &str) -> String {
        String::from_utf8(self.read(name)).unwrap()
    }

    fn model(&self, name: &str) -> Model {
        Model::load(&self.read(name)).unwrap()
    }

    fn presses(&self, name: &str) -> Presses {
        read_one(&self.path(name)).unwrap()
    }

    fn meta(&self, name: &str) -> Value {
        presses::meta(&self.path(name)).unwrap()
    }

    /// The trainer with the words of `line` as its arguments.
    fn command(&self, line: &str) -> Command {
        let mut command = Command::new(TRAINER);
        command.args(line.split_whitespace());
        command.current_dir(self.0.path());
        command
    }

    /// Runs the trainer. Returns exit code, stdout and stderr.
    fn run(&self, line: &str) -> (i32, String, String) {
        let output = self.command(line).output().unwrap();
        let [stdout, stderr] =
            [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.code().unwrap(), stdout, stderr)
    }

    /// What the trainer says on stdout. It must succeed.
    #[track_caller]
    fn succeeds(&self, line: &str) -> String {
        let (code, stdout, stderr) = self.run(line);
        assert_eq!(code, 0, "{line}: {stderr}");
        stdout
    }

    /// The JSON that the trainer prints.
    #[track_caller]
    fn json(&self, line: &str) -> Value {
        serde_json::from_str(&self.succeeds(line)).unwrap()
    }

    /// The error of the trainer, its last line, which has this part. It must fail with this exit code.
    #[track_caller]
    fn fails(&self, line: &str, code: i32, part: &str) -> String {
        let (found, _, stderr) = self.run(line);
        assert_eq!(found, code, "{line}: {stderr}");
        let last = stderr.lines().last().unwrap_or_default();
        let is_right = last.starts_with("hrn-train: ") && last.contains(part);
        assert!(is_right, "{line}: {part:?} is not last in {stderr}");
        last.to_owned()
    }

    /// The same for each line of a table: the command, its exit code, and the part, with ` | ` between.
    #[track_caller]
    fn fails_each(&self, table: &str) {
        for row in table.trim().lines() {
            let [line, code, part] = row.trim().split(" | ").collect::<Vec<_>>()[..] else {
                panic!("{row}");
            };
            self.fails(line, code.parse().unwrap(), part);
        }
    }
}

/// A desk for the whole process, with a small data set of rigid and soft objects, `tiny.npz`.
fn data() -> &'static Desk {
    static DATA: OnceLock<Desk> = OnceLock::new();
    DATA.get_or_init(|| {
        let desk = Desk::new();
        let simulate = "simulate --seed 5 --objects 4 --test-objects 1 --presses 10 \
                        --lowest-force 5 --shapes paper --out tiny.npz";
        desk.succeeds(simulate);
        desk
    })
}
