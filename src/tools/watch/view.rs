//! The state of each sensor and its age. In: lines of the daemon. Out: answers for a moment.
//!
//! A moment is a [`Duration`] on CLOCK_MONOTONIC. The moment of an event is when it happened, not
//! when it was read, so time in a queue counts as age. Nothing here has a clock or does I/O.

mod sensor;

use std::time::Duration;

use jiff::SignedDuration;
use serde_json::{Value, json};

pub(super) use self::sensor::{Frame, Load, Sensor, WINDOW};
use crate::tools::answer::{items, labels};
use crate::tools::connect::WEB_SERVER;
use crate::tools::score::Truth;
use hardnessd_core::event::PROTOCOL;
use hardnessd_core::frame::Stamp;

/// The time between two requests for the totals. Without a request, the daemon sends them only when
/// the state changes.
pub(super) const QUESTION: Duration = Duration::from_secs(1);

/// After three questions without an answer, the daemon counts as dead.
const SILENCE: Duration = Duration::from_secs(3);

/// Everything that `watch` shows.
#[derive(Debug)]
pub(super) struct View {
    /// The `hello` of the last connection. Null before the first one.
    pub(super) hello: Value,
    /// The labels of the model's levels, in order.
    pub(super) labels: Vec<String>,
    pub(super) sensors: Vec<Sensor>,
    /// Index of the sensor that is shown.
    pub(super) chosen: usize,
    /// Address of the last connection.
    pub(super) address: String,
    /// What a person types, while they do.
    pub(super) entry: Option<String>,
    /// The outcome of the last command, until the next key.
    pub(super) said: Option<String>,
    daemon: Daemon,
    /// The moment of the daemon's last line, or of the connection.
    last_line: Duration,
    clock: Clock,
    /// How far the daemon's clock is behind this machine's. Frames show it, because they are sent
    /// at once.
    behind: Option<SignedDuration>,
}

/// The clock that the daemon's times come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Clock {
    /// The clock of this machine.
    Ours,
    /// The clock of another machine, which may be wrong.
    Theirs,
}

/// Whether there is a daemon.
#[derive(Debug, PartialEq, Eq)]
enum Daemon {
    /// There is no daemon, for this reason.
    Absent(String),
    /// Something has accepted the connection, but has not sent `hello` yet. The field is the reason
    /// why there was no daemon before.
    Unknown(String),
    Met,
}

/// The state of a link. The values of a sensor are current only if it is `Live`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Link {
    Live,
    /// Frames come, but the sensor has no zero yet.
    NoZero,
    Connecting,
    Stale,
    Lost,
    /// The daemon is connected but sends nothing.
    Silent,
    NoDaemon,
}

impl Link {
    pub(super) fn name(self) -> &'static str {
        match self {
            Link::Live => "LIVE",
            Link::NoZero => "NO ZERO YET",
            Link::Connecting => "CONNECTING",
            Link::Stale => "STALE",
            Link::Lost => "LOST",
            Link::Silent => "DAEMON SILENT",
            Link::NoDaemon => "NO DAEMON",
        }
    }
}

/// A key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Key {
    /// Ctrl-C, also while a person types.
    Quit,
    Redraw,
    Next,
    Previous,
    Enter,
    Backspace,
    Escape,
    Char(char),
}

/// What a key asks for that the view cannot do.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Order {
    Quit,
    Redraw,
    /// Set this context.
    Context(Value),
}

/// The longest text that a person may type.
const ENTRY_CHARS: usize = 60;

/// The way in which a daemon was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Loss {
    /// The connection broke, for this reason.
    Broken(String),
    /// The daemon cannot be reached, for this reason.
    Unreachable(String),
}

impl View {
    /// A view that knows nothing yet.
    pub(super) fn new() -> Self {
        Self {
            hello: Value::Null,
            labels: Vec::new(),
            sensors: Vec::new(),
            chosen: 0,
            address: String::new(),
            entry: None,
            said: None,
            daemon: Daemon::Absent("connecting".to_owned()),
            last_line: Duration::ZERO,
            clock: Clock::Ours,
            behind: None,
        }
    }

    /// Takes in a line of the daemon, read at `now`. Ignores an unknown line. The caller must send
    /// the returned request to the daemon.
    pub(super) fn take_line(&mut self, line: &str, now: Stamp) -> Option<String> {
        if line.starts_with("HTTP/") {
            self.daemon = Daemon::Absent(WEB_SERVER.to_owned());
            return None;
        }
        let event = serde_json::from_str::<Value>(line).ok()?;
        self.last_line = now.mono;
        let kind = event["type"].as_str().unwrap_or_default();
        match kind {
            "hello" => return self.meet(event),
            // Before a `hello`, an error means that the daemon has no room.
            "error" if self.daemon != Daemon::Met => {
                let reason = event["message"].as_str().unwrap_or_default();
                self.daemon = Daemon::Absent(reason.to_owned());
            }
            _ => {
                let at = self.moment(&event, kind, now);
                let mut sensors = self.sensors.iter_mut();
                if let Some(sensor) = sensors.find(|one| event["sensor"] == *one.name) {
                    sensor.take_event(event, at);
                }
            }
        }
        None
    }

    /// The moment of an event. A daemon on another machine has another clock. The frame with the
    /// shortest delay shows how far that clock is behind.
    fn moment(&mut self, event: &Value, kind: &str, now: Stamp) -> Duration {
        let time = event["time"].as_str().and_then(|time| time.parse().ok());
        let Some(past) = time.map(|time: jiff::Timestamp| now.wall.duration_since(time)) else {
            return now.mono;
        };
        if self.clock == Clock::Theirs && kind == "frame" {
            self.behind = Some(self.behind.map_or(past, |behind| behind.min(past)));
        }
        let past = past - self.behind.unwrap_or_default();
        now.mono
            .saturating_sub(Duration::try_from(past).unwrap_or_default())
    }

    /// Takes in that something at `address` has accepted the connection at `now`. It has as long to
    /// send `hello` as a daemon has to answer.
    pub(super) fn wait(&mut self, address: String, clock: Clock, now: Duration) {
        self.last_line = now;
        self.address = address;
        (self.clock, self.behind) = (clock, None);
        self.daemon = Daemon::Unknown(self.absence().to_owned());
    }

    /// Takes in a `hello`, and begins anew. Returns the request for all events of this run that the
    /// daemon still holds, and those that come.
    fn meet(&mut self, hello: Value) -> Option<String> {
        let protocol = &hello["protocol"];
        if *protocol != PROTOCOL {
            let reason = format!("found protocol {protocol}, expected {PROTOCOL}");
            self.daemon = Daemon::Absent(reason);
            return None;
        }
        let chosen = self.sensor().map(|one| one.name.clone());
        self.sensors = items(&hello, "sensors").map(Sensor::new).collect();
        let is_chosen = |one: &Sensor| Some(&one.name) == chosen.as_ref();
        self.chosen = self.sensors.iter().position(is_chosen).unwrap_or(0);
        self.labels = labels(&hello);
        self.daemon = Daemon::Met;
        let types = ["hardness", "press", "status", "frame"];
        let since = format!("{}:0", hello["run"].as_str().unwrap_or_default());
        self.hello = hello;
        Some(json!({"subscribe": types, "since": since}).to_string())
    }

    /// Takes in that the daemon has gone or cannot be reached.
    pub(super) fn lose(&mut self, loss: Loss) {
        match loss {
            Loss::Unreachable(reason) => self.daemon = Daemon::Absent(reason),
            // The daemon's `error` or its protocol gave the reason already.
            Loss::Broken(_) if matches!(self.daemon, Daemon::Absent(_)) => {}
            Loss::Broken(reason) => self.daemon = Daemon::Absent(reason),
        }
    }

    /// Takes in a key. The caller must carry out the order.
    pub(super) fn press(&mut self, key: Key) -> Option<Order> {
        self.said = None;
        let count = self.sensors.len().max(1);
        match (&mut self.entry, key) {
            (_, Key::Quit) | (None, Key::Char('q' | 'Q')) => return Some(Order::Quit),
            (_, Key::Redraw) => return Some(Order::Redraw),
            (Some(text), Key::Char(char)) if text.chars().count() < ENTRY_CHARS => text.push(char),
            (Some(text), Key::Backspace) => drop(text.pop()),
            (Some(_), Key::Escape) => self.entry = None,
            (Some(_), Key::Enter) => {
                let text = self.entry.take().unwrap_or_default();
                return self.pressing(&text);
            }
            (Some(_), _) => {}
            (None, Key::Char('p' | 'P')) => {
                self.entry = Some(String::new());
            }
            (None, Key::Char(digit @ '1'..='9')) => {
                let index = digit as usize - '1' as usize;
                if index < count {
                    self.chosen = index;
                }
            }
            (None, Key::Next) => self.chosen = (self.chosen + 1) % count,
            (None, Key::Previous) => self.chosen = (self.chosen + count - 1) % count,
            (None, _) => {}
        }
        None
    }

    /// Takes in what is being pressed, as a person typed it. Returns the order to tell the daemon.
    fn pressing(&mut self, text: &str) -> Option<Order> {
        let truth = Truth::read(text, &self.labels);
        let sensor = self.sensors.get_mut(self.chosen)?;
        sensor.score.begin(truth.clone());
        let context = truth.within(&sensor.context, &sensor.name);
        sensor.context = context.clone();
        Some(Order::Context(context))
    }

    /// The sensor that is shown.
    pub(super) fn sensor(&self) -> Option<&Sensor> {
        self.sensors.get(self.chosen)
    }

    /// The state of a sensor, with its reason.
    pub(super) fn link(&self, sensor: &Sensor, now: Duration) -> (Link, Option<String>) {
        if let Some((link, reason)) = self.trouble(now) {
            return (link, Some(reason));
        }
        let has_zero = |frame: &Frame| frame.force_n.is_some();
        let text = |key: &str| sensor.status[key].as_str();
        let link = match text("state").unwrap_or_default() {
            "live" if !sensor.frame.as_ref().is_none_or(has_zero) => Link::NoZero,
            "live" => Link::Live,
            "stale" => Link::Stale,
            "lost" => Link::Lost,
            _ => Link::Connecting,
        };
        let detail = text("detail").map(|detail| format!(": {detail}"));
        let detail = detail.unwrap_or_default();
        (
            link,
            text("reason").map(|reason| reason.to_owned() + &detail),
        )
    }

    /// The state that holds for all sensors because of the daemon, with its reason.
    pub(super) fn trouble(&self, now: Duration) -> Option<(Link, String)> {
        let silence = now.saturating_sub(self.last_line);
        match &self.daemon {
            Daemon::Absent(reason) => Some((Link::NoDaemon, reason.clone())),
            Daemon::Unknown(_) | Daemon::Met if silence > SILENCE => {
                Some((Link::Silent, format!("no answer for {}", age(silence))))
            }
            Daemon::Unknown(reason) => Some((Link::NoDaemon, reason.clone())),
            Daemon::Met => None,
        }
    }

    /// The reason why there is no daemon.
    fn absence(&self) -> &str {
        match &self.daemon {
            Daemon::Absent(reason) | Daemon::Unknown(reason) => reason,
            Daemon::Met => "",
        }
    }
}

/// A time span as a short text.
pub(super) fn age(age: Duration) -> String {
    let seconds = age.as_secs_f64();
    match seconds {
        ..10.0 => format!("{seconds:.1} s"),
        ..120.0 => format!("{seconds:.0} s"),
        ..7200.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.0} h", seconds / 3600.0),
    }
}
