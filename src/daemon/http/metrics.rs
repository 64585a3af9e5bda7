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

use crate::daemon::hub::{SensorSnapshot, Series, Snapshot};
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
    let subscribers = [(Vec::new(), now.subscribers as f64)];
    let help = "Subscribers there are, on sockets and pages";
    gauges(&mut registry, "subscribers", help, subscribers);
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

/// These labels of a series, and that of the sensor.
fn of(sensor: &SensorSnapshot, more: Labels) -> Labels {
    let sensor = ("sensor", sensor.state.status.sensor.clone());
    [vec![sensor], more].concat()
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
    let sensors = || now.sensors.iter();
    for (name, help, count) in counts {
        let series = sensors().map(|one| (of(one, Vec::new()), count(&one.state)));
        counters(registry, name, help, series);
    }
    let states = sensors().flat_map(|one| {
        LinkState::ALL.map(|known| {
            let holds = f64::from(u8::from(one.state.status.state == known));
            (of(one, vec![("state", event::name(&known))]), holds)
        })
    });
    let help = "State of the link: 1 for the one that holds";
    gauges(registry, "link_state", help, states);
    let rates =
        sensors().filter_map(|one| Some((of(one, Vec::new()), one.state.status.frame_rate_hz?)));
    gauges(registry, "frame_rate_hertz", "Measured frame rate", rates);
    let ages =
        sensors().filter_map(|one| Some((of(one, Vec::new()), one.last_frame_age?.as_secs_f64())));
    let help = "Age of the last whole frame; absent before the first";
    gauges(registry, "last_frame_age_seconds", help, ages);
}

/// The series of presses and verdicts.
fn presses(registry: &mut Registry, now: &Snapshot) {
    for (name, help) in [
        ("presses", "Presses, by what became of them"),
        ("verdicts", "Verdicts, by level"),
        ("verdicts_rejected", "Verdicts withheld, by reason"),
    ] {
        let series = now.sensors.iter().flat_map(|one| {
            let zeros = first_series(now).into_iter().map(|series| (series, 0));
            let counted = one.counts.clone().into_iter();
            let all = zeros.chain(counted);
            let named = all.filter(|((metric, _), _)| *metric == name);
            named.map(|((_, labels), count)| (of(one, labels), count))
        });
        counters(registry, name, help, series);
    }
}

/// The series of a sensor that are there before its first press. A reload may replace the model of some levels.
fn first_series(now: &Snapshot) -> Vec<Series> {
    let press = |state: &str| ("presses", vec![("state", state.to_owned())]);
    let mut all = Vec::from(["begin", "end", "aborted"].map(press));
    for phase in ["early", "final"] {
        let with = |key, value| vec![("phase", phase.to_owned()), (key, value)];
        for level in &now.hello.model.levels {
            all.push(("verdicts", with("level", level.level.to_string())));
        }
        for reason in ["low_confidence", "low_force", "ambiguous"] {
            all.push(("verdicts_rejected", with("reason", reason.to_owned())));
        }
    }
    all
}
