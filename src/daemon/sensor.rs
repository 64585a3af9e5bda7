//! One sensor: its port at one end, the hub at the other, its pipeline between.
//!
//! The task waits for the port, the pipeline's deadline or a command. Then it makes one call into the
//! pipeline and sends the events to the hub. It shares nothing, so a sensor that is lost disturbs no
//! other.

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

/// What a sensor's task can be asked to do.
#[derive(Debug)]
pub(crate) enum Command {
    /// To say how the sensor is now.
    Status(oneshot::Sender<Vitals>),
    /// To take another tare. The answer comes when it is taken or given up.
    Tare(oneshot::Sender<Result<Tared, RetareError>>),
    /// To echo what the controller says it is doing. The answer comes when it is in force.
    Context(Option<Value>, oneshot::Sender<()>),
    /// To take where the robot says its arm is. The answer comes when it is taken.
    Motion(Vec<Point>, oneshot::Sender<Result<(), StepBack>>),
    /// To write the last minute. The answer is the path of the file.
    Blackbox(oneshot::Sender<Result<PathBuf, NoBlackbox>>),
    /// To judge by another description and model from now on. Nothing that is fixed may differ.
    Reload(Box<Sensor>, Arc<Hrn>),
    /// To end. A press under way is aborted, and no event follows.
    Finish,
}

/// A sensor as it is now.
#[derive(Debug, Clone)]
pub(crate) struct Vitals {
    pub(crate) status: Status,
    /// Age of its last whole frame.
    pub(crate) last_frame_age: Option<Duration>,
    pub(crate) contact_threshold_n: f32,
    /// Verdicts since the start that did not come because the model failed.
    pub(crate) unjudged: u64,
    /// Positions of the arm since the start, and those among them that came too late.
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
    /// Every sensor now; those that have ended are left out.
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

    /// Every sensor's status now.
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
    // The asker who waits for a tare.
    let mut taring = None;
    let mut unjudged = 0;
    loop {
        let deadline = pipeline.deadline();
        let events = tokio::select! {
            // Not biased: a sensor that never pauses must still obey `Finish`, and commands that
            // never pause must not keep the task from its port.
            command = commands.recv() => match command {
                Some(Command::Status(reply)) => {
                    // The asker may have gone.
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
                    // The asker may have gone.
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

/// Answers the asker of a tare when its outcome is known.
fn answer(
    pipeline: &mut Pipeline,
    taring: &mut Option<oneshot::Sender<Result<Tared, RetareError>>>,
) {
    if let Some(outcome) = pipeline.retared() {
        log::tare(pipeline.sensor().name(), &outcome);
        if let Some(reply) = taring.take() {
            // The asker may have gone.
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

/// Waits for a moment of CLOCK_MONOTONIC, which is the runtime's clock too. Without a moment it waits
/// for ever.
async fn until(deadline: Option<Duration>) {
    match deadline {
        Some(deadline) => {
            let left = deadline.saturating_sub(super::now().mono);
            tokio::time::sleep_until(Instant::now() + left).await;
        }
        None => std::future::pending().await,
    }
}
