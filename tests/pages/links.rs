//! Every link between pages leads to a page or a heading, here and in the Debian package. No page has a
//! gap for a figure.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Component, Path, PathBuf};

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

/// The pages and files that the Debian package installs beside each other, by their path there.
fn packaged() -> BTreeMap<PathBuf, PathBuf> {
    let manifest = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Value = toml::from_str(&manifest).unwrap();
    let assets = manifest["package"]["metadata"]["deb"]["assets"].as_array();
    let mut found = BTreeMap::new();
    for asset in assets.unwrap() {
        let (source, place) = (asset[0].as_str().unwrap(), asset[1].as_str().unwrap());
        let Some(place) = place.strip_prefix("usr/share/doc/hardnessd/") else {
            continue;
        };
        let (directory, pattern) = source.rsplit_once('/').unwrap_or((".", source));
        // A wildcard stands in the name of the file, at most once in a part of it.
        let parts: Vec<&str> = pattern.split('*').collect();
        // What the build generates is not in the repository.
        let entries = fs::read_dir(root().join(directory));
        for entry in entries.into_iter().flatten() {
            let file = entry.unwrap().path();
            let name = file.file_name().unwrap().to_string_lossy().into_owned();
            if file.is_file() && matches(&name, &parts) {
                found.insert(Path::new(place).join(name), file);
            }
        }
    }
    found
}

/// Whether a name has these parts in this order, with anything between them.
fn matches(name: &str, parts: &[&str]) -> bool {
    let (first, rest) = parts.split_first().unwrap();
    let Some(mut left) = name.strip_prefix(first) else {
        return false;
    };
    let Some((last, middle)) = rest.split_last() else {
        return left.is_empty();
    };
    for part in middle {
        match left.split_once(part) {
            Some((_, after)) => left = after,
            None => return false,
        }
    }
    left.ends_with(last)
}

/// A path without `..` and `.`.
fn plain(path: &Path) -> PathBuf {
    let mut kept = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => assert!(kept.pop(), "{} leads out", path.display()),
            Component::CurDir => {}
            part => kept.push(part),
        }
    }
    kept
}

#[test]
fn the_package_has_what_its_pages_link_to() {
    let files = packaged();
    let mut missing = Vec::new();
    let mut checked = 0;
    for (place, page) in &files {
        if place.extension().is_none_or(|end| end != "md") {
            continue;
        }
        for link in links(&fs::read_to_string(page).unwrap()) {
            let target = link.split('#').next().unwrap_or_default();
            if target.is_empty() || target.contains("://") {
                continue;
            }
            checked += 1;
            let target = plain(&place.parent().unwrap().join(target));
            if !files.keys().any(|file| file.starts_with(&target)) {
                missing.push(format!("{}: {link}", place.display()));
            }
        }
    }
    assert!(checked > 100, "{checked}");
    assert!(
        missing.is_empty(),
        "not among the package's assets in Cargo.toml: {missing:#?}"
    );
}
