//! The task of one sensor, which connects the sensor's port, its pipeline and the hub.
//!
//! The task waits for the port, the pipeline's deadline or a command. Then it makes one call into
//! the pipeline and sends the events to the hub. It shares nothing, so a sensor that is lost does
//! not disturb the others.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Map, Value};
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;
use tracing::{error, info, warn};

use super::hub::Hub;
use super::own::Store;
use super::record::SensorRecorder;
use super::serial::Source;
use super::{log, request};
use crate::maybe;
use hardnessd_core::event::{self, Event, Phase, Status, Tared};
use hardnessd_core::pipeline::{Input, Pipeline, Refused};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::RetareError;
use hardnessd_core::verdict::Model;
use hardnessd_core::wording;

/// The content of an `ok`: the tare that was taken, or the black box that was written.
#[derive(Debug, Default)]
pub(crate) struct Done {
    pub(crate) tare: Option<Tared>,
    pub(crate) blackbox: Option<PathBuf>,
}

/// Where the answer to a command goes: what was done, or why it is refused, in words, because nobody tells reasons
/// apart.
pub(crate) type Answer = oneshot::Sender<Result<Done, String>>;

/// A command to a sensor's task.
#[derive(Debug)]
pub(crate) enum Command {
    /// Take another tare. The answer comes when the tare is taken, refused or abandoned.
    Tare(Answer),
    /// Take a context of the controller, or positions of the arm. The answer comes when the pipeline has it, or
    /// says why it is refused.
    Take(Input, Answer),
    /// Set these keys of the context, as [`Self::Take`] sets a whole one.
    Merge(Map<String, Value>, Answer),
    /// Write the last minute to a file. The answer comes when it is written.
    Blackbox(Answer),
    /// Judge with another model from the next rest on. Of the sensor's tables, only `[model]` may differ.
    Model(Box<Sensor>, Arc<Model>),
    /// End the task. A press under way is aborted, and no further event follows.
    Finish,
}

/// A sensor without its port: what its task begins with, and what is left of it at the end.
#[derive(Debug)]
pub(crate) struct SensorCore {
    pub(crate) pipeline: Pipeline,
    pub(crate) recorder: Option<SensorRecorder>,
    /// The number of verdicts since the start that are missing because the model failed.
    pub(crate) unjudged: u64,
    pub(crate) commands: mpsc::Receiver<Command>,
}

/// The current state of a sensor.
#[derive(Debug, Clone)]
pub(crate) struct SensorState {
    pub(crate) status: Status,
    /// When the sensor's last whole frame came, by CLOCK_MONOTONIC.
    pub(crate) last_frame: Option<Duration>,
    pub(crate) contact_threshold_n: f32,
    /// The number of verdicts since the start that are missing because the model failed.
    pub(crate) unjudged: u64,
    /// The number of positions of the arm since the start, and the number of them that came too
    /// late.
    pub(crate) motion: (u64, u64),
}

/// Sends commands to the task of one sensor.
#[derive(Debug, Clone)]
pub(crate) struct SensorHandle {
    pub(crate) name: String,
    pub(crate) commands: mpsc::Sender<Command>,
}

/// Sends commands to the tasks of all sensors, in the order of the configuration.
pub(crate) type Sensors = Arc<[SensorHandle]>;

/// Serves one sensor until [`Command::Finish`]. Returns what is left of it.
pub(crate) async fn serve(
    mut core: SensorCore,
    mut source: Source,
    hub: Hub,
    store: Option<Store>,
) -> SensorCore {
    // The client that waits for the outcome of a tare.
    let mut taring: Option<Answer> = None;
    let mut frames = core.pipeline.frame_counts().0;
    // The model that judges from the next rest on.
    let mut next_model = None;
    loop {
        if core.pipeline.is_at_rest()
            && let Some((sensor, hrn)) = next_model.take()
            && let Some(judging) = core.pipeline.with_model(sensor, hrn)
        {
            core.pipeline = judging;
            core.begin_recording_anew();
        }
        hub.log().report(core.state());
        // A sensor that never pauses leaves the others their turns.
        tokio::task::yield_now().await;
        let deadline = core.pipeline.deadline();
        let events = tokio::select! {
            // The selection is not biased: the task must still obey `Finish` if the sensor never
            // pauses, and still read its port if commands never pause.
            command = core.commands.recv() => match command {
                Some(Command::Tare(reply)) => {
                    match core.take(Input::Tare) {
                        Err(Refused::Tare(refusal)) => {
                            let _ = reply.send(tared(core.name(), Err(refusal)));
                        }
                        _ => taring = Some(reply),
                    }
                    continue;
                }
                Some(Command::Take(input, reply)) => {
                    let taken = core.take_asked(input);
                    core.answer(reply, taken);
                    continue;
                }
                Some(Command::Merge(keys, reply)) => {
                    let merged = merged(core.pipeline.context(), core.name(), keys);
                    let taken = merged.and_then(|merged| core.take_asked(Input::Context(merged)));
                    core.answer(reply, taken);
                    continue;
                }
                Some(Command::Blackbox(reply)) => {
                    match &core.recorder {
                        Some(recorder) => recorder.blackbox(reply),
                        None => {
                            let none = "blackbox: nothing is kept: the configuration has no [record]";
                            let _ = reply.send(Err(none.to_owned()));
                        }
                    }
                    continue;
                }
                Some(Command::Model(sensor, hrn)) => {
                    next_model = Some((*sensor, hrn));
                    continue;
                }
                Some(Command::Finish) | None => {
                    let ended = "tare: the daemon stops, or the sensor begins anew after a reload: ask again";
                    let _ = taring.map(|reply| reply.send(Err(ended.to_owned())));
                    hub.publish(core.taken(Input::Shutdown));
                    source.close().await;
                    return core;
                }
            },
            input = source.next() => core.taken(input),
            () = maybe::until(deadline.map(moment)) => core.taken(Input::Tick),
        };
        if std::mem::replace(&mut frames, core.pipeline.frame_counts().0) < frames {
            source.proven();
        }
        if let Some(outcome) = core.pipeline.retared() {
            let done = tared(core.name(), outcome);
            // The client may have gone.
            let _ = taring.take().map(|reply| reply.send(done));
        }
        for failed in core.pipeline.unjudged() {
            log::limited(core.name(), || {
                error!(
                    sensor = core.name(),
                    press = failed.press,
                    phase = event::name(&failed.phase),
                    reason = %failed.error,
                    "no verdict"
                );
            });
            core.unjudged += 1;
        }
        let is_final =
            |event: &Event| matches!(event, Event::Hardness(one) if one.phase == Phase::Final);
        let is_judged = events.iter().any(is_final);
        hub.publish(events);
        if let Some(store) = store.as_ref().filter(|_| is_judged) {
            store.save(&core.pipeline);
        }
    }
}

impl SensorCore {
    pub(super) fn name(&self) -> &str {
        self.pipeline.sensor().name()
    }

    /// Records an input, then passes it on to the pipeline.
    fn take(&mut self, input: Input) -> Result<Vec<Event>, Refused> {
        let now = super::now();
        if let Some(recorder) = &mut self.recorder {
            recorder.note(&self.pipeline, &input, now);
        }
        self.pipeline.take(input, now)
    }

    /// The pipeline begins anew, or has another model.
    pub(super) fn begin_recording_anew(&mut self) {
        if let Some(recorder) = &mut self.recorder {
            recorder.begin_anew(&self.pipeline, super::now());
        }
    }

    /// The same for an input that is never refused.
    fn taken(&mut self, input: Input) -> Vec<Event> {
        let taken = self.take(input);
        taken.expect("only a tare and positions of the arm can be refused")
    }

    /// The same for an input that a client sent.
    fn take_asked(&mut self, input: Input) -> Result<Done, String> {
        if let Input::Context(context) = &input {
            let levels = self.pipeline.hrn().card().levels.len();
            check_truth(context.as_ref(), levels)?;
            let context = context.as_ref();
            log::limited(self.name(), || {
                let context = context.map(|context| wording::escaped(&context.to_string()));
                info!(sensor = self.name(), context, "context");
            });
        }
        match self.take(input) {
            Err(Refused::Motion(back)) => Err(format!("motion.at[{}]: {back}", back.index)),
            _ => Ok(Done::default()),
        }
    }

    /// Answers a client, which may not wait for it.
    fn answer(&self, reply: Answer, taken: Result<Done, String>) {
        if let Err(Err(reason)) = reply.send(taken) {
            log::limited(self.name(), || {
                warn!(sensor = self.name(), reason, "refused");
            });
        }
    }

    /// The state of the sensor, which the hub has for everybody who asks.
    pub(super) fn state(&self) -> SensorState {
        let pipeline = &self.pipeline;
        SensorState {
            status: pipeline.status(super::now()),
            last_frame: pipeline.last_frame().map(|frame| frame.mono),
            contact_threshold_n: pipeline.sensor().thresholds().contact_threshold_n,
            unjudged: self.unjudged,
            motion: pipeline.track().counts(),
        }
    }
}

/// Logs the outcome of a tare that a client requested, and returns the answer.
fn tared(sensor: &str, outcome: Result<Tared, RetareError>) -> Result<Done, String> {
    log::tare(sensor, &outcome);
    match outcome {
        Ok(tared) => Ok(Done {
            tare: Some(tared),
            ..Done::default()
        }),
        Err(refusal) => Err(format!("tare: {refusal}")),
    }
}

/// The context of a sensor in which these keys are set, and those that are null removed.
fn merged(
    context: Option<&Value>,
    sensor: &str,
    keys: Map<String, Value>,
) -> Result<Option<Value>, String> {
    let mut merged = context
        .and_then(Value::as_object)
        .cloned()
        .unwrap_or_default();
    for (key, value) in keys {
        match value {
            Value::Null => merged.remove(&key),
            value => merged.insert(key, value),
        };
    }
    if merged.keys().all(|key| key == "sensor") {
        return Ok(None);
    }
    merged.insert("sensor".to_owned(), sensor.into());
    let merged = Value::Object(merged);
    event::check_context(&merged).map_err(|problem| format!("merge: {problem}"))?;
    Ok(Some(merged))
}

/// Checks the keys of a context that say what is pressed, for a model with so many levels.
fn check_truth(context: Option<&Value>, levels: usize) -> Result<(), String> {
    let Some(context) = context else {
        return Ok(());
    };
    let is_level = |level: &Value| {
        level
            .as_u64()
            .is_some_and(|level| (1..=levels as u64).contains(&level))
    };
    if let Some(found) = context.get("object").filter(|found| !found.is_string()) {
        return Err(request::unusable("context.object", found, "a text"));
    }
    match context.get("level").filter(|found| !is_level(found)) {
        Some(found) => {
            let expected = format!("a level of the model: 1 to {levels}");
            Err(request::unusable("context.level", found, &expected))
        }
        None => Ok(()),
    }
}

/// The moment of a time of CLOCK_MONOTONIC, which is also the runtime's clock.
fn moment(mono: Duration) -> Instant {
    Instant::now() + mono.saturating_sub(super::now().mono)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn keys_are_merged_into_a_context() {
        let merged = |context: Option<Value>, keys: Value| {
            merged(context.as_ref(), "palm", keys.as_object().unwrap().clone())
        };
        let context = json!({"sensor": "palm", "tag": null, "level": 2});
        let keys = json!({"level": null, "object": "cup"});
        let expected = json!({"sensor": "palm", "tag": null, "object": "cup"});
        assert_eq!(merged(Some(context), keys.clone()), Ok(Some(expected)));
        let expected = json!({"sensor": "palm", "object": "cup"});
        assert_eq!(merged(None, keys), Ok(Some(expected.clone())));
        assert_eq!(merged(Some(expected), json!({"object": null})), Ok(None));
        assert!(merged(None, json!({"tag": "x".repeat(2000)})).is_err());
    }

    #[test]
    fn the_truth_in_a_context_is_a_text_and_a_level_of_the_model() {
        let refusal = |context: Value| check_truth(Some(&context), 4).err();
        assert_eq!(
            refusal(json!({"object": "cup", "level": 4, "tag": 5})),
            None
        );
        for found in [json!(5), json!(null)] {
            let expected = format!("context.object: found {found}, expected a text");
            assert_eq!(refusal(json!({"object": found})), Some(expected));
        }
        for found in [json!(0), json!(5), json!(1.5), json!("2")] {
            let expected =
                format!("context.level: found {found}, expected a level of the model: 1 to 4");
            assert_eq!(refusal(json!({"level": found})), Some(expected));
        }
    }
}
