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
use crate::compare::sets::{MATCHED, PAPER_SPLIT};
use crate::compare::table::Table;
use crate::compare::tables;
use crate::judge::metrics::{Bin, Evaluation};

const STYLE: &str = include_str!("report/style.css");

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
    let rows = comparison.rows();
    let mut page = Page::default();
    page.section("summary", "Summary");
    page.table(&tables::headline(&rows));
    page.figure(
        &figures::accuracies(
            &rows,
            MATCHED,
            "accuracy on fresh objects of matched shapes",
        ),
        "Fresh objects, shapes alike for all materials: mean over seeds, its 95 % interval, \
         and a tick for each seed.",
    );

    page.section("table-2", "Table 2");
    page.table(&tables::table_2(&rows));
    page.figure(
        &figures::accuracies(&rows, PAPER_SPLIT, "accuracy on the test split"),
        "The data set's own test split, of the paper's size. Rings: the paper's figures on its own \
         data.",
    );
    for table in tables::fresh(&rows) {
        page.subtitle(&table.title);
        page.table(&table);
    }

    page.section("table-3", "Table 3");
    page.table(&tables::table_3(&rows));
    page.note("Samples of the test split, mean over seeds; in the paper 250 a level.");
    page.panels(confusions(&rows));

    page.section("steps", "Accuracy against steps");
    page.figure(
        &figures::price(&rows, MATCHED),
        "Accuracy of every method on fresh objects of matched shapes, against the steps of all its \
         stages.",
    );
    page.note(
        "In training, a line for each seed: the share of the training samples that were judged \
         correctly (blue), and of held-out objects if there are some (orange). Dashed lines separate \
         the stages. Methods that do not measure this share are left out. The dot is the accuracy on \
         fresh objects of matched shapes.",
    );
    page.panels(
        rows.iter()
            .filter_map(|row| figures::curve(row, MATCHED))
            .collect(),
    );

    page.section("samples", "Frames, real and generated");
    samples(&mut page, &rows)?;

    page.section("calibration", "Calibration");
    page.table(&tables::calibration(&rows));
    page.note(
        "Share of right answers against stated confidence, fresh objects of matched shapes, all \
         seeds. Below the diagonal a model is too sure.",
    );
    page.panels(reliabilities(&rows));
    page.subtitle("Another sensor");
    page.table(&tables::shifts(&rows));
    page.subtitle("Other shapes and materials");
    page.table(&tables::worlds(&rows));

    page.section("price", "Price");
    page.table(&tables::price(&rows));

    if !comparison.swaps.is_empty() {
        page.section("swaps", "Materials swapped");
        page.table(&tables::swaps(&comparison.swaps));
        page.figure(
            &figures::swaps(&tables::swap_groups(&comparison.swaps)),
            "Each dot is a run: an assignment of the two materials of each level to training and test, \
             and a seed. Rings are the paper's assignment.",
        );
    }
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
    let path = details.directory.join("evaluation.json");
    if let Ok(bytes) = std::fs::read(&path) {
        let evaluation: Evaluation =
            serde_json::from_slice(&bytes).with_context(|| path.display().to_string())?;
        ensure_square(&details.directory, std::iter::once(&evaluation))?;
        page.section("evaluation", "On the test split");
        page.table(&tables::evaluation(&evaluation));
        let counts = tables::mean_confusion(&[&evaluation]);
        page.panels(vec![figures::confusion(&counts, "counts")]);
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
    page.note(
        "Blue: loss and accuracy on the training samples (of a GAN, the discriminator's loss). \
         Orange: on held-out objects, the generator's loss, or within a component. Dashed: real \
         frames.",
    );
    page.panels(figures::stages(&details.history));
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

fn confusions(rows: &[Row]) -> Vec<String> {
    let mut pictures = Vec::new();
    for row in rows {
        let evaluations = tables::evaluations(row, PAPER_SPLIT);
        if evaluations.is_empty() {
            continue;
        }
        let counts = tables::mean_confusion(&evaluations);
        let mut picture = figures::confusion(&counts, &row.title);
        if let Some(paper) = tables::paper_row(row) {
            let counts = paper
                .confusion
                .map(|row| row.map(|count| count as f64).to_vec());
            picture += &figures::confusion(&counts, "in the paper");
        }
        pictures.push(picture);
    }
    pictures
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
        page.body += "<details><summary>fixed noise at the end of each stage</summary>\n";
        for picture in &pictures[1..] {
            page.picture(picture)?;
        }
        page.body += "</details>\n";
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

    fn figure(&mut self, picture: &str, caption: &str) {
        let caption = escaped(caption);
        let _ = writeln!(
            self.body,
            "<figure>{picture}<figcaption>{caption}</figcaption></figure>"
        );
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
