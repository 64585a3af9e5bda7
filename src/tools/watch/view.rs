//! The state of each sensor and its age. In: events of the daemon, and keys. Out: answers for a moment.
//!
//! A moment is a [`Duration`] on CLOCK_MONOTONIC. The moment of an event is when it happened, not
//! when it was read, so time in a queue counts as age. Nothing here has a clock or does I/O.

use std::collections::VecDeque;
use std::time::Duration;

use jiff::SignedDuration;
use ratatui_crossterm::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use serde_json::Value;

use super::pressing::{Count, Truth};
use crate::tools::answer::{items, labels};
use crate::tools::readable::number;
use hardnessd_core::frame::{MOST_SIDE, Stamp};

/// After three questions without an answer, the daemon counts as dead.
const SILENCE: Duration = Duration::from_secs(3);

/// How far back the curve of the force goes.
pub(super) const WINDOW: Duration = Duration::from_secs(30);

/// The number of verdicts kept for a sensor: more than a tall terminal shows.
const VERDICTS: usize = 100;

/// The longest text that a person may type.
const ENTRY_CHARS: usize = 60;

/// Everything that `watch` shows.
#[derive(Debug, Default)]
pub(super) struct View {
    /// The `hello` of the last connection. Null before the first one.
    pub(super) hello: Value,
    /// The labels of the model's levels, in order.
    pub(super) labels: Vec<String>,
    pub(super) sensors: Vec<Sensor>,
    /// Index of the sensor that is shown.
    pub(super) chosen: usize,
    /// What a person types, while they do.
    pub(super) entry: Option<String>,
    /// The outcome of the last command, until the next key.
    pub(super) said: Option<String>,
    /// Why there is no daemon. `None` while there is one.
    pub(super) absence: Option<String>,
    /// The moment of the daemon's last line.
    last_line: Duration,
    /// Whether the daemon is on another machine, whose clock may be wrong.
    is_remote: bool,
    /// How far the daemon's clock is behind this machine's. Frames show it, because they are sent
    /// at once.
    behind: Option<SignedDuration>,
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

/// What a key asks for that the view cannot do.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Order {
    Quit,
    Redraw,
    /// Set these keys of a context.
    Merge(Value),
}

/// One sensor.
#[derive(Debug, Default)]
pub(super) struct Sensor {
    pub(super) name: String,
    pub(super) rows: usize,
    pub(super) cols: usize,
    /// The last status. Null before the first one.
    pub(super) status: Value,
    /// The last frame, and its moment.
    pub(super) frame: Option<(Duration, Value)>,
    /// The forces of the last frames and their moments, in newtons.
    forces: Vec<(Duration, f32)>,
    /// The last event of a press, and its moment.
    pub(super) press: Option<(Duration, Value)>,
    /// The verdicts and their moments, the newest first.
    pub(super) verdicts: VecDeque<(Duration, Value)>,
    /// What is being pressed, and how many verdicts are right.
    pub(super) count: Count,
}

impl View {
    /// A view that knows nothing yet.
    pub(super) fn new() -> Self {
        Self {
            absence: Some("connecting".to_owned()),
            ..Self::default()
        }
    }

    /// Takes in a `hello`, read at `now`, and begins anew.
    pub(super) fn meet(&mut self, hello: Value, is_remote: bool, now: Duration) {
        let chosen = self.sensor().map(|one| one.name.clone());
        self.sensors = items(&hello, "sensors").map(Sensor::new).collect();
        let is_chosen = |one: &Sensor| Some(&one.name) == chosen.as_ref();
        self.chosen = self.sensors.iter().position(is_chosen).unwrap_or(0);
        self.labels = labels(&hello);
        self.hello = hello;
        self.absence = None;
        self.last_line = now;
        (self.is_remote, self.behind) = (is_remote, None);
    }

    /// Takes in an event of the daemon, read at `now`.
    pub(super) fn take(&mut self, event: Value, now: Stamp) {
        self.last_line = now.mono;
        let at = self.moment(&event, now);
        let mut sensors = self.sensors.iter_mut();
        if let Some(sensor) = sensors.find(|one| event["sensor"] == *one.name) {
            sensor.take(event, at);
        }
    }

    /// The moment of an event. A daemon on another machine has another clock. The frame with the
    /// shortest delay shows how far that clock is behind.
    fn moment(&mut self, event: &Value, now: Stamp) -> Duration {
        let time = event["time"].as_str().and_then(|time| time.parse().ok());
        let Some(past) = time.map(|time: jiff::Timestamp| now.wall.duration_since(time)) else {
            return now.mono;
        };
        if self.is_remote && event["type"] == "frame" {
            self.behind = Some(self.behind.map_or(past, |behind| behind.min(past)));
        }
        let past = past - self.behind.unwrap_or_default();
        now.mono
            .saturating_sub(Duration::try_from(past).unwrap_or_default())
    }

    /// Takes in a key. The caller must carry out the order.
    pub(super) fn press(&mut self, key: KeyEvent) -> Option<Order> {
        // In raw mode Ctrl-C sends no signal.
        if key.modifiers == KeyModifiers::CONTROL {
            return match key.code {
                KeyCode::Char('c') => Some(Order::Quit),
                KeyCode::Char('l') => Some(Order::Redraw),
                _ => None,
            };
        }
        self.said = None;
        let Some(text) = &mut self.entry else {
            return self.choose(key.code);
        };
        match key.code {
            KeyCode::Char(char) if text.chars().count() < ENTRY_CHARS => text.push(char),
            KeyCode::Backspace => drop(text.pop()),
            KeyCode::Esc => self.entry = None,
            KeyCode::Enter => {
                let text = self.entry.take().unwrap_or_default();
                return self.pressing(&text);
            }
            _ => {}
        }
        None
    }

    /// Takes in a key while nobody types a text.
    fn choose(&mut self, key: KeyCode) -> Option<Order> {
        let count = self.sensors.len().max(1);
        match key {
            KeyCode::Char('q' | 'Q') => return Some(Order::Quit),
            KeyCode::Char('p' | 'P') => self.entry = Some(String::new()),
            KeyCode::Char(digit @ '1'..='9') => {
                let index = digit as usize - '1' as usize;
                if index < count {
                    self.chosen = index;
                }
            }
            KeyCode::Tab | KeyCode::Right | KeyCode::Down => {
                self.chosen = (self.chosen + 1) % count;
            }
            KeyCode::BackTab | KeyCode::Left | KeyCode::Up => {
                self.chosen = (self.chosen + count - 1) % count;
            }
            _ => {}
        }
        None
    }

    /// Takes in what is being pressed, as a person typed it. Returns the order to tell the daemon.
    fn pressing(&mut self, text: &str) -> Option<Order> {
        let truth = Truth::read(text, &self.labels);
        let sensor = self.sensors.get_mut(self.chosen)?;
        let keys = truth.keys(&sensor.name);
        sensor.count.begin(truth);
        Some(Order::Merge(keys))
    }

    /// The sensor that is shown.
    pub(super) fn sensor(&self) -> Option<&Sensor> {
        self.sensors.get(self.chosen)
    }

    /// The state of a sensor, with its reason. That of the daemon comes first.
    pub(super) fn link(&self, sensor: Option<&Sensor>, now: Duration) -> (Link, Option<String>) {
        if let Some(reason) = &self.absence {
            return (Link::NoDaemon, Some(reason.clone()));
        }
        let silence = now.saturating_sub(self.last_line);
        if silence > SILENCE {
            return (
                Link::Silent,
                Some(format!("no answer for {}", age(silence))),
            );
        }
        let Some(sensor) = sensor else {
            return (Link::Connecting, None);
        };
        // Until it has one, its frames have no force.
        let has_no_zero = |(_, frame): &(Duration, Value)| frame["force_n"].is_null();
        let text = |key: &str| sensor.status[key].as_str();
        let link = match text("state").unwrap_or_default() {
            "live" if sensor.frame.as_ref().is_some_and(has_no_zero) => Link::NoZero,
            "live" => Link::Live,
            "stale" => Link::Stale,
            "lost" => Link::Lost,
            _ => Link::Connecting,
        };
        let reason = text("reason").map(|reason| match text("detail") {
            Some(detail) => format!("{reason}: {detail}"),
            None => reason.to_owned(),
        });
        (link, reason)
    }
}

impl Sensor {
    fn new(card: &Value) -> Self {
        let size = |key| (number(card, key) as usize).clamp(1, MOST_SIDE);
        Self {
            name: card["name"].as_str().unwrap_or_default().to_owned(),
            rows: size("rows"),
            cols: size("cols"),
            ..Self::default()
        }
    }

    /// Takes in an event.
    fn take(&mut self, event: Value, at: Duration) {
        match event["type"].as_str() {
            Some("status") => self.status = event,
            Some("press") => self.press = Some((at, event)),
            Some("hardness") => {
                self.count.take(&event);
                self.verdicts.push_front((at, event));
                self.verdicts.truncate(VERDICTS);
            }
            Some("frame") if items(&event, "newtons").count() == self.rows * self.cols => {
                let is_recent = |(moment, _): &(Duration, f32)| moment.saturating_add(WINDOW) >= at;
                self.forces.retain(is_recent);
                let force_n = event["force_n"].as_f64();
                self.forces
                    .extend(force_n.map(|force_n| (at, force_n as f32)));
                self.frame = Some((at, event));
            }
            _ => {}
        }
    }

    /// The newtons on each taxel in the last frame, `[rows, cols]`.
    pub(super) fn newtons(&self) -> Vec<f32> {
        let frame = self.frame.iter();
        let newtons = frame.flat_map(|(_, frame)| items(frame, "newtons"));
        let newtons = newtons.map(|newtons| newtons.as_f64().unwrap_or_default() as f32);
        newtons.collect()
    }

    /// The greatest force in each of `spans` equal spans up to `now`. `None` where no frame came.
    pub(super) fn curve(&self, now: Duration, spans: usize) -> Vec<Option<f32>> {
        let span_s = WINDOW.as_secs_f64() / spans.max(1) as f64;
        let mut curve: Vec<Option<f32>> = vec![None; spans];
        for &(at, force_n) in &self.forces {
            let before = (now.saturating_sub(at).as_secs_f64() / span_s) as usize;
            if let Some(place) = spans.checked_sub(1 + before) {
                let most = curve[place].map_or(force_n, |most| most.max(force_n));
                curve[place] = Some(most);
            }
        }
        curve
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
