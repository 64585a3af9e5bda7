//! The reference pages agree with the programs: they have every key, option, field and metric, and nothing
//! else.
//!
//! A block whose fence names a source is made from that source: `text hardnessd run -h` from what the
//! program prints but for the option that every command has, `toml config/hardnessd.toml [press]` from that part of the file. `MAKE_PAGES=1 cargo test
//! --workspace --test program blocks` writes them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use crate::bench::{BINARY, Bench, get, wait_for};

/// The page with the commands of the trainer that users seldom need.
const TRAINER: &str = "results/trainer.md";

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn page(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap()
}

/// A row of a table: its cells by the names of their columns, and the heading above it.
#[derive(Debug)]
struct Row {
    section: String,
    cells: BTreeMap<String, String>,
}

fn cells(line: &str) -> Vec<String> {
    let inner = line.trim().trim_start_matches('|').trim_end_matches('|');
    inner
        .split('|')
        .map(|cell| cell.trim().to_owned())
        .collect()
}

/// All rows of all tables in a page.
fn rows(text: &str) -> Vec<Row> {
    let mut section = String::new();
    let mut columns: Vec<String> = Vec::new();
    let mut rows = Vec::new();
    for line in text.lines() {
        if line.starts_with("## ") {
            section = String::new();
        } else if let Some(heading) = line.strip_prefix("### ") {
            section = heading.to_owned();
        }
        if !line.starts_with('|') {
            columns = Vec::new();
        } else if columns.is_empty() {
            columns = cells(line);
        } else if !line.starts_with("|---") {
            rows.push(Row {
                section: section.clone(),
                cells: columns.iter().cloned().zip(cells(line)).collect(),
            });
        }
    }
    rows
}

/// The text between backticks, if the whole cell is that text.
fn code(cell: &str) -> Option<&str> {
    let inner = cell.strip_prefix('`')?.strip_suffix('`')?;
    (!inner.contains('`')).then_some(inner)
}

/// Whether this build has the command: some come with a feature.
pub(crate) fn has_command(name: &str) -> bool {
    match name {
        "watch" => cfg!(feature = "watch"),
        _ => true,
    }
}

fn output(program: &str, arguments: &[&str]) -> String {
    let path = match program {
        "hrn-train" => crate::bench::hrn_train(),
        _ => PathBuf::from(BINARY),
    };
    let mut call = Command::new(path);
    // The width of the reader's terminal would wrap the help.
    call.args(arguments).env_remove("COLUMNS");
    let output = call.output().unwrap();
    assert!(output.status.success(), "{program} {arguments:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// The commands in a program's `--help`.
fn commands(program: &str) -> Vec<String> {
    let help = output(program, &["--help"]);
    let listed = help.split("Commands:\n").nth(1).unwrap();
    let listed = listed.split("\n\n").next().unwrap();
    let names = listed.lines().filter_map(|line| {
        let name = line.strip_prefix("  ")?;
        (!name.starts_with(' ')).then(|| name.split_whitespace().next().unwrap().to_owned())
    });
    names.filter(|name| name != "help").collect()
}

/// The parts of a configuration, which blank lines separate, by the table or key that each begins with.
fn parts(file: &str) -> Vec<(String, String)> {
    let text = page(file);
    let parts = text.split("\n\n").skip(1).map(|part| {
        let name = part.trim_start_matches("# ").split_whitespace().next();
        (name.unwrap().to_owned(), part.to_owned())
    });
    parts.collect()
}

/// The output of `-h` without the line of `-h` itself. It is the last option, and may be the only one.
fn without_help(output: &str) -> String {
    let lines = output.lines();
    let kept: Vec<&str> = lines
        .filter(|line| !line.starts_with("  -h, --help"))
        .collect();
    let kept = kept.join("\n");
    let kept = kept.trim_end();
    kept.strip_suffix("\n\nOptions:").unwrap_or(kept).to_owned()
}

/// What a source says now. Nothing if this build does not have the command.
fn content(source: &str) -> Option<String> {
    let words: Vec<&str> = source.split(' ').collect();
    let content = match words[0] {
        "hardnessd" | "hrn-train" if !has_command(words[1]) => return None,
        program @ ("hardnessd" | "hrn-train") => without_help(&output(program, &words[1..])),
        file => {
            let part = parts(file).into_iter().find(|(name, _)| name == words[1]);
            part.unwrap_or_else(|| panic!("no part {source}")).1
        }
    };
    let lines: Vec<&str> = content.trim_end().lines().map(str::trim_end).collect();
    Some(lines.join("\n"))
}

/// The page with every block that has a source made anew.
fn made(text: &str) -> String {
    let mut made = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        made += &format!("{line}\n");
        let fence = line.strip_prefix("```");
        if let Some((_, source)) = fence.and_then(|fence| fence.split_once(' ')) {
            let old: Vec<&str> = lines.by_ref().take_while(|line| *line != "```").collect();
            let new = content(source).unwrap_or_else(|| old.join("\n"));
            made += &format!("{new}\n```\n");
        }
    }
    made
}

#[test]
fn blocks_that_are_made_have_what_their_sources_say() {
    for name in ["docs/command-line.md", "docs/configuration.md", TRAINER] {
        // The package of the sources leaves out the results.
        if !root().join(name).exists() {
            continue;
        }
        let text = page(name);
        let made = made(&text);
        if std::env::var_os("MAKE_PAGES").is_some() {
            fs::write(root().join(name), made).unwrap();
            continue;
        }
        let changed = text.lines().zip(made.lines()).find(|(old, new)| old != new);
        assert!(
            text == made,
            "{name}: MAKE_PAGES=1 cargo test --workspace --test program blocks ({changed:?})"
        );
    }
}

#[test]
fn every_command_and_every_table_has_a_block() {
    let mut text = page("docs/command-line.md");
    // The package of the sources leaves out the results.
    let mut programs = vec!["hardnessd"];
    if root().join(TRAINER).exists() {
        text += &page(TRAINER);
        programs.push("hrn-train");
    }
    for program in programs {
        for command in commands(program) {
            let call = format!("{program} {command}");
            let block = format!("\n## `{call}`\n\n```text {call} -h\n");
            assert!(text.contains(&block), "docs/command-line.md: {call}");
        }
    }
    let text = page("docs/configuration.md");
    let file = "config/hardnessd.toml";
    for (name, _) in parts(file) {
        let block = format!("\n### `{name}`\n\n```toml {file} {name}\n");
        assert!(text.contains(&block), "docs/configuration.md: {name}");
    }
}

#[test]
fn the_page_on_the_protocol_has_every_field_of_the_schema_and_no_other() {
    let schema: serde_json::Value = serde_json::from_str(&page("docs/events.schema.json")).unwrap();
    let mut written: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for row in rows(&page("docs/protocol.md")) {
        let Some(kind) = code(&row.section) else {
            continue;
        };
        let Some(fields) = row.cells.get("Field") else {
            continue;
        };
        let fields = fields.split('`').skip(1).step_by(2).map(str::to_owned);
        written.entry(kind.to_owned()).or_default().extend(fields);
    }
    for (kind, fields) in &written {
        let known = schema["$defs"][kind]["properties"].as_object().unwrap();
        let mut known: BTreeSet<String> = known.keys().cloned().collect();
        // The fields of all events are in a table of their own. The `seq` of `hello` has another
        // meaning.
        for shared in ["type", "sensor", "time"] {
            known.remove(shared);
        }
        if kind != "hello" {
            known.remove("seq");
        }
        assert_eq!(fields, &known, "{kind}");
    }
    let kinds: Vec<&str> = written.keys().map(String::as_str).collect();
    assert_eq!(kinds, ["frame", "hardness", "hello", "press", "status"]);
}

#[test]
fn the_page_on_metrics_has_every_metric_and_no_other() {
    let bench = Bench::new();
    let http = "[http]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = bench.daemon_with(http);
    let address = daemon.address("http");
    let _sensor = bench.sensor(&[]);
    daemon.logged("\"live\"");
    let mut found: BTreeMap<String, (String, BTreeSet<String>)> = BTreeMap::new();
    // The measured rate exists from the second frame on.
    wait_for("two frames", || {
        found = scrape(&get(&address.to_string(), "/metrics"));
        found.contains_key("hardnessd_frame_rate_hertz")
    });
    let documented = rows(&page("docs/metrics.md")).into_iter().map(|row| {
        let name = code(&row.cells["Metric"]).unwrap().to_owned();
        let mut labels: BTreeSet<String> = row.cells["More labels"]
            .split(", ")
            .filter_map(code)
            .map(str::to_owned)
            .collect();
        labels.insert("robot".to_owned());
        (name, (row.cells["Type"].clone(), labels))
    });
    assert_eq!(documented.collect::<BTreeMap<_, _>>(), found);
}

/// The name of every series -> its type and the names of its labels.
fn scrape(text: &str) -> BTreeMap<String, (String, BTreeSet<String>)> {
    let mut found: BTreeMap<String, (String, BTreeSet<String>)> = BTreeMap::new();
    let mut kind = String::new();
    for line in text.lines() {
        if let Some(declared) = line.strip_prefix("# TYPE ") {
            kind = declared.split(' ').nth(1).unwrap().to_owned();
        } else if line.starts_with("hardnessd_") {
            let end = line.find(['{', ' ']).unwrap();
            let labels = line.split_once('{').map_or("", |(_, labels)| labels);
            let labels = labels.rsplit_once('}').map_or("", |(labels, _)| labels);
            let entry = found
                .entry(line[..end].to_owned())
                .or_insert((kind.clone(), BTreeSet::new()));
            entry.1.extend(
                labels
                    .split(',')
                    .filter_map(|label| label.split_once('='))
                    .map(|(name, _)| name.to_owned()),
            );
        }
    }
    found
}
