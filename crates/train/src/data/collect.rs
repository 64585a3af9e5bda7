//! Recordings of known objects as presses of a data set.
//!
//! In: recordings (`.mcap` or `.bin`). Out: the chosen frame of every press that was judged, or all its frames
//! with the arm's approach. The daemon's own pipeline decodes, tares and selects, so a model learns from the
//! same frames that it will judge.
//!
//! All presses of a call are in memory.

mod capture;
mod selection;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{ErrorKind, Read as _, Seek, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Map, Value, json};

use self::capture::{NoPress, Pressed, Said};
use crate::data::presses::{self, Layout, Press, Presses, file, read_one};
use crate::data::source::{COLLECTOR, Kind, MOST_LEVELS, Source};
use crate::exit::unreadable;
use hardnessd_core::recording::{FileKind, Labels, MAGIC};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Hrn, Level, sha256_hex};
use hardnessd_core::wording;
use hardnessd_simulator::Split;

/// How an `.npz` file begins: it is a zip archive.
const ARCHIVE: &[u8] = b"PK\x03\x04";
/// The material of presses whose recording does not name one.
const NO_MATERIAL: &str = "unknown";

/// The objects of recordings that no label and no option gives a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unnumbered {
    /// All of a call are one object.
    One,
    /// Each is an object of its own.
    Each,
}

/// The recordings that are left out. Any other one that cannot be used ends the collection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeaveOut {
    /// None.
    None,
    /// Those without a press.
    WithoutPress,
    /// All that cannot be used.
    Unusable,
}

/// How recordings become presses.
#[derive(Debug)]
pub struct Settings {
    /// The sensor of recordings that do not describe their own.
    pub sensor: Sensor,
    /// The model that judges the presses.
    pub hrn: Arc<Hrn>,
    /// The levels that labels may name, or the Shore hardness of a label may be of.
    pub levels: Vec<Level>,
    /// The hardness level, from 1, or 0 for unlabelled. `None` takes it from the recording's labels.
    pub level: Option<u8>,
    /// The number of the pressed object. `None` takes it from the recording's labels.
    pub object: Option<u32>,
    /// The objects of recordings without a number.
    pub unnumbered: Unnumbered,
    /// The split: training or test.
    pub split: Split,
    /// Whether all frames of a press are wanted, or only the chosen one.
    pub layout: Layout,
    /// Which recordings are left out.
    pub leave_out: LeaveOut,
}

impl Settings {
    fn leaves_out(&self, error: &anyhow::Error) -> bool {
        match self.leave_out {
            LeaveOut::None => false,
            LeaveOut::WithoutPress => error.is::<NoPress>(),
            LeaveOut::Unusable => true,
        }
    }
}

/// Collects recordings, after the presses of the data set `earlier` if there is one. The presses are in the order
/// of the paths.
///
/// # Errors
///
/// Returns the error of the first file that cannot be used, unless such files are left out; and an error if
/// `earlier` is no data set of this layout, or has no numbers of objects.
pub fn collect(
    paths: &[PathBuf],
    earlier: Option<&Path>,
    settings: &Settings,
) -> anyhow::Result<Collection> {
    let mut collection = match earlier {
        Some(path) => Collection::of(path, settings.layout)?,
        None => Collection::default(),
    };
    collection.earlier = collection.presses.all.len();
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} recordings, {eta} left");
    let bar = ProgressBar::new(paths.len() as u64);
    let bar = bar.with_style(style.expect("the template is right"));
    for path in paths {
        match collection.add(path, settings) {
            Err(error) if settings.leaves_out(&error) => collection.left_out.push(error),
            added => added?,
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    collection.number_objects(settings.unnumbered)?;
    collection.presses.warn_of_object_in_both_splits();
    Ok(collection)
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
        let mut found = Vec::new();
        find_below(path, &mut found)?;
        ensure!(
            !found.is_empty(),
            "{}: no recording is in this directory",
            path.display()
        );
        found.sort();
        all.append(&mut found);
    }
    Ok(all)
}

fn find_below(directory: &Path, found: &mut Vec<PathBuf>) -> anyhow::Result<()> {
    let failed = |error| unreadable(directory, &error);
    for entry in fs::read_dir(directory).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let path = entry.path();
        if entry.file_type().map_err(failed)?.is_dir() {
            find_below(&path, found)?;
        } else if path.is_file() && begins(&path, MAGIC) {
            found.push(path);
        }
    }
    Ok(())
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

/// The labels of each recording that can be read. Raw bytes have none.
pub fn labels(paths: &[PathBuf]) -> Vec<Labels> {
    let bytes = paths.iter().filter_map(|path| file::whole(path).ok());
    bytes.map(|bytes| capture::labels(&bytes)).collect()
}

/// A data set under construction.
#[derive(Debug, Default)]
pub struct Collection {
    presses: Presses,
    /// The number of presses that were there before.
    earlier: usize,
    /// What an earlier data set says of itself.
    meta: Map<String, Value>,
    /// The names of the materials and of the sensors, by number.
    materials: Vec<String>,
    sensors: Vec<String>,
    /// The elements of `meta.captures`.
    captures: Vec<Value>,
    /// The recordings of this call.
    recordings: Vec<Recording>,
    /// Why recordings were left out.
    pub left_out: Vec<anyhow::Error>,
}

/// A recording whose presses were taken.
#[derive(Debug)]
struct Recording {
    /// What `meta.captures` says of it, except for its objects.
    capture: Value,
    presses: Range<usize>,
}

impl Collection {
    /// The data set in a file, to add to it.
    fn of(path: &Path, layout: Layout) -> anyhow::Result<Self> {
        let shown = path.display();
        match (file::layout_of(path)?, layout) {
            (Layout::OverTime, Layout::Frames) => {
                bail!("{shown}: has whole presses, not single frames: collect with --sequences")
            }
            (Layout::Frames, Layout::OverTime) => {
                bail!("{shown}: has single frames, not whole presses: collect without --sequences")
            }
            _ => {}
        }
        let mut presses = read_one(path)?;
        ensure!(
            presses.all.iter().all(|press| press.object.is_some()),
            "{shown}: has no array `object`: nothing can be added to it, but train takes several --data"
        );
        let meta = match presses::meta(path)? {
            Value::Object(meta) => meta,
            _ => Map::new(),
        };
        let list = |key: &str| meta.get(key).and_then(Value::as_array);
        let names = |key: &str, last: Option<u32>| -> Vec<String> {
            let named = list(key).into_iter().flatten();
            let named = named.map(|name| name.as_str().unwrap_or_default().to_owned());
            let all = last.map_or(0, |last| last as usize + 1);
            let mut names: Vec<String> = named.collect();
            names.resize(all.max(names.len()), String::new());
            names
        };
        let last = presses.all.iter().filter_map(|press| press.material).max();
        let mut materials = names("materials", last.map(u32::from));
        for press in presses
            .all
            .iter_mut()
            .filter(|press| press.material.is_none())
        {
            let unknown = number_of(&mut materials, NO_MATERIAL);
            press.material = u8::try_from(unknown).ok();
        }
        let last = presses.all.iter().map(|press| press.sensor).max();
        Ok(Self {
            sensors: names("sensors", last),
            materials,
            captures: list("captures").cloned().unwrap_or_default(),
            presses,
            meta,
            ..Self::default()
        })
    }

    /// Says on stderr which recordings were left out, and why.
    pub fn say_left_out(&self) {
        for left_out in &self.left_out {
            hardnessd_core::stderr_line!("left out: {}", wording::line(left_out.as_ref()));
        }
    }

    /// The number of presses.
    pub fn presses(&self) -> usize {
        self.presses.all.len()
    }

    /// The number of presses that were added, and of those whose approach is known.
    pub fn added(&self) -> [usize; 2] {
        let added = self.earlier..self.presses.all.len();
        [
            added.len(),
            added.filter(|&press| self.presses.is_known(press)).count(),
        ]
    }

    /// Adds the presses of a recording, or nothing.
    fn add(&mut self, path: &Path, settings: &Settings) -> anyhow::Result<()> {
        let bytes = file::whole(path)?;
        self.add_bytes(path, &bytes, settings)
            .with_context(|| path.display().to_string())
    }

    fn add_bytes(&mut self, path: &Path, bytes: &[u8], settings: &Settings) -> anyhow::Result<()> {
        ensure!(
            !bytes.starts_with(ARCHIVE),
            "is a data set, not a recording: train and fit take several data sets"
        );
        let sha256 = sha256_hex(bytes);
        let before = self.recordings.iter().map(|recording| &recording.capture);
        if let Some(same) = self
            .captures
            .iter()
            .chain(before)
            .find(|of| of["sha256"] == sha256)
        {
            let name = same["name"].as_str().unwrap_or_default();
            bail!("the same recording as {name}, whose presses are in the data set already");
        }
        let Pressed {
            judged,
            labels,
            pitch_mm,
            grid,
        } = Pressed::of(bytes, &settings.sensor, &settings.hrn)?;
        let is_said = judged.iter().any(|press| press.level.is_some());
        let said = Said::of(&labels, settings, is_said)?;
        match self.presses.sources.first_mut() {
            None => self.presses.sources.push(Source {
                path: path.to_owned(),
                pitch_mm: Some(pitch_mm),
                grid,
                ..Source::default()
            }),
            Some(source) => {
                let expected = source.pitch();
                ensure!(
                    pitch_mm == expected,
                    "taxel pitch: found {pitch_mm} mm, expected {expected} mm, that of {}",
                    source.path.display()
                );
                source.grid = source.grid.filter(|_| source.grid == grid);
            }
        }
        let material = number_of(&mut self.materials, said.material);
        let material = u8::try_from(material);
        let material = material.context("a data set has at most 256 materials")?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let is_raw = FileKind::of(bytes) == FileKind::Raw;
        let is_simulated = labels.get("simulated").is_some_and(|label| label == "true");
        let first = self.presses.all.len();
        for judged in judged {
            let named = judged
                .object
                .as_deref()
                .filter(|_| settings.object.is_none());
            let named = named.filter(|_| said.reference.is_none());
            let mut press = Press {
                level: judged.level.filter(|_| said.by_press).unwrap_or(said.level),
                object: named.map(capture::object_of).or(said.object),
                material: Some(material),
                force_n: Some(judged.force_n),
                split: settings.split,
                shore: said.shore,
                arm_n_per_mm: judged.arm_n_per_mm,
                sensor: number_of(&mut self.sensors, &judged.sensor) as u32,
                reference: said.reference,
                name: Some(format!("{name} press {}", judged.press)),
                unloaded: Some(judged.unloaded),
                kind: Kind::of_recording(is_simulated, is_raw),
                best: judged.best,
                ..Press::default()
            };
            match settings.layout {
                Layout::OverTime => self.presses.push(press, judged.moments.into_iter()),
                Layout::Frames => {
                    let (.., frame) = judged.moments[judged.best];
                    press.best = 0;
                    self.presses.push(press, [(0.0, None, frame)].into_iter());
                }
            }
        }
        let mut capture = json!({
            "name": name,
            "sha256": sha256,
            "split": settings.split.name(),
            "labels": labels,
        });
        if is_raw {
            capture["raw"] = Value::Bool(true);
        }
        self.recordings.push(Recording {
            capture,
            presses: first..self.presses.all.len(),
        });
        Ok(())
    }

    /// Gives the objects without a number one that no other object has, and says of each recording which objects
    /// it has.
    fn number_objects(&mut self, unnumbered: Unnumbered) -> anyhow::Result<()> {
        let last = self
            .presses
            .all
            .iter()
            .filter_map(|press| press.object)
            .max();
        let mut next = last.map_or(Some(0), |last| last.checked_add(1));
        for Recording { capture, presses } in std::mem::take(&mut self.recordings) {
            let all = &mut self.presses.all[presses];
            let mut counts = BTreeMap::<(u32, u8), usize>::new();
            let mut is_numbered = true;
            for press in all {
                is_numbered &= press.object.is_some();
                let number = press.object.or(next).with_context(|| {
                    format!(
                        "no number is left for a new object beyond {}: give one with --object",
                        u32::MAX
                    )
                })?;
                press.object = Some(number);
                *counts.entry((number, press.level)).or_default() += 1;
            }
            if !is_numbered && unnumbered == Unnumbered::Each {
                next = next.and_then(|next| next.checked_add(1));
            }
            for ((object, level), count) in counts {
                let mut capture = capture.clone();
                (capture["object"], capture["level"]) = (json!(object), json!(level));
                capture["presses"] = json!(count);
                self.captures.push(capture);
            }
        }
        Ok(())
    }

    /// The presses, as those of one file with these levels.
    pub fn into_presses(self, levels: &[Level]) -> Presses {
        let hashes = self.captures.iter().filter_map(|of| of["sha256"].as_str());
        let mut presses = self.presses;
        for source in &mut presses.sources {
            source.name = format!("{} recordings", self.captures.len());
            source.sha256 = sha256_hex(hashes.clone().collect::<String>().as_bytes());
            source.generator = Some(collector());
            source.levels = Some(levels.to_owned());
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
        let source = &self.presses.sources[0];
        let before = meta.get("generator").and_then(Value::as_str);
        let generator = match before {
            // A data set that names no program had one too.
            _ if self.earlier == 0 => collector(),
            Some(before) if before.contains(&collector()) => before.to_owned(),
            before => format!("{}, {}", before.unwrap_or("unknown"), collector()),
        };
        for (key, value) in [
            ("captures", json!(self.captures)),
            ("generator", json!(generator)),
            ("levels", json!(self.levels())),
            ("materials", json!(self.materials)),
            ("pitch_mm", json!(source.pitch())),
            (
                "grid",
                json!(source.grid.map(|array| [array.rows, array.cols])),
            ),
        ] {
            meta.insert(key.to_owned(), value);
        }
        meta.entry("seed").or_insert(Value::Null);
        if layout == Layout::OverTime {
            meta.insert("sensors".to_owned(), json!(self.sensors));
        }
        Ok(presses::write(out, &self.presses, layout, &meta.into())?)
    }

    /// The levels of an earlier data set or the paper's, or as many as the presses have, with their numbers for
    /// names.
    fn levels(&self) -> Vec<Level> {
        let stated = self.presses.levels();
        let most = self.presses.all.iter().map(|press| press.level).max();
        let most = most.unwrap_or_default();
        if usize::from(most) <= stated.len() {
            return stated;
        }
        let level = |level: u8| Level {
            level,
            label: level.to_string(),
            shore: "-".to_owned(),
        };
        (1..=most.min(MOST_LEVELS as u8)).map(level).collect()
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
