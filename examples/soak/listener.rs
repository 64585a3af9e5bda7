//! Subscribers.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::sleep;
use std::time::Duration;

use hardnessd_simulator::random::Stream;
use serde_json::Value;

use crate::Failure;

/// How often a subscriber has read that a sensor is live, and that it is lost.
#[derive(Default)]
pub(crate) struct Link {
    pub(crate) lives: AtomicU64,
    pub(crate) losses: AtomicU64,
}

/// The record of a subscriber.
#[derive(Default)]
pub(crate) struct Received {
    pub(crate) events: u64,
    /// For each sensor and press, how the press ended. Empty if it has not ended.
    pub(crate) ends: Vec<Vec<String>>,
    pub(crate) problems: Vec<String>,
}

/// Reads to the end. The numbers of events and of presses must be consecutive.
pub(crate) fn receive(connection: UnixStream, links: &[Arc<Link>]) -> Result<Received, Failure> {
    let mut received = Received::default();
    received.ends.resize(links.len(), Vec::new());
    let mut last = None;
    for line in BufReader::new(connection).lines() {
        let event: Value = serde_json::from_str(&line?)?;
        if event["type"] == "gap" {
            received
                .problems
                .push(format!("a gap after event {last:?}"));
        }
        let name = event["sensor"]
            .as_str()
            .and_then(|name| name.strip_prefix('s'));
        let sensor = name.and_then(|number| number.parse::<usize>().ok());
        if let (Some(sensor), "status") = (sensor, event["type"].as_str().unwrap_or_default()) {
            let link = &links[sensor];
            link.lives
                .fetch_add(u64::from(event["state"] == "live"), Relaxed);
            link.losses
                .fetch_add(u64::from(event["state"] == "lost"), Relaxed);
        }
        // The number in a hello is that of the last event before it.
        let Some(seq) = event["seq"].as_u64() else {
            continue;
        };
        if last.is_some_and(|last| seq != last + 1) {
            received
                .problems
                .push(format!("event {seq} after {last:?}"));
        }
        last = Some(seq);
        received.events += u64::from(event["type"] != "hello");
        let Some(sensor) = sensor else {
            continue;
        };
        let ends = &mut received.ends[sensor];
        let press = event["press"].as_u64().unwrap_or_default() as usize;
        match (event["type"].as_str(), event["state"].as_str()) {
            (Some("press"), Some("begin")) => {
                if press != ends.len() + 1 {
                    received
                        .problems
                        .push(format!("s{sensor}: press {press} after {}", ends.len()));
                }
                ends.push(String::new());
            }
            (Some("press"), Some("aborted")) | (Some("hardness"), _)
                if event["phase"] != "early" =>
            {
                if let Some(end) = press.checked_sub(1).and_then(|place| ends.get_mut(place)) {
                    *end += event["phase"]
                        .as_str()
                        .or(event["reason"].as_str())
                        .unwrap_or("?");
                }
            }
            _ => {}
        }
    }
    Ok(received)
}

/// Again and again, connects, listens for a moment and disconnects.
pub(crate) fn come_and_go(socket: &Path, seed: u64, over: &AtomicBool) -> Result<(), Failure> {
    let mut stream = Stream::new(seed, "guest");
    while !over.load(Relaxed) {
        let mut connection = UnixStream::connect(socket)?;
        connection.write_all(b"{\"subscribe\":[\"frame\",\"press\"]}\n")?;
        let _ = connection.read(&mut [0; 4096])?;
        sleep(Duration::from_secs_f64(stream.range(0.1, 2.0)));
    }
    Ok(())
}
