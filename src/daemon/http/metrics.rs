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
use prometheus_client::registry::Registry;

use crate::daemon::hub::{SensorSnapshot, Snapshot};
use crate::daemon::sensor::SensorState;
use hardnessd_core::event::{self, LinkState};

pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;

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
    let help = "Subscribers there are, on sockets and pages";
    gauges(
        &mut registry,
        "subscribers",
        help,
        [(Vec::new(), now.subscribers as f64)],
    );
    for (name, help, count) in [
        ("events", "Numbered events published", hello.seq),
        ("gaps", "Gaps that subscribers were told of", now.gaps),
        (
            "events_dropped",
            "Events dropped because a subscriber was too slow",
            now.dropped,
        ),
    ] {
        counters(&mut registry, name, help, [(Vec::new(), count)]);
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

/// Registers counters. Those with the same labels are added.
fn counters(
    registry: &mut Registry,
    name: &str,
    help: &str,
    series: impl IntoIterator<Item = (Labels, u64)>,
) {
    let family: Family<Labels, Counter> = Family::default();
    for (labels, count) in series {
        family.get_or_create(&labels).inc_by(count);
    }
    registry.register(name, help, family);
}

fn gauges(
    registry: &mut Registry,
    name: &str,
    help: &str,
    series: impl IntoIterator<Item = (Labels, f64)>,
) {
    let family: Family<Labels, Gauge<f64, AtomicU64>> = Family::default();
    for (labels, value) in series {
        family.get_or_create(&labels).set(value);
    }
    registry.register(name, help, family);
}

/// The labels of a series of a sensor.
fn of(sensor: &SensorSnapshot, more: &[(&'static str, &str)]) -> Labels {
    let mut labels = vec![("sensor", sensor.state.status.sensor.clone())];
    labels.extend(more.iter().map(|&(key, value)| (key, value.to_owned())));
    labels
}

/// The series of the links.
fn links(registry: &mut Registry, now: &Snapshot) {
    type Count = fn(&SensorState) -> u64;
    let counts: [(&str, &str, Count); 7] = [
        ("frames", "Whole frames", |of| of.status.frames),
        ("frames_damaged", "Damaged frames", |of| {
            of.status.frames_damaged
        }),
        ("frames_dropped", "Frames above twice frame_rate_hz", |of| {
            of.status.frames_dropped
        }),
        (
            "skipped_bytes",
            "Bytes that belonged to no whole frame",
            |of| of.status.bytes_skipped,
        ),
        (
            "verdicts_failed",
            "Verdicts that did not come: the log says how",
            |of| of.unjudged,
        ),
        (
            "motion_points",
            "Positions of the arm that the robot told",
            |of| of.motion.0,
        ),
        (
            "motion_points_late",
            "Positions of the arm after their verdict",
            |of| of.motion.1,
        ),
    ];
    for (name, help, count) in counts {
        let series = now
            .sensors
            .iter()
            .map(|one| (of(one, &[]), count(&one.state)));
        counters(registry, name, help, series);
    }
    let states = now.sensors.iter().flat_map(|one| {
        LinkState::ALL.map(|known| {
            let holds = f64::from(u8::from(one.state.status.state == known));
            (of(one, &[("state", &event::name(&known))]), holds)
        })
    });
    let help = "State of the link: 1 for the one that holds";
    gauges(registry, "link_state", help, states);
    let rates = now
        .sensors
        .iter()
        .filter_map(|one| Some((of(one, &[]), one.state.status.frame_rate_hz?)));
    gauges(registry, "frame_rate_hertz", "Measured frame rate", rates);
    let ages = now
        .sensors
        .iter()
        .filter_map(|one| Some((of(one, &[]), one.last_frame_age?.as_secs_f64())));
    let help = "Age of the last whole frame; absent before the first";
    gauges(registry, "last_frame_age_seconds", help, ages);
}

/// The series of presses and verdicts.
fn presses(registry: &mut Registry, now: &Snapshot) {
    let (mut presses, mut verdicts, mut rejected) = (Vec::new(), Vec::new(), Vec::new());
    for one in &now.sensors {
        let counts = &one.counts;
        let with_phase = |phase: &str, key, value: &str| of(one, &[("phase", phase), (key, value)]);
        let states = ["begin", "end", "aborted"].map(|state| (of(one, &[("state", state)]), 0));
        presses.extend(states);
        for phase in ["early", "final"] {
            for level in &now.hello.model.levels {
                let level = level.level.to_string();
                verdicts.push((with_phase(phase, "level", &level), 0));
            }
            let reasons = ["low_confidence", "low_force", "ambiguous"];
            rejected.extend(reasons.map(|reason| (with_phase(phase, "reason", reason), 0)));
        }
        // A reload may have replaced the model of some levels.
        for ([phase, level], &count) in &counts.verdicts {
            verdicts.push((with_phase(phase, "level", level), count));
        }
        for ([phase, reason], &count) in &counts.rejected {
            rejected.push((with_phase(phase, "reason", reason), count));
        }
        for (state, &count) in &counts.presses {
            presses.push((of(one, &[("state", state)]), count));
        }
    }
    let help = "Presses, by what became of them";
    counters(registry, "presses", help, presses);
    counters(registry, "verdicts", "Verdicts, by level", verdicts);
    let help = "Verdicts withheld, by reason";
    counters(registry, "verdicts_rejected", help, rejected);
}
