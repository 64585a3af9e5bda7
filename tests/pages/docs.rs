//! The reference pages agree with the programs: they have every key, option, field and metric with
//! its default, and nothing else.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::bench::{BINARY, Bench, Daemon};
use hardnessd::daemon::config::Config;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn page(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap()
}

/// A row of a table: its cells by the names of their columns, and the headings above it.
#[derive(Debug)]
struct Row {
    chapter: String,
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
    let (mut chapter, mut section) = (String::new(), String::new());
    let mut columns: Vec<String> = Vec::new();
    let mut rows = Vec::new();
    for line in text.lines() {
        if let Some(heading) = line.strip_prefix("## ") {
            chapter = heading.to_owned();
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
                chapter: chapter.clone(),
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

/// The names of the TOML tables in a heading, such as "`[publish.tcp]`".
fn tables(heading: &str) -> Vec<String> {
    let parts = heading.split('`').skip(1).step_by(2);
    parts
        .map(|part| part.trim_matches(['[', ']']).to_owned())
        .collect()
}

/// Every documented key with its default as it is written: (table.key) -> (default, unit).
fn documented(chapter: &str) -> BTreeMap<String, (String, String)> {
    let mut keys = BTreeMap::new();
    let text = page("docs/configuration.md");
    for row in rows(&text) {
        let Some(key) = row.cells.get("Key").and_then(|cell| code(cell)) else {
            continue;
        };
        // Only a table of keys has a unit.
        let Some(unit) = row.cells.get("Unit") else {
            continue;
        };
        if row.chapter != chapter {
            continue;
        }
        for (column, default) in &row.cells {
            let table = if column == "Default" {
                tables(&row.section).first().cloned().unwrap_or_default()
            } else if column.starts_with("`[") {
                tables(column)[0].clone()
            } else {
                continue;
            };
            let path = if table.is_empty() {
                key.to_owned()
            } else {
                format!("{table}.{key}")
            };
            let entry = (default.clone(), unit.clone());
            assert!(keys.insert(path.clone(), entry).is_none(), "{path} twice");
        }
    }
    keys
}

/// The keys of all values that are not tables, with the values as TOML writes them.
fn leaves(value: &toml::Value, path: &str, found: &mut BTreeMap<String, String>) {
    let below = |key: &str| {
        if path.is_empty() {
            key.to_owned()
        } else {
            format!("{path}.{key}")
        }
    };
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                leaves(value, &below(key), found);
            }
        }
        toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {
            items.iter().for_each(|item| leaves(item, path, found));
        }
        _ => {
            found.insert(path.to_owned(), value.to_string());
        }
    }
}

/// Writes and reads settings, so that an f32 keeps its own digits.
fn as_file(settings: &impl serde::Serialize) -> toml::Value {
    toml::from_str(&toml::to_string(settings).unwrap()).unwrap()
}

/// The unit at the end of a key's name.
fn unit_of(key: &str) -> Option<&'static str> {
    [
        ("newtons_per_count", "N/count"),
        ("_hz", "Hz"),
        ("_n_per_mm", "N/mm"),
        ("_mm_s", "mm/s"),
        ("_mm", "mm"),
        ("_ms", "ms"),
        ("_mb", "MB"),
        ("_s", "s"),
        ("_seconds", "s"),
        ("_n", "N"),
        ("_taxels", "taxels"),
        ("_frames", "frames"),
        ("epochs", "epochs"),
    ]
    .into_iter()
    .find(|(suffix, _)| key.ends_with(suffix) && !key.starts_with("dead_"))
    .map(|(_, unit)| unit)
}

fn check_keys(
    documented: &BTreeMap<String, (String, String)>,
    defaults: &BTreeMap<String, String>,
    without_default: &BTreeSet<String>,
) {
    for (path, default) in defaults {
        let (written, _) = documented
            .get(path)
            .unwrap_or_else(|| panic!("{path} is not in docs/configuration.md"));
        if without_default.contains(path) {
            assert!(code(written).is_none(), "{path}: {written} is no default");
        } else {
            assert_eq!(code(written), Some(default.as_str()), "{path}");
        }
    }
    for (path, (written, unit)) in documented {
        let is_known = defaults.contains_key(path) || without_default.contains(path);
        assert!(
            is_known,
            "docs/configuration.md has {path}, which is no key"
        );
        assert!(!written.is_empty(), "{path} has no default");
        let key = path.rsplit('.').next().unwrap();
        if let Some(expected) = unit_of(key) {
            assert_eq!(unit, expected, "{path}");
        }
    }
}

#[test]
fn the_page_on_configuration_has_every_key_of_the_daemon_and_no_other() {
    // Tables that are off by default have default values too.
    let tables =
        "[http]\n[record]\n[publish.tcp]\n[publish.foxglove]\n[publish.zenoh]\n[publish.ros2]";
    let config: Config = toml::from_str(&format!("[[sensor]]\nport = \"p\"\n{tables}")).unwrap();
    let mut defaults = BTreeMap::new();
    leaves(&as_file(&config), "", &mut defaults);
    // The default of these keys depends on the machine or the preset. The shipped file, which
    // another test checks, shows that they are keys.
    let mut without: BTreeSet<String> = ["robot".to_owned(), "sensor.port".to_owned()].into();
    let mut table = String::new();
    let mut shipped = BTreeSet::new();
    for line in page("config/hardnessd.toml").lines() {
        let line = line.trim_start_matches("# ");
        if line.starts_with('[') {
            let end = line.rfind(']').unwrap();
            table = line[..end].trim_matches(['[', ']']).to_owned() + ".";
        } else if let Some((key, _)) = line.split_once(" = ") {
            shipped.insert(format!("{table}{key}"));
        }
    }
    for path in &shipped {
        if !defaults.contains_key(path) {
            without.insert(path.clone());
        }
    }
    check_keys(&documented("The daemon"), &defaults, &without);
    let documented: BTreeSet<String> = documented("The daemon").into_keys().collect();
    assert_eq!(documented, shipped, "config/hardnessd.toml");
}

#[test]
fn the_page_on_configuration_has_every_key_of_the_trainer_and_no_other() {
    // A unit test of the trainer compares this file with its defaults.
    let file = fs::read_to_string(root().join("config/hrn-train.toml")).unwrap();
    let mut defaults = BTreeMap::new();
    leaves(&toml::from_str(&file).unwrap(), "", &mut defaults);
    // The default of this key depends on the network.
    let without = ["pretraining", "training"].map(|table| format!("{table}.level_balance"));
    check_keys(&documented("The trainer"), &defaults, &without.into());
}

/// The long options in a command's `--help`, with the text of each on one line.
fn options(program: &Path, command: &str) -> BTreeMap<String, String> {
    let help = Command::new(program)
        .args([command, "--help"])
        .output()
        .unwrap();
    assert!(help.status.success(), "{command}");
    let help = String::from_utf8(help.stdout).unwrap();
    let mut options: BTreeMap<String, String> = BTreeMap::new();
    let mut last = None;
    for line in help.lines().map(str::trim_start) {
        let named = line.strip_prefix("-h, ").unwrap_or(line);
        if let Some(option) = named.strip_prefix("--") {
            let end =
                option.find(|c: char| c != '-' && !c.is_ascii_lowercase() && !c.is_ascii_digit());
            let name = option[..end.unwrap_or(option.len())].to_owned();
            options.insert(name.clone(), String::new());
            last = Some(name);
        }
        if let Some(text) = last.as_ref().and_then(|name| options.get_mut(name)) {
            *text += line;
            text.push(' ');
        }
    }
    options.remove("help");
    options.remove("version");
    options
}

/// The default of an option, if it is a value and not an explanation.
fn default_of(text: &str) -> Option<&str> {
    let (_, rest) = text.split_once("[default: ")?;
    let (value, _) = rest.split_once(']')?;
    (!value.contains(' ') && value != "never").then_some(value)
}

/// The commands in a program's `--help`.
fn commands(program: &Path) -> Vec<String> {
    let help = Command::new(program).arg("--help").output().unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    let listed = help.split("Commands:\n").nth(1).unwrap();
    let listed = listed.split("\n\n").next().unwrap();
    let names = listed.lines().filter_map(|line| {
        let name = line.strip_prefix("  ")?;
        (!name.starts_with(' ')).then(|| name.split_whitespace().next().unwrap().to_owned())
    });
    names.filter(|name| name != "help").collect()
}

fn check_options(program: &str, path: &Path) {
    let text = page("docs/command-line.md");
    let mut documented: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    for row in rows(&text) {
        let Some(option) = row.cells.get("Option").and_then(|cell| code(cell)) else {
            continue;
        };
        let chapter = row.chapter.trim_matches('`');
        if let Some(command) = chapter.strip_prefix(&format!("{program} ")) {
            let options = documented.entry(command.to_owned()).or_default();
            let name = option.trim_start_matches("--").to_owned();
            options.insert(name, row.cells["Default"].clone());
        }
    }
    for command in commands(path) {
        assert!(
            text.contains(&format!("\n## `{program} {command}`\n")),
            "{program} {command} is not in docs/command-line.md"
        );
        let written = documented.remove(&command).unwrap_or_default();
        let known = options(path, &command);
        assert_eq!(
            written.keys().collect::<Vec<_>>(),
            known.keys().collect::<Vec<_>>(),
            "{program} {command}"
        );
        for (option, help) in &known {
            if let Some(default) = default_of(help) {
                let written = written[option].replace(' ', "");
                assert_eq!(written, default, "{program} {command} --{option}");
            }
        }
    }
    if !cfg!(feature = "watch") {
        documented.remove("watch");
    }
    if !cfg!(feature = "zenoh") {
        documented.remove("fleet");
    }
    assert!(documented.is_empty(), "no such commands: {documented:?}");
}

#[test]
fn the_page_on_the_command_line_has_every_option_of_the_daemon_and_no_other() {
    check_options("hardnessd", Path::new(BINARY));
}

#[test]
fn the_page_on_the_command_line_has_every_option_of_the_trainer_and_no_other() {
    check_options("hrn-train", &crate::bench::hrn_train());
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
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", http));
    let address = daemon.address("http");
    let _sensor = bench.sensor(&[]);
    daemon.logged("\"live\"");
    let mut found: BTreeMap<String, (String, BTreeSet<String>)> = BTreeMap::new();
    // The measured rate exists from the second frame on.
    crate::bench::wait_for("two frames", || {
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

fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
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
