//! The guides in `docs/` are true: this test runs every command in them, unchanged, on a simulated
//! sensor, and expects every line that they show.
//! A `console` block has commands after `$ ` and their output, in which `...` matches anything. A
//! `toml` or `python` block that begins with `# NAME` is a file of that name. Commands that need a
//! machine of their own (`sudo`, `systemctl`) are in `sh` blocks. This test does not run those, but
//! every `hardnessd` and `hrn-train` of any page must name commands and options that there are. The unit
//! tests of `hrn-train` check its own.

use std::fs::{self, File};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};

use super::commands::{assert_known, blocks, root};
use crate::bench::{BINARY, free_address};
use hardnessd::tools::args::Args;
use rustix::process::{Pid, Signal, kill_process_group};

/// Whether `shown` occurs in the output `came`. `...` matches anything, also several lines.
fn occurs(shown: &str, came: &str) -> bool {
    let mut rest = came;
    shown.split("...").all(|part| {
        let found = rest.split_once(part.trim_matches('\n'));
        rest = found.map_or("", |(_, after)| after);
        found.is_some()
    })
}

fn follow(guide: &str) {
    let text = fs::read_to_string(root().join("docs").join(guide)).unwrap();
    // Another program may use the ports of the guide on this machine.
    let free = || free_address().port().to_string();
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
    let mut expected: Vec<(&str, &str)> = Vec::new();
    for (kind, block) in blocks(&text) {
        let name = block
            .strip_prefix("# ")
            .and_then(|rest| rest.lines().next());
        match (kind, name) {
            ("toml" | "python", Some(name)) if !name.contains(' ') => {
                script += &format!("cat > {name} <<'END OF FILE'\n{block}\nEND OF FILE\n");
            }
            ("console", _) => {
                for part in block.trim_start_matches("$ ").split("\n$ ") {
                    let (command, shown) = part.split_once('\n').unwrap_or((part, ""));
                    script += &format!("{command}\necho \"@@ $?\"\n");
                    expected.push((command, shown));
                }
            }
            _ => {}
        }
    }
    assert!(!expected.is_empty(), "{guide} has no commands");
    let output = run(&script, place.path());
    let mut rest = output.as_str();
    for (command, shown) in expected {
        let ended = rest.split_once("@@ ");
        let (came, after) = ended.unwrap_or_else(|| panic!("{guide}: no end: {command}\n{output}"));
        let (code, after) = after.split_once('\n').unwrap();
        assert_eq!(code, "0", "{guide}: {command}\n{came}");
        let is_as_shown = occurs(shown, came);
        assert!(
            is_as_shown,
            "{guide}: {command}\nexpected\n{shown}\ncame\n{came}"
        );
        rest = after;
    }
}

/// Runs a script to its end, then ends every process that the script left running.
fn run(script: &str, place: &Path) -> String {
    let binaries = Path::new(BINARY).parent().unwrap().display();
    let path = std::env::var("PATH").unwrap();
    let path = format!("{binaries}:{binaries}/examples:{path}");
    let mut command = Command::new("timeout");
    command
        .args(["--foreground", "240", "bash", "-c", script])
        .current_dir(place);
    command
        .env("PATH", path)
        .env("XDG_RUNTIME_DIR", place)
        .env("RUST_LOG", "info");
    command.env_remove("RUNTIME_DIRECTORY").process_group(0);
    command.stdin(Stdio::null()).stderr(Stdio::null());
    command.stdout(File::create(place.join(".output")).unwrap());
    let mut child = command.spawn().unwrap();
    child.wait().unwrap();
    let group = Pid::from_raw(i32::try_from(child.id()).unwrap()).unwrap();
    // The group may already be empty.
    let _ = kill_process_group(group, Signal::KILL);
    fs::read_to_string(place.join(".output")).unwrap()
}

#[test]
fn each_guide_says_what_happens() {
    std::thread::scope(|scope| {
        for guide in [
            "operator.md",
            "controller.md",
            "your-array.md",
            "motion.md",
            "recordings.md",
        ] {
            scope.spawn(move || follow(guide));
        }
    });
}

#[test]
fn every_command_and_option_of_the_daemon_in_the_pages_exists() {
    assert_known::<Args>("hardnessd", 80);
}
