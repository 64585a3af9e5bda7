//! The arm of `hardnessd simulate --arm`, which a controller moves against a simulated object.
//!
//! In: lines of JSON on a Unix socket, of one controller at a time. Out: an answer to each line, and
//! the frames of the sensor on the arm, computed at the moments that they show. The arm stops when its
//! controller goes, and when the sensor bears [`STOP_N`].

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt as _;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::player::Played;
use crate::daemon;
use crate::daemon::accept::Listener;
use crate::daemon::lines::lines;
use crate::daemon::socket::Socket;
use crate::thread::NoThread;
use hardnessd_core::event::round_3;
use hardnessd_core::range::{self, OutOfRange};
use hardnessd_core::stderr_line;
use hardnessd_simulator::{Rig, SequenceSettings, Touched};

/// The time between the moment that a frame shows and its first byte: a sensor needs some to scan its
/// taxels, and here it hides the time that a step of the physics takes.
pub(crate) const SCAN: Duration = Duration::from_millis(10);

/// The greatest position, in mm.
const REACH_MM: f64 = 30.0;
/// The greatest speed, and the speed until a controller names another one.
const FASTEST_MM_S: f64 = 20.0;
const SPEED_MM_S: f64 = 5.0;
/// The force at which the arm stops by itself, as robots do to protect what they touch.
const STOP_N: f64 = 50.0;
/// The longest step of the physics.
const LONGEST_STEP_S: f64 = 0.05;
/// The longest line of a controller.
const LONGEST_LINE_BYTES: usize = 4096;

/// A simulated arm, at rest before its first object.
#[derive(Debug)]
pub(crate) struct Arm {
    socket: Socket,
    state: Arc<watch::Sender<State>>,
}

/// What the controller's side and the physics share.
#[derive(Debug, Clone, Copy)]
struct State {
    leg: Leg,
    /// The object that the controller wants, and how many it has wanted before.
    object: u32,
    placements: u32,
    /// The object that is there. `None` until the first step with it.
    touched: Option<Touched>,
}

/// A movement at a steady speed.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from_mm: f64,
    start: Instant,
    to_mm: f64,
    speed_mm_s: f64,
}

impl Leg {
    fn mm(&self, at: Instant) -> f64 {
        let most_mm = self.speed_mm_s * (at - self.start).as_secs_f64();
        self.from_mm + (self.to_mm - self.from_mm).clamp(-most_mm, most_mm)
    }

    fn stop(&mut self, at: Instant) {
        self.to_mm = self.mm(at);
    }
}

/// A line of the controller. Every part may be missing.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    /// Where to go.
    to_mm: Option<f64>,
    /// How fast, from now on.
    speed_mm_s: Option<f64>,
    /// The object to put in front of the sensor.
    object: Option<u32>,
}

impl Order {
    fn read(line: &[u8]) -> Result<Self, String> {
        let order: Self = serde_json::from_slice(line).map_err(|error| error.to_string())?;
        order.check().map_err(|error| error.to_string())?;
        Ok(order)
    }

    fn check(&self) -> Result<(), OutOfRange> {
        range::within("to_mm", self.to_mm.unwrap_or(0.0), (0.0, REACH_MM), "")?;
        let speed_mm_s = self.speed_mm_s.unwrap_or(SPEED_MM_S);
        range::within("speed_mm_s", speed_mm_s, (0.1, FASTEST_MM_S), "")?;
        range::check("object", 0, self.object != Some(0), "a number from 1")
    }
}

impl Arm {
    /// Listens at `path`.
    ///
    /// # Errors
    ///
    /// Fails as [`Socket::bind`] does.
    pub(crate) fn bind(path: &Path) -> Result<Self, daemon::Error> {
        let state = State {
            leg: Leg {
                from_mm: 0.0,
                start: Instant::now(),
                to_mm: 0.0,
                speed_mm_s: SPEED_MM_S,
            },
            object: 1,
            placements: 0,
            touched: None,
        };
        Ok(Self {
            socket: Socket::bind("--arm", path, 0o600, None)?,
            state: Arc::new(watch::Sender::new(state)),
        })
    }

    /// Where the arm is at a moment, for the robot that reports it.
    pub(crate) fn position(&self) -> impl Fn(Instant) -> Option<f64> + use<> {
        let state = self.state.subscribe();
        move |at| Some(state.borrow().leg.mm(at))
    }

    /// The frames of the sensor, the first of which shows the moment `start`.
    ///
    /// # Errors
    ///
    /// Fails if the system has no thread to compute them on.
    pub(crate) fn frames(
        &self,
        settings: SequenceSettings,
        start: Instant,
    ) -> Result<mpsc::Receiver<Played>, NoThread> {
        let (frames, played) = mpsc::channel(1);
        let state = Arc::clone(&self.state);
        let thread = std::thread::Builder::new();
        thread.spawn(move || simulate(&state, settings, start, &frames))?;
        Ok(played)
    }

    /// Obeys one controller after the other, for ever.
    pub(crate) async fn serve(mut self) {
        loop {
            let served = match self.socket.accept().await {
                Ok(controller) => self.obey(controller).await,
                Err(error) => Err(error),
            };
            let now = Instant::now();
            self.state.send_modify(|state| state.leg.stop(now));
            if let Err(error) = served {
                stderr_line!("warning: --arm: {error}");
                tokio::time::sleep(SCAN).await;
            }
        }
    }

    async fn obey(&self, controller: UnixStream) -> io::Result<()> {
        let (input, mut output) = controller.into_split();
        let mut lines = lines(input, LONGEST_LINE_BYTES);
        while let Some(line) = lines.next().await {
            let line = line.map_err(io::Error::other)?;
            let answer = match Order::read(&line) {
                Ok(order) => self.take(order).await,
                Err(error) => json!({"error": error}),
            };
            let answer = format!("{answer}\n");
            // A controller need not wait for an answer, and may have gone.
            if output.write_all(answer.as_bytes()).await.is_err() {
                break;
            }
        }
        Ok(())
    }

    /// Takes an order, and answers with the state. An order that is refused changes nothing.
    async fn take(&self, order: Order) -> Value {
        let now = Instant::now();
        let at_mm = self.state.borrow().leg.mm(now);
        if order.object.is_some() && at_mm > 0.0 {
            let found = format!("object: found the arm at {} mm", round_3(at_mm));
            return json!({"error": format!("{found}, expected 0: withdraw it first")});
        }
        self.state.send_modify(|state| {
            let leg = &mut state.leg;
            *leg = Leg {
                from_mm: leg.mm(now),
                start: now,
                to_mm: order.to_mm.unwrap_or(leg.to_mm),
                speed_mm_s: order.speed_mm_s.unwrap_or(leg.speed_mm_s),
            };
            if let Some(object) = order.object {
                state.object = object;
                state.placements = state.placements.wrapping_add(1);
                state.touched = None;
            }
        });
        let mut state = self.state.subscribe();
        let state = *state
            .wait_for(|state| state.touched.is_some())
            .await
            .expect("this arm holds the sender");
        let touched = state.touched.expect("waited for");
        json!({
            "at_mm": round_3(state.leg.mm(Instant::now())),
            "to_mm": round_3(state.leg.to_mm),
            "speed_mm_s": state.leg.speed_mm_s,
            "truth": {
                "object": touched.object,
                "material": touched.material.name(),
                "level": touched.material.level(),
                "shore": round_3(touched.shore),
                "force_n": round_3(touched.force_n),
                "greatest_n": round_3(touched.greatest_n),
            },
        })
    }
}

/// Steps the physics in time with the clock, until nobody takes the frames. A step that comes too late
/// is left out, with its frame, so that a frame never shows an old position.
fn simulate(
    state: &watch::Sender<State>,
    settings: SequenceSettings,
    start: Instant,
    frames: &mpsc::Sender<Played>,
) {
    let period_s = 1.0 / settings.frame_rate_hz;
    let steps_a_frame = (period_s / LONGEST_STEP_S).ceil() as u32;
    let step = Duration::from_secs_f64(period_s / f64::from(steps_a_frame));
    let mut rig = Rig::new(settings);
    let mut placements = 0;
    let mut last = start;
    let mut number = 0;
    loop {
        let at = start + step * number;
        std::thread::sleep(at.saturating_duration_since(Instant::now()));
        let wanted = *state.borrow();
        if wanted.placements != placements {
            placements = wanted.placements;
            rig.place(wanted.object);
        }
        rig.move_to(wanted.leg.mm(at), (at - last).as_secs_f64());
        last = at;
        let touched = rig.touched();
        state.send_modify(|state| {
            if touched.force_n > STOP_N && state.leg.to_mm > state.leg.mm(at) {
                state.leg.stop(at);
            }
            if state.placements == placements {
                state.touched = Some(touched);
            }
        });
        if number.is_multiple_of(steps_a_frame) {
            let frame = Played {
                number: number / steps_a_frame,
                raw: rig.read(),
                approach: None,
            };
            if frames.blocking_send(frame).is_err() {
                return;
            }
        }
        let late = Instant::now().saturating_duration_since(at);
        number += 1 + (late.as_secs_f64() / step.as_secs_f64()) as u32;
    }
}
