//! The sources import each other as the table in ARCHITECTURE.md says, and never in a loop.
//!
//! The imports are read from the sources: `use` statements, and paths that begin with `crate`,
//! `super`, `self` or a child module. Tests, comments and strings do not count.

#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A module's path within the crate, such as `["train", "net", "layers"]`. The path of a binary
/// begins with `bin`.
type Module = Vec<String>;

/// Every module of `src`, with its source.
fn modules() -> BTreeMap<Module, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = BTreeMap::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            if path.extension().is_none_or(|extension| extension != "rs") {
                continue;
            }
            let inside = path.strip_prefix(&root).unwrap().with_extension("");
            let mut module: Module = inside
                .iter()
                .map(|part| part.to_string_lossy().into_owned())
                .collect();
            let last = module.last().unwrap().as_str();
            if last == "tests" || module == ["lib"] {
                continue;
            }
            if module[0] == "bin" && last == "main" {
                module.pop();
            }
            found.insert(module, std::fs::read_to_string(&path).unwrap());
        }
    }
    found
}

/// The words and signs of Rust source, without comments, strings and tests.
fn tokens(source: &str) -> Vec<String> {
    let mut tokens: Vec<String> = Vec::new();
    let bytes: Vec<char> = source.chars().collect();
    let mut at = 0;
    while at < bytes.len() {
        let rest = &bytes[at..];
        let begins = |with: &str| rest.iter().take(with.len()).copied().eq(with.chars());
        if begins("//") {
            at += rest.iter().take_while(|c| **c != '\n').count();
        } else if begins("/*") {
            at += 2 + rest.windows(2).position(|pair| pair == ['*', '/']).unwrap();
        } else if begins("r\"")
            || begins("r#") && rest[1..].iter().find(|c| **c != '#') == Some(&'"')
        {
            let hashes = rest[1..].iter().take_while(|c| **c == '#').count();
            let end: Vec<char> = std::iter::once('"')
                .chain(std::iter::repeat_n('#', hashes))
                .collect();
            let body = &rest[hashes + 2..];
            let length = body
                .windows(end.len())
                .position(|part| part == end)
                .unwrap();
            at += hashes + 2 + length + end.len();
        } else if rest[0] == '"' {
            at += 1;
            while bytes[at] != '"' {
                at += if bytes[at] == '\\' { 2 } else { 1 };
            }
            at += 1;
        } else if rest[0] == '\'' && (rest[1] == '\\' || rest.get(2) == Some(&'\'')) {
            // The character after a backslash may itself be a quote.
            at += if rest[1] == '\\' { 3 } else { 2 };
            while bytes[at] != '\'' {
                at += 1;
            }
            at += 1;
        } else if rest[0].is_alphanumeric() || rest[0] == '_' {
            let word: String = rest
                .iter()
                .take_while(|c| c.is_alphanumeric() || **c == '_')
                .collect();
            at += word.chars().count();
            tokens.push(word);
        } else if begins("::") {
            tokens.push("::".to_owned());
            at += 2;
        } else {
            if !rest[0].is_whitespace() {
                tokens.push(rest[0].to_string());
            }
            at += 1;
        }
    }
    without_tests(&tokens)
}

/// Leaves out every item after `#[cfg(test)]`.
fn without_tests(tokens: &[String]) -> Vec<String> {
    let mut left = Vec::new();
    let mut at = 0;
    let marker = ["#", "[", "cfg", "(", "test", ")", "]"];
    while at < tokens.len() {
        if !tokens[at..].iter().take(marker.len()).eq(&marker) {
            left.push(tokens[at].clone());
            at += 1;
            continue;
        }
        let mut depth = 0;
        loop {
            at += 1;
            match tokens[at].as_str() {
                "{" => depth += 1,
                "}" => depth -= 1,
                _ => {}
            }
            if depth == 0 && matches!(tokens[at].as_str(), "}" | ";") {
                break;
            }
        }
        at += 1;
    }
    left
}

/// Adds the paths of the `use` tree that begins at `at`, each after `prefix`. Returns the tree's
/// end.
fn use_tree(tokens: &[String], mut at: usize, prefix: &[String], into: &mut Vec<Module>) -> usize {
    let mut path = prefix.to_vec();
    loop {
        match tokens[at].as_str() {
            "{" => {
                at += 1;
                while tokens[at] != "}" {
                    assert_ne!(
                        tokens[at],
                        ";",
                        "a list of imports has an end: {:?}",
                        &tokens[at.saturating_sub(40)..at]
                    );
                    at = use_tree(tokens, at, &path, into);
                    if tokens[at] == "," {
                        at += 1;
                    }
                }
                return at + 1;
            }
            "::" => at += 1,
            "as" => at += 2,
            "," | "}" | ";" => {
                into.push(path);
                return at;
            }
            word => {
                path.push(word.to_owned());
                at += 1;
            }
        }
    }
}

/// The modules that a module's source names.
fn imports(module: &Module, source: &str, all: &BTreeMap<Module, String>) -> BTreeSet<Module> {
    let tokens = tokens(source);
    let mut paths: Vec<Module> = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        let before = |back: usize| {
            at.checked_sub(back)
                .map_or("", |place| tokens[place].as_str())
        };
        if tokens[at] == "in" && before(1) == "(" && before(2) == "pub" {
            at += 1 + tokens[at..].iter().position(|token| token == ")").unwrap();
            continue;
        }
        // A re-export passes on names of a child, but uses none of them.
        if tokens[at] == "use" && before(1) == "pub" {
            at += tokens[at..].iter().position(|token| token == ";").unwrap();
            continue;
        }
        // `use<>` in a type captures and imports nothing.
        if tokens[at] == "use" && tokens[at + 1] != "<" {
            at = use_tree(&tokens, at + 1, &[], &mut paths);
            continue;
        }
        let starts = tokens.get(at + 1).is_some_and(|next| next == "::")
            && (at == 0 || tokens[at - 1] != "::");
        if starts {
            let mut path = vec![tokens[at].clone()];
            while tokens.get(at + 1).is_some_and(|next| next == "::") {
                path.push(tokens[at + 2].clone());
                at += 2;
            }
            paths.push(path);
        }
        at += 1;
    }
    let absolute = |path: Module| -> Option<Module> {
        let mut from = match path[0].as_str() {
            "hardnessd" => Vec::new(),
            "crate" if module[0] == "bin" => module[..2.min(module.len())].to_vec(),
            "crate" => Vec::new(),
            "self" => module.clone(),
            "super" => module[..module.len() - 1].to_vec(),
            child => {
                let mut child_module = module.clone();
                child_module.push(child.to_owned());
                return all.contains_key(&child_module).then(|| {
                    child_module.extend(path[1..].iter().cloned());
                    child_module
                });
            }
        };
        for part in &path[1..] {
            match part.as_str() {
                "super" => {
                    from.pop();
                }
                "self" => {}
                part => from.push(part.to_owned()),
            }
        }
        Some(from)
    };
    let mut found = BTreeSet::new();
    for mut path in paths.into_iter().filter_map(absolute) {
        while !path.is_empty() && !all.contains_key(&path) {
            path.pop();
        }
        if !path.is_empty() && path != *module {
            found.insert(path);
        }
    }
    found
}

/// Every file's imports.
fn arrows() -> BTreeMap<Module, BTreeSet<Module>> {
    let all = modules();
    all.iter()
        .map(|(module, source)| (module.clone(), imports(module, source, &all)))
        .collect()
}

/// The table of ARCHITECTURE.md: each storey, and the storeys that it may use.
fn storeys() -> Vec<(String, Vec<String>)> {
    let page = include_str!("../ARCHITECTURE.md");
    let table = page
        .split("```storeys\n")
        .nth(1)
        .expect("the table is there");
    let table = table.split("```").next().unwrap();
    let mut storeys: Vec<(String, Vec<String>)> = Vec::new();
    for line in table.lines() {
        let (name, used) = line
            .split_once(':')
            .expect("a storey, a colon, what it may use");
        let mut names = Vec::new();
        for word in used.split_whitespace() {
            if word == "core" {
                let core = storeys.iter().map(|(name, _)| name.clone());
                names.extend(core.take_while(|name| name != "random"));
            } else {
                assert!(
                    storeys.iter().any(|(above, _)| above == word),
                    "{name} may use {word}, which is no storey above it"
                );
                names.push(word.to_owned());
            }
        }
        storeys.push((name.trim().to_owned(), names));
    }
    storeys
}

fn name(module: &Module) -> String {
    module.join("/")
}

#[test]
fn no_two_files_import_each_other_in_a_loop() {
    let mut arrows = arrows();
    // A file and its own folder count as one module: the file may call them, and they know its
    // types.
    for (module, imports) in &mut arrows {
        imports.retain(|imported| !imported.starts_with(module));
    }
    assert!(arrows.len() > 100, "found {} files", arrows.len());
    // A file whose imports are all gone is in no loop.
    loop {
        let left: BTreeSet<Module> = arrows.keys().cloned().collect();
        let free = |imports: &BTreeSet<Module>| imports.is_disjoint(&left);
        let before = arrows.len();
        arrows.retain(|_, imports| !free(imports));
        if arrows.len() == before {
            break;
        }
    }
    // A file that no remaining file imports is in no loop either.
    loop {
        let imported: BTreeSet<Module> = arrows.values().flatten().cloned().collect();
        let before = arrows.len();
        arrows.retain(|module, _| imported.contains(module));
        if arrows.len() == before {
            break;
        }
    }
    let left: BTreeSet<Module> = arrows.keys().cloned().collect();
    let loops: Vec<String> = arrows
        .iter()
        .flat_map(|(module, imports)| {
            let inside = imports.intersection(&left);
            inside.map(|imported| format!("{} -> {}", name(module), name(imported)))
        })
        .collect();
    assert!(loops.is_empty(), "loops among: {loops:#?}");
}

#[test]
fn every_file_uses_only_the_storeys_that_its_own_may_use() {
    let storeys = storeys();
    let storey_of = |module: &Module| -> usize {
        let path = name(module);
        let fits = |storey: &str| {
            path == storey || path.starts_with(storey) && path[storey.len()..].starts_with('/')
        };
        let fitting = storeys
            .iter()
            .enumerate()
            .filter(|(_, (name, _))| fits(name));
        let longest = fitting.max_by_key(|(_, (name, _))| name.len());
        longest
            .unwrap_or_else(|| panic!("{path} is on no storey"))
            .0
    };
    let mut wrong = Vec::new();
    for (module, imports) in arrows() {
        let own = storey_of(&module);
        for imported in imports {
            let (storey, _) = &storeys[storey_of(&imported)];
            if storeys[own].0 != *storey && !storeys[own].1.contains(storey) {
                wrong.push(format!("{} -> {}", name(&module), name(&imported)));
            }
        }
    }
    assert!(wrong.is_empty(), "against the table: {wrong:#?}");
}
