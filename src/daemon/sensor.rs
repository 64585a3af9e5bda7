//! The task of one sensor, which connects the sensor's port, its pipeline and the hub.
//!
//! The task waits for the port, the pipeline's deadline or a command. Then it makes one call into
//! the pipeline and sends the events to the hub. It shares nothing, so a sensor that is lost does
//! not disturb the others.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use super::frame_rate::FrameRate;
use super::hub::Hub;
use super::log;
use super::own::Store;
use super::record::{NoBlackbox, SensorRecorder};
use super::request::motion::{Calendar, Placed};
use super::serial::{Source, Turn};
use crate::maybe;
use hardnessd_core::event::{Event, Phase, Status, Tared};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::StepBack;
use hardnessd_core::pipeline::{Input, Pipeline, Refused};
use hardnessd_core::port::Port;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::RetareError;
use hardnessd_core::verdict::Hrn;
use hardnessd_core::wire::is_telnet;

/// A command to a sensor's task.
#[derive(Debug)]
pub(crate) enum Command {
    /// Take another tare. The answer comes when the tare is taken, refused or abandoned.
    Tare(oneshot::Sender<Result<Tared, RetareError>>),
    /// Repeat the controller's context in events. The answer comes when the pipeline has the
    /// context.
    Context(Option<Value>, oneshot::Sender<()>),
    /// Take positions of the arm that the robot reports. The answer comes when they are taken.
    Motion(Placed, oneshot::Sender<Result<(), StepBack>>),
    /// Write the last minute to a file. The answer is the path of the file.
    Blackbox(oneshot::Sender<Result<PathBuf, NoBlackbox>>),
    /// Judge with another model from the next rest on. Of the sensor's tables, only `[model]` may differ.
    Model(Box<Sensor>, Arc<Hrn>),
    /// Record with another recorder.
    Recorder(SensorRecorder),
    /// End the task. A press under way is aborted, and no further event follows.
    Finish,
}

/// A sensor without its port: what its task begins with, and what is left of it at the end.
#[derive(Debug)]
pub(crate) struct SensorCore {
    pub(crate) pipeline: Pipeline,
    pub(crate) recorder: SensorRecorder,
    /// The number of verdicts since the start that are missing because the model failed.
    pub(crate) unjudged: u64,
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
}

/// Serves one sensor until [`Command::Finish`]. Returns what is left of it, which is no longer in
/// `link`.
pub(crate) async fn serve(
    core: SensorCore,
    mut link: Source,
    (hub, store): (Hub, Store),
    mut commands: mpsc::Receiver<Command>,
) -> SensorCore {
    // The client that waits for the outcome of a tare.
    let mut taring = None;
    let SensorCore {
        mut pipeline,
        mut recorder,
        mut unjudged,
    } = core;
    let mut calendar = Calendar::default();
    let mut frame_rate = FrameRate::default();
    let mut frames = pipeline.frame_counts().0;
    // The model that judges from the next rest on.
    let mut next_model = None;
    // Whether nothing came since the port was opened.
    let mut is_new = false;
    loop {
        if pipeline.is_at_rest()
            && let Some((sensor, hrn)) = next_model.take()
            && let Some(judging) = pipeline.with_model(sensor, hrn)
        {
            pipeline = judging;
            recorder.begin_anew(&pipeline, super::now());
        }
        hub.report(state(&pipeline, unjudged));
        // A sensor that never pauses leaves the others their turns.
        tokio::task::yield_now().await;
        let deadline = pipeline.deadline();
        let events = tokio::select! {
            // The selection is not biased: the task must still obey `Finish` if the sensor never
            // pauses, and still read its port if commands never pause.
            command = commands.recv() => match command {
                Some(Command::Tare(reply)) => {
                    match take(&mut pipeline, &mut recorder, Input::Tare, super::now()) {
                        Err(Refused::Tare(refusal)) => {
                            log::tare(pipeline.sensor().name(), &Err(refusal));
                            let _ = reply.send(Err(refusal));
                        }
                        _ => taring = Some(reply),
                    }
                    continue;
                }
                Some(Command::Context(context, reply)) => {
                    log::context(pipeline.sensor().name(), context.as_ref());
                    let input = Input::Context(context);
                    taken(&mut pipeline, &mut recorder, input, super::now());
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
                Some(Command::Model(sensor, hrn)) => {
                    next_model = Some((*sensor, hrn));
                    continue;
                }
                Some(Command::Recorder(next)) => {
                    recorder.replace(next);
                    continue;
                }
                Some(Command::Finish) | None => {
                    let events = taken(&mut pipeline, &mut recorder, Input::Shutdown, super::now());
                    hub.publish(events);
                    link.close().await;
                    return SensorCore {
                        pipeline,
                        recorder,
                        unjudged,
                    };
                }
            },
            turn = link.turn() => {
                let at = super::now();
                if let Turn::Bytes(bytes) = &turn
                    && std::mem::take(&mut is_new)
                    && is_telnet(bytes)
                    && !matches!(pipeline.sensor().description().sensor.port, Port::Device(_))
                {
                    log::telnet(pipeline.sensor().name());
                }
                is_new |= matches!(turn, Turn::Opened);
                let input = match turn {
                    Turn::Bytes(bytes) => Input::Bytes(bytes.to_vec()),
                    Turn::Skipped(bytes) => Input::Skipped(bytes),
                    Turn::Opened => Input::Opened,
                    Turn::Unavailable(reason) => Input::Unavailable(reason),
                    Turn::Lost(reason) => Input::Lost(reason),
                    Turn::Stranger(address) => {
                        log::stranger(pipeline.sensor().name(), address);
                        continue;
                    }
                };
                taken(&mut pipeline, &mut recorder, input, at)
            }
            () = maybe::until(deadline.map(moment)) => {
                taken(&mut pipeline, &mut recorder, Input::Tick, super::now())
            }
        };
        let before = std::mem::replace(&mut frames, pipeline.frame_counts().0);
        if frames > before {
            link.proven();
            let configured_hz = pipeline.sensor().frame_rate_hz();
            let now = super::now().mono;
            let differs = frame_rate.differs((frames - before) as u32, now, configured_hz);
            if let Some(measured_hz) = differs {
                log::frame_rate(pipeline.sensor().name(), configured_hz, measured_hz);
            }
        }
        answer(&mut pipeline, &mut taring);
        for failed in pipeline.unjudged() {
            hub.unjudged(&failed);
            unjudged += 1;
        }
        let is_final =
            |event: &Event| matches!(event, Event::Hardness(one) if one.phase == Phase::Final);
        let is_judged = events.iter().any(is_final);
        hub.publish(events);
        if is_judged {
            store.save(&pipeline);
        }
    }
}

/// Records an input, then passes it on to the pipeline.
fn take(
    pipeline: &mut Pipeline,
    recorder: &mut SensorRecorder,
    input: Input,
    at: Stamp,
) -> Result<Vec<Event>, Refused> {
    recorder.note(pipeline, &input, at);
    pipeline.take(input, at)
}

/// The same for an input that is never refused.
fn taken(
    pipeline: &mut Pipeline,
    recorder: &mut SensorRecorder,
    input: Input,
    at: Stamp,
) -> Vec<Event> {
    let taken = take(pipeline, recorder, input, at);
    taken.expect("only a tare and positions of the arm can be refused")
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
        let input = Input::ClockSet(set.until_ns);
        taken(pipeline, recorder, input, super::now());
    }
    let input = Input::Motion(placed.points.clone());
    match take(pipeline, recorder, input, super::now()) {
        Err(Refused::Motion(step_back)) => Err(step_back),
        _ => Ok(()),
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

/// The state of the sensor, which the hub has for everybody who asks.
pub(super) fn state(pipeline: &Pipeline, unjudged: u64) -> SensorState {
    // The hub sets the time of the status when somebody asks.
    let at = Stamp {
        mono: Duration::ZERO,
        wall: Timestamp::UNIX_EPOCH,
    };
    SensorState {
        status: pipeline.status(at),
        last_frame: pipeline.last_frame().map(|frame| frame.mono),
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
    use jiff::SignedDuration;
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
                raw.counts[300..336].fill(60.0);
            }
            let mut bytes = Vec::new();
            pipeline.sensor().layout().encode(&raw, &mut bytes);
            for event in pipeline.take(Input::Bytes(bytes), now).unwrap() {
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
