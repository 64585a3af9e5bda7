//! `/metrics`: the state of the daemon as numbers, in the OpenMetrics text format that Prometheus
//! reads.
//!
//! Every scrape asks the hub, so nothing is counted twice. A series exists from the
//! start with the value 0, so that its first change is seen.

use std::sync::atomic::AtomicU64;

use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use crate::daemon::hub::{SensorSnapshot, Snapshot, Verdicts};
use crate::daemon::sensor::SensorState;
use hardnessd_core::event::{self, LinkState};

pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type Counters = Family<Labels, Counter>;
type Gauges = Family<Labels, Gauge<f64, AtomicU64>>;

/// The state of the hub and the sensors in the text format. Every series has the label `robot`.
pub(super) fn encode(now: &Snapshot) -> String {
    let hello = &now.hello;
    let robot = ("robot".into(), escaped(&hello.robot).into());
    let mut registry = Registry::with_prefix_and_labels("hardnessd", [robot].into_iter());
    registry.register(
        "build",
        "The daemon and its model",
        Info::new(vec![
            ("version", hello.version.to_owned()),
            ("run", hello.run.clone()),
            ("model", hello.model.sha256.clone()),
        ]),
    );
    links(&mut registry, now);
    presses(&mut registry, now);
    let subscribers: Gauge = Gauge::default();
    subscribers.set(i64::try_from(now.subscribers).unwrap_or(i64::MAX));
    let help = "Subscribers there are, on sockets and pages";
    registry.register("subscribers", help, subscribers);
    for (name, help, count) in [
        ("events", "Numbered events published", hello.seq),
        ("gaps", "Gaps that subscribers were told of", now.gaps),
        (
            "events_dropped",
            "Events dropped because a subscriber was too slow",
            now.dropped,
        ),
    ] {
        let counter: Counter = Counter::default();
        counter.inc_by(count);
        registry.register(name, help, counter);
    }
    let mut text = String::new();
    text::encode(&mut text, &registry).expect("writing to a string cannot fail");
    text
}

/// A label's value with the escapes of the format, which the library leaves to its callers. Only
/// the robot's name can hold such characters, and it has no line feed.
fn escaped(value: &str) -> String {
    value.replace('\\', r"\\").replace('"', r#"\""#)
}

/// The series of the links.
fn links(registry: &mut Registry, now: &Snapshot) {
    let (frames, damaged, dropped) = <(Counters, Counters, Counters)>::default();
    let (skipped, failed) = <(Counters, Counters)>::default();
    let (positions, late) = <(Counters, Counters)>::default();
    let (state, rate, age) = <(Gauges, Gauges, Gauges)>::default();
    for sensor in &now.sensors {
        let SensorSnapshot {
            state:
                SensorState {
                    status,
                    unjudged,
                    motion,
                    ..
                },
            last_frame_age,
            ..
        } = sensor;
        let labels = vec![("sensor", status.sensor.clone())];
        frames.get_or_create(&labels).inc_by(status.frames);
        damaged.get_or_create(&labels).inc_by(status.frames_damaged);
        dropped.get_or_create(&labels).inc_by(status.frames_dropped);
        skipped.get_or_create(&labels).inc_by(status.bytes_skipped);
        failed.get_or_create(&labels).inc_by(*unjudged);
        positions.get_or_create(&labels).inc_by(motion.0);
        late.get_or_create(&labels).inc_by(motion.1);
        if let Some(hz) = status.frame_rate_hz {
            rate.get_or_create(&labels).set(hz);
        }
        if let Some(since) = last_frame_age {
            age.get_or_create(&labels).set(since.as_secs_f64());
        }
        for known in LinkState::ALL {
            let mut labels = labels.clone();
            labels.push(("state", event::name(&known)));
            let holds = f64::from(u8::from(status.state == known));
            state.get_or_create(&labels).set(holds);
        }
    }
    registry.register("frames", "Whole frames", frames);
    registry.register("frames_damaged", "Damaged frames", damaged);
    let help = "Whole frames that were dropped: more than twice frame_rate_hz";
    registry.register("frames_dropped", help, dropped);
    let help = "Bytes that belonged to no whole frame";
    registry.register_with_unit("skipped", help, Unit::Bytes, skipped);
    let help = "Verdicts that did not come: the model failed, the log says how";
    registry.register("verdicts_failed", help, failed);
    let help = "Positions of the arm that the robot told";
    registry.register("motion_points", help, positions);
    let help = "Positions of the arm that came after the verdict that they belong to";
    registry.register("motion_points_late", help, late);
    let help = "State of the link: 1 for the one that holds";
    registry.register("link_state", help, state);
    let hertz = Unit::Other("hertz".to_owned());
    registry.register_with_unit("frame_rate", "Measured frame rate", hertz, rate);
    let help = "Age of the last whole frame; absent before the first";
    registry.register_with_unit("last_frame_age", help, Unit::Seconds, age);
}

/// The series of presses and verdicts.
fn presses(registry: &mut Registry, now: &Snapshot) {
    let (presses, verdicts, rejected) = <(Counters, Counters, Counters)>::default();
    for SensorSnapshot { state, counts, .. } in &now.sensors {
        let with = |more: &[(&'static str, &str)]| {
            let mut labels = vec![("sensor", state.status.sensor.clone())];
            labels.extend(more.iter().map(|&(key, value)| (key, value.to_owned())));
            labels
        };
        for (state, count) in [
            ("begin", counts.begun),
            ("end", counts.ended),
            ("aborted", counts.aborted),
        ] {
            let counter = presses.get_or_create_owned(&with(&[("state", state)]));
            counter.inc_by(count);
        }
        for (phase, made) in [("early", &counts.early), ("final", &counts.finals)] {
            // Keep the series for the levels of a model that a reload has replaced.
            let known = now.hello.model.levels.iter().map(|level| level.level);
            let mut levels: Vec<u8> = known.chain(made.levels.keys().copied()).collect();
            levels.sort_unstable();
            levels.dedup();
            for level in levels {
                let labels = with(&[("phase", phase), ("level", &level.to_string())]);
                let count = made.levels.get(&level).copied().unwrap_or(0);
                verdicts.get_or_create(&labels).inc_by(count);
            }
            let Verdicts {
                low_confidence,
                low_force,
                ambiguous,
                ..
            } = *made;
            for (reason, count) in [
                ("low_confidence", low_confidence),
                ("low_force", low_force),
                ("ambiguous", ambiguous),
            ] {
                let labels = with(&[("phase", phase), ("reason", reason)]);
                rejected.get_or_create(&labels).inc_by(count);
            }
        }
    }
    registry.register("presses", "Presses, by what became of them", presses);
    registry.register("verdicts", "Verdicts, by level", verdicts);
    registry.register(
        "verdicts_rejected",
        "Verdicts withheld, by reason",
        rejected,
    );
}
