//! Every link between pages leads to a page or a heading, and the pages are short.
//! `tests/peers/package.py` checks the links in the Debian package.

use std::fs;
use std::path::Path;

use super::commands::{pages, prose, root};

/// Whether a page has a heading with this anchor: lower case, no punctuation, dashes for spaces.
fn has_anchor(page: &Path, fragment: &str) -> bool {
    let text = fs::read_to_string(page).unwrap();
    let headings = prose(&text)
        .flat_map(str::lines)
        .filter(|line| line.starts_with('#'));
    let mut anchors = headings.map(|line| {
        let heading = line.trim_start_matches('#').trim().to_lowercase();
        let kept = heading.replace(|c: char| !(c.is_alphanumeric() || " -_".contains(c)), "");
        kept.replace(' ', "-")
    });
    anchors.any(|anchor| anchor == fragment)
}

#[test]
fn the_pages_are_short_enough_to_be_read() {
    // The results are for those who doubt, and for who changes the project.
    let is_result = |page: &str| {
        ["results", "fixtures", "fuzz"]
            .iter()
            .any(|other| page.starts_with(other))
    };
    let words = |text: &str| text.split_whitespace().count();
    let pages = pages().into_iter().filter(|(page, _)| !is_result(page));
    let count: usize = pages.map(|(_, text)| words(&text)).sum();
    assert!(count <= 36_000, "{count} words");
    let readme = words(&fs::read_to_string(root().join("README.md")).unwrap());
    assert!(readme <= 600, "README.md: {readme} words");
}

#[test]
fn links_between_pages_lead_somewhere() {
    let mut checked = 0;
    for (page, text) in pages() {
        let path = root().join(&page);
        let text: String = prose(&text).collect();
        let links = text
            .split("](")
            .skip(1)
            .filter_map(|rest| rest.split_once(')'));
        for (link, _) in links.filter(|(link, _)| !link.contains("://")) {
            checked += 1;
            let (name, fragment) = link.split_once('#').unwrap_or((link, ""));
            let target = match name {
                "" => path.clone(),
                name => path.with_file_name(name),
            };
            let leads = target.exists() && (fragment.is_empty() || has_anchor(&target, fragment));
            assert!(leads, "{page}: {link}");
        }
    }
    assert!(checked > 100, "{checked}");
}
