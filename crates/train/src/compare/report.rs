//! One HTML page that shows a run or a comparison, and opens without a network.
//!
//! In: a comparison's results, or a run's directory. Out: HTML with its style, its figures as SVG
//! and the runs' own pictures as data URIs. The page loads nothing else. This module writes no
//! file.

mod courses;
mod figures;
mod plot;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;

pub use self::courses::{Curve, courses};

use self::plot::escaped;
use crate::compare::digits;
use crate::compare::results::{Comparison, Details, Measured, Row, ensure_square};
use crate::compare::sets::MATCHED;
use crate::compare::table::Table;
use crate::compare::tables;
use crate::judge::metrics::{Bin, Evaluation};
use crate::settings::Profile;

const STYLE: &str = include_str!("report/style.css");

/// How to read the curves of training.
const CURVES: &str = "A line for each run. Blue: loss and accuracy on the training samples (of a GAN, \
                      the discriminator's loss). Orange: on held-out objects, the generator's loss, or \
                      within a component. Dashed: real frames.";

/// What a run of the profile `smoke` is worth.
const SMOKE: &str = "Profile smoke: it tries the commands in seconds and learnt nothing. The figures say nothing of \
                     the method.";

/// The page of the comparison or run in `directory`.
///
/// # Errors
///
/// Fails if the directory holds neither, or a file in it cannot be read or parsed.
pub fn of(directory: &Path) -> anyhow::Result<String> {
    if let Some(found) = Comparison::read(directory)? {
        return comparison(&found);
    }
    let details = Details::read(directory)?;
    run(&details)
}

/// The page of a comparison.
///
/// # Errors
///
/// Fails if a picture of a run cannot be read.
pub fn comparison(comparison: &Comparison) -> anyhow::Result<String> {
    let mut page = Page::default();
    let mut entries = comparison.entries.iter();
    if entries.any(|entry| entry.profile == Profile::Smoke) {
        page.note(SMOKE);
    }
    page.section("tables", "Tables");
    for table in tables::all(comparison) {
        page.subtitle(&table.title);
        page.table(&table);
    }
    let rows = comparison.rows();
    page.section("training", "Training");
    page.note(CURVES);
    for row in &rows {
        let histories = row.runs.iter().map(|(_, details)| &details.history);
        let pictures = figures::stages(&histories.collect::<Vec<_>>());
        if !pictures.is_empty() {
            page.folded(&row.title, |page| page.panels(pictures));
        }
    }
    page.section("samples", "Frames, real and generated");
    samples(&mut page, &rows)?;
    page.section("calibration", "Calibration");
    page.note(
        "Share of right answers against stated confidence, fresh objects of matched shapes, all \
         seeds. Below the diagonal a model is too sure.",
    );
    page.panels(reliabilities(&rows));
    let provenance = tables::provenance(comparison);
    Ok(page.finish("Hardness recognition: methods compared", &provenance))
}

/// The page of one run.
///
/// # Errors
///
/// Fails if the directory holds no run, or a file in it cannot be read or parsed.
pub fn run(details: &Details) -> anyhow::Result<String> {
    let directory = details.directory.display();
    let run = details.description.as_ref();
    let run = run.with_context(|| format!("{directory}: holds neither a comparison nor a run"))?;
    let mut page = Page::default();
    if run.profile == Profile::Smoke {
        page.note(SMOKE);
    }
    let path = details.directory.join("evaluation.json");
    if let Ok(bytes) = std::fs::read(&path) {
        let evaluation: Evaluation =
            serde_json::from_slice(&bytes).with_context(|| path.display().to_string())?;
        ensure_square(&details.directory, std::iter::once(&evaluation))?;
        page.section("evaluation", "On the test split");
        page.table(&tables::evaluation(&evaluation));
        page.table(&tables::confusion(&evaluation));
    }
    page.section("sets", "On other shapes and materials");
    if details.worth.sets.is_empty() {
        page.note(
            "Not measured: the run belongs to no comparison. The test split has the shapes and materials of \
             the data set alone. hrn-train evaluate judges the run on any other data set. hrn-train simulate \
             --materials broad --shapes wide makes one of other materials and other shapes.",
        );
    } else {
        page.table(&tables::sets(&details.worth));
    }
    page.section("steps", "Training");
    page.table(&tables::stages(&details.history));
    page.note(CURVES);
    page.panels(figures::stages(&[&details.history]));
    if !details.worth.sets.is_empty() {
        page.section("calibration", "Calibration");
        let sets = details.worth.sets.iter();
        let picture = |(name, measured): (&String, &Measured)| {
            figures::reliability(&measured.calibration, &name.replace('_', " "))
        };
        page.panels(sets.map(picture).collect());
    }
    page.section("samples", "Frames");
    let pictures = pictures(&details.directory);
    if pictures.is_empty() {
        page.note("This run has no pictures.");
    }
    for picture in pictures {
        page.picture(&picture)?;
    }
    page.section("settings", "Settings");
    let settings = toml::to_string(run).context("the run's settings")?;
    let _ = writeln!(page.body, "<pre>{}</pre>", escaped(&settings));
    let title = format!("{}, seed {}", run.method, run.seed);
    let provenance = format!(
        "{} labels. {}.",
        digits::thousands(run.labels as u64),
        details.revisions.replace('\n', ", ")
    );
    Ok(page.finish(&title, &provenance))
}

fn reliabilities(rows: &[Row]) -> Vec<String> {
    let mut pictures = Vec::new();
    for row in rows {
        let bins: Vec<&[Bin]> = row
            .runs
            .iter()
            .filter_map(|(_, details)| Some(&details.worth.sets.get(MATCHED)?.calibration[..]))
            .collect();
        if !bins.is_empty() {
            pictures.push(figures::reliability(&figures::added(&bins), &row.title));
        }
    }
    pictures
}

/// Adds a picture of generated frames for each method that has any, from the row's first run. The
/// reference method gets the pictures of all stages.
fn samples(page: &mut Page, rows: &[Row]) -> anyhow::Result<()> {
    let mut none = true;
    for row in rows {
        let run = row.runs[0].1;
        let mut pictures = pictures(&run.directory);
        pictures.retain(|picture| !picture.ends_with("mistakes.png"));
        let Some(first) = pictures.first() else {
            continue;
        };
        none = false;
        page.subtitle(&row.title);
        page.picture(first)?;
        if !tables::reference(rows).is_some_and(|reference| std::ptr::eq(row, reference)) {
            continue;
        }
        page.folded("fixed noise at the end of each stage", |page| {
            let mut later = pictures[1..].iter();
            later.try_for_each(|picture| page.picture(picture))
        })?;
    }
    if none {
        page.note("None of these runs has pictures.");
    }
    Ok(())
}

/// A run's pictures: real beside generated frames, mistakes, and the last picture of each stage.
fn pictures(run: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(run.join("samples")) else {
        return Vec::new();
    };
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "png"))
        .collect();
    paths.sort();
    // Pictures of a stage are called like `ustgan-000500.png`, so their names sort by epoch.
    let stage = |path: &Path| {
        let name = path
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        name.rsplit_once('-').map(|(stage, _)| stage.to_owned())
    };
    let (stages, mut first): (Vec<_>, Vec<_>) =
        paths.into_iter().partition(|path| stage(path).is_some());
    for (index, path) in stages.iter().enumerate() {
        let next = stages.get(index + 1);
        if next.is_none_or(|next| stage(next) != stage(path)) {
            first.push(path.clone());
        }
    }
    first
}

/// A page under construction.
#[derive(Debug, Default)]
struct Page {
    links: String,
    body: String,
}

impl Page {
    fn section(&mut self, id: &str, title: &str) {
        let title = escaped(title);
        let _ = writeln!(self.links, r##"<a href="#{id}">{title}</a>"##);
        let _ = writeln!(self.body, r#"<h2 id="{id}">{title}</h2>"#);
    }

    fn subtitle(&mut self, title: &str) {
        let _ = writeln!(self.body, "<h3>{}</h3>", escaped(title));
    }

    fn note(&mut self, text: &str) {
        let _ = writeln!(self.body, "<p>{}</p>", escaped(text));
    }

    /// Adds what `content` adds, folded under a title.
    fn folded<T>(&mut self, title: &str, content: impl FnOnce(&mut Self) -> T) -> T {
        let title = escaped(title);
        let _ = writeln!(self.body, "<details><summary>{title}</summary>");
        let result = content(self);
        self.body += "</details>\n";
        result
    }

    fn panels(&mut self, pictures: Vec<String>) {
        self.body += "<div class=\"panels\">\n";
        for picture in pictures {
            let _ = writeln!(self.body, "<figure>{picture}</figure>");
        }
        self.body += "</div>\n";
    }

    fn table(&mut self, table: &Table) {
        self.note(&table.note);
        let cells = |cells: &[String], tag: &str| -> String {
            let cell = |cell: &String| format!("<{tag}>{}</{tag}>", escaped(cell));
            cells.iter().map(cell).collect()
        };
        self.body += "<div class=\"scroll\"><table>\n";
        let _ = writeln!(
            self.body,
            "<thead><tr>{}</tr></thead>",
            cells(&table.head, "th")
        );
        for row in &table.rows {
            let _ = writeln!(self.body, "<tr>{}</tr>", cells(row, "td"));
        }
        self.body += "</table></div>\n";
    }

    /// Embeds a PNG in the page.
    fn picture(&mut self, path: &Path) -> anyhow::Result<()> {
        let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
        let name = escaped(&path.file_stem().unwrap_or_default().to_string_lossy());
        let data = BASE64_STANDARD.encode(bytes);
        let _ = writeln!(
            self.body,
            r#"<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{name}</figcaption></figure>"#
        );
        Ok(())
    }

    fn finish(self, title: &str, provenance: &str) -> String {
        let title = escaped(title);
        let provenance: String = provenance
            .lines()
            .map(|line| format!("<p>{}</p>\n", escaped(line)))
            .collect();
        let Self { links, body } = self;
        format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n\
             <h1>{title}</h1>\n{provenance}<nav>\n{links}</nav>\n{body}</body>\n</html>\n"
        )
    }
}
