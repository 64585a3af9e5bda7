//! The command lines of the Markdown pages, as a shell calls them.
//!
//! Bash runs the `sh` and `console` blocks of a page. In place of our programs it calls functions
//! that write down their arguments, and every other program does nothing. So quotes, variables,
//! loops and continued lines mean what they mean to the reader.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clap::error::ErrorKind;

/// A command line in a page: the program and its arguments.
#[derive(Debug)]
pub(crate) struct Call {
    /// The page, relative to the repository.
    pub(crate) page: String,
    /// The program, then its arguments.
    pub(crate) words: Vec<String>,
}

impl fmt::Display for Call {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.page, self.words.join(" "))
    }
}

/// Replaces every program by one that does nothing, and ours by ones that write down their
/// arguments.
const STAGE: &str = r#"
PATH=/nowhere
command_not_found_handle() { :; }
called() { printf '%s\0' "$#" "$@" >>"$CALLS"; }
hardnessd() { called hardnessd "$@"; }
hrn-train() { called hrn-train "$@"; }
cargo() {
    local program=hardnessd
    [[ $1 == run ]] || return 0
    while (($#)); do
        case $1 in
            --example) return ;;
            --bin) program=$2 ;;
            --) called "$program" "${@:2}"; return ;;
        esac
        shift
    done
}
sudo() { "$@"; }
timeout() { "${@:2}"; }
[() { :; }
test() { :; }
cd() { :; }
kill() { :; }
"#;

/// The fenced blocks of a page, with kind and content.
pub(crate) fn blocks(text: &str) -> Vec<(String, String)> {
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

/// The shell script of a block, without prompts and output.
fn script(kind: &str, block: &str) -> String {
    match kind {
        "sh" => block.to_owned(),
        "console" => {
            let mut lines = Vec::new();
            let mut is_command = false;
            for line in block.lines() {
                let command = line.strip_prefix("$ ");
                let more = line.strip_prefix("> ").filter(|_| is_command);
                is_command = command.or(more).is_some();
                lines.extend(command.or(more));
            }
            lines.join("\n")
        }
        _ => String::new(),
    }
}

/// The calls of our programs in the blocks of a page.
///
/// # Panics
///
/// Panics if a block writes outside its directory, or does not end.
pub(crate) fn calls(page: &str, text: &str) -> Vec<Call> {
    let scripts = blocks(text)
        .into_iter()
        .map(|(kind, block)| script(&kind, &block));
    let script: Vec<String> = scripts.filter(|script| !script.is_empty()).collect();
    let script = script.join("\n").replace("target/release/", "");
    let inside = script.replace(">/dev/", "").replace("> /dev/", "");
    assert!(
        !inside.contains(">/") && !inside.contains("> /"),
        "{page}: a command writes outside its directory"
    );
    let place = tempfile::tempdir().unwrap();
    let calls = place.path().join("calls");
    fs::write(&calls, "").unwrap();
    let work = place.path().join("work");
    fs::create_dir(&work).unwrap();
    let ended = Command::new("timeout")
        .args(["60", "bash", "-c", &format!("{STAGE}\n{script}\nwait\n")])
        // Nothing of the caller: `~` and `$HOME` are the block's own directory.
        .env_clear()
        .envs(std::env::var_os("PATH").map(|path| ("PATH", path)))
        .env("HOME", &work)
        .current_dir(&work)
        .env("CALLS", &calls)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    assert_ne!(ended.unwrap().code(), Some(124), "{page}: no end");
    let written = fs::read_to_string(&calls).unwrap();
    let mut fields = written.split_terminator('\0');
    let mut calls = Vec::new();
    while let Some(count) = fields.next() {
        let words = fields.by_ref().take(count.parse().unwrap());
        calls.push(Call {
            page: page.to_owned(),
            words: words.map(str::to_owned).collect(),
        });
    }
    calls
}

fn markdown(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap();
    let mut pages: Vec<PathBuf> = entries
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "md"))
        // It also names commands of the past.
        .filter(|path| !path.ends_with("CHANGELOG.md"))
        .collect();
    pages.sort();
    pages
}

/// Every page for users: its path within the repository, and its text.
fn pages() -> Vec<(String, String)> {
    // The trainer's tests use this file too, from two folders below.
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let root = here
        .ancestors()
        .find(|folder| folder.join("Cargo.lock").exists());
    let root = root.expect("the tests run in the repository");
    let folders = ["", "docs", "models", "fixtures", "clients/python"];
    let more = [
        "clients/ros2",
        "clients/lerobot",
        "clients/foxglove",
        "clients/grafana",
    ];
    let mut pages: Vec<PathBuf> = folders
        .iter()
        .chain(&more)
        .flat_map(|folder| markdown(&root.join(folder)))
        .collect();
    // The package of the sources leaves out the results.
    let results = root.join("results");
    if results.exists() {
        pages.extend(markdown(&results));
    }
    let read = |path: PathBuf| {
        let page = path.strip_prefix(root).unwrap().display().to_string();
        (page, fs::read_to_string(path).unwrap())
    };
    pages.into_iter().map(read).collect()
}

/// The calls of `program` in the blocks of every page.
pub(crate) fn calls_of(program: &str) -> Vec<Call> {
    let mut found = Vec::new();
    for (page, text) in pages() {
        found.extend(calls(&page, &text));
    }
    found.retain(|call| call.words[0] == program);
    found
}

/// The commands of `program` that the sentences of every page name between backticks. They need
/// not be complete, and may have `N` or `...` for a value.
pub(crate) fn names_of(program: &str) -> Vec<Call> {
    let mut found = Vec::new();
    for (page, text) in pages() {
        // Every second part between fences is a block.
        let prose: Vec<&str> = text.split("```").step_by(2).collect();
        for paragraph in prose.join("\n\n").split("\n\n") {
            for span in paragraph.split('`').skip(1).step_by(2) {
                let words = span
                    .split_whitespace()
                    .take_while(|word| !matches!(*word, "|" | ">" | "<" | "&&" | "||" | "..."));
                let words: Vec<String> = words.map(str::to_owned).collect();
                if words.len() > 1 && words[0] == program {
                    let page = page.clone();
                    found.push(Call { page, words });
                }
            }
        }
    }
    found
}

/// The calls that are no command line of `P`, each with its error.
pub(crate) fn wrong_calls<P: clap::Parser>(calls: &[Call]) -> Vec<String> {
    let wrong = calls.iter().filter_map(|call| {
        let error = P::try_parse_from(&call.words).err()?;
        Some(format!("{call}: {error}"))
    });
    wrong.collect()
}

/// The calls that name a command or an option which `P` does not have, each with its error.
pub(crate) fn unknown_names<P: clap::Parser>(calls: &[Call]) -> Vec<String> {
    let unknown = [ErrorKind::UnknownArgument, ErrorKind::InvalidSubcommand];
    let wrong = calls.iter().filter_map(|call| {
        let error = P::try_parse_from(&call.words).err()?;
        let is_unknown = unknown.contains(&error.kind());
        is_unknown.then(|| format!("{call}: {error}"))
    });
    wrong.collect()
}
