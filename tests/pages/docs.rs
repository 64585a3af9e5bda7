//! The reference pages have every command with its options, and every part of the configuration.
//!
//! A block whose fence names a source is made from that source: `text hardnessd run -h` from what the
//! program prints but for the option that every command has, `toml config/hardnessd.toml [press]` from that part of the
//! file. `MAKE_PAGES=1 cargo test --workspace --test program blocks` writes them. `tests/peers/schema.py` compares the
//! pages on the protocol and the metrics with what the daemon sends.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use super::commands::root;
use crate::bench::{BINARY, hrn_train, ran};

const PAGES: [&str; 3] = [
    "docs/command-line.md",
    "docs/configuration.md",
    // The commands of the trainer that users seldom need. The package of the sources leaves out the results.
    "results/trainer.md",
];
const CONFIGURATION: &str = "config/hardnessd.toml";

/// The pages that are there, with their texts.
fn pages() -> Vec<(PathBuf, String)> {
    let paths = PAGES.map(|name| root().join(name)).into_iter();
    let there = paths.filter_map(|path| fs::read_to_string(&path).ok().map(|text| (path, text)));
    there.collect()
}

fn output(program: &str, arguments: &[&str]) -> String {
    let path = match program {
        "hrn-train" => hrn_train(),
        _ => PathBuf::from(BINARY),
    };
    // The width of the reader's terminal would wrap the help.
    let mut call = Command::new(path);
    let (code, output, _) = ran(call.args(arguments).env_remove("COLUMNS"));
    assert_eq!(code, 0, "{program} {arguments:?}");
    output
}

/// The commands in a program's `--help`.
fn commands(program: &str) -> Vec<String> {
    let help = output(program, &["--help"]);
    let listed = help.split("Commands:\n").nth(1).unwrap();
    let listed = listed.split("\n\n").next().unwrap().lines();
    let names = listed.filter_map(|line| line.strip_prefix("  ")?.split(' ').next());
    let names = names.filter(|name| !["", "help"].contains(name));
    names.map(str::to_owned).collect()
}

/// The parts of the configuration, which blank lines separate, by the table or key that each begins with.
fn configuration() -> Vec<(String, String)> {
    let text = fs::read_to_string(root().join(CONFIGURATION)).unwrap();
    let parts = text.split("\n\n").skip(1).map(|part| {
        let name = part.trim_start_matches("# ").split_whitespace().next();
        (name.unwrap().to_owned(), part.to_owned())
    });
    parts.collect()
}

/// What a source says now.
fn content(source: &str) -> String {
    let words: Vec<&str> = source.split(' ').collect();
    let content = if words[0] == CONFIGURATION {
        let part = configuration().into_iter().find(|part| part.0 == words[1]);
        part.unwrap_or_else(|| panic!("no part {source}")).1
    } else {
        // The line of `-h` itself is the last option, and may be the only one.
        let help = output(words[0], &words[1..]);
        let lines = help.lines();
        let kept: Vec<&str> = lines
            .filter(|line| !line.starts_with("  -h, --help"))
            .collect();
        let kept = kept.join("\n");
        let kept = kept.trim_end();
        kept.strip_suffix("\n\nOptions:").unwrap_or(kept).to_owned()
    };
    let lines: Vec<&str> = content.trim_end().lines().map(str::trim_end).collect();
    lines.join("\n")
}

/// The page with every block that has a source made anew.
fn made(text: &str) -> String {
    let mut made = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        made += &format!("{line}\n");
        let fence = line.strip_prefix("```");
        if let Some((_, source)) = fence.and_then(|fence| fence.split_once(' ')) {
            lines.by_ref().find(|line| *line == "```");
            made += &format!("{}\n```\n", content(source));
        }
    }
    made
}

#[test]
fn blocks_that_are_made_have_what_their_sources_say() {
    for (path, text) in pages() {
        let made = made(&text);
        if std::env::var_os("MAKE_PAGES").is_some() {
            fs::write(&path, made).unwrap();
            continue;
        }
        let changed = text.lines().zip(made.lines()).find(|(old, new)| old != new);
        let how = "MAKE_PAGES=1 cargo test --workspace --test program blocks";
        assert!(text == made, "{}: {how} ({changed:?})", path.display());
    }
}

#[test]
fn every_command_and_every_table_has_a_block() {
    let text: String = pages().into_iter().map(|(_, text)| text).collect();
    let mut blocks: Vec<String> = Vec::new();
    for program in ["hardnessd", "hrn-train"] {
        let of_command =
            |name: &String| format!("\n## `{program} {name}`\n\n```text {program} {name} -h\n");
        blocks.extend(commands(program).iter().map(of_command));
    }
    let of_part = |(name, _): &(String, String)| {
        format!("\n### `{name}`\n\n```toml {CONFIGURATION} {name}\n")
    };
    blocks.extend(configuration().iter().map(of_part));
    for block in blocks {
        let has_it = text.contains(&block) || block.contains("hrn-train") && pages().len() < 3;
        assert!(has_it, "docs: no {block}");
    }
}
