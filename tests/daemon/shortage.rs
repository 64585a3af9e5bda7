//! The system has no thread or process to spare: every command ends with one line, and the daemon
//! goes on.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::bench::{BINARY, Bench, Daemon, Process, hrn_train};
use rustix::process::{Resource, Signal, geteuid, getrlimit};

/// A user without privileges and without processes, because no limit of processes holds for root. If
/// the test does not run as root, this is the user who runs it.
pub(crate) struct User {
    id: Option<u32>,
    program: PathBuf,
}

impl User {
    /// The user with this number among those of this process. The user can start the program, and
    /// make files in the bench.
    pub(crate) fn new(bench: &Bench, number: u32) -> Self {
        let program = bench.path("hardnessd");
        fs::copy(BINARY, &program).unwrap();
        fs::set_permissions(bench.path(""), Permissions::from_mode(0o777)).unwrap();
        let id = 20_000 + std::process::id() % 10_000 * 4 + number;
        Self {
            id: geteuid().is_root().then_some(id),
            program,
        }
    }

    pub(crate) fn program(&self) -> &Path {
        &self.program
    }

    /// Runs `program` as this user.
    pub(crate) fn runs(&self, program: &Path) -> Command {
        let Some(id) = self.id else {
            return Command::new(program);
        };
        let mut command = Command::new("setpriv");
        command
            .args([format!("--reuid={id}"), format!("--regid={id}")])
            .args(["--clear-groups", "--bounding-set=-all", "--inh-caps=-all"])
            .arg("--")
            .arg(program);
        command
    }

    /// Limits how many processes and threads the user may have when `process` makes another one.
    pub(crate) fn limit(&self, process: &Process, most: Option<u64>) {
        let most = most.or(getrlimit(Resource::Nproc).maximum);
        let most = most.map_or("unlimited".to_owned(), |most| most.to_string());
        let mut command = self.runs(Path::new("prlimit"));
        command.arg(format!("--pid={}", process.0.id()));
        command.arg(format!("--nproc={most}:"));
        assert!(command.status().unwrap().success());
    }
}

#[test]
fn a_reload_without_a_thread_or_a_process_is_refused_and_the_next_one_is_not() {
    let bench = Bench::new();
    let user = User::new(&bench, 1);
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/hrn.onnx");
    fs::copy(model, bench.path("hrn.onnx")).unwrap();
    let model = "[model]\npath = \"hrn.onnx\"\n";
    let config = bench.configure("hardnessd.toml", "events.sock", model);
    let mut daemon = Daemon::start_by(&mut user.runs(user.program()), &config);
    let threads = || {
        let tasks = format!("/proc/{}/task", daemon.process.0.id());
        fs::read_dir(tasks).unwrap().count() as u64
    };
    // Now and then there is a thread more, which tries to open the port. It may be among those that are
    // counted, so the first limit is one below.
    let least = threads() - 1;
    let mut refusals = Vec::new();
    for spare in 0..6 {
        user.limit(&daemon.process, Some(least + spare));
        daemon.process.signal(Signal::HUP);
        let line = daemon.logged("reload");
        if line.contains("refused") {
            refusals.push(line);
        }
    }
    for part in ["cannot start a thread", "no process to try it in"] {
        assert!(
            refusals.iter().any(|line| line.contains(part)),
            "{refusals:#?}"
        );
    }
    let fault = |line: &&String| line.contains("panicked") || line.contains("without a result");
    assert_eq!(daemon.log.seen.iter().find(fault), None);
    user.limit(&daemon.process, None);
    daemon.process.signal(Signal::HUP);
    daemon.logged("reloaded");
}

#[test]
fn a_command_without_a_thread_ends_with_one_line() {
    let bench = Bench::new();
    let user = User::new(&bench, 2);
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let config = config.to_str().unwrap();
    let fixture = |name: &str| {
        let file = bench.path(name);
        let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures");
        fs::copy(fixtures.join(name), &file).unwrap();
        file.to_str().unwrap().to_owned()
    };
    let foam = &fixture("foam.5hz.bin");
    let faults = bench.path("faults.toml");
    fs::write(&faults, "").unwrap();
    let faults = faults.to_str().unwrap();
    let new = bench.path("new");
    let new = new.to_str().unwrap();
    let trainer = bench.path("hrn-train");
    fs::copy(hrn_train(), &trainer).unwrap();
    let check = |program: &Path, code: i32, arguments: &[&str]| {
        let mut command = user.runs(Path::new("prlimit"));
        let output = command
            .arg("--nproc=1:")
            .arg(program)
            .args(arguments)
            .output()
            .unwrap();
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {message}");
        assert_eq!(message.lines().count(), 1, "{arguments:?}: {message}");
        assert!(
            message.contains("temporarily unavailable"),
            "{arguments:?}: {message}"
        );
    };
    for arguments in [
        &["run", "--config", config][..],
        &["demo"],
        &["record", "--config", config, "--out", new],
        &["check", "--config", config],
        &["doctor", "--port", foam],
        &["replay", foam],
        &["recover", foam, "--out", new],
        &["sniff", foam],
        &["calibrate", "arm", "--config", config, "--from", foam],
        &[
            "identify", "--config", config, "--out", new, "--as", "flat:20", foam,
        ],
        &["simulate"],
        &["simulate", "--to", new, "--presses", "1"],
        &["simulate", "--faults", faults],
        &["simulate", "--arm", new],
    ] {
        check(user.program(), 74, arguments);
    }
    // The system has no thread to look the name up.
    check(user.program(), 69, &["tail", "--connect", "localhost:1"]);
    check(&trainer, 74, &["inspect", foam]);
}
