//! The task of one sensor, which connects the sensor's port, its pipeline and the hub.
//!
//! The task waits for the port, the pipeline's deadline or a command. Then it makes one call into
//! the pipeline and sends the events to the hub. It shares nothing, so a sensor that is lost does
//! not disturb the others.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

use super::hub;
use super::log;
use super::record::{NoBlackbox, SensorRecorder};
use super::serial::{Link, Turn};
use crate::event::{Event, Kind, Status, Tared};
use crate::motion::{Point, StepBack};
use crate::pipeline::Pipeline;
use crate::recording::Input;
use crate::sensor::Sensor;
use crate::tare::RetareError;
use crate::verdict::Hrn;

/// A command to a sensor's task.
#[derive(Debug)]
pub(crate) enum Command {
    /// Report the current state of the sensor.
    Status(oneshot::Sender<Vitals>),
    /// Take another tare. The answer comes when the tare is taken, refused or abandoned.
    Tare(oneshot::Sender<Result<Tared, RetareError>>),
    /// Repeat the controller's context in events. The answer comes when the pipeline has the
    /// context.
    Context(Option<Value>, oneshot::Sender<()>),
    /// Take positions of the arm that the robot reports. The answer comes when they are taken.
    Motion(Vec<Point>, oneshot::Sender<Result<(), StepBack>>),
    /// Write the last minute to a file. The answer is the path of the file.
    Blackbox(oneshot::Sender<Result<PathBuf, NoBlackbox>>),
    /// Use another description and model from now on. Values that only a restart can change must
    /// not differ.
    Reload(Box<Sensor>, Arc<Hrn>),
    /// End the task. A press under way is aborted, and no further event follows.
    Finish,
}

/// The current state of a sensor.
#[derive(Debug, Clone)]
pub(crate) struct Vitals {
    pub(crate) status: Status,
    /// The age of the sensor's last whole frame.
    pub(crate) last_frame_age: Option<Duration>,
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
#[derive(Debug, Clone)]
pub(crate) struct Sensors(pub(crate) Vec<SensorHandle>);

impl Sensors {
    /// The current state of every sensor. A sensor whose task has ended is left out.
    pub(crate) async fn vitals(&self) -> Vec<Vitals> {
        let mut all = Vec::with_capacity(self.0.len());
        for sensor in &self.0 {
            let (reply, vitals) = oneshot::channel();
            if sensor.commands.send(Command::Status(reply)).await.is_ok()
                && let Ok(vitals) = vitals.await
            {
                all.push(vitals);
            }
        }
        all
    }

    /// Every sensor's current status.
    pub(crate) async fn statuses(&self) -> Vec<Status> {
        let vitals = self.vitals().await;
        vitals.into_iter().map(|vitals| vitals.status).collect()
    }
}

/// Serves one sensor until [`Command::Finish`].
pub(crate) async fn serve(
    mut pipeline: Pipeline,
    mut link: Link,
    mut recorder: SensorRecorder,
    hub: hub::Handle,
    mut commands: mpsc::Receiver<Command>,
) {
    // The client that waits for the outcome of a tare.
    let mut taring = None;
    let mut unjudged = 0;
    loop {
        let deadline = pipeline.deadline();
        let events = tokio::select! {
            // The selection is not biased: the task must still obey `Finish` if the sensor never
            // pauses, and still read its port if commands never pause.
            command = commands.recv() => match command {
                Some(Command::Status(reply)) => {
                    // The client may have gone.
                    let _ = reply.send(vitals(&pipeline, unjudged));
                    continue;
                }
                Some(Command::Tare(reply)) => {
                    recorder.note(&pipeline, &Input::Tare, super::now());
                    match pipeline.retare() {
                        Ok(()) => taring = Some(reply),
                        Err(refusal) => {
                            log::tare(pipeline.sensor().name(), &Err(refusal));
                            let _ = reply.send(Err(refusal));
                        }
                    }
                    continue;
                }
                Some(Command::Context(context, reply)) => {
                    log::context(pipeline.sensor().name(), context.as_ref());
                    recorder.feed(&mut pipeline, Input::Context(context), super::now());
                    let _ = reply.send(());
                    continue;
                }
                Some(Command::Motion(points, reply)) => {
                    let input = Input::Motion(points.as_slice().into());
                    recorder.note(&pipeline, &input, super::now());
                    // The client may have gone.
                    let _ = reply.send(pipeline.tell(&points));
                    continue;
                }
                Some(Command::Blackbox(reply)) => {
                    recorder.blackbox(reply);
                    continue;
                }
                Some(Command::Reload(sensor, hrn)) => {
                    recorder.reload(&pipeline, &sensor, &hrn, super::now());
                    let reloaded = pipeline.reload(*sensor, hrn);
                    reloaded.expect("a configuration that differs in what is fixed was refused");
                    answer(&mut pipeline, &mut taring);
                    continue;
                }
                Some(Command::Finish) | None => {
                    let events = recorder.feed(&mut pipeline, Input::Shutdown, super::now());
                    return hub.publish(events).await;
                }
            },
            turn = link.turn() => {
                let at = super::now();
                let input = match turn {
                    Turn::Bytes(bytes) => Input::Bytes(bytes.into()),
                    Turn::Opened => Input::Opened,
                    Turn::Unavailable(reason) => Input::Unavailable(reason.into()),
                    Turn::Lost(reason) => Input::Lost(reason.into()),
                };
                recorder.feed(&mut pipeline, input, at)
            }
            () = until(deadline) => recorder.feed(&mut pipeline, Input::Tick, super::now()),
        };
        if events
            .iter()
            .map(Event::kind)
            .any(|kind| kind == Kind::Frame)
        {
            link.proven();
        }
        answer(&mut pipeline, &mut taring);
        for failed in pipeline.unjudged() {
            log::unjudged(&failed);
            unjudged += 1;
        }
        hub.publish(events).await;
    }
}

/// Answers the client that requested a tare, when the outcome is known.
fn answer(
    pipeline: &mut Pipeline,
    taring: &mut Option<oneshot::Sender<Result<Tared, RetareError>>>,
) {
    if let Some(outcome) = pipeline.retared() {
        log::tare(pipeline.sensor().name(), &outcome);
        if let Some(reply) = taring.take() {
            // The client may have gone.
            let _ = reply.send(outcome);
        }
    }
}

fn vitals(pipeline: &Pipeline, unjudged: u64) -> Vitals {
    let now = super::now();
    Vitals {
        status: pipeline.status(now),
        last_frame_age: pipeline
            .last_frame()
            .map(|frame| now.mono.saturating_sub(frame.mono)),
        contact_threshold_n: pipeline.sensor().description().press.contact_threshold_n,
        unjudged,
        motion: pipeline.motion_counts(),
    }
}

/// Waits for a time of CLOCK_MONOTONIC, which is also the runtime's clock. Without a deadline, this
/// waits forever.
async fn until(deadline: Option<Duration>) {
    match deadline {
        Some(deadline) => {
            let left = deadline.saturating_sub(super::now().mono);
            tokio::time::sleep_until(Instant::now() + left).await;
        }
        None => std::future::pending().await,
    }
}
