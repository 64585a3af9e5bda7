//! Recordings of known objects as presses of a data set.
//!
//! In: recordings (`.mcap` or `.bin`). Out: the best frame of every press that ended, or all its frames with
//! the arm's approach. The daemon's own pipeline decodes, tares and selects, so a model learns from the same
//! frames that it will judge.
//!
//! One recording is in memory at a time, and of each press what the data set gets of it.

mod recording;

use std::fs::File;
use std::io::{ErrorKind, Read as _, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, anyhow, bail, ensure};
use serde_json::{Map, Value, json};
use walkdir::WalkDir;

pub use self::recording::Recording;
use crate::data::presses::{self, Layout, Presses, file, read_one};
use crate::data::source::{COLLECTOR, Source, name_of, papers_levels};
use crate::exit::unreadable;
use crate::progress;
use hardnessd_core::npz::Writer;
use hardnessd_core::recording::{MAGIC, object_of};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{BUILT_IN_HRN, Level, MOST_LEVELS, Model, sha256_hex};
use hardnessd_core::wording;
use hardnessd_simulator::Split;

/// How an `.npz` file begins: it is a zip archive.
const ARCHIVE: &[u8] = b"PK\x03\x04";
/// The material of presses whose recording does not name one.
const NO_MATERIAL: &str = "unknown";

/// What is known of the presses of recordings.
#[derive(Debug)]
pub struct Settings {
    /// The levels that labels may name, or the Shore hardness of a label may be of.
    pub levels: Vec<Level>,
    /// The hardness level, from 1, or 0 for unlabelled. `None` takes it from the recording's labels.
    pub level: Option<u8>,
    /// The number of the pressed object. `None` takes it from the recording's labels.
    pub object: Option<u32>,
    /// Whether all recordings without a number are of one object. Otherwise each is of its own.
    pub is_one_object: bool,
    /// The split: training or test.
    pub split: Split,
}

/// The files that `paths` name. In place of a directory come all recordings below it, sorted by
/// their paths. A recording is known by its first bytes. Links to directories are not followed.
///
/// # Errors
///
/// Returns an error if a directory cannot be read, or has no recording.
pub fn captures(paths: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for path in paths {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let (before, mut sets) = (all.len(), 0);
        for entry in WalkDir::new(path).sort_by_file_name() {
            let entry = entry.map_err(|error| unreadable(path, &error.into()))?;
            if entry.path().is_file() && begins(entry.path(), MAGIC) {
                all.push(entry.into_path());
            } else if is_data_set(entry.path()) {
                sets += 1;
            }
        }
        if sets > 0 {
            hardnessd_core::stderr_line!(
                "warning: {}: only recordings are taken of a directory, and {sets} .npz files are not: name the data sets \
                 among them",
                path.display()
            );
        }
        ensure!(
            all.len() > before,
            "{}: no recording is in this directory",
            path.display()
        );
    }
    Ok(all)
}

/// Whether a file is a data set, which its first bytes say.
pub fn is_data_set(path: &Path) -> bool {
    path.is_file() && begins(path, ARCHIVE)
}

/// Whether a file begins with these bytes. An unreadable file counts as such, so that it is named later.
fn begins(path: &Path, with: &[u8]) -> bool {
    let mut start = vec![0; with.len()];
    match File::open(path).and_then(|mut file| file.read_exact(&mut start)) {
        Ok(()) => start == with,
        Err(error) => error.kind() != ErrorKind::UnexpectedEof,
    }
}

/// Plays recordings, in the order of the paths, and gives each to `take` before the next one is read. Returns how
/// many were used. `sensor` is that of recordings that do not describe their own. A recording without a press is
/// left out, with a word.
///
/// # Errors
///
/// Returns the error of the first file that cannot be used, or that `take` refuses, unless `skips_unusable`: then such
/// a file is left out too.
pub fn recordings(
    paths: &[PathBuf],
    sensor: &Sensor,
    layout: Layout,
    skips_unusable: bool,
    mut take: impl FnMut(Recording) -> anyhow::Result<()>,
) -> anyhow::Result<usize> {
    let template = "{bar:30} {pos}/{len} recordings, {eta} left";
    let bar = progress::bar(template, paths.len());
    let hrn = Arc::new(Model::load(BUILT_IN_HRN)?);
    let mut used = 0;
    for path in paths {
        let played = file::whole(path).and_then(|bytes| {
            let played = Recording::played(path, &bytes, sensor, layout, &hrn);
            played.with_context(|| path.display().to_string())
        });
        let left_out = match played {
            Ok(recording) if recording.presses.all.is_empty() => Some(anyhow!(
                "{}: no press found: was the sensor pressed, and is this its layout? `hardnessd replay` shows what is \
                 in a recording",
                path.display()
            )),
            played => match played.and_then(&mut take) {
                Err(error) if skips_unusable => Some(error),
                taken => {
                    taken?;
                    used += 1;
                    None
                }
            },
        };
        // It is said at once, because a later file may end the call.
        if let Some(error) = left_out {
            bar.suspend(|| {
                hardnessd_core::stderr_line!("left out: {}", wording::line(error.as_ref()));
            });
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(used)
}

/// A data set under construction.
#[derive(Debug, Default)]
pub struct Collection {
    /// The presses so far.
    pub presses: Presses,
    /// What an earlier data set says of itself.
    meta: Map<String, Value>,
    /// The names of the materials and of the sensors, by number.
    materials: Vec<String>,
    sensors: Vec<String>,
    /// The elements of `meta.captures`.
    captures: Vec<Value>,
    /// The object of recordings without a number, if they are all of one.
    unnumbered: Option<u32>,
}

impl Collection {
    /// The data set in a file, to add to it.
    ///
    /// # Errors
    ///
    /// Returns an error if the file is no data set of this layout, or has no numbers of objects.
    pub fn of(path: &Path, layout: Layout) -> anyhow::Result<Self> {
        let shown = path.display();
        let mut presses = read_one(path)?;
        match presses.layout() {
            own if own == layout => {}
            Layout::OverTime => {
                bail!("{shown}: has whole presses, not single frames: collect with --sequences")
            }
            Layout::Frames => {
                bail!("{shown}: has single frames, not whole presses: collect without --sequences")
            }
        }
        ensure!(
            presses.all.iter().all(|press| press.object.is_some()),
            "{shown}: has no array `object`: nothing can be added to it, but train takes several --data"
        );
        let meta = presses::meta(path)?;
        let names = |key: &str, last: Option<u32>| -> Vec<String> {
            let named = meta[key].as_array().into_iter().flatten();
            let named = named.map(|name| name.as_str().unwrap_or_default().to_owned());
            let mut names: Vec<String> = named.collect();
            let all = last.map_or(0, |last| last as usize + 1);
            names.resize(all.max(names.len()), String::new());
            names
        };
        let last = presses.all.iter().filter_map(|press| press.material).max();
        let mut materials = names("materials", last.map(u32::from));
        let unnamed = presses.all.iter_mut();
        for press in unnamed.filter(|press| press.material.is_none()) {
            press.material = u8::try_from(number_of(&mut materials, NO_MATERIAL)).ok();
        }
        let last = presses.all.iter().map(|press| press.sensor).max();
        Ok(Self {
            sensors: names("sensors", last),
            materials,
            captures: meta["captures"].as_array().cloned().unwrap_or_default(),
            presses,
            meta: meta.as_object().cloned().unwrap_or_default(),
            ..Self::default()
        })
    }

    /// Adds the presses of a recording, or nothing.
    ///
    /// # Errors
    ///
    /// Returns an error if its labels cannot be used, it was added before, or its taxels have another pitch.
    pub fn add(&mut self, mut recording: Recording, settings: &Settings) -> anyhow::Result<()> {
        let shown = recording.path.display().to_string();
        let mut before = self.captures.iter();
        if let Some(same) = before.find(|before| before["sha256"] == recording.sha256) {
            let name = same["name"].as_str().unwrap_or_default();
            bail!(
                "{shown}: the same recording as {name}, whose presses are in the data set already"
            );
        }
        let new = object_of(&recording.sha256);
        let new = match settings.is_one_object {
            true => self.unnumbered.unwrap_or(new),
            false => new,
        };
        let labelled = recording.label_presses(settings, new);
        labelled.context(shown)?;
        let (labels, mut presses) = (&recording.labels, recording.presses);
        for source in &mut presses.sources {
            source.levels = Some(settings.levels.clone());
        }
        let material = labels.get("material").map_or(NO_MATERIAL, String::as_str);
        // The names of a recording that is refused after all do not stay.
        let (mut materials, mut sensors) = (self.materials.clone(), self.sensors.clone());
        let material = number_of(&mut materials, material);
        let material = u8::try_from(material).context("a data set has at most 256 materials")?;
        for press in &mut presses.all {
            let sensor = &recording.sensors[press.sensor as usize].sensor;
            press.sensor = number_of(&mut sensors, sensor.name()) as u32;
            press.material = Some(material);
        }
        self.presses.append(presses)?;
        (self.materials, self.sensors) = (materials, sensors);
        self.captures.push(json!({
            "name": name_of(&recording.path),
            "sha256": recording.sha256,
            "split": settings.split,
            "labels": labels,
        }));
        self.unnumbered = Some(new);
        Ok(())
    }

    /// Adds the presses of a data set that was collected. Its objects have the numbers of their labels.
    ///
    /// # Errors
    ///
    /// Returns an error if it was added before, its taxels have another pitch, or all presses are too many.
    pub fn add_set(&mut self, set: Presses) -> anyhow::Result<()> {
        for Source { name, sha256, .. } in &set.sources {
            let mut before = self.captures.iter();
            let is_same = before.any(|before| before["sha256"] == *sha256);
            ensure!(!is_same, "{name}: is named twice");
            let capture = json!({ "name": name, "sha256": sha256 });
            self.captures.push(capture);
        }
        self.presses.append(set)
    }

    /// The presses, as those of one file with these levels.
    pub fn into_presses(self, levels: &[Level]) -> Presses {
        let hashes = self.captures.iter().filter_map(|of| of["sha256"].as_str());
        let mut presses = self.presses;
        presses.all.iter_mut().for_each(|press| press.source = 0);
        let grid = presses.grid();
        presses.sources.truncate(1);
        for source in &mut presses.sources {
            source.name = format!("{} files", self.captures.len());
            source.sha256 = sha256_hex(hashes.clone().collect::<String>().as_bytes());
            source.generator = Some(collector());
            source.levels = Some(levels.to_owned());
            source.grid = grid;
        }
        presses
    }

    /// Writes the data set.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing to `out`.
    pub fn write<W: Write + Seek>(&self, out: W, layout: Layout) -> anyhow::Result<W> {
        let mut meta = self.meta.clone();
        let grid = self.presses.grid();
        if grid.is_none() && self.presses.all.iter().any(|press| press.parts.is_some()) {
            hardnessd_core::stderr_line!(
                "warning: not all presses have parts of one array: the data set has none, so no model of taxels is \
                 learnt from it"
            );
        }
        // That of an earlier data set.
        meta.remove("grid_pitch_mm");
        for (key, value) in [
            ("captures", json!(self.captures)),
            ("levels", json!(self.levels()?)),
            ("materials", json!(self.materials)),
            ("pitch_mm", json!(self.presses.pitch_mm())),
            ("grid", json!(grid.map(|of| [of.array.rows, of.array.cols]))),
        ] {
            meta.insert(key.to_owned(), value);
        }
        if let Some(grid) = grid.filter(|grid| !grid.is_kept()) {
            meta.insert("grid_pitch_mm".to_owned(), json!(grid.pitch_mm));
        }
        meta.entry("generator").or_insert(json!(collector()));
        meta.entry("seed").or_insert(Value::Null);
        if layout == Layout::OverTime {
            meta.insert("sensors".to_owned(), json!(self.sensors));
        }
        let npz = Writer::in_chunks(out);
        Ok(presses::write(npz, &self.presses, layout, &meta.into())?)
    }

    /// The levels of an earlier data set, of the configuration or the paper's, or as many as the presses have, with
    /// their numbers for names.
    fn levels(&self) -> anyhow::Result<Vec<Level>> {
        let stated = self.presses.levels();
        let most = self.presses.all.iter().map(|press| press.level).max();
        let most = most.unwrap_or_default();
        if usize::from(most) <= stated.len() {
            return Ok(stated);
        }
        let is_number = |level: &Level| level.label == level.level.to_string();
        let are_numbers = stated.iter().all(is_number);
        ensure!(
            are_numbers || stated == papers_levels(),
            "level: found {most}, expected at most {}, as many as the data set has names for",
            stated.len()
        );
        let level = |level: u8| Level::new(level, level.to_string(), "-");
        Ok((1..=most.min(MOST_LEVELS as u8)).map(level).collect())
    }
}

fn collector() -> String {
    format!("{COLLECTOR} {}", env!("CARGO_PKG_VERSION"))
}

/// The place of a name in a list, at whose end it comes if it is new.
fn number_of(names: &mut Vec<String>, name: &str) -> usize {
    let known = names.iter().position(|known| known == name);
    known.unwrap_or_else(|| {
        names.push(name.to_owned());
        names.len() - 1
    })
}
