//! The guides in `docs/` are true: this test runs every command in them, unchanged, on a simulated
//! sensor, and expects every line that they show.
//! A `console` block has commands after `$ ` and their output, in which `...` matches anything. A
//! `toml` or `python` block that begins with `# NAME` is a file of that name. Commands that need a
//! machine of their own (`sudo`, `systemctl`) are in `sh` blocks. This test does not run those, but
//! every `hardnessd` and `hrn-train` in a block of any page must be a valid command line. The unit
//! tests of `hrn-train` check its own.

use std::fs;
use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::commands::{Call, blocks, calls, calls_of, names_of, unknown_names, wrong_calls};
use super::docs::has_command;
use crate::bench::{BINARY, events};
use hardnessd::tools::args::Args;
use hardnessd_core::verdict::argmax;
use rustix::process::{Pid, Signal, kill_process_group};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
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
    // A reader presses by hand. The simulated sensor is pressed sooner.
    let text = text.replace("--timeout 20 >presses", "--timeout 8 >presses");
    let place = tempfile::tempdir().unwrap();
    for file in ["clients/python/hardnessd.py", "examples/gentle_press.py"] {
        let file = root().join(file);
        fs::copy(&file, place.path().join(file.file_name().unwrap())).unwrap();
    }
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
    check(guide, &output, expected);
}

/// Compares the output of a script with what each of its commands should print.
fn check(guide: &str, output: &str, expected: Vec<(String, String)>) {
    let mut rest = output;
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
    follow("your-array.md");
}

#[test]
fn the_guide_to_the_arms_motion_says_what_happens() {
    follow("motion.md");
}

#[test]
fn the_page_on_recordings_says_what_happens() {
    follow("recordings.md");
}

/// Whether this build has the command of a call.
fn is_built(call: &Call) -> bool {
    call.words.get(1).is_none_or(|name| has_command(name))
}

#[test]
fn every_command_of_the_daemon_in_the_pages_is_a_valid_one() {
    let mut calls = calls_of("hardnessd");
    assert!(calls.len() > 50, "found {} commands", calls.len());
    calls.retain(is_built);
    let wrong = wrong_calls::<Args>(&calls);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn every_option_of_the_daemon_in_a_sentence_exists() {
    let mut names = names_of("hardnessd");
    assert!(names.len() > 30, "found {} commands", names.len());
    names.retain(is_built);
    let wrong = unknown_names::<Args>(&names);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The built-in model's levels.
const LABELS: [&str; 4] = ["hard", "firm", "soft", "very-soft"];

#[test]
fn the_readmes_demonstration_has_the_verdicts_that_it_shows() {
    let text = fs::read_to_string(root().join("README.md")).unwrap();
    let command = calls("README.md", &text)
        .into_iter()
        .find(|call| call.words.get(1).is_some_and(|word| word == "demo"))
        .expect("the README begins with the demonstration");
    let shown = blocks(&text)
        .into_iter()
        .find_map(|(_, block)| block.contains("\npress 1 ").then_some(block))
        .expect("the README shows the presses");
    let place = tempfile::tempdir().unwrap();
    // The reader ends it with Ctrl-C.
    let script = format!("{} --presses 4 2>/dev/null", command.words.join(" "));
    let shown: Vec<&str> = shown
        .lines()
        .filter_map(|line| line.split_once("->"))
        .map(|(_, verdict)| verdict)
        .collect();
    let is_as_shown = || {
        let output = run(&script, place.path());
        // Frames that are late move a probability by some points, and may add a level to a set or take one
        // from it. The likeliest level stays.
        let verdicts: Vec<(&str, String)> = events(&output)
            .into_iter()
            .filter(|event| event["phase"] == "final")
            .map(|event| {
                let probabilities = event["probabilities"].as_array().unwrap().iter();
                let probabilities: Vec<f32> = probabilities
                    .map(|share| share.as_f64().unwrap() as f32)
                    .collect();
                let force = format!("{:.1} N", event["force_n"].as_f64().unwrap());
                (LABELS[argmax(&probabilities).0], force)
            })
            .collect();
        assert_eq!((shown.len(), verdicts.len()), (4, 4));
        shown.iter().zip(verdicts).all(|(shown, (label, force))| {
            shown.split_whitespace().any(|word| word == label) && shown.contains(&force)
        })
    };
    // A busy machine delays the frames of a try.
    assert!((0..3).any(|_| is_as_shown()), "{shown:?}");
}
