//! Turns the entries of a recording back into events.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{Entry, Found, Labels, RecordedSensor, State};
use crate::event::Event;
use crate::frame::Stamp;
use crate::judge::{EndedPress, Unjudged};
use crate::pipeline::{Clock, Pipeline};
use crate::press::End;
use crate::sensor::Sensor;
use crate::verdict::{Model, ModelError};

/// The pipelines of a recording's sensors. They get the same inputs as the recorded ones.
///
/// # Example
///
/// ```no_run
/// use std::sync::Arc;
///
/// use hardnessd_core::recording::{Playback, Reader};
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
///
/// let mut playback = Playback::new(Arc::new(Model::load(BUILT_IN_HRN)?));
/// let mut events = Vec::new();
/// for found in Reader::new(std::fs::File::open("press.mcap")?) {
///     events.extend(playback.feed(found?)?);
/// }
/// events.extend(playback.end());
/// events.iter().for_each(|event| print!("{}", event.to_line()));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Playback {
    hrn: Arc<Model>,
    /// The models of sensors whose references are not those of the recording.
    identified: BTreeMap<String, Arc<Model>>,
    players: Vec<Player>,
    /// The first moment of each sensor whose first entry is no state, and the moment of its first
    /// state, if there is one.
    left_out: BTreeMap<String, (Stamp, Option<Stamp>)>,
    keeps_courses: bool,
}

#[derive(Debug)]
struct Player {
    pipeline: Pipeline,
    /// The moment of the last entry. `None` for raw bytes, whose times come from the frame rate.
    last: Option<Stamp>,
    labels: Labels,
    /// The sensor as it was recorded. Raw bytes have none.
    recorded: Option<RecordedSensor>,
}

impl Player {
    fn has(&self, state: &State) -> bool {
        self.recorded.as_ref() == Some(&state.sensor)
            && self.pipeline.at_rest().as_ref() == Some(&state.at_rest)
    }
}

/// The error of an entry that cannot be played.
#[derive(Debug, thiserror::Error)]
#[error("sensor {sensor:?}: {problem}")]
pub struct PlaybackError {
    sensor: String,
    problem: Problem,
}

/// The sensor is not valid, the model takes no frames of it or other references, or no pipeline can have
/// the state.
type Problem = Box<dyn std::error::Error + Send + Sync>;

impl Playback {
    /// A playback without any sensor yet. The model is `hrn`. A sensor keeps the references of the
    /// recording if the recording is of this model.
    pub fn new(hrn: Arc<Model>) -> Self {
        Self {
            hrn,
            identified: BTreeMap::new(),
            players: Vec::new(),
            left_out: BTreeMap::new(),
            keeps_courses: false,
        }
    }

    /// A playback of the raw bytes of a sensor. The moments of entries do not count: the frames get theirs from
    /// the frame rate.
    pub fn of_bytes(sensor: Sensor, hrn: Arc<Model>) -> Self {
        let mut playback = Self::new(hrn.clone());
        playback.players.push(Player {
            recorded: None,
            pipeline: Pipeline::new(sensor, hrn, Clock::FrameRate),
            last: None,
            labels: Labels::new(),
        });
        playback
    }

    /// Keeps each press that ends, until [`Self::ended`] returns it.
    pub fn keep_courses(&mut self) {
        self.keeps_courses = true;
        for player in &mut self.players {
            player.pipeline.keep_courses();
        }
    }

    /// The kept presses that were not returned yet. A state of a sensor forgets its own.
    pub fn ended(&mut self) -> Vec<EndedPress> {
        let players = self.players.iter_mut();
        players.flat_map(|player| player.pipeline.ended()).collect()
    }

    /// Judges the presses of a sensor with `hrn`, which has references of that sensor.
    pub fn identify(&mut self, sensor: &str, hrn: Arc<Model>) {
        self.identified.insert(sensor.to_owned(), hrn);
    }

    /// The model with the references of a recorded sensor.
    fn hrn_of(&self, recorded: &RecordedSensor) -> Result<Arc<Model>, ModelError> {
        if let Some(hrn) = self.identified.get(recorded.name()) {
            return Ok(hrn.clone());
        }
        if recorded.references.is_none() || recorded.model_sha256 != self.hrn.sha256() {
            return Ok(self.hrn.clone());
        }
        Ok(Arc::new(self.hrn.identified(recorded.references.clone())?))
    }

    /// The events of one entry. An entry before its sensor's first state cannot be played and has
    /// no events: see [`Self::left_out`]. `mono_ns` is null, because the moment belongs to another boot.
    ///
    /// # Errors
    ///
    /// Returns an error if the sensor's description or state is not valid.
    pub fn feed(&mut self, found: Found) -> Result<Vec<Event>, PlaybackError> {
        let Found { sensor, at, entry } = found;
        let played = self.play(&sensor, at, entry);
        let mut events = played.map_err(|problem| PlaybackError { sensor, problem })?;
        forget_boot(&mut events);
        Ok(events)
    }

    fn play(&mut self, sensor: &str, at: Stamp, entry: Entry) -> Result<Vec<Event>, Problem> {
        let hrn = match &entry {
            Entry::State(state) => self.hrn_of(&state.sensor)?,
            Entry::Input(_) => self.hrn.clone(),
        };
        let mut players = self.players.iter_mut();
        let known = players.find(|player| player.pipeline.sensor().name() == sensor);
        let events = match (entry, known) {
            // If no entry is missing, the pipeline already has this state.
            (Entry::State(state), Some(known)) if known.has(&state) => Vec::new(),
            (Entry::State(state), known) => {
                let described = state.sensor.check()?;
                hrn.card().check_array(described.layout().array())?;
                if !state.at_rest.is_usable(described.layout().array()) {
                    let found = "what no pipeline can have come to";
                    return Err(format!("state: found {found}, expected the state of one").into());
                }
                let mut pipeline = Pipeline::resumed(described, hrn, state.at_rest);
                if self.keeps_courses {
                    pipeline.keep_courses();
                }
                let player = Player {
                    pipeline,
                    last: Some(at),
                    labels: state.labels,
                    recorded: Some(state.sensor),
                };
                match known {
                    Some(known) => {
                        let mut before = std::mem::replace(known, player).pipeline;
                        // A press under way has lost its end with the missing entries.
                        let mut events = Vec::new();
                        before.abort(End::EndOfRecording, &mut events);
                        events
                    }
                    None => {
                        if let Some((_, to)) = self.left_out.get_mut(sensor) {
                            *to = Some(at);
                        }
                        self.players.push(player);
                        Vec::new()
                    }
                }
            }
            (Entry::Input(input), Some(known)) => {
                known.last = known.last.and(Some(at));
                // What was refused then is refused now.
                known.pipeline.take(input, at).unwrap_or_default()
            }
            (_, None) => {
                let name = sensor.to_owned();
                self.left_out.entry(name).or_insert((at, None));
                Vec::new()
            }
        };
        Ok(events)
    }

    /// The last events of every sensor, at the end of the recording.
    pub fn end(&mut self) -> Vec<Event> {
        let players = self.players.iter_mut();
        let mut events: Vec<Event> = players
            .flat_map(|player| player.pipeline.end_of_recording(player.last))
            .collect();
        forget_boot(&mut events);
        events
    }

    /// Takes out the missing verdicts. Each is returned once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        let players = self.players.iter_mut();
        players
            .flat_map(|player| player.pipeline.unjudged())
            .collect()
    }

    /// The pipeline of a sensor.
    pub fn pipeline(&self, sensor: &str) -> Option<&Pipeline> {
        let mut pipelines = self.players.iter().map(|player| &player.pipeline);
        pipelines.find(|pipeline| pipeline.sensor().name() == sensor)
    }

    /// What cannot be played, in words: a clip of a recording may begin inside a press. It is played
    /// from the next rest on.
    pub fn left_out(&self) -> Vec<String> {
        let note = |(sensor, (from, to)): (&String, &(Stamp, Option<Stamp>))| match to {
            Some(to) => {
                let seconds = to.mono.saturating_sub(from.mono).as_secs_f64();
                format!(
                    "sensor {sensor:?}: left out: the first {seconds:.1} s, which come before a state at rest"
                )
            }
            None => format!("sensor {sensor:?}: left out: it has no state at rest"),
        };
        self.left_out.iter().map(note).collect()
    }

    /// Why nothing was played, in words. `None` if something was.
    pub fn nothing_played(&self) -> Option<&'static str> {
        let problem = match self.left_out.is_empty() {
            true => "found no state of a sensor, expected a recording of hardnessd",
            // A clip of a recording may lie inside one press.
            false => "found no sensor at rest, expected a recording with a moment between presses",
        };
        self.players.is_empty().then_some(problem)
    }

    /// The labels of the recording, from the part played so far.
    pub fn labels(&self) -> Labels {
        let players = self.players.first();
        players.map_or_else(Labels::new, |player| player.labels.clone())
    }

    /// The SHA-256 of a model during recording, if it differs from the current model.
    pub fn other_model(&self) -> Option<&str> {
        let recorded = self.players.iter().flat_map(|player| &player.recorded);
        let mut models = recorded.map(|recorded| recorded.model_sha256.as_str());
        models.find(|model| *model != self.hrn.sha256())
    }
}

fn forget_boot(events: &mut [Event]) {
    for event in events {
        if let Event::Hardness(verdict) = event {
            verdict.mono_ns = None;
        }
    }
}
