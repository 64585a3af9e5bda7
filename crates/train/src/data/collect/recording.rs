//! The presses in one recording, and what its labels say of them.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail, ensure};
use jiff::Timestamp;
use serde_json::Value;

use super::{ARCHIVE, Settings};
use crate::data::presses::file::SHORE;
use crate::data::presses::{Layout, Press, Presses};
use crate::data::source::{Grid, Kind, PITCH_MM, Source, name_of};
use crate::exit::coded;
use hardnessd_core::event::{self, Event, PressState};
use hardnessd_core::exit::USAGE;
use hardnessd_core::frame::Stamp;
use hardnessd_core::judge::EndedPress;
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, FileKind, Found, Labels, Playback, Reader, object_of};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Borders, MOST_LEVELS, Model, Piece, sha256_hex};

/// The moment of raw bytes, whose times come from the frame rate.
const NOT_LOOKED_AT: Stamp = Stamp {
    mono: std::time::Duration::ZERO,
    wall: jiff::Timestamp::UNIX_EPOCH,
};
/// A touch is felt at most so long before it is a press.
const REST_S: f64 = 0.5;
/// A durometer's reading may be so many OO beyond the border of the level that people say.
const NEAR_OO: f32 = 2.0;
/// Bytes of a raw recording that are played at once.
const CHUNK_BYTES: usize = 1 << 16;

/// A recording that was played.
#[derive(Debug)]
pub struct Recording {
    pub(super) path: PathBuf,
    /// What its labels say. Raw bytes have none.
    pub labels: Labels,
    pub(super) sha256: String,
    /// When it began. Raw bytes do not say it.
    pub began: Option<Timestamp>,
    layout: Layout,
    kind: Kind,
    /// Its sensors, by number.
    pub(super) sensors: Vec<Watched>,
    /// Its presses, with the level and the object that their context names, and with it as their only source.
    pub(super) presses: Presses,
}

/// A sensor of a recording, and what it read before the press.
#[derive(Debug)]
pub(super) struct Watched {
    pub(super) sensor: Sensor,
    /// Whether the recording has it with two arrays.
    is_changed: bool,
    is_pressed: bool,
    /// The last frame before the first tare, and the last ones between presses.
    untared: Vec<f32>,
    at_rest: VecDeque<Vec<f32>>,
}

impl Recording {
    /// Plays the recording `bytes`. A pipeline needs a model, whose verdicts do not matter here.
    pub(super) fn played(
        path: &Path,
        bytes: &[u8],
        sensor: &Sensor,
        layout: Layout,
        hrn: &Arc<Model>,
    ) -> anyhow::Result<Self> {
        ensure!(
            !bytes.starts_with(ARCHIVE),
            "is a data set, not a recording: train and fit take several data sets"
        );
        let mut recording = Self {
            path: path.to_owned(),
            labels: Labels::new(),
            sha256: sha256_hex(bytes),
            began: None,
            layout,
            kind: Kind::Unknown,
            sensors: Vec::new(),
            presses: Presses::default(),
        };
        recording.play(bytes, sensor, hrn)?;
        let source = recording.source()?;
        recording.presses.sources.push(source);
        Ok(recording)
    }

    /// A label as `read` reads it, if there is one.
    fn label<T>(
        &self,
        key: &str,
        expected: &str,
        read: impl Fn(&str) -> Option<T>,
    ) -> anyhow::Result<Option<T>> {
        let Some(text) = self.labels.get(key) else {
            return Ok(None);
        };
        let read =
            read(text).with_context(|| format!("label {key}: found {text:?}, expected {expected}"));
        read.map(Some)
    }

    /// Whether it has a press of which neither a label nor a word during the press says which object it was.
    pub fn is_unnumbered(&self) -> bool {
        let are_named = |press: &Press| press.object.is_some();
        !self.labels.contains_key("object") && !self.presses.all.iter().all(are_named)
    }

    /// Whether neither a label nor a word during a press says what was pressed.
    pub fn is_unlabelled(&self) -> bool {
        let says = |key: &str| self.labels.contains_key(key);
        !["level", "shore", "reference"].into_iter().any(says)
            && self.presses.all.iter().all(|press| press.level == 0)
    }

    /// Gives its presses what options and labels say of them. What was said of a press while it was made counts more
    /// than the labels. An object without a number is `new`.
    pub(super) fn label_presses(&mut self, of: &Settings, new: u32) -> anyhow::Result<()> {
        let expected = "flat:MM or ball:MM with 0.1 to 1000 mm";
        let reference = self.label("reference", expected, Piece::rigid)?;
        ensure!(
            reference.is_none() || self.presses.are_over_time(),
            "label reference: collect presses of rigid pieces with --sequences"
        );
        let shore = |text: &str| text.parse().ok().filter(|shore| SHORE.contains(shore));
        let shore = self.label("shore", "a number from 0 to 100", shore)?;
        let expected = "the name of a level, or a number from 0 (unlabelled) to 16: `collect --level` gives \
                        another one";
        let level = match of.level {
            None => self.label("level", expected, |text| level(text, of))?,
            given => given,
        };
        let borders = Borders::of(&of.levels).ok();
        if let (Some(level @ 1..), Some(shore), Some(borders)) = (level, shore, &borders)
            && usize::from(level) <= of.levels.len()
        {
            let [low, high] = borders.part(usize::from(level) - 1);
            ensure!(
                (low - NEAR_OO..=high + NEAR_OO).contains(&shore),
                "label shore: found {shore} OO, expected {low} to {high}, those of its label level"
            );
        }
        let of_shore = || Some(of.levels[borders?.place_of(shore?)].level);
        let level = level.or_else(of_shore);
        let object = match of.object {
            None => self.label("object", "a number: --object gives another one", |text| {
                text.parse().ok()
            })?,
            given => given,
        };
        let presses = &mut self.presses.all;
        for press in presses.iter_mut() {
            press.split = of.split;
            if reference.is_some() {
                (press.level, press.object) = (0, object.or(Some(new)));
                press.reference = reference;
                continue;
            }
            if press.level == 0 || of.level.is_some() {
                press.level = level.unwrap_or(0);
            }
            let named = press.object.filter(|_| of.object.is_none());
            press.object = named.or(object).or(Some(new));
            press.shore = shore;
        }
        if reference.is_none() && level.is_none() && presses.iter().all(|of| of.level == 0) {
            let text = "the recording has no label `level`: give its level with --level";
            return Err(coded(USAGE, text));
        }
        Ok(())
    }

    /// Plays a recording of hardnessd, or raw bytes of this sensor.
    fn play(&mut self, bytes: &[u8], sensor: &Sensor, hrn: &Arc<Model>) -> anyhow::Result<()> {
        let (mut playback, entries): (_, Box<dyn Iterator<Item = Result<Found, _>>>) =
            match FileKind::of(bytes) {
                FileKind::Recording => (Playback::new(hrn.clone()), Box::new(Reader::new(bytes))),
                FileKind::Raw => {
                    self.watch(sensor.clone());
                    let found = |chunk: &[u8]| Found {
                        sensor: sensor.name().to_owned(),
                        at: NOT_LOOKED_AT,
                        entry: Entry::Input(Input::Bytes(chunk.to_vec())),
                    };
                    let chunks = bytes.chunks(CHUNK_BYTES).map(found).map(Ok);
                    let playback = Playback::of_bytes(sensor.clone(), hrn.clone());
                    (playback, Box::new(chunks))
                }
            };
        playback.keep_courses();
        for found in entries {
            let found = found?;
            if found.at.wall != NOT_LOOKED_AT.wall {
                self.began.get_or_insert(found.at.wall);
            }
            // A wrong description is an error of the playback.
            if let Entry::State(state) = &found.entry
                && let Ok(sensor) = state.sensor.check()
            {
                self.watch(sensor);
                let simulated = state.labels.get("simulated");
                self.kind = match simulated.is_some_and(|label| label == "true") {
                    true => Kind::Simulated,
                    false => Kind::Recorded,
                };
            }
            let events = playback.feed(found)?;
            self.take(events, &playback.ended());
            self.presses.check_size()?;
        }
        let events = playback.end();
        self.take(events, &playback.ended());
        for note in playback.left_out() {
            hardnessd_core::stderr_line!("warning: {note}");
        }
        if let Some(problem) = playback.nothing_played() {
            bail!(problem);
        }
        self.labels = playback.labels();
        Ok(())
    }

    /// Takes a sensor as it is from now on.
    fn watch(&mut self, sensor: Sensor) {
        let mut known = self.sensors.iter_mut();
        match known.find(|known| known.sensor.name() == sensor.name()) {
            Some(known) => {
                known.is_changed |= grid(&known.sensor) != grid(&sensor);
                known.sensor = sensor;
            }
            None => self.sensors.push(Watched {
                sensor,
                is_changed: false,
                is_pressed: false,
                untared: Vec::new(),
                at_rest: VecDeque::new(),
            }),
        }
    }

    /// Takes events, and the presses that ended with them.
    fn take(&mut self, events: Vec<Event>, ended: &[EndedPress]) {
        for event in events {
            let mut watched = self.sensors.iter_mut();
            let place = watched.position(|of| of.sensor.name() == event.sensor());
            let Some(place) = place else {
                continue;
            };
            let watched = &mut self.sensors[place];
            match event {
                Event::Frame(frame) if !frame.tared => watched.untared = frame.newtons,
                Event::Frame(frame) if !watched.is_pressed => watched.rest(frame.newtons),
                // The press's first frame came just before the event of its begin.
                Event::Press(press) => {
                    watched.is_pressed = press.state == PressState::Begin;
                    let is_this = |ended: &&EndedPress| {
                        (ended.press, &ended.sensor) == (press.press, &press.sensor)
                    };
                    let ended = ended.iter().find(is_this);
                    if let Some(ended) = ended.filter(|_| press.state == PressState::End) {
                        self.add(place, &press, ended);
                    }
                    if press.state != PressState::Begin {
                        self.sensors[place].at_rest.clear();
                    }
                }
                Event::Frame(_) | Event::Hardness(_) | Event::Status(_) => {}
            }
        }
    }

    /// Adds a press of the sensor in this place.
    fn add(&mut self, place: usize, press: &event::Press, ended: &EndedPress) {
        let watched = &self.sensors[place];
        let said = |key| press.context.as_ref()?.get(key);
        let level = said("level").and_then(Value::as_u64);
        let level = level.and_then(|level| u8::try_from(level).ok());
        let is_level = |level: &u8| usize::from(*level) <= MOST_LEVELS;
        let best = &ended.moments[ended.best].frame;
        let name = name_of(&self.path);
        let press = Press {
            level: level.filter(is_level).unwrap_or(0),
            object: said("object").and_then(Value::as_str).map(object_of),
            force_n: Some(best.force_n() as f32),
            arm_n_per_mm: ended.arm_n_per_mm,
            sensor: place as u32,
            name: Some(format!("{name} press {}", press.press)),
            kind: self.kind,
            ..Press::default()
        };
        let mut moments = ended.course(grid_mm(&watched.sensor)).moments;
        match self.layout {
            Layout::OverTime => {
                let mut before_s = -1.0_f32;
                let moments = moments.into_iter().map(|moment| {
                    // Two frames may have arrived at the same moment, but times in a file must ascend.
                    before_s = moment.time_s.max(before_s.next_up());
                    (before_s, moment.approach_mm, moment.frame.newtons)
                });
                let has_parts = grid(&watched.sensor).is_some_and(|grid| !grid.is_kept());
                let area =
                    || best.contact_area_taxels(watched.sensor.thresholds().contact_threshold_n);
                let press = Press {
                    best: ended.best,
                    unloaded: Some(watched.unloaded()),
                    parts: has_parts.then(|| ended.parts()),
                    contact_area_taxels: has_parts.then(area),
                    ..press
                };
                self.presses.push(press, moments);
            }
            Layout::Frames => {
                let best = moments.swap_remove(ended.best);
                self.presses.push(press, [(0.0, None, best.frame.newtons)]);
            }
        }
    }

    /// The recording as a source of presses. All its sensors have one pitch.
    fn source(&self) -> anyhow::Result<Source> {
        let mut sensors = self.sensors.iter().map(|of| &of.sensor);
        let expected = sensors.clone().next().map_or(PITCH_MM, grid_mm);
        if let Some(found) = sensors.find(|sensor| grid_mm(sensor) != expected) {
            bail!(
                "taxel pitch: found {} mm, expected {expected} mm, that of its first sensor",
                grid_mm(found)
            );
        }
        let one = |of: &Watched| grid(&of.sensor).filter(|_| !of.is_changed);
        let mut grids = self.sensors.iter().map(one);
        let first = grids.next().flatten();
        Ok(Source {
            path: self.path.clone(),
            pitch_mm: Some(expected),
            grid: first.filter(|_| grids.all(|grid| grid == first)),
            ..Source::default()
        })
    }
}

/// The level that a label names or numbers.
fn level(label: &str, of: &Settings) -> Option<u8> {
    let mut levels = of.levels.iter();
    let named = levels.find(|level| level.label.eq_ignore_ascii_case(label));
    let numbered = label.parse().ok();
    let numbered = numbered.filter(|level| usize::from(*level) <= MOST_LEVELS);
    named.map(|level| level.level).or(numbered)
}

impl Watched {
    /// Takes a frame between presses.
    fn rest(&mut self, newtons: Vec<f32>) {
        let frames = (REST_S * self.sensor.frame_rate_hz()).ceil() as usize;
        self.at_rest.push_back(newtons);
        while self.at_rest.len() > frames + 1 {
            self.at_rest.pop_front();
        }
    }

    /// The whole array before the touch, with what the tare takes off. The newest frame between presses is the one
    /// that began the press, and some before it have a taxel or two of it.
    fn unloaded(&self) -> Vec<f32> {
        let at_rest = self.at_rest.front().map_or(&[][..], Vec::as_slice);
        let of = |newtons: &[f32], place: usize| newtons.get(place).copied().unwrap_or(0.0);
        let whole = |place| of(at_rest, place) + of(&self.untared, place);
        (0..at_rest.len()).map(whole).collect()
    }
}

/// The array of a sensor with square taxels.
fn grid(sensor: &Sensor) -> Option<Grid> {
    let pitch = sensor.calibration().pitch_mm;
    (pitch.rows_mm == pitch.cols_mm).then(|| Grid {
        array: sensor.layout().array(),
        pitch_mm: pitch.rows_mm,
    })
}

/// The distance between the taxels of the grid on which a data set holds the frames of `sensor`. An
/// array that fits into a data set is kept as it is.
fn grid_mm(sensor: &Sensor) -> f64 {
    let kept = grid(sensor).filter(Grid::is_kept);
    kept.map_or(PITCH_MM, |grid| grid.pitch_mm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::frame::Pitch;
    use hardnessd_core::tests::support::{hrn, of_a_press};
    use hardnessd_simulator::Split;
    use serde_json::json;

    #[test]
    fn a_recording_whose_sensor_changes_its_array_is_of_none() {
        let (bytes, sensor) = of_a_press(|_| {}, None, false);
        let path = Path::new("a.mcap");
        let recording = Recording::played(path, &bytes, &sensor, Layout::OverTime, &hrn());
        let mut recording = recording.unwrap();
        assert!(recording.source().unwrap().grid.is_some());
        let (_, finer) = of_a_press(
            |described| described.sensor.calibration.pitch_mm = Pitch::square(2.0),
            None,
            false,
        );
        for sensor in [finer, sensor] {
            recording.watch(sensor);
            assert_eq!(recording.source().unwrap().grid, None);
        }
    }

    #[test]
    fn what_the_context_of_a_press_says_counts_more_than_the_labels() {
        let truth = |context: Value| {
            let (bytes, sensor) = of_a_press(|_| {}, Some(context), false);
            let path = Path::new("a.mcap");
            let recording = Recording::played(path, &bytes, &sensor, Layout::OverTime, &hrn());
            let mut recording = recording.unwrap();
            let settings = Settings {
                levels: Vec::new(),
                level: None,
                object: None,
                is_one_object: true,
                split: Split::Train,
            };
            recording.label_presses(&settings, 5).unwrap();
            let press = &recording.presses.all[0];
            (press.level, press.object)
        };
        let cup = json!({"sensor": "forearm", "level": 3, "object": "cup"});
        assert_eq!(truth(cup), (3, Some(object_of("cup"))));
        // The label says 2.
        assert_eq!(truth(json!({"level": 99, "object": 7})), (2, Some(5)));
        for name in ["cup", "mug", "a", "b", "c", "d", "e", "f"] {
            assert!(object_of(name) >= 1 << 31, "{name}");
        }
    }
}
