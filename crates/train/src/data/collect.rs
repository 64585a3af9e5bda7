//! Recordings of known objects as samples of a data set.
//!
//! In: recordings (`.mcap` or `.bin`), and data sets that are put together. Out: the chosen frame of
//! every press that was judged, or all its frames with the arm's approach. The daemon's own pipeline
//! decodes, tares and selects, so a model learns from the same frames that it will judge.
//!
//! All presses of a call are in memory.

mod capture;
mod error;
mod part;
mod selection;
mod walk;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Map, Value, json};

pub use self::error::{CollectError, Problem};
pub use self::part::Part;
use self::part::Shape;
pub use self::walk::captures;
use crate::data::presses::{self, Layout, Presses, file};
use crate::data::source::{MOST_LEVELS, Object, Source, papers_levels};
use hardnessd_core::frame::Array;
use hardnessd_core::recording::Labels;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Hrn, Level, sha256_hex};
use hardnessd_simulator::Split;

/// The labels of the samples. A field that is `None` is taken from the recording's labels.
#[derive(Debug, Clone, Copy)]
pub struct Labelling {
    /// The hardness level, from 1, or 0 for unlabelled.
    pub level: Option<u8>,
    /// The number of the pressed object. The same number in another data set is another object. Of recordings
    /// without a number, [`Settings::unnumbered`] says which objects they are. If
    /// neither this field nor a label gives a number, all recordings of one call are one new object.
    pub object: Option<u32>,
    /// The split: training or test.
    pub split: Split,
}

/// The objects of recordings that no label and no option gives a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unnumbered {
    /// All of a call are one object.
    One,
    /// Each is an object of its own.
    Each,
}

/// How recordings become samples.
#[derive(Debug)]
pub struct Settings {
    /// The sensor of recordings that do not describe their own.
    pub sensor: Sensor,
    /// The model that judges the presses.
    pub hrn: Arc<Hrn>,
    /// The objects of recordings without a number.
    pub unnumbered: Unnumbered,
    /// The levels that labels may name, or the Shore hardness of a label may be of.
    pub levels: Vec<Level>,
    /// The labels of the samples.
    pub labelling: Labelling,
    /// Whether all frames of a press are wanted, or only the chosen one.
    pub layout: Layout,
    /// Whether files that cannot be used are left out and listed. Otherwise the first one ends the
    /// collection.
    pub skip_unusable: bool,
}

/// Collects `paths`, recordings and data sets, after the samples of `earlier` if there are any. The
/// samples are in the order of the paths. The data set has the array `material`, and the array
/// `shore`, if the recordings have that label.
///
/// Presses over time whose begin is not in the recording are left out. They may lack a material or
/// a measured hardness.
///
/// # Errors
///
/// Returns the [`CollectError`] of the first file that cannot be used, unless such files are left
/// out.
pub fn collect(
    paths: &[PathBuf],
    mut earlier: Option<Part>,
    settings: &Settings,
) -> Result<Collection, CollectError> {
    if let Some(earlier) = &mut earlier {
        // The objects of the data set keep their numbers.
        earlier.new_objects.clear();
    }
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} recordings, {eta} left");
    let bar = ProgressBar::new(paths.len() as u64);
    let bar = bar.with_style(style.expect("the template is right"));
    let mut parts = Vec::new();
    for path in paths {
        let part = Part::read(path, settings);
        bar.inc(1);
        match part {
            Err(error) if !settings.skip_unusable => return Err(error),
            part => parts.push(part),
        }
    }
    bar.finish_and_clear();

    let read = || parts.iter().flatten();
    // The most frequent shape, so that a stray recording does not decide what the data set has.
    let shape = |part: &Part| part.shape(settings.layout);
    let frequency = |part: &&Part| read().filter(|other| shape(other) == shape(part)).count();
    let first = read().rev().max_by_key(frequency);
    let first = earlier.as_ref().or(first);
    let (first, shape) =
        first.map_or_else(Default::default, |part| (part.path.clone(), shape(part)));
    let mut collection = Collection::new(settings, first, shape);
    let mut grids: Vec<_> = read().chain(&earlier).map(|part| part.grid).collect();
    grids.dedup();
    collection.grid = if let [grid] = grids[..] { grid } else { None };
    // A recording without a label must not share the number of one with a label.
    let parts_and_earlier = read().chain(&earlier);
    let last = parts_and_earlier.flat_map(Part::numbered_objects).max();
    collection.free_object = last.map_or(Some(0), |last| last.checked_add(1));
    if let Some(earlier) = earlier {
        collection.meta = earlier.meta.clone();
        collection.add(earlier)?;
        (collection.added, collection.known) = (0, 0);
    }
    for (path, part) in paths.iter().zip(parts) {
        match part.and_then(|part| collection.add(part)) {
            Err(error) if settings.skip_unusable => {
                collection.left_out.push((path.clone(), error.reason(path)));
            }
            added => added?,
        }
    }
    Ok(collection)
}

/// The labels of each recording that can be read. Raw bytes and data sets have none.
pub fn labels(paths: &[PathBuf]) -> Vec<Labels> {
    let bytes = paths.iter().filter_map(|path| file::whole(path).ok());
    bytes.map(|bytes| capture::labels(&bytes)).collect()
}

/// The levels that a data set states. `None` for a recording.
pub fn levels(path: &Path) -> Option<Vec<Level>> {
    let meta = presses::meta(path).ok()?;
    serde_json::from_value(meta["levels"].clone()).ok()
}

/// A data set under construction.
#[derive(Debug)]
pub struct Collection {
    presses: Presses,
    layout: Layout,
    unnumbered: Unnumbered,
    /// What all samples have in common.
    shape: Shape,
    /// The one array whose frames all samples have as they are.
    grid: Option<Array>,
    /// The file that first had this shape.
    first: PathBuf,
    /// What an earlier data set says of itself.
    meta: Map<String, Value>,
    materials: Vec<String>,
    sensors: Vec<Option<String>>,
    captures: Vec<Value>,
    generators: Vec<String>,
    /// The names of recordings by what makes two of them the same presses of the same object.
    names: BTreeMap<String, String>,
    objects: BTreeSet<(Object, Split)>,
    /// The least number that no object has. `None` if all numbers are taken.
    free_object: Option<u32>,
    /// The number of the object of this call's recordings without a number, once there is one.
    new_object: Option<u32>,
    /// The files that give no samples, with the reason.
    pub left_out: Vec<(PathBuf, String)>,
    /// The number of presses that were added.
    pub added: usize,
    /// The number of these whose approach is known.
    pub known: usize,
    /// The number of presses that were left out because their begin is not in the recording.
    pub partial: usize,
}

impl Collection {
    fn new(settings: &Settings, first: PathBuf, shape: Shape) -> Self {
        Self {
            presses: Presses::default(),
            layout: settings.layout,
            unnumbered: settings.unnumbered,
            shape,
            grid: None,
            first,
            meta: Map::from_iter([("seed".to_owned(), Value::Null)]),
            materials: Vec::new(),
            sensors: Vec::new(),
            captures: Vec::new(),
            generators: Vec::new(),
            names: BTreeMap::new(),
            objects: BTreeSet::new(),
            free_object: None,
            new_object: None,
            left_out: Vec::new(),
            added: 0,
            known: 0,
            partial: 0,
        }
    }

    /// The number of presses.
    pub fn presses(&self) -> usize {
        self.presses.all.len()
    }

    fn add(&mut self, mut part: Part) -> Result<(), CollectError> {
        let fits = self.fit(&mut part);
        fits.map_err(|problem| problem.of(&part.path))?;
        self.objects.extend(part.objects());
        self.names.extend(part.captures.iter().filter_map(identity));
        self.captures.extend(part.captures);
        for generator in part.generators {
            if !self.generators.contains(&generator) {
                self.generators.push(generator);
            }
        }
        self.added += part.presses.all.len();
        self.known += part.presses.known();
        self.partial += part.partial;
        self.presses.append(part.presses, 0);
        Ok(())
    }

    /// Gives the objects and the materials of a part their numbers in this data set, and returns an
    /// error if the part does not go with the rest.
    fn fit(&mut self, part: &mut Part) -> Result<(), Problem> {
        part.shape(self.layout).check(&self.shape, &self.first)?;
        let mut materials = Vec::new();
        for name in &part.materials {
            let known = self.materials.iter().position(|material| material == name);
            let number = known.unwrap_or(self.materials.len());
            let number = u8::try_from(number);
            materials.push(number.map_err(|_| Problem::Materials(name.clone()))?);
            if known.is_none() {
                self.materials.push(name.clone());
            }
        }
        let mut objects = BTreeMap::new();
        for &number in &part.new_objects {
            objects.insert(number, self.new_object(part.is_recording)?);
        }
        let renumbered = |number: u32| objects.get(&number).copied().unwrap_or(number);
        let sensors: Vec<u32> = part.sensors.iter().map(|name| self.sensor(name)).collect();
        for press in &mut part.presses.all {
            press.object = press.object.map(renumbered);
            press.material = press.material.map(|number| materials[usize::from(number)]);
            press.sensor = sensors[press.sensor as usize];
        }
        for capture in &mut part.captures {
            let number = capture["object"].as_u64();
            let number = number.and_then(|number| u32::try_from(number).ok());
            if let Some(number) = number.filter(|_| capture["new_object"] == true) {
                capture["object"] = json!(renumbered(number));
            }
        }
        for (identity, _) in part.captures.iter().filter_map(identity) {
            if let Some(name) = self.names.get(&identity) {
                return Err(Problem::Twice(name.clone()));
            }
        }
        for (added, split) in part.objects() {
            let other = |(object, of): &&(Object, Split)| object.is_same_as(&added) && *of != split;
            if let Some((object, expected)) = self.objects.iter().find(other) {
                return Err(Problem::Splits {
                    object: object.number,
                    found: split.name(),
                    expected: expected.name(),
                });
            }
        }
        Ok(())
    }

    /// The number of the sensor of this name. One without a name is a sensor of its own.
    fn sensor(&mut self, name: &Option<String>) -> u32 {
        let known = self
            .sensors
            .iter()
            .position(|known| known.is_some() && known == name);
        let number = known.unwrap_or(self.sensors.len());
        if known.is_none() {
            self.sensors.push(name.clone());
        }
        number as u32
    }

    /// A number for an object that has none.
    fn new_object(&mut self, is_recording: bool) -> Result<u32, Problem> {
        let is_shared = is_recording && self.unnumbered == Unnumbered::One;
        if is_shared && let Some(number) = self.new_object {
            return Ok(number);
        }
        let number = self.free_object.ok_or(Problem::NoNumber)?;
        self.free_object = number.checked_add(1);
        if is_shared {
            self.new_object = Some(number);
        }
        Ok(number)
    }

    /// The presses, as those of one file with these levels.
    pub fn into_presses(self, levels: Vec<Level>) -> Presses {
        let hashes: Vec<&str> = self
            .captures
            .iter()
            .filter_map(|of| of["sha256"].as_str())
            .collect();
        let source = Source {
            name: format!("{} recordings or data sets", self.captures.len().max(1)),
            sha256: sha256_hex(hashes.concat().as_bytes()),
            generator: Some(self.generators.join(", ")),
            pitch_mm: Some(self.shape.pitch_mm),
            grid: self.grid,
            levels: Some(levels),
            recorded: file::recorded(&json!(self.captures)),
            ..Source::default()
        };
        let mut presses = self.presses;
        presses.all.iter_mut().for_each(|press| press.source = 0);
        (presses.sources, presses.paths) = (vec![source], vec![self.first]);
        presses
    }

    /// Writes the data set.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing to `out`.
    pub fn write<W: Write + Seek>(&self, out: W) -> anyhow::Result<W> {
        let mut meta = self.meta.clone();
        for (key, value) in [
            ("captures", json!(self.captures)),
            ("generator", json!(self.generators.join(", "))),
            ("levels", json!(self.levels())),
            ("materials", json!(self.materials)),
            ("pitch_mm", json!(self.shape.pitch_mm)),
            (
                "grid",
                json!(self.grid.map(|array| [array.rows, array.cols])),
            ),
        ] {
            meta.insert(key.to_owned(), value);
        }
        if self.layout == Layout::OverTime {
            meta.insert("sensors".to_owned(), json!(self.sensors));
        }
        Ok(presses::write(
            out,
            &self.presses,
            self.layout,
            &meta.into(),
        )?)
    }

    /// The paper's levels, or as many as the presses have, with their numbers for names.
    fn levels(&self) -> Vec<Level> {
        let papers = papers_levels();
        let most = self.presses.all.iter().map(|press| press.level).max();
        let most = most.unwrap_or_default();
        if usize::from(most) <= papers.len() {
            return papers;
        }
        let level = |level: u8| Level {
            level,
            label: level.to_string(),
            shore: "-".to_owned(),
        };
        (1..=most.min(MOST_LEVELS as u8)).map(level).collect()
    }
}

/// What makes two recordings the same presses of the same object, and the name of this one. `None` if
/// another program described the recording in another way.
fn identity(capture: &Value) -> Option<(String, String)> {
    let sha256 = capture["sha256"].as_str()?;
    let [level, object, split] = ["level", "object", "split"].map(|key| &capture[key]);
    let name = capture["name"].as_str().unwrap_or_default();
    Some((
        format!("{sha256} {level} {object} {split}"),
        name.to_owned(),
    ))
}
