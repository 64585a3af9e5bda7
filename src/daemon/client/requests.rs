//! What a connection asks for: queries, and commands that change something.
//!
//! In: a request. Out: the lines of its answer, of which the last is `ok` or `error`.

use std::path::PathBuf;
use std::sync::Arc;

use serde_json::Value;
use tokio::sync::oneshot;

use super::Service;
use crate::daemon::hub::Line;
use crate::daemon::now;
#[cfg(feature = "ros2")]
use crate::daemon::request::motion::ReportedPoint;
use crate::daemon::request::motion::{self, Positions};
use crate::daemon::request::{self, Context, Query, Request};
use crate::daemon::sensor::{Command, SensorHandle, Sensors};
use hardnessd_core::event::{Reply, Tared};
use hardnessd_core::pipeline::Input;

/// The reason a request is answered with an `error`, in words: nobody tells reasons apart.
pub(in crate::daemon) type Refused = String;

/// The key of a sensor's name in a request with positions.
const MOTION_KEY: &str = "motion.sensor";

/// The content of an `ok`.
#[derive(Default)]
pub(super) struct Done {
    tare: Option<Tared>,
    blackbox: Option<PathBuf>,
}

/// The answer to a query or a command.
pub(super) async fn answer(
    service: &Service,
    request: Result<Request, Refused>,
    id: Option<Value>,
) -> Vec<Arc<Line>> {
    let mut lines = Vec::new();
    let done = match request {
        Ok(Request::Get(query)) => {
            let now = service.hub.snapshot().await;
            match query {
                Query::Status => lines.extend(now.statuses()),
                Query::Last => lines.extend(now.sensors.into_iter().filter_map(|one| one.last)),
            }
            Ok(Done::default())
        }
        Ok(request) => change(service.control.as_ref(), request).await,
        Err(unusable) => Err(unusable),
    };
    lines.push(end(done, id));
    lines
}

/// The last line of an answer.
pub(super) fn end(done: Result<Done, Refused>, id: Option<Value>) -> Arc<Line> {
    Line::reply(&match done {
        Ok(Done { tare, blackbox }) => Reply::Ok {
            id,
            tare,
            blackbox: blackbox.map(|path| path.display().to_string()),
        },
        Err(message) => Reply::Error { message, id },
    })
}

/// Carries out a request that changes something. Of all sockets, only the control socket may.
async fn change(sensors: Option<&Sensors>, request: Request) -> Result<Done, Refused> {
    let Some(sensors) = sensors else {
        return Err("this socket changes nothing: send it to the control socket".to_owned());
    };
    let mut done = Done::default();
    match request {
        Request::Tare(sensor) => {
            let tared = ask(sensors, "tare", &sensor, Command::Tare).await?;
            done.tare = Some(tared.map_err(|error| format!("tare: {error}"))?);
        }
        Request::Context(context) => set_context(sensors, context).await?,
        Request::Motion(Positions { sensor, points }) => {
            // Read the clocks now, because the sensor's task may have other work to do first.
            let input = Input::Motion(motion::placed(&points, now())?);
            ask(sensors, MOTION_KEY, &sensor, |reply| {
                Command::Take(input, reply)
            })
            .await??;
        }
        Request::Blackbox(sensor) => {
            let written = ask(sensors, "blackbox", &sensor, Command::Blackbox).await?;
            done.blackbox = Some(written.map_err(|error| format!("blackbox: {error}"))?);
        }
        // They change nothing.
        Request::Subscribe(_) | Request::Get(_) => {}
    }
    Ok(done)
}

/// Sets the context of a sensor.
pub(in crate::daemon) async fn set_context(
    sensors: &Sensors,
    Context { sensor, context }: Context,
) -> Result<(), Refused> {
    let command = |reply| Command::Take(Input::Context(context), reply);
    ask(sensors, "context.sensor", &sensor, command).await?
}

/// Passes positions of the arm on to the task of their sensor, without waiting. If the task refuses them, it
/// logs that.
#[cfg(feature = "ros2")]
pub(in crate::daemon) fn try_move_arm(
    sensors: &Sensors,
    sensor: &str,
    points: &[ReportedPoint],
) -> Result<(), Refused> {
    let found = find(sensors, MOTION_KEY, sensor)?;
    let (reply, _) = oneshot::channel();
    let command = Command::Take(Input::Motion(motion::placed(points, now())?), reply);
    let sent = found.commands.try_send(command);
    sent.map_err(|_| "they come too fast".to_owned())
}

/// Passes a command on to the sensor called `name`, and waits for the answer. `key` is the request's
/// key for that name.
async fn ask<T>(
    sensors: &Sensors,
    key: &str,
    name: &str,
    command: impl FnOnce(oneshot::Sender<T>) -> Command,
) -> Result<T, Refused> {
    let sensor = find(sensors, key, name)?;
    let (reply, answer) = oneshot::channel();
    // An answer that does not come is dropped by a sensor's task that ends, or by a recorder whose
    // queue is full.
    let _ = sensor.commands.send(command(reply)).await;
    answer
        .await
        .map_err(|_| format!("{key}: the daemon is stopping, or has no time for it"))
}

fn find<'a>(sensors: &'a Sensors, key: &str, name: &str) -> Result<&'a SensorHandle, Refused> {
    let found = sensors.iter().find(|sensor| sensor.name == name);
    found.ok_or_else(|| {
        let names: Vec<&str> = sensors.iter().map(|sensor| sensor.name.as_str()).collect();
        request::unusable(key, name, &format!("one of {}", names.join(", ")))
    })
}
