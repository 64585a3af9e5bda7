//! What is known of every robot.
//!
//! In: news, and the time. Out: robots, their sensors and what is new. It reads no clock. Strangers who reach
//! the router can claim to be robots, so everything that is kept has a bound.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;

use super::numbers::Numbers;
use super::session::{FleetEvent, Hello, News, What};
use hardnessd_core::event::Kind;
use hardnessd_core::frame::Stamp;

/// Robots beyond these are kept only in the place of one that is gone.
const MOST_ROBOTS: usize = 4096;
/// Sensors beyond these, of all robots together, are left out.
const MOST_SENSORS: usize = 4096;
/// The largest number of sensors of one robot, so that one robot cannot take the place of all others.
const MOST_SENSORS_A_ROBOT: usize = 256;
/// Numbers that wait to know which run they are of.
const MOST_WAITING: usize = 512;

/// An event that was sent before a `hello` comes at most this long after it.
const ON_ITS_WAY: Duration = Duration::from_secs(2);

/// A robot is asked every [`ASK`]. One that has said nothing for so long does not answer.
const SILENT: Duration = Duration::from_secs(25);

/// How often each robot is asked what is true now.
pub(super) const ASK: Duration = Duration::from_secs(10);

/// Every robot that was heard of.
#[derive(Debug, Default)]
pub(super) struct Fleet {
    robots: BTreeMap<String, Robot>,
    sensors: usize,
    /// Robots of which something is new: of these sensors, or of the robot itself.
    new: BTreeMap<String, BTreeSet<String>>,
    /// Robots and sensors that were left out.
    left_out: u64,
}

/// A robot, by what came from it.
#[derive(Debug, Default)]
pub(super) struct Robot {
    /// Whether its token is there.
    pub(super) is_there: bool,
    /// When its token went.
    pub(super) gone: Option<Stamp>,
    /// The time of the newest word of its token, by CLOCK_MONOTONIC.
    token_received_at: Duration,
    /// What it last said of itself.
    pub(super) hello: Option<Hello>,
    pub(super) sensors: BTreeMap<String, Sensor>,
    /// How many numbered events came.
    pub(super) received: u64,
    /// Events of earlier runs that did not come.
    missed_before: u64,
    /// How often its daemon was started anew.
    pub(super) restarts: u64,
    numbers: Option<Numbers>,
    /// While it is not known which run the robot is in: the numbers that came.
    waiting: Option<Vec<u64>>,
    /// The number of the newest `hello`, and when it came, by CLOCK_MONOTONIC.
    claimed: Option<(Duration, u64)>,
}

/// A sensor, by its newest events.
#[derive(Debug)]
pub(super) struct Sensor {
    /// When the last word of it came.
    pub(super) received_at: Stamp,
    /// JSON, empty before the first.
    pub(super) status: String,
    /// The last final verdict: JSON, empty before the first.
    pub(super) verdict: String,
    /// When that came.
    pub(super) verdict_at: Option<Timestamp>,
}

impl Fleet {
    /// Takes in what is new.
    pub(super) fn learn(&mut self, news: News) {
        match news {
            News::Robot { site, what, at } => self.learn_of(site, what, at),
            News::Tokens(asked) => self.miss_tokens(asked),
        }
    }

    /// Every token that was there at that time has come. A robot without one is gone.
    fn miss_tokens(&mut self, asked: Stamp) {
        for (site, robot) in &mut self.robots {
            if robot.is_there && robot.token_received_at < asked.mono {
                robot.go(asked);
                let new = self.new.entry(site.clone()).or_default();
                new.extend(robot.sensors.keys().cloned());
            }
        }
    }

    fn learn_of(&mut self, site: String, what: What, at: Stamp) {
        if !self.robots.contains_key(&site) {
            // An answer or an end makes nobody known.
            if matches!(what, What::Gone | What::Asked) {
                return;
            }
            if self.robots.len() == MOST_ROBOTS && !self.forget_one() {
                self.left_out += 1;
                return;
            }
        }
        let robot = self.robots.entry(site.clone()).or_default();
        let mut about = None;
        match what {
            // It says what was true before something newer came.
            What::There | What::Came | What::Gone if at.mono < robot.token_received_at => return,
            What::There if robot.is_there => {
                robot.token_received_at = at.mono;
                return;
            }
            What::There | What::Came => robot.come(at),
            What::Gone => robot.go(at),
            What::Hello(hello) => robot.meet(hello, at),
            // A robot that never says its run is not waited for. One that did is asked again.
            What::Asked if robot.waiting.is_some() && robot.hello.is_none() => {
                robot.settle_run(None);
            }
            What::Asked => return,
            What::Event(incoming) => {
                robot.count(&incoming);
                about = Some(incoming.sensor.clone());
                if !robot.sensors.contains_key(&incoming.sensor) {
                    let is_full = robot.sensors.len() == MOST_SENSORS_A_ROBOT;
                    if is_full || self.sensors == MOST_SENSORS {
                        self.left_out += 1;
                        return;
                    }
                    self.sensors += 1;
                }
                robot.take_event(incoming, at);
            }
        }
        let new = self.new.entry(site).or_default();
        match about {
            Some(sensor) => drop(new.insert(sensor)),
            None => new.extend(robot.sensors.keys().cloned()),
        }
    }

    /// Makes room by the robot that is gone for longest.
    fn forget_one(&mut self) -> bool {
        let gone = self.robots.iter().filter(|(_, robot)| !robot.is_there);
        let first = gone.min_by_key(|(_, robot)| robot.gone.map(|gone| gone.mono));
        let Some(site) = first.map(|(site, _)| site.clone()) else {
            return false;
        };
        let robot = self.robots.remove(&site);
        self.sensors -= robot.map_or(0, |robot| robot.sensors.len());
        self.new.remove(&site);
        true
    }

    /// Counts as missed what was sent a while ago and did not come.
    pub(super) fn settle(&mut self, now: Stamp) {
        for (site, robot) in &mut self.robots {
            if robot.settle(now) {
                let new = self.new.entry(site.clone()).or_default();
                new.extend(robot.sensors.keys().cloned());
            }
        }
    }

    /// Every robot by name.
    pub(super) fn robots(&self) -> impl Iterator<Item = (&String, &Robot)> {
        self.robots.iter()
    }

    /// One of them.
    pub(super) fn robot(&self, site: &str) -> Option<&Robot> {
        self.robots.get(site)
    }

    /// The robots of which something is new since the last call, with those of their sensors.
    pub(super) fn take_new(&mut self) -> BTreeMap<String, BTreeSet<String>> {
        std::mem::take(&mut self.new)
    }

    /// Robots and sensors that were left out, because there were too many.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out
    }
}

impl Robot {
    fn come(&mut self, at: Stamp) {
        (self.is_there, self.gone, self.token_received_at) = (true, None, at.mono);
        // Until its hello comes, it may be in another run.
        self.waiting.get_or_insert_default();
        self.claimed = None;
    }

    fn go(&mut self, at: Stamp) {
        (self.is_there, self.token_received_at) = (false, at.mono);
        self.gone.get_or_insert(at);
    }

    fn meet(&mut self, hello: Hello, at: Stamp) {
        let run = hello.run.clone();
        let is_other = self.hello.as_ref().is_some_and(|known| known.run != run);
        if is_other || self.waiting.is_some() {
            self.settle_run(Some(is_other));
        }
        // The first one of a robot may be older than this subscription.
        let is_known = self.hello.is_some();
        if is_known && self.claimed.is_none() {
            self.claimed = Some((at.mono, hello.seq));
        }
        self.hello = Some(hello);
    }

    /// Counts the numbers that waited. Without a `hello`, they say by themselves whether they began anew.
    fn settle_run(&mut self, is_other: Option<bool>) {
        let waiting = self.waiting.take().unwrap_or_default();
        let first = waiting.first().copied();
        if let Some(numbers) = &self.numbers {
            let began_anew = || first.is_some_and(|first| numbers.is_long_past(first));
            if is_other.unwrap_or_else(began_anew) {
                self.missed_before = self.missed();
                self.restarts += 1;
                self.numbers = Some(Numbers::after(0));
                self.claimed = None;
            }
        }
        for number in waiting {
            self.receive(number);
        }
    }

    fn receive(&mut self, number: u64) {
        // The first number that comes: those before it were sent before anyone listened.
        let begin = || Numbers::after(number.saturating_sub(1));
        let numbers = self.numbers.get_or_insert_with(begin);
        self.received += u64::from(numbers.come(number));
    }

    fn count(&mut self, incoming: &FleetEvent) {
        let Some(number) = incoming.seq else {
            return;
        };
        // An answer repeats an event of any age. It is counted if the event itself did not come.
        if incoming.is_answer && self.numbers.is_none() {
            return;
        }
        let numbers = self.numbers.as_ref();
        let is_odd = numbers.is_some_and(|numbers| numbers.is_long_past(number));
        if is_odd && !incoming.is_answer {
            self.waiting.get_or_insert_default();
        }
        match &mut self.waiting {
            Some(waiting) if waiting.len() < MOST_WAITING => waiting.push(number),
            Some(_) => {
                self.settle_run(None);
                self.receive(number);
            }
            None => self.receive(number),
        }
    }

    fn take_event(&mut self, incoming: FleetEvent, at: Stamp) {
        let sensor = self
            .sensors
            .entry(incoming.sensor)
            .or_insert_with(|| Sensor {
                received_at: at,
                status: String::new(),
                verdict: String::new(),
                verdict_at: None,
            });
        // An event is never older than an answer. An answer may come from a storage, and repeat what was
        // true long ago.
        let is_older = |known: &str| incoming.is_answer && is_older(&incoming.text, known);
        match incoming.kind {
            Kind::Status if is_older(&sensor.status) => return,
            Kind::Status => sensor.status = incoming.text,
            Kind::Hardness if incoming.is_final && !is_older(&sensor.verdict) => {
                // The time at which a verdict first came stays.
                if !incoming.is_answer || incoming.text != sensor.verdict {
                    sensor.verdict_at = Some(at.wall);
                }
                sensor.verdict = incoming.text;
            }
            Kind::Hardness | Kind::Press | Kind::Frame => {}
        }
        sensor.received_at = at;
    }

    fn settle(&mut self, now: Stamp) -> bool {
        let Some((at, number)) = self.claimed else {
            return false;
        };
        if now.mono.saturating_sub(at) < ON_ITS_WAY || self.waiting.is_some() {
            return false;
        }
        self.claimed = None;
        let before = self.missed();
        match &mut self.numbers {
            Some(numbers) => numbers.reach(number),
            // It sent nothing yet. From here on it counts.
            None => self.numbers = Some(Numbers::after(number)),
        }
        self.missed() != before
    }

    /// Numbered events that it sent and that did not come.
    pub(super) fn missed(&self) -> u64 {
        let now = self.numbers.as_ref().map_or(0, Numbers::missed);
        self.missed_before.saturating_add(now)
    }

    /// The state of a sensor. What is out of date is never shown as current.
    pub(super) fn state(&self, sensor: &Sensor, now: Stamp) -> String {
        if self.gone.is_some() {
            return "gone".to_owned();
        }
        if now.mono.saturating_sub(sensor.received_at.mono) > SILENT {
            return "no answer".to_owned();
        }
        let status = read(&sensor.status);
        status["state"].as_str().unwrap_or("unknown").to_owned()
    }
}

/// JSON that was read before; null for what is not there.
pub(super) fn read(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_default()
}

/// The time of an event.
pub(super) fn time(event: &Value) -> Option<Timestamp> {
    event["time"].as_str()?.parse().ok()
}

fn is_older(text: &str, than: &str) -> bool {
    let known = time(&read(than));
    known.is_some_and(|known| time(&read(text)).is_none_or(|time| time < known))
}
