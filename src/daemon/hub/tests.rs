use std::time::Duration;

use serde_json::Value;

use super::*;
use crate::daemon::request::{Policy, Since};
use hardnessd_core::event::{FrameEvent, LinkState, ModelCard, PressState, Status};

const RUN: &str = "5eed";

pub(in crate::daemon) fn hello() -> Hello {
    Hello {
        protocol: hardnessd_core::event::PROTOCOL,
        server: "hardnessd",
        version: "0",
        robot: "arm-7".to_owned(),
        run: RUN.to_owned(),
        boot_id: String::new(),
        seq: 0,
        sensors: Vec::new(),
        model: ModelCard {
            sha256: String::new(),
            validation: String::new(),
            levels: Vec::new(),
            name: String::new(),
            needs: String::new(),
            without_effect: Vec::new(),
        },
    }
}

fn hub() -> Hub {
    Hub::new(hello())
}

/// The status of a live sensor.
pub(in crate::daemon) fn live(sensor: &str) -> Status {
    Status {
        seq: None,
        sensor: sensor.to_owned(),
        time: jiff::Timestamp::UNIX_EPOCH,
        state: LinkState::Live,
        reason: None,
        frames: 0,
        frames_damaged: 0,
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
        tared: true,
        approach_mm: None,
    })
}

impl Hub {
    fn publish_now(&mut self, event: Event) {
        self.publish(event, Duration::ZERO);
    }

    /// All lines that a subscriber gets now, each as `TYPE:SEQ`, `gap:LOST` or `frame:NUMBER`.
    fn drain(&mut self, id: u64) -> Vec<String> {
        let mut drained = Vec::new();
        loop {
            let lines = self.take(id);
            if lines.is_empty() {
                return drained;
            }
            drained.extend(lines.iter().map(|line| {
                let event: Value = serde_json::from_str(&line.json).unwrap();
                let number = match event["type"].as_str().unwrap() {
                    "gap" => &event["lost"],
                    "frame" => &event["frame"],
                    _ => &event["seq"],
                };
                format!("{}:{number}", event["type"].as_str().unwrap())
            }));
        }
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
fn events_are_numbered_over_all_sensors_and_frames_are_not() {
    let mut hub = hub();
    let (id, _) = hub.join();
    let every = [Kind::Status, Kind::Press, Kind::Hardness, Kind::Frame];
    hub.subscribe(id, &wanting(&every, Policy::Queue, None))
        .unwrap();
    hub.publish_now(status("a"));
    hub.publish_now(frame("a", 7));
    hub.publish_now(press("b"));
    assert_eq!(hub.drain(id), ["status:1", "frame:7", "press:2"]);
}

#[test]
fn a_subscriber_gets_the_kinds_it_asked_for_and_by_default_no_frames() {
    let mut hub = hub();
    let (usual, _) = hub.join();
    let (presses, _) = hub.join();
    hub.subscribe(presses, &wanting(&[Kind::Press], Policy::Queue, None))
        .unwrap();
    hub.publish_now(status("a"));
    hub.publish_now(frame("a", 0));
    hub.publish_now(press("a"));
    assert_eq!(hub.drain(usual), ["status:1", "press:2"]);
    assert_eq!(hub.drain(presses), ["press:2"]);
}

#[test]
fn a_stalled_subscriber_loses_the_oldest_and_learns_exactly_how_many() {
    let mut hub = hub();
    let (stalled, _) = hub.join();
    let (awake, _) = hub.join();
    let mut drained = Vec::new();
    for _ in 0..3000 {
        hub.publish_now(status("a"));
        drained.extend(hub.drain(awake));
    }
    assert_eq!(drained, numbers("status", 1..=3000));
    let mut expected = vec!["gap:1976".to_owned()];
    expected.extend(numbers("status", 1977..=3000));
    assert_eq!(hub.drain(stalled), expected);
    hub.publish_now(status("a"));
    assert_eq!(hub.drain(stalled), ["status:3001"]);
    assert_eq!((hub.tally.gaps, hub.tally.dropped), (1, 1976));
}

#[test]
fn latest_keeps_the_newest_of_each_kind_and_sensor_and_counts_all_but_frames() {
    let mut hub = hub();
    let (id, _) = hub.join();
    let kinds = [Kind::Status, Kind::Press, Kind::Frame];
    hub.subscribe(id, &wanting(&kinds, Policy::Latest, None))
        .unwrap();
    for number in 0..5 {
        hub.publish_now(status("a"));
        hub.publish_now(frame("a", number));
    }
    hub.publish_now(status("b"));
    hub.publish_now(press("a"));
    assert_eq!(
        hub.drain(id),
        ["gap:4", "status:5", "frame:4", "status:6", "press:7"]
    );
}

#[test]
fn latest_frames_lets_frames_be_superseded_and_nothing_else() {
    let mut hub = hub();
    let (id, _) = hub.join();
    let kinds = [Kind::Status, Kind::Frame];
    hub.subscribe(id, &wanting(&kinds, Policy::LatestFrames, None))
        .unwrap();
    for number in 0..3 {
        hub.publish_now(status("a"));
        hub.publish_now(frame("a", number));
        hub.publish_now(frame("b", number));
    }
    assert_eq!(
        hub.drain(id),
        ["status:1", "status:2", "status:3", "frame:2", "frame:2"]
    );
    assert_eq!((hub.tally.gaps, hub.tally.dropped), (0, 0));
}

#[test]
fn since_gives_what_is_held_then_what_comes_and_nothing_twice() {
    let mut hub = hub();
    for _ in 0..10 {
        hub.publish_now(press("a"));
    }
    let (id, _) = hub.join();
    hub.publish_now(press("a"));
    // The default subscription delivered number 11 before the request came.
    assert_eq!(hub.drain(id), ["press:11"]);
    hub.publish_now(press("a"));
    hub.subscribe(id, &wanting(&[Kind::Press], Policy::Queue, Some(7)))
        .unwrap();
    hub.publish_now(press("a"));
    assert_eq!(
        hub.drain(id),
        ["press:8", "press:9", "press:10", "press:12", "press:13"]
    );
}

#[test]
fn another_subscription_reaches_what_since_asked_for() {
    let mut hub = hub();
    for _ in 0..5 {
        hub.publish_now(press("a"));
        hub.publish_now(status("a"));
    }
    let (id, _) = hub.join();
    hub.subscribe(id, &wanting(&Kind::NUMBERED, Policy::Queue, Some(0)))
        .unwrap();
    hub.subscribe(id, &wanting(&[Kind::Status], Policy::Queue, None))
        .unwrap();
    assert_eq!(hub.drain(id), numbers("status", (2..=10).step_by(2)));
}

#[test]
fn since_older_than_what_is_held_says_how_much_is_gone() {
    let mut hub = hub();
    for _ in 0..HELD + 100 {
        hub.publish_now(press("a"));
    }
    let held = numbers("press", 101..=HELD as u64 + 100);
    let mut check = |kinds: &[Kind], since, lost: &str| {
        let (id, _) = hub.join();
        hub.subscribe(id, &wanting(kinds, Policy::Queue, Some(since)))
            .unwrap();
        let lines = hub.drain(id);
        assert_eq!(lines[0], format!("gap:{lost}"));
        assert_eq!(lines[1..], held);
    };
    check(&Kind::NUMBERED, 40, "60");
    // The kinds of the 60 events are no longer known.
    check(&[Kind::Press], 40, "null");
    check(&[Kind::Press], 0, "100");
}

#[test]
fn since_of_another_run_gives_an_unknown_gap_and_all_that_is_held() {
    let mut hub = hub();
    hub.publish_now(press("a"));
    let (id, _) = hub.join();
    let since = Since {
        run: "0ther".to_owned(),
        seq: 900,
    };
    let subscription = Subscription {
        since: Some(since),
        ..Subscription::default()
    };
    hub.subscribe(id, &subscription).unwrap();
    assert_eq!(hub.drain(id), ["gap:null", "press:1"]);
}

#[test]
fn since_beyond_the_latest_number_is_refused() {
    let mut hub = hub();
    let (id, _) = hub.join();
    let refused = hub.subscribe(id, &wanting(&[Kind::Press], Policy::Queue, Some(1)));
    let expected = "since: found 1, expected at most 0";
    assert_eq!(refused.unwrap_err().to_string(), expected);
}

#[test]
fn what_is_forgotten_during_a_slow_replay_is_counted() {
    let mut hub = hub();
    for _ in 0..HELD {
        hub.publish_now(press("a"));
    }
    let (id, _) = hub.join();
    hub.subscribe(id, &wanting(&[Kind::Press], Policy::Queue, Some(0)))
        .unwrap();
    let had = hub.take(id).len() as u64;
    assert!((1..1000).contains(&had), "a batch of {had} lines");
    for _ in 0..had + 10 {
        hub.publish_now(press("a"));
    }
    let lines = hub.drain(id);
    assert_eq!(lines[0], "gap:10");
    assert_eq!(
        lines[1..],
        numbers("press", had + 11..=HELD as u64 + had + 10)
    );
}

#[tokio::test]
async fn a_subscriber_that_waits_gets_a_line_without_asking_again() {
    let hub = start(hello(), EventRecorder::default());
    let (id, hello) = hub.join().await.unwrap();
    assert!(hello.json.starts_with(r#"{"type":"hello""#));
    let lines = hub.take(id).await.unwrap();
    hub.publish(vec![status("a"), press("a")]).await;
    assert_eq!(lines.await.unwrap().len(), 2);
    let last = hub.take(id).await.unwrap();
    hub.close().await;
    assert!(last.await.is_err());
}
