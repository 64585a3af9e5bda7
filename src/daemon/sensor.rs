//! The task of one sensor, which connects the sensor's port, its pipeline and the hub.
//!
//! The task waits for the port, the pipeline's deadline or a command. Then it makes one call into
//! the pipeline and sends the events to the hub. It shares nothing, so a sensor that is lost does
//! not disturb the others.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use super::frame_rate::FrameRate;
use super::hub;
use super::log;
use super::record::{NoBlackbox, SensorRecorder};
use super::request::motion::{Calendar, Placed};
use super::serial::{self, Link, Turn};
use crate::maybe;
use hardnessd_core::event::{Event, Kind, Status, Tared};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::StepBack;
use hardnessd_core::pipeline::{Input, Pipeline};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::RetareError;
use hardnessd_core::verdict::Hrn;

/// So many sensors are asked for their state at once: few switches between threads, and yet a frame
/// that comes meanwhile does not wait for all sensors.
const AT_ONCE: usize = 32;

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
    Motion(Placed, oneshot::Sender<Result<(), StepBack>>),
    /// Write the last minute to a file. The answer is the path of the file.
    Blackbox(oneshot::Sender<Result<PathBuf, NoBlackbox>>),
    /// Use another description and model from now on. Values that only a restart can change must
    /// not differ. If there is another recorder, use that one too.
    Reload(Box<Sensor>, Arc<Hrn>, Option<SensorRecorder>),
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

/// Sends commands to the tasks of all sensors, in the order of the configuration. A reload may add and
/// remove sensors.
#[derive(Debug, Clone)]
pub(crate) struct Sensors(watch::Receiver<Arc<[SensorHandle]>>);

impl Sensors {
    /// These sensors, until the sender sends others.
    pub(crate) fn new(sensors: Vec<SensorHandle>) -> (watch::Sender<Arc<[SensorHandle]>>, Self) {
        let (sender, current) = watch::channel(sensors.into());
        (sender, Self(current))
    }

    /// The sensors that there are now.
    pub(crate) fn current(&self) -> Arc<[SensorHandle]> {
        Arc::clone(&self.0.borrow())
    }

    /// The current state of every sensor, and whether every sensor answered. A sensor whose task has
    /// ended is left out.
    pub(crate) async fn vitals(&self) -> (Vec<Vitals>, bool) {
        let sensors = self.current();
        let mut all = Vec::with_capacity(sensors.len());
        for some in sensors.chunks(AT_ONCE) {
            let mut asked = Vec::with_capacity(AT_ONCE);
            for sensor in some {
                let (reply, vitals) = oneshot::channel();
                if sensor.commands.send(Command::Status(reply)).await.is_ok() {
                    asked.push(vitals);
                }
            }
            for vitals in asked {
                all.extend(vitals.await.ok());
            }
        }
        let is_whole = all.len() == sensors.len();
        (all, is_whole)
    }

    /// Every sensor's current status, and whether every sensor answered.
    pub(crate) async fn statuses(&self) -> (Vec<Status>, bool) {
        let (vitals, is_whole) = self.vitals().await;
        let statuses = vitals.into_iter().map(|vitals| vitals.status);
        (statuses.collect(), is_whole)
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
    let mut calendar = Calendar::default();
    let mut frame_rate = FrameRate::default();
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
                    take(&mut pipeline, &mut recorder, Input::Context(context), super::now());
                    let _ = reply.send(());
                    continue;
                }
                Some(Command::Motion(placed, reply)) => {
                    let taken = take_positions(&mut pipeline, &mut recorder, &mut calendar, &placed);
                    // The client may have gone.
                    let _ = reply.send(taken);
                    continue;
                }
                Some(Command::Blackbox(reply)) => {
                    recorder.blackbox(reply);
                    continue;
                }
                Some(Command::Reload(sensor, hrn, next)) => {
                    recorder.reload(&pipeline, &sensor, &hrn, super::now());
                    link.reload(serial::Settings::of(&sensor));
                    let reloaded = pipeline.reload(*sensor, hrn);
                    reloaded.expect("a configuration that differs in what is fixed was refused");
                    recorder = next.unwrap_or(recorder);
                    answer(&mut pipeline, &mut taring);
                    frame_rate = FrameRate::default();
                    continue;
                }
                Some(Command::Finish) | None => {
                    let events = take(&mut pipeline, &mut recorder, Input::Shutdown, super::now());
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
                    Turn::Restored(changed) => {
                        log::line_settings(pipeline.sensor().name(), &changed);
                        continue;
                    }
                    Turn::Stranger(address) => {
                        log::stranger(pipeline.sensor().name(), address);
                        continue;
                    }
                };
                take(&mut pipeline, &mut recorder, input, at)
            }
            () = maybe::until(deadline.map(moment)) => take(&mut pipeline, &mut recorder, Input::Tick, super::now()),
        };
        let kinds = events.iter().map(Event::kind);
        let frames = kinds.filter(|&kind| kind == Kind::Frame).count();
        if frames > 0 {
            link.proven();
            let configured_hz = pipeline.sensor().description().frame_rate_hz;
            let slow_hz = pipeline.slow_rate_hz();
            let now = super::now().mono;
            let differs = frame_rate.differs(frames as u32, now, configured_hz, slow_hz);
            if let Some(measured_hz) = differs {
                log::frame_rate(pipeline.sensor().name(), configured_hz, measured_hz);
            }
        }
        answer(&mut pipeline, &mut taring);
        for failed in pipeline.unjudged() {
            log::unjudged(&failed);
            unjudged += 1;
        }
        hub.publish(events).await;
    }
}

/// Records an input, then passes it on to the pipeline.
fn take(
    pipeline: &mut Pipeline,
    recorder: &mut SensorRecorder,
    input: Input<'_>,
    at: Stamp,
) -> Vec<Event> {
    recorder.note(pipeline, &input, at);
    pipeline.take(input, at)
}

/// Records positions of the arm and passes them on to the pipeline. If this machine's calendar
/// clock was set since the last positions with calendar times, the pipeline learns that first.
fn take_positions(
    pipeline: &mut Pipeline,
    recorder: &mut SensorRecorder,
    calendar: &mut Calendar,
    placed: &Placed,
) -> Result<(), StepBack> {
    if let Some(set) = placed.converted.and_then(|now| calendar.set(now)) {
        log::clock_set(pipeline.sensor().name(), set.by_ms);
        take(
            pipeline,
            recorder,
            Input::ClockSet(set.until_ns),
            super::now(),
        );
    }
    let input = Input::Motion(placed.points.as_slice().into());
    recorder.note(pipeline, &input, super::now());
    pipeline.add_positions(&placed.points)
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
        contact_threshold_n: pipeline.sensor().thresholds().contact_threshold_n,
        unjudged,
        motion: pipeline.motion_counts(),
    }
}

/// The moment of a time of CLOCK_MONOTONIC, which is also the runtime's clock.
fn moment(mono: Duration) -> Instant {
    Instant::now() + mono.saturating_sub(super::now().mono)
}

#[cfg(test)]
mod tests {
    use jiff::{SignedDuration, Timestamp};
    use serde_json::json;

    use super::*;
    use crate::daemon::request::{Request, motion, parse};
    use hardnessd_core::frame::RawFrame;
    use hardnessd_core::pipeline::Clock;
    use hardnessd_core::test_support as tests;

    /// The approach at each frame of the presses that [`pressed`] makes. The robot moves at 20 mm/s
    /// and sends a line every 20 ms, with calendar times or with those of CLOCK_MONOTONIC. At 2 s
    /// this machine's calendar clock is set by `set_ms`. The robot's own clock stays.
    fn approaches(by_calendar: bool, set_ms: i64) -> Vec<(u64, Option<f64>)> {
        let mut pipeline = Pipeline::new(tests::sensor(), tests::hrn(), Clock::Arrival);
        let (mut recorder, mut calendar) = (SensorRecorder::default(), Calendar::default());
        let mut found = Vec::new();
        for ms in (0..6_000_u64).step_by(20) {
            let by_robot = Timestamp::UNIX_EPOCH + SignedDuration::from_millis(ms.cast_signed());
            let set = if ms < 2_000 { 0 } else { set_ms };
            let now = Stamp {
                mono: Duration::from_millis(5_000_000 + ms),
                wall: by_robot + SignedDuration::from_millis(set),
            };
            let moment = if by_calendar {
                json!(by_robot.to_string())
            } else {
                json!(now.mono.as_nanos() as u64)
            };
            let line = json!({"motion": {"sensor": "forearm", "at": [[moment, 0.02 * ms as f64]]}});
            let request = parse(line.to_string().as_bytes()).request;
            let Ok(Request::Motion(motion)) = request else {
                panic!("{request:?}");
            };
            let placed = motion::placed(&motion.points, now).unwrap();
            // Points after a step back are taken in too.
            let _ = take_positions(&mut pipeline, &mut recorder, &mut calendar, &placed);
            if ms % 200 != 0 {
                continue;
            }
            let mut raw = RawFrame::default();
            if pressed(ms) {
                raw.counts[300..336].fill(60);
            }
            let mut bytes = Vec::new();
            pipeline.sensor().layout().encode(&raw, &mut bytes);
            for event in pipeline.push(&bytes, now) {
                if let Event::Frame(frame) = event
                    && pressed(ms)
                {
                    found.push((ms, frame.approach_mm));
                }
            }
        }
        found
    }

    /// There are two presses.
    fn pressed(ms: u64) -> bool {
        (1_400..3_000).contains(&ms) || (4_000..5_000).contains(&ms)
    }

    #[test]
    fn a_calendar_clock_that_is_set_in_a_press_makes_its_approach_unknown_and_no_other() {
        // 20 ms are the distance of two points.
        for (by_calendar, set_ms, is_unknown) in [
            (true, 0, false),
            (false, -200, false),
            (true, 1, false),
            (true, -200, true),
            (true, 15, true),
            (true, 200, true),
        ] {
            for (ms, approach_mm) in approaches(by_calendar, set_ms) {
                let case = format!("{approach_mm:?} at {ms} ms, set by {set_ms} ms");
                match ms {
                    2_000..3_000 if is_unknown => assert_eq!(approach_mm, None, "{case}"),
                    // The first position after the begin may come later.
                    4_000..4_400 if set_ms != 0 => {}
                    _ => {
                        let begin = if ms < 4_000 { 1_400 } else { 4_000 };
                        let way_mm = 0.02 * (ms - begin) as f64;
                        // The newest position may be as old as the setting is large.
                        let lag_mm = 0.02 * set_ms.unsigned_abs() as f64;
                        let found = approach_mm.expect(&case);
                        assert!((found - way_mm).abs() <= lag_mm + 1e-6, "{case}");
                    }
                }
            }
        }
    }
}
