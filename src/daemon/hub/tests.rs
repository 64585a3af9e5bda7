use std::path::Path;
use std::sync::LazyLock;
use std::time::Duration;

use serde_json::Value;

use super::cursor::QUEUE;
use super::log::HELD;
use super::*;
use crate::daemon::config::Setup;
use crate::daemon::request::{Policy, Since};
use crate::daemon::sensor::SensorState;
use hardnessd_core::event::{FrameEvent, Kind, LinkState, PressState, Status};

const RUN: &str = "5eed";

/// The greeting of a daemon of a sensor called "a".
pub(in crate::daemon) fn hello() -> Hello {
    static HELLO: LazyLock<Hello> = LazyLock::new(|| {
        let text = "[[sensor]]\nname = \"a\"\nport = \"p\"\n[model]\nbuilt_in = \"hrn\"\n";
        let setup = Setup::of(toml::from_str(text).unwrap(), Path::new("hub")).unwrap();
        crate::daemon::hello(&setup, RUN.to_owned())
    });
    HELLO.clone()
}

fn log() -> Log {
    Log::new(hello())
}

/// The state of a live sensor.
pub(in crate::daemon) fn state(sensor: &str) -> SensorState {
    SensorState {
        status: live(sensor),
        last_frame: None,
        contact_threshold_n: 0.0,
        unjudged: 0,
        motion: (0, 0),
    }
}

/// The status of a live sensor.
pub(in crate::daemon) fn live(sensor: &str) -> Status {
    Status {
        seq: None,
        sensor: sensor.to_owned(),
        time: jiff::Timestamp::UNIX_EPOCH,
        state: LinkState::Live,
        reason: None,
        detail: None,
        frames: 0,
        frames_damaged: 0,
        frames_dropped: 0,
        bytes_skipped: 0,
        frame_rate_hz: None,
    }
}

fn status(sensor: &str) -> Event {
    Event::Status(live(sensor))
}

pub(in crate::daemon) fn press(sensor: &str) -> Event {
    Event::Press(hardnessd_core::event::Press {
        seq: None,
        sensor: sensor.to_owned(),
        time: jiff::Timestamp::UNIX_EPOCH,
        press: 1,
        state: PressState::Begin,
        frame: 0,
        reason: None,
        frames: 1,
        context: None,
    })
}

fn frame(sensor: &str, number: u64) -> Event {
    let shown = hardnessd_core::frame::Frame::default();
    Event::Frame(FrameEvent {
        sensor: sensor.to_owned(),
        time: jiff::Timestamp::UNIX_EPOCH,
        frame: number,
        rows: shown.array.rows,
        cols: shown.array.cols,
        newtons: shown.newtons.into_vec(),
        contact_area_taxels: 0,
        force_n: Some(0.0),
        tared: true,
        approach_mm: None,
    })
}

impl Log {
    fn publish_now(&mut self, event: Event) {
        self.publish(event, Duration::ZERO);
    }

    /// Publishes so many presses.
    fn presses(&mut self, count: u64) {
        (0..count).for_each(|_| self.publish_now(press("a")));
    }

    fn joins(&mut self, wanted: &Subscription) -> u64 {
        self.join(wanted).unwrap()
    }

    fn wants(&mut self, id: u64, wanted: &Subscription) {
        self.subscribe(id, wanted).unwrap();
    }

    /// All lines that a subscriber gets now, each as `TYPE:SEQ`, `gap:LOST` or `frame:NUMBER`.
    fn drain(&mut self, id: u64) -> Vec<String> {
        let mut drained = Vec::new();
        loop {
            let lines = self.lines(id);
            if lines.is_empty() {
                return drained;
            }
            drained.extend(lines);
        }
    }

    /// The next batch of these lines.
    fn lines(&mut self, id: u64) -> Vec<String> {
        let lines = self.read(id).into_iter().map(|line| {
            let event: Value = serde_json::from_str(line.json()).unwrap();
            let number = match event["type"].as_str().unwrap() {
                "gap" => &event["lost"],
                "frame" => &event["frame"],
                _ => &event["seq"],
            };
            format!("{}:{number}", event["type"].as_str().unwrap())
        });
        lines.collect()
    }
}

fn wanting(kinds: &[Kind], policy: Policy, since: Option<u64>) -> Subscription {
    let since = since.map(|seq| Since {
        run: RUN.to_owned(),
        seq,
    });
    Subscription {
        kinds: kinds.iter().copied().collect(),
        policy,
        since,
    }
}

fn numbers(kind: &str, seqs: impl Iterator<Item = u64>) -> Vec<String> {
    seqs.map(|seq| format!("{kind}:{seq}")).collect()
}

#[test]
fn a_stalled_subscriber_loses_the_oldest_and_learns_exactly_how_many() {
    let mut log = log();
    let stalled = log.joins(&Subscription::default());
    let awake = log.joins(&Subscription::default());
    let mut drained = Vec::new();
    for _ in 0..3000 {
        log.publish_now(status("a"));
        drained.extend(log.drain(awake));
    }
    assert_eq!(drained, numbers("status", 1..=3000));
    let mut expected = vec!["gap:1976".to_owned()];
    expected.extend(numbers("status", 1977..=3000));
    assert_eq!(log.drain(stalled), expected);
    log.publish_now(status("a"));
    assert_eq!(log.drain(stalled), ["status:3001"]);
    let now = log.snapshot();
    assert_eq!((now.gaps, now.dropped), (1, 1976));
}

#[test]
fn latest_keeps_the_newest_of_each_kind_and_sensor_and_counts_all_but_frames() {
    let mut log = log();
    let kinds = [Kind::Status, Kind::Press, Kind::Frame];
    let id = log.joins(&wanting(&kinds, Policy::Latest, None));
    for number in 0..5 {
        log.publish_now(status("a"));
        log.publish_now(frame("a", number));
    }
    log.publish_now(status("b"));
    log.publish_now(press("a"));
    assert_eq!(
        log.drain(id),
        ["gap:4", "status:5", "frame:4", "status:6", "press:7"]
    );
}

#[test]
fn latest_frames_lets_frames_be_superseded_and_nothing_else() {
    let mut log = log();
    let kinds = [Kind::Status, Kind::Frame];
    let id = log.joins(&wanting(&kinds, Policy::LatestFrames, None));
    for number in 0..3 {
        log.publish_now(status("a"));
        log.publish_now(frame("a", number));
        log.publish_now(frame("b", number));
    }
    assert_eq!(
        log.drain(id),
        ["status:1", "status:2", "status:3", "frame:2", "frame:2"]
    );
    let now = log.snapshot();
    assert_eq!((now.gaps, now.dropped), (0, 0));
}

#[test]
fn since_gives_what_is_held_then_what_comes_and_nothing_twice() {
    let mut log = log();
    let since = |log: &mut Log, id| {
        log.wants(id, &wanting(&[Kind::Press], Policy::Queue, Some(0)));
    };
    // A batch holds fewer.
    log.presses(600);
    let id = log.joins(&Subscription::default());
    log.publish_now(press("a"));
    assert_eq!(log.drain(id), ["press:601"]);
    since(&mut log, id);
    let mut lines = log.lines(id);
    assert!((1..600).contains(&lines.len()), "{}", lines.len());
    since(&mut log, id);
    lines.extend(log.drain(id));
    assert_eq!(lines, numbers("press", 1..=600));
    // What came after a gap and before it is not given again either, but what the gap announced as lost. Then come
    // live ones.
    log.presses(2 * QUEUE);
    let lines = log.drain(id);
    assert_eq!(lines.len() as u64, 1 + QUEUE);
    since(&mut log, id);
    log.publish_now(press("a"));
    let mut expected = numbers("press", 602..=601 + QUEUE);
    expected.push(format!("press:{}", 602 + 2 * QUEUE));
    assert_eq!(log.drain(id), expected);
}

#[test]
fn since_older_than_what_is_held_says_how_much_is_gone() {
    let mut log = log();
    log.presses(HELD as u64 + 100);
    let held = numbers("press", 101..=HELD as u64 + 100);
    let mut check = |kinds: &[Kind], since, lost: &str| {
        let id = log.joins(&wanting(kinds, Policy::Queue, Some(since)));
        let lines = log.drain(id);
        assert_eq!(lines[0], format!("gap:{lost}"));
        assert_eq!(lines[1..], held);
    };
    check(&Kind::NUMBERED, 40, "60");
    // The kinds of the 60 events are no longer known.
    check(&[Kind::Press], 40, "null");
}

#[test]
fn since_of_another_run_gives_an_unknown_gap_and_all_that_is_held() {
    let mut log = log();
    log.publish_now(press("a"));
    let mut other = wanting(&[Kind::Press], Policy::Queue, Some(900));
    assert_eq!(
        log.join(&other).unwrap_err(),
        "since: found 900, expected at most 1"
    );
    "0ther".clone_into(&mut other.since.as_mut().unwrap().run);
    let id = log.joins(&other);
    assert_eq!(log.drain(id), ["gap:null", "press:1"]);
}

#[test]
fn what_is_forgotten_during_a_slow_replay_is_counted() {
    let mut log = log();
    log.presses(HELD as u64);
    let id = log.joins(&wanting(&[Kind::Press], Policy::Queue, Some(0)));
    let had = log.read(id).len() as u64;
    assert!((1..1000).contains(&had), "a batch of {had} lines");
    log.presses(had + 10);
    let lines = log.drain(id);
    assert_eq!(lines[0], "gap:10");
    assert_eq!(
        lines[1..],
        numbers("press", had + 11..=HELD as u64 + had + 10)
    );
}

#[test]
fn events_that_came_before_a_since_and_between_two_come_once() {
    let mut log = log();
    let id = log.joins(&Subscription::default());
    for _ in 0..3 {
        log.publish_now(press("a"));
        log.publish_now(status("a"));
    }
    assert_eq!(log.drain(id).len(), 6);
    let presses = wanting(&[Kind::Press], Policy::Queue, None);
    log.subscribe(id, &presses).unwrap();
    log.publish_now(press("a"));
    log.publish_now(status("a"));
    assert_eq!(log.drain(id), ["press:7"]);
    for expected in [&["status:8"][..], &[]] {
        let all = wanting(&Kind::NUMBERED, Policy::Queue, Some(0));
        log.subscribe(id, &all).unwrap();
        assert_eq!(log.drain(id), expected);
    }
}

#[test]
fn a_kind_that_is_wanted_later_comes_from_then_on() {
    let mut log = log();
    let id = log.joins(&wanting(&[Kind::Press], Policy::Queue, None));
    let watching = log.joins(&wanting(&[Kind::Frame], Policy::Queue, None));
    log.publish_now(press("a"));
    log.publish_now(frame("a", 0));
    log.publish_now(status("a"));
    log.wants(id, &wanting(&Kind::ALL, Policy::Queue, None));
    log.publish_now(frame("a", 1));
    log.publish_now(status("a"));
    assert_eq!(log.drain(id), ["press:1", "frame:1", "status:3"]);
    assert_eq!(log.drain(watching), ["frame:0", "frame:1"]);
}

#[test]
fn frames_are_held_only_for_those_who_read_them() {
    let mut log = log();
    log.publish_now(frame("a", 0));
    assert_eq!(log.frames.len(), 0);
    let slow = log.joins(&wanting(&[Kind::Frame], Policy::Queue, None));
    let page = log.joins(&wanting(&[Kind::Frame], Policy::LatestFrames, None));
    for number in 1..=QUEUE + 5 {
        log.publish_now(frame("a", number));
    }
    assert_eq!(log.frames.len(), QUEUE as usize);
    assert_eq!(log.drain(page), [format!("frame:{}", QUEUE + 5)]);
    let mut expected = vec!["gap:5".to_owned()];
    expected.extend(numbers("frame", 6..=QUEUE + 5));
    assert_eq!(log.drain(slow), expected);
    log.publish_now(frame("a", QUEUE + 6));
    assert_eq!(log.drain(slow).len(), 1);
    log.leave(slow);
    assert_eq!(log.frames.len(), 1, "the newest, for the page");
    log.leave(page);
    assert_eq!(log.frames.len(), 0);
}

#[test]
fn a_subscriber_remembers_no_more_than_is_held_beside_a_quiet_sensor() {
    let mut log = log();
    let id = log.joins(&wanting(&[Kind::Status, Kind::Press], Policy::Queue, None));
    // It is held as long as its sensor says no more.
    log.publish_now(status("quiet"));
    for _ in 0..20 {
        log.presses(1000);
        log.drain(id);
    }
    let remembered = log.subscribers[&id].had.len();
    assert!(remembered < 3 * HELD, "{remembered}");
}

#[tokio::test]
async fn a_subscriber_that_waits_gets_a_line_without_asking_again() {
    let hub = Hub::new(hello());
    hub.log().report(state("a"));
    let (mut subscriber, now) = hub.join(Subscription::default()).await.unwrap();
    let lines = now.greeting();
    assert!(lines[0].json().starts_with(r#"{"type":"hello""#));
    let waiting = tokio::spawn(async move { (subscriber.next().await, subscriber) });
    tokio::task::yield_now().await;
    hub.publish(vec![status("a"), press("a")]);
    let (lines, mut subscriber) = waiting.await.unwrap();
    assert_eq!(lines.unwrap().len(), 2);
    hub.publish(vec![press("a")]);
    hub.log().close();
    assert_eq!(subscriber.next().await.unwrap().len(), 1);
    assert!(subscriber.next().await.is_none());
    assert_eq!(hub.snapshot().await.subscribers, 1);
    drop(subscriber);
    assert_eq!(hub.snapshot().await.subscribers, 0);
}

#[test]
fn a_sensor_that_floods_takes_no_place_from_the_others() {
    let mut log = log();
    let [presses, frames] =
        [Kind::Press, Kind::Frame].map(|kind| log.joins(&wanting(&[kind], Policy::Queue, None)));
    let begun = log.snapshot().hello.seq;
    for number in 0..20 {
        log.publish_now(press("good"));
        log.publish_now(frame("good", number));
        for flood in ["flood1", "flood2", "flood3"] {
            for number in 0..300 {
                log.publish_now(press(flood));
                log.publish_now(frame(flood, 1_000 + number));
            }
        }
    }
    // What is held beside the newest events is bounded.
    assert!(log.frames.len() < 3 * QUEUE as usize);
    let numbers_of = |lines: &[String], kind: &str| -> Vec<u64> {
        let numbers = lines.iter().filter_map(|line| line.strip_prefix(kind));
        numbers.map(|number| number.parse().unwrap()).collect()
    };
    let lost = |lines: &[String]| -> u64 { numbers_of(lines, "gap:").iter().sum() };
    let lines = log.drain(frames);
    let got = numbers_of(&lines, "frame:");
    assert!((0..20).all(|number| got.contains(&number)), "{got:?}");
    assert_eq!(
        got.len() as u64 + lost(&lines),
        20 + 20 * 900,
        "none is lost without a gap"
    );

    let lines = log.drain(presses);
    let got = numbers_of(&lines, "press:");
    assert!(got.is_sorted());
    let of_good: Vec<u64> = (0..20).map(|number| begun + 1 + number * 901).collect();
    assert!(of_good.iter().all(|seq| got.contains(seq)), "{got:?}");
    assert_eq!(got.len() as u64 + lost(&lines), 20 * 901);

    // Whoever comes back gets what is held, and learns what is not.
    for since in [0, of_good[3], of_good[3] + 5, 20 * 901] {
        let again = log.joins(&wanting(&Kind::NUMBERED, Policy::Queue, Some(since)));
        let lines = log.drain(again);
        let got = numbers_of(&lines, "press:");
        let after = of_good.iter().filter(|&&seq| seq > since);
        assert!(after.into_iter().all(|seq| got.contains(seq)));
        assert_eq!(got.len() as u64 + lost(&lines), 20 * 901 - since, "{since}");
    }
}
