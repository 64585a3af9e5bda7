//! Every link between pages leads to a page or a heading, and no page has a gap for a figure.
//! `tests/peers/package.py` checks the links in the Debian package.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Every page of the repository.
fn pages(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            if !name.starts_with('.')
                && !name.starts_with("target")
                && !path.join("CACHEDIR.TAG").exists()
            {
                pages(&path, found);
            }
        } else if name.ends_with(".md") {
            found.push(path);
        }
    }
}

/// The page without its code blocks.
fn prose(text: &str) -> String {
    let mut is_code = false;
    let mut kept = String::new();
    for line in text.lines() {
        if line.trim_start().starts_with("```") {
            is_code = !is_code;
        } else if !is_code {
            kept += line;
            kept.push('\n');
        }
    }
    kept
}

/// The targets of a page's links.
fn links(text: &str) -> Vec<String> {
    let text = prose(text);
    let targets = text.split("](").skip(1);
    targets
        .filter_map(|rest| rest.split_once(')'))
        .map(|(target, _)| target.to_owned())
        .collect()
}

/// The anchor of a heading: lower case, no punctuation, dashes for spaces.
fn anchor(heading: &str) -> String {
    let lower = heading.to_lowercase();
    let kept = lower
        .chars()
        .filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    kept.collect::<String>().replace(' ', "-")
}

fn anchors(text: &str) -> BTreeSet<String> {
    let text = prose(text);
    let headings = text.lines().filter(|line| line.starts_with('#'));
    headings
        .map(|line| anchor(line.trim_start_matches('#').trim()))
        .collect()
}

/// The most words of all pages for users, as `wc -w` counts them. The changelog and the results are not among them.
const MOST_WORDS: usize = 36_000;

#[test]
fn the_pages_are_short_enough_to_be_read() {
    let mut all = Vec::new();
    for folder in ["docs", "models", "clients"] {
        pages(&root().join(folder), &mut all);
    }
    let top = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"];
    all.extend(top.map(|name| root().join(name)));
    let words = |page: &PathBuf| fs::read_to_string(page).unwrap().split_whitespace().count();
    let count: usize = all.iter().map(words).sum();
    assert!(count <= MOST_WORDS, "{count} words");
    let readme = words(&root().join("README.md"));
    assert!(readme <= 600, "README.md: {readme} words");
}

#[test]
fn no_page_has_a_gap_for_a_figure() {
    let mut all = Vec::new();
    pages(&root(), &mut all);
    for page in all {
        let text = fs::read_to_string(&page).unwrap();
        let is_gap = |word: &&str| {
            let word = word.trim_matches(|c: char| !c.is_alphanumeric() && c != '@');
            let is_marked = word.len() > 2 && word.starts_with('@') && word.ends_with('@');
            is_marked || word == "XX" || word == "TODO"
        };
        let found: Vec<&str> = text.split_whitespace().filter(is_gap).collect();
        assert!(found.is_empty(), "{}: {found:?}", page.display());
    }
}

#[test]
fn links_between_pages_lead_somewhere() {
    let mut all = Vec::new();
    pages(&root(), &mut all);
    assert!(all.len() > 12, "{all:?}");
    let mut broken = Vec::new();
    let mut checked = 0;
    for page in all {
        let text = fs::read_to_string(&page).unwrap();
        for link in links(&text) {
            if link.contains("://") {
                continue;
            }
            checked += 1;
            let (path, fragment) = link.split_once('#').unwrap_or((&link, ""));
            let target = match path {
                "" => page.clone(),
                path => page.parent().unwrap().join(path),
            };
            let leads = target.exists()
                && (fragment.is_empty()
                    || anchors(&fs::read_to_string(&target).unwrap()).contains(fragment));
            if !leads {
                broken.push(format!("{}: {link}", page.display()));
            }
        }
    }
    assert!(checked > 100, "{checked}");
    assert!(broken.is_empty(), "{broken:#?}");
}
