//! The Markdown pages, and the command lines in them. The trainer's tests use this file too.

use std::fs;
use std::path::{Path, PathBuf};

use clap::error::ErrorKind;

/// The directory of the sources.
pub(crate) fn root() -> PathBuf {
    let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let root = folders.find(|folder| folder.join("Cargo.lock").exists());
    root.expect("the tests run in the repository").to_owned()
}

/// Every page for users: its path within the repository, and its text. The changelog also names what is gone.
pub(crate) fn pages() -> Vec<(String, String)> {
    let root = root();
    let mut found = Vec::new();
    // The package of the sources leaves out the results.
    let folders = ". docs models fixtures results fuzz clients/python clients/ros2 clients/lerobot \
                   clients/foxglove clients/grafana";
    for folder in folders
        .split(' ')
        .filter(|folder| root.join(folder).exists())
    {
        for entry in fs::read_dir(root.join(folder)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            if name.ends_with(".md") && name != "CHANGELOG.md" {
                let page = format!("{folder}/{name}");
                let text = fs::read_to_string(root.join(&page)).unwrap();
                found.push((page, text));
            }
        }
    }
    found.sort();
    found
}

/// The text of a page between its blocks.
pub(crate) fn prose(text: &str) -> impl Iterator<Item = &str> {
    text.split("```").step_by(2)
}

/// The blocks of a page: what stands behind the fence, and the content.
pub(crate) fn blocks(text: &str) -> impl Iterator<Item = (&str, &str)> {
    let blocks = text.split("```").skip(1).step_by(2);
    blocks.filter_map(|block| block.split_once('\n'))
}

/// The lines of a page that a shell reads: those of blocks, each command with all its lines, and the code in sentences.
fn commands(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (kind, block) in blocks(text) {
        let is_typed =
            |line: &&str| kind == "sh" || kind == "console" && line.starts_with(['$', '>']);
        let joined = block.replace("\\\n", " ");
        found.extend(joined.lines().filter(is_typed).map(str::to_owned));
    }
    for paragraph in prose(text).flat_map(|part| part.split("\n\n")) {
        let spans = paragraph.split('`').skip(1).step_by(2);
        found.extend(spans.map(|span| span.replace('\n', " ")));
    }
    found
}

/// The arguments of every call of `program` in a line. Values that a shell or the reader fills in are left out.
fn calls(program: &str, line: &str) -> Vec<Vec<String>> {
    let is_before = |word: &&str| ["$", ">", "sudo", "until", "do"].contains(word);
    let mut found = Vec::new();
    for command in line.split(['|', '&', ';']) {
        let words = command.split_whitespace().skip_while(is_before);
        let words = words.take_while(|word| !word.contains(['>', '<', '#']) && *word != "...");
        let words: Vec<&str> = words.filter(|word| !word.starts_with('$')).collect();
        if words.len() > 1 && words[0].rsplit('/').next() == Some(program) {
            found.push(words.into_iter().map(str::to_owned).collect());
        }
    }
    found
}

/// All calls of `program` in the pages name commands and options that `P` has. There are at least `least`.
///
/// # Panics
///
/// Panics if a call does not, or if there are fewer.
pub(crate) fn assert_known<P: clap::Parser>(program: &str, least: usize) {
    let unknown = [ErrorKind::UnknownArgument, ErrorKind::InvalidSubcommand];
    let mut count = 0;
    for (page, text) in pages() {
        for call in commands(&text).iter().flat_map(|line| calls(program, line)) {
            count += 1;
            let error = P::try_parse_from(&call).err();
            let error = error.filter(|error| unknown.contains(&error.kind()));
            assert!(error.is_none(), "{page}: {}: {error:?}", call.join(" "));
        }
    }
    assert!(count >= least, "found {count} calls");
}
