//! What is known of each sensor and how old it is: lines in, answers at a moment.
//!
//! A moment is a [`Duration`] on CLOCK_MONOTONIC; that of an event is when it happened, not when it
//! was read, so what lay in a queue is as old as it is. Nothing here has a clock or does I/O.

use std::collections::VecDeque;
use std::time::Duration;

use serde_json::Value;

use crate::event::PROTOCOL;
use crate::frame::{COLS, ROWS, Stamp, TAXELS};

/// How far back the curves go.
pub(super) const WINDOW: Duration = Duration::from_secs(30);

/// How often the daemon is asked for the totals, which it tells by itself only with a change.
pub(super) const QUESTION: Duration = Duration::from_secs(1);

/// A daemon that has answered nothing for three questions is taken for dead.
const SILENCE: Duration = Duration::from_secs(3);

/// Verdicts kept of a sensor: more than a tall terminal shows.
const VERDICTS: usize = 100;

/// A value is current for so many periods after its frame (contract, section 5).
const PERIODS: f64 = 2.5;

/// All that is shown.
#[derive(Debug)]
pub(super) struct View {
    /// Of the daemon that was met last.
    pub(super) hello: Option<Hello>,
    pub(super) sensors: Vec<Sensor>,
    /// Index of the sensor that is looked at.
    pub(super) chosen: usize,
    daemon: Daemon,
    /// When the daemon last said anything.
    heard: Duration,
    /// Events that it had no room for; `None`: their number is unknown.
    pub(super) missed: Option<u64>,
}

/// Whether there is a daemon.
#[derive(Debug, PartialEq, Eq)]
enum Daemon {
    /// There is none, and why.
    Absent(String),
    /// Something has taken the connection and not said what it is; why there was none before.
    Unknown(String),
    Met,
}

/// Who speaks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Hello {
    pub(super) robot: String,
    pub(super) version: String,
    run: String,
    /// First digits of the model's hash.
    pub(super) model: String,
    pub(super) validation: String,
    /// Of the levels, in order.
    pub(super) labels: Vec<String>,
}

/// One sensor.
#[derive(Debug, Default)]
pub(super) struct Sensor {
    pub(super) name: String,
    pub(super) rows: usize,
    pub(super) cols: usize,
    pub(super) status: Option<Status>,
    /// Its last frame.
    pub(super) frame: Option<Frame>,
    trace: VecDeque<Load>,
    pub(super) press: Option<Press>,
    /// The newest first.
    pub(super) verdicts: VecDeque<Verdict>,
}

/// What the daemon says of a link.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Status {
    state: String,
    reason: Option<String>,
    pub(super) frames: u64,
    pub(super) frames_damaged: u64,
    pub(super) bytes_skipped: u64,
    pub(super) frame_rate_hz: Option<f64>,
}

/// The last frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Frame {
    pub(super) at: Duration,
    /// `[28, 28]`, newtons a taxel.
    newtons: Vec<f32>,
    pub(super) force_n: f32,
    pub(super) contact_area_taxels: u32,
}

/// A point of the curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Load {
    at: Duration,
    pub(super) force_n: f32,
    pub(super) contact_area_taxels: u32,
}

/// The last press.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Press {
    pub(super) at: Duration,
    pub(super) number: u64,
    pub(super) state: String,
    pub(super) reason: Option<String>,
}

/// A verdict.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Verdict {
    pub(super) at: Duration,
    pub(super) press: u64,
    pub(super) phase: String,
    /// Level and label; or why there are none.
    pub(super) level: Result<(u64, String), String>,
    pub(super) probabilities: Vec<f64>,
    pub(super) force_n: f64,
    pub(super) notes: Vec<String>,
}

/// Whether what is shown of a sensor is true now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Link {
    Live,
    Connecting,
    Stale,
    Lost,
    /// The daemon is there and says nothing.
    Silent,
    NoDaemon,
}

impl Link {
    pub(super) fn name(self) -> &'static str {
        match self {
            Link::Live => "LIVE",
            Link::Connecting => "CONNECTING",
            Link::Stale => "STALE",
            Link::Lost => "LOST",
            Link::Silent => "DAEMON SILENT",
            Link::NoDaemon => "NO DAEMON",
        }
    }
}

/// What the user asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Key {
    Quit,
    Redraw,
    Next,
    Previous,
    /// A sensor by its index.
    Sensor(usize),
}

/// How a daemon was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Loss {
    /// It closed the connection.
    Closed,
    /// It cannot be reached, and why.
    Unreachable(String),
}

impl View {
    /// Nothing is known yet.
    pub(super) fn new() -> Self {
        Self {
            hello: None,
            sensors: Vec::new(),
            chosen: 0,
            daemon: Daemon::Absent("connecting".to_owned()),
            heard: Duration::ZERO,
            missed: Some(0),
        }
    }

    /// Takes in a line of the daemon, read at `now`. What it does not know it passes over.
    pub(super) fn hear(&mut self, line: &str, now: Stamp) {
        let Ok(event) = serde_json::from_str::<Value>(line) else {
            return;
        };
        self.heard = now.mono;
        match text(&event, "type").as_str() {
            "hello" => self.meet(&event),
            "gap" => {
                let lost = event["lost"].as_u64();
                self.missed = self.missed.zip(lost).map(|(sum, lost)| sum + lost);
            }
            // Before a hello: there is no room.
            "error" if self.daemon != Daemon::Met => {
                self.daemon = Daemon::Absent(text(&event, "message"));
            }
            kind => {
                let name = text(&event, "sensor");
                let at = moment(&event, now);
                if let Some(sensor) = self.sensors.iter_mut().find(|one| one.name == name) {
                    sensor.hear(kind, &event, at);
                }
            }
        }
    }

    /// Something has taken the connection at `now`: it is given as long to say what it is as a
    /// daemon to answer.
    pub(super) fn wait(&mut self, now: Duration) {
        self.heard = now;
        self.daemon = Daemon::Unknown(self.absence().to_owned());
    }

    fn meet(&mut self, event: &Value) {
        let protocol = &event["protocol"];
        if *protocol != PROTOCOL {
            let reason = format!("found protocol {protocol}, expected {PROTOCOL}");
            self.daemon = Daemon::Absent(reason);
            return;
        }
        let hello = hello(event);
        // In another run numbers begin again, and nothing of the old one is known any more.
        if self
            .hello
            .as_ref()
            .is_none_or(|known| known.run != hello.run)
        {
            let name = self.sensors.get(self.chosen).map(|one| one.name.clone());
            self.sensors = items(event, "sensors").map(Sensor::new).collect();
            let again = self
                .sensors
                .iter()
                .position(|one| Some(&one.name) == name.as_ref());
            self.chosen = again.unwrap_or(0);
            self.missed = Some(0);
        }
        self.hello = Some(hello);
        self.daemon = Daemon::Met;
    }

    /// The daemon went away, or does not answer.
    pub(super) fn lose(&mut self, loss: Loss) {
        match loss {
            Loss::Unreachable(reason) => self.daemon = Daemon::Absent(reason),
            // Where it never said hello, why it did not is known already.
            Loss::Closed if matches!(self.daemon, Daemon::Absent(_)) => {}
            Loss::Closed => self.daemon = Daemon::Absent("it closed the connection".to_owned()),
        }
    }

    /// Does what the key asks for, if that is about sensors.
    pub(super) fn press(&mut self, key: Key) {
        let count = self.sensors.len().max(1);
        self.chosen = match key {
            Key::Next => (self.chosen + 1) % count,
            Key::Previous => (self.chosen + count - 1) % count,
            Key::Sensor(index) if index < count => index,
            Key::Sensor(_) | Key::Quit | Key::Redraw => self.chosen,
        };
    }

    /// The sensor that is looked at.
    pub(super) fn sensor(&self) -> Option<&Sensor> {
        self.sensors.get(self.chosen)
    }

    /// What holds for a sensor, and why.
    pub(super) fn link(&self, sensor: &Sensor, now: Duration) -> (Link, Option<String>) {
        if let Some((link, reason)) = self.trouble(now) {
            return (link, Some(reason));
        }
        let Some(status) = &sensor.status else {
            return (Link::Connecting, None);
        };
        let link = match status.state.as_str() {
            "live" => Link::Live,
            "stale" => Link::Stale,
            "lost" => Link::Lost,
            _ => Link::Connecting,
        };
        (link, status.reason.clone())
    }

    /// What keeps the daemon from telling of any sensor, and why.
    pub(super) fn trouble(&self, now: Duration) -> Option<(Link, String)> {
        let silence = now.saturating_sub(self.heard);
        match &self.daemon {
            Daemon::Absent(reason) => Some((Link::NoDaemon, reason.clone())),
            Daemon::Unknown(_) | Daemon::Met if silence > SILENCE => {
                Some((Link::Silent, format!("no answer for {}", age(silence))))
            }
            Daemon::Unknown(reason) => Some((Link::NoDaemon, reason.clone())),
            Daemon::Met => None,
        }
    }

    /// Why there is no daemon.
    fn absence(&self) -> &str {
        match &self.daemon {
            Daemon::Absent(reason) | Daemon::Unknown(reason) => reason,
            Daemon::Met => "",
        }
    }
}

impl Sensor {
    fn new(card: &Value) -> Self {
        let size = |key, most: usize| {
            let size = card[key]
                .as_u64()
                .and_then(|size| usize::try_from(size).ok());
            size.unwrap_or(most).clamp(1, most)
        };
        Self {
            name: text(card, "name"),
            rows: size("rows", ROWS),
            cols: size("cols", COLS),
            ..Self::default()
        }
    }

    fn hear(&mut self, kind: &str, event: &Value, at: Duration) {
        match kind {
            "status" => {
                self.status = Some(Status {
                    state: text(event, "state"),
                    reason: event["reason"].as_str().map(plain),
                    frames: number(event, "frames"),
                    frames_damaged: number(event, "frames_damaged"),
                    bytes_skipped: number(event, "bytes_skipped"),
                    frame_rate_hz: event["frame_rate_hz"].as_f64(),
                });
            }
            "press" => {
                self.press = Some(Press {
                    at,
                    number: number(event, "press"),
                    state: text(event, "state"),
                    reason: event["reason"].as_str().map(plain),
                });
            }
            "hardness" => self.judge(event, at),
            "frame" => self.show(event, at),
            _ => {}
        }
    }

    fn judge(&mut self, event: &Value, at: Duration) {
        let level = match event["level"].as_u64() {
            Some(level) => Ok((level, text(event, "label"))),
            None => Err(text(event, "rejected").replace('_', " ")),
        };
        let verdict = Verdict {
            at,
            press: number(event, "press"),
            phase: text(event, "phase"),
            level,
            probabilities: items(event, "probabilities")
                .filter_map(Value::as_f64)
                .collect(),
            force_n: event["force_n"].as_f64().unwrap_or_default(),
            notes: items(event, "notes")
                .filter_map(Value::as_str)
                .map(|note| plain(note).replace('_', " "))
                .collect(),
        };
        // Asked for after a break of the connection, the last one may be known.
        let is_same =
            |known: &Verdict| (known.press, &known.phase) == (verdict.press, &verdict.phase);
        if !self.verdicts.iter().any(is_same) {
            self.verdicts.push_front(verdict);
            self.verdicts.truncate(VERDICTS);
        }
    }

    fn show(&mut self, event: &Value, at: Duration) {
        let newtons: Vec<f32> = items(event, "newtons")
            .filter_map(Value::as_f64)
            .map(|newtons| newtons as f32)
            .collect();
        if newtons.len() != TAXELS {
            return;
        }
        let load = Load {
            at,
            force_n: newtons.iter().sum(),
            contact_area_taxels: u32::try_from(number(event, "contact_area_taxels"))
                .unwrap_or_default(),
        };
        while self
            .trace
            .front()
            .is_some_and(|first| first.at + WINDOW < at)
        {
            self.trace.pop_front();
        }
        self.trace.push_back(load);
        self.frame = Some(Frame {
            at,
            newtons,
            force_n: load.force_n,
            contact_area_taxels: load.contact_area_taxels,
        });
    }

    /// Newtons of the taxel at a row and column of the sensor's own array in the last frame: smaller
    /// arrays sit in the middle of the 28x28 (contract, section 3).
    pub(super) fn newtons(&self, row: usize, col: usize) -> Option<f32> {
        let (top, left) = ((ROWS - self.rows) / 2, (COLS - self.cols) / 2);
        let frame = self.frame.as_ref()?;
        (row < self.rows && col < self.cols).then(|| frame.newtons[(top + row) * COLS + left + col])
    }

    /// The course of `value` up to `now` in so many equal spans, the greatest of each; `None` where
    /// no frame was current.
    pub(super) fn curve(
        &self,
        now: Duration,
        spans: usize,
        value: impl Fn(&Load) -> f32,
    ) -> Vec<Option<f32>> {
        let span = WINDOW.as_secs_f64() / spans.max(1) as f64;
        let begin = now.as_secs_f64() - WINDOW.as_secs_f64();
        let rate_hz = self.status.as_ref().and_then(|status| status.frame_rate_hz);
        let mut curve = vec![None; spans];
        let mut held: Vec<Option<f32>> = vec![None; spans];
        for load in &self.trace {
            let place = (load.at.as_secs_f64() - begin) / span;
            if place >= 0.0 && (place as usize) < spans {
                let cell: &mut Option<f32> = &mut curve[place as usize];
                *cell = Some(cell.map_or(value(load), |most| most.max(value(load))));
            }
            // It stands for the spans after it, for as long as it is current.
            let current = rate_hz.map_or(0.0, |hz| PERIODS / hz / span);
            let first = place.max(0.0) as usize;
            let last = (place + current).max(0.0) as usize;
            for cell in held.iter_mut().take(last).skip(first) {
                *cell = Some(value(load));
            }
        }
        let filled = curve.into_iter().zip(held);
        filled.map(|(own, held)| own.or(held)).collect()
    }

    /// The greatest taxel of the last frame.
    pub(super) fn highest_n(&self) -> f32 {
        let newtons = self.frame.iter().flat_map(|frame| &frame.newtons);
        newtons.copied().fold(0.0, f32::max)
    }
}

fn hello(event: &Value) -> Hello {
    let model = &event["model"];
    let sha256 = text(model, "sha256");
    Hello {
        robot: text(event, "robot"),
        version: text(event, "version"),
        run: text(event, "run"),
        model: sha256.get(..12).unwrap_or(&sha256).to_owned(),
        validation: text(model, "validation"),
        labels: items(model, "levels")
            .map(|level| text(level, "label"))
            .collect(),
    }
}

/// When it happened. Daemon and viewer share a machine and its clocks.
fn moment(event: &Value, now: Stamp) -> Duration {
    let time = text(event, "time").parse::<jiff::Timestamp>();
    let past = time.map(|time| now.wall.duration_since(time));
    let past = past.ok().and_then(|past| Duration::try_from(past).ok());
    now.mono.saturating_sub(past.unwrap_or_default())
}

/// How long ago, to be read at a glance.
pub(super) fn age(age: Duration) -> String {
    let seconds = age.as_secs_f64();
    match seconds {
        ..10.0 => format!("{seconds:.1} s"),
        ..120.0 => format!("{seconds:.0} s"),
        ..7200.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.0} h", seconds / 3600.0),
    }
}

fn items<'a>(event: &'a Value, key: &str) -> impl Iterator<Item = &'a Value> {
    event[key].as_array().into_iter().flatten()
}

fn number(event: &Value, key: &str) -> u64 {
    event[key].as_u64().unwrap_or_default()
}

fn text(event: &Value, key: &str) -> String {
    event[key].as_str().map(plain).unwrap_or_default()
}

/// A reason comes from the system, a label from a model file: neither may move the cursor.
fn plain(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).collect()
}
