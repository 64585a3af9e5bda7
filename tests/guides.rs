//! The guides in `docs/` are true: this test runs every command in them, unchanged, on a simulated
//! sensor, and expects every line that they show.
//! A `console` block has commands after `$ ` and their output, in which `...` matches anything. A
//! `toml` or `python` block that begins with `# NAME` is a file of that name. Commands that need a
//! machine of their own (`sudo`, `systemctl`) are in `sh` blocks. This test does not run those.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;

use std::fs;
use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use bench::BINARY;
use rustix::process::{Pid, Signal, kill_process_group};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The fenced blocks of a page, with kind and content.
fn blocks(text: &str) -> Vec<(String, String)> {
    let mut blocks = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let fence = line.trim_start();
        let Some(kind) = fence.strip_prefix("```") else {
            continue;
        };
        let indent = line.len() - fence.len();
        let block: Vec<&str> = lines
            .by_ref()
            .map(|line| line.get(indent..).unwrap_or_default())
            .take_while(|line| *line != "```")
            .collect();
        blocks.push((kind.to_owned(), block.join("\n")));
    }
    blocks
}

/// Whether `shown` occurs in the output `came`. `...` matches anything, also several lines.
fn occurs(shown: &str, came: &str) -> bool {
    let mut rest = came;
    shown.split("...").all(|part| {
        let part = part.trim_matches('\n');
        match rest.find(part) {
            Some(at) => {
                rest = &rest[at + part.len()..];
                true
            }
            None => false,
        }
    })
}

fn follow(guide: &str) {
    let text = fs::read_to_string(root().join("docs").join(guide)).unwrap();
    // Another program may use the ports of the guide on this machine.
    let free = || {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.local_addr().unwrap().port().to_string()
    };
    let text = text.replace("8255", &free()).replace("8256", &free());
    // This machine may be busier than the reader's.
    let text = text.replace("sleep 1\n", "sleep 3\n");
    let place = tempfile::tempdir().unwrap();
    let client = root().join("clients/python/hardnessd.py");
    fs::copy(client, place.path().join("hardnessd.py")).unwrap();
    let mut script = String::from("exec 2>&1\n");
    let mut expected: Vec<(String, String)> = Vec::new();
    for (kind, block) in blocks(&text) {
        let name = block
            .lines()
            .next()
            .and_then(|line| line.strip_prefix("# "));
        match (kind.as_str(), name) {
            ("toml" | "python", Some(name)) if !name.contains(' ') => {
                script += &format!("cat > {name} <<'END OF FILE'\n{block}\nEND OF FILE\n");
            }
            ("console", _) => {
                for part in format!("\n{block}").split("\n$ ").skip(1) {
                    let (command, shown) = part.split_once('\n').unwrap_or((part, ""));
                    script += &format!("{command}\necho \"@@ $?\"\n");
                    expected.push((command.to_owned(), shown.to_owned()));
                }
            }
            _ => {}
        }
    }
    assert!(!expected.is_empty(), "{guide} has no commands");
    let output = run(&script, place.path());
    let mut rest = output.as_str();
    for (command, shown) in expected {
        let (came, after) = rest
            .split_once("@@ ")
            .unwrap_or_else(|| panic!("{guide}: {command} did not end:\n{output}"));
        let (code, after) = after.split_once('\n').unwrap();
        assert_eq!(code, "0", "{guide}: {command}\n{came}");
        assert!(
            occurs(&shown, came),
            "{guide}: {command}\nexpected\n{shown}\ncame\n{came}"
        );
        rest = after;
    }
}

/// Runs a script to its end, then ends every process that the script left running.
fn run(script: &str, place: &Path) -> String {
    let binaries = Path::new(BINARY).parent().unwrap();
    let path = std::env::var("PATH").unwrap();
    let path = format!(
        "{}:{}:{path}",
        binaries.display(),
        binaries.join("examples").display()
    );
    let child = Command::new("timeout")
        .args(["--foreground", "240", "bash", "-c", script])
        .current_dir(place)
        .env("PATH", path)
        .env("XDG_RUNTIME_DIR", place)
        .env("RUST_LOG", "info")
        .env_remove("RUNTIME_DIRECTORY")
        .process_group(0)
        .stdin(Stdio::null())
        .stdout(fs::File::create(place.join(".output")).unwrap())
        .stderr(Stdio::null())
        .spawn();
    let mut child = child.unwrap();
    child.wait().unwrap();
    let group = Pid::from_raw(i32::try_from(child.id()).unwrap()).unwrap();
    // The group may already be empty.
    let _ = kill_process_group(group, Signal::KILL);
    fs::read_to_string(place.join(".output")).unwrap()
}

#[test]
fn the_operators_guide_says_what_happens() {
    follow("operator.md");
}

#[test]
fn the_controllers_guide_says_what_happens() {
    follow("controller.md");
}

#[test]
fn the_guide_to_a_new_sensor_says_what_happens() {
    follow("new-sensor.md");
}

#[test]
fn the_guide_to_the_arms_motion_says_what_happens() {
    follow("motion.md");
}

#[test]
fn the_page_on_recordings_says_what_happens() {
    follow("recordings.md");
}

#[test]
fn dots_match_anything_and_the_rest_must_come() {
    assert!(occurs("a ... c\n...\ne", "x\na b c\nd\ne\n"));
    assert!(!occurs("a ... d", "a b c"));
    assert!(occurs("", "anything"));
}
