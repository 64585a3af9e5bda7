//! Limits how often the same line is repeated.
//!
//! A program that sends commands can make the daemon log as fast as that program can write. So of
//! the lines from one place in the source about one sensor, at most [`MOST`] are written within
//! [`WINDOW`]. The others are counted. Before the next line after the window, or at the end of the
//! program, one line gives their number.
//!
//! Two kinds of line are always written: numbered events (they have a `seq`), which only a sensor
//! can cause, and lines below `info`, which the operator requested with `RUST_LOG`.

use std::collections::HashMap;
use std::fmt::Debug;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber, warn};
use tracing_subscriber::layer::{Context, Layer};

/// The most lines of one kind that are written within a window.
const MOST: u64 = 50;

/// The length of a window. It begins with the first line of its kind.
const WINDOW: Duration = Duration::from_secs(10);

/// The field that marks the line with the number of lines left out.
const LEFT_OUT: &str = "left_out";

/// The layer that leaves lines out. Clones share the counts.
#[derive(Clone, Default)]
pub(super) struct Limit(Arc<Mutex<Windows>>);

impl Limit {
    /// Logs the number of lines left out in every window that has ended by `now`.
    pub(super) fn report(&self, now: Instant) {
        let over = self.windows().close(now);
        for LeftOut { what, lines } in over {
            let About { message, sensor } = what;
            let within_s = WINDOW.as_secs();
            warn!(
                left_out = lines,
                within_s,
                of = message,
                sensor,
                "lines left out"
            );
        }
    }

    /// Logs the number of lines left out so far, because no more lines follow.
    pub(super) fn report_all(&self) {
        self.report(Instant::now() + WINDOW);
    }

    fn windows(&self) -> MutexGuard<'_, Windows> {
        // The counts stay usable even if a thread panicked while it changed them.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<S: Subscriber> Layer<S> for Limit {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let meta = event.metadata();
        let never_left_out = ["seq", LEFT_OUT]
            .iter()
            .any(|name| meta.fields().field(*name).is_some());
        if *meta.level() > Level::INFO || never_left_out {
            return true;
        }
        let mut about = About::default();
        event.record(&mut about);
        self.windows().admit(meta.callsite(), about, Instant::now())
    }
}

/// The message of a line, and the sensor that it is about.
#[derive(Debug, Clone, Default, PartialEq)]
struct About {
    message: String,
    sensor: Option<String>,
}

impl Visit for About {
    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "sensor" => self.sensor = Some(value.to_owned()),
            "message" => value.clone_into(&mut self.message),
            _ => {}
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            self.message = format!("{value:?}");
        }
    }
}

/// The number of lines that were not written, and what they were about.
#[derive(Debug, PartialEq)]
struct LeftOut {
    what: About,
    lines: u64,
}

/// The windows that are open, by place in the source and sensor.
#[derive(Default)]
struct Windows(HashMap<(Identifier, Option<String>), Window>);

struct Window {
    since: Instant,
    lines: u64,
    message: String,
}

impl Windows {
    /// Counts a line. Returns whether the line is to be written.
    fn admit(&mut self, place: Identifier, about: About, now: Instant) -> bool {
        let window = self.0.entry((place, about.sensor)).or_insert(Window {
            since: now,
            lines: 0,
            message: about.message,
        });
        window.lines += 1;
        window.lines <= MOST
    }

    /// Closes the windows that have ended, and returns what they left out.
    fn close(&mut self, now: Instant) -> Vec<LeftOut> {
        let over = |window: &Window| now.saturating_duration_since(window.since) >= WINDOW;
        let closed = self.0.extract_if(|_, window| over(window));
        closed
            .filter(|(_, window)| window.lines > MOST)
            .map(|((_, sensor), Window { lines, message, .. })| LeftOut {
                what: About { message, sensor },
                lines: lines - MOST,
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn about(sensor: Option<&str>) -> About {
        About {
            message: "tare refused".to_owned(),
            sensor: sensor.map(str::to_owned),
        }
    }

    #[test]
    fn what_repeats_is_left_out_and_counted_and_other_lines_are_not() {
        let place =
            tracing::callsite!(name: "one", kind: tracing::metadata::Kind::EVENT, fields: "");
        let other =
            tracing::callsite!(name: "two", kind: tracing::metadata::Kind::EVENT, fields: "");
        let id = |place: &'static dyn tracing::Callsite| Identifier(place);
        let (mut windows, start) = (Windows::default(), Instant::now());
        let mut written = 0;
        for _ in 0..86_000 {
            written += u64::from(windows.admit(id(place), about(Some("forearm")), start));
        }
        assert_eq!(written, MOST);
        assert!(windows.admit(id(place), about(Some("wrist")), start));
        assert!(windows.admit(id(other), about(Some("forearm")), start));
        assert_eq!(windows.close(start + WINDOW / 2), []);
        let expected = LeftOut {
            what: about(Some("forearm")),
            lines: 86_000 - MOST,
        };
        assert_eq!(windows.close(start + WINDOW), [expected]);
        // In a new window the line is written again.
        assert!(windows.admit(id(place), about(Some("forearm")), start + WINDOW));
    }
}
