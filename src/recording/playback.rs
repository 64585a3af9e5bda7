//! Turns the entries of a recording into events again.

use std::sync::Arc;

use super::{Entry, Found, Labels};
use crate::event::Event;
use crate::frame::Stamp;
use crate::pipeline::{Clock, FixedError, Pipeline, Unjudged};
use crate::sensor::SensorError;
use crate::verdict::Hrn;

/// The pipelines of a recording's sensors. They get what the recorded ones got.
#[derive(Debug)]
pub struct Playback {
    hrn: Arc<Hrn>,
    players: Vec<Player>,
}

#[derive(Debug)]
struct Player {
    pipeline: Pipeline,
    last: Stamp,
    labels: Labels,
    /// Model that judged when it was recorded.
    model: String,
}

/// An entry that cannot be played.
#[derive(Debug, thiserror::Error)]
#[error("sensor {sensor:?}: {problem}")]
pub struct PlaybackError {
    sensor: String,
    problem: PlaybackProblem,
}

/// Why an entry cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlaybackProblem {
    /// It describes a sensor that cannot be.
    #[error(transparent)]
    Sensor(#[from] SensorError),
    /// What its pipeline is said to have seen.
    #[error("memory: found what no pipeline can have come to, expected the memory of one")]
    Memory,
    /// It describes another sensor under the same name.
    #[error(transparent)]
    Fixed(#[from] FixedError),
}

impl Playback {
    /// Plays no sensor yet; `hrn` judges.
    pub fn new(hrn: Arc<Hrn>) -> Self {
        Self {
            hrn,
            players: Vec::new(),
        }
    }

    /// The events of one entry. An entry before its sensor's first state cannot be played and gives
    /// none. `mono_ns` is null, because the moment belongs to another boot.
    ///
    /// # Errors
    ///
    /// If the recording describes a sensor or a state that cannot be.
    pub fn feed(&mut self, found: Found) -> Result<Vec<Event>, PlaybackError> {
        let Found { sensor, at, entry } = found;
        let played = self.play(&sensor, at, entry);
        let mut events = played.map_err(|problem| PlaybackError { sensor, problem })?;
        forget_boot(&mut events);
        Ok(events)
    }

    fn play(
        &mut self,
        sensor: &str,
        at: Stamp,
        entry: Entry,
    ) -> Result<Vec<Event>, PlaybackProblem> {
        let mut players = self.players.iter_mut();
        let known = players.find(|player| player.pipeline.sensor().name() == sensor);
        let events = match (entry, known) {
            (Entry::State(state), known) => {
                if !state.memory.is_possible() {
                    return Err(PlaybackProblem::Memory);
                }
                // If nothing is missing, the pipeline is in this state already.
                let described = state.sensor.check()?;
                let mut pipeline = Pipeline::new(described, self.hrn.clone(), Clock::Arrival);
                pipeline.recall(state.memory);
                let player = Player {
                    pipeline,
                    last: at,
                    labels: state.labels,
                    model: state.sensor.model,
                };
                match known {
                    Some(known) => *known = player,
                    None => self.players.push(player),
                }
                Vec::new()
            }
            (Entry::Settings(described), Some(known)) => {
                let sensor = described.check()?;
                known.pipeline.reload(sensor, self.hrn.clone())?;
                known.model = described.model;
                Vec::new()
            }
            (Entry::Input(input), Some(known)) => {
                known.last = at;
                input.feed(&mut known.pipeline, at)
            }
            (_, None) => Vec::new(),
        };
        Ok(events)
    }

    /// The recording has ended: the last events of every sensor.
    pub fn end(&mut self) -> Vec<Event> {
        let players = self.players.iter_mut();
        let mut events: Vec<Event> = players
            .flat_map(|player| player.pipeline.end_of_recording(Some(player.last)))
            .collect();
        forget_boot(&mut events);
        events
    }

    /// Gives the verdicts that did not come, each once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        let players = self.players.iter_mut();
        players
            .flat_map(|player| player.pipeline.unjudged())
            .collect()
    }

    /// How many sensors have been met so far.
    pub fn sensors(&self) -> usize {
        self.players.len()
    }

    /// The labels of the recording, as far as it has been played.
    pub fn labels(&self) -> Labels {
        let players = self.players.first();
        players.map_or_else(Labels::new, |player| player.labels.clone())
    }

    /// The SHA-256 of a model that judged then, if it is not the one that judges now.
    pub fn other_model(&self) -> Option<&str> {
        let models = self.players.iter().map(|player| player.model.as_str());
        models.into_iter().find(|model| *model != self.hrn.sha256())
    }
}

fn forget_boot(events: &mut [Event]) {
    for event in events {
        if let Event::Hardness(verdict) = event {
            verdict.mono_ns = None;
        }
    }
}
