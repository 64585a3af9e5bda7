//! The log for the operator: one line for each event, on stderr or in the journal.
//!
//! Field names are stable: they are those of the published events. `RUST_LOG` sets the level, as
//! levels and `TARGET=LEVEL` separated by commas. Without it, the level is `info` for the daemon.
//! Nothing here is written to stdout, which is for events.

mod journal;
mod limit;
mod lines;

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{error, info, warn};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Registry, reload};

use self::journal::Journal;
use self::limit::Limit;
use self::lines::Lines;
use super::serial::tty::Changed;
use hardnessd_core::event::{Event, LinkState, PressState, Tared, name, round_3};
use hardnessd_core::pipeline::Unjudged;
use hardnessd_core::tare::RetareError;
use hardnessd_core::wording;

/// The `[log]` table.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The format of a line.
    pub format: Format,
}

/// The format of a line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Text for people, on stderr.
    #[default]
    Text,
    /// One JSON object per line, on stderr.
    Json,
    /// Entries of the journal, whose fields have the prefix `HARDNESSD_`.
    Journald,
}

/// How long the process waits at its end until its last lines are written.
const LAST_LINES: Duration = Duration::from_millis(200);

type Output = Box<dyn Layer<Registry> + Send + Sync>;

/// The log of this process. Its format may change while the process runs.
pub struct Log {
    output: reload::Handle<Output, Registry>,
    lines: Lines,
    limit: Limit,
}

/// Writes the last lines before the process ends.
impl Drop for Log {
    fn drop(&mut self) {
        self.limit.report_all();
        self.lines.flush(LAST_LINES);
    }
}

/// The reason there is no log in the configured format.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is no journal.
    #[error(
        "log.format: there is no journal at {} for \"journald\": set \"text\" or \"json\"",
        journal::SOCKET
    )]
    Journal(#[source] std::io::Error),
    /// `RUST_LOG` is malformed.
    #[error(
        "RUST_LOG: found {found:?}, expected off, error, warn, info, debug or trace, or TARGET=LEVEL, \
         as in \"warn,hardnessd=debug\""
    )]
    Filter {
        /// The part of `RUST_LOG` that is wrong.
        found: String,
    },
    /// The thread that writes could not be started.
    #[error("log: cannot start a thread: {0}")]
    Thread(#[source] std::io::Error),
    /// A log was started before.
    #[error("the log was started twice")]
    Twice,
}

impl Log {
    /// Starts the log of the process, once. `level` is used if `RUST_LOG` is not set.
    ///
    /// # Errors
    ///
    /// Fails if `RUST_LOG` is malformed, the journal is configured and cannot be reached, the
    /// thread of the log cannot be started, or a log has been started before.
    pub fn start(settings: Settings, level: &str) -> Result<Self, Error> {
        let filter = filter(&std::env::var("RUST_LOG").unwrap_or_default(), level)?;
        // The filter is a layer beside the output: a filter inside the output would be lost when
        // the output is exchanged.
        let limit = Limit::default();
        let lines = Lines::start(limit.clone()).map_err(Error::Thread)?;
        let (layer, output) = reload::Layer::new(output(settings, &lines)?);
        tracing_subscriber::registry()
            .with(layer)
            .with(filter)
            .with(limit.clone())
            .try_init()
            .map_err(|_| Error::Twice)?;
        Ok(Self {
            output,
            lines,
            limit,
        })
    }

    /// From now on, each line on stderr first clears the line that the cursor is in. Call this if
    /// stderr is a terminal on which the process shows a line of progress.
    pub fn clear_progress(&self) {
        self.lines.clear_progress();
    }

    /// Waits until all lines so far are written, but not longer than `LAST_LINES`.
    pub fn flush(&self) {
        self.lines.flush(LAST_LINES);
    }

    /// Writes in the format of `settings` from now on.
    ///
    /// # Errors
    ///
    /// Fails if the journal is configured and cannot be reached. The log then stays as it is.
    pub fn change(&self, settings: Settings) -> Result<(), Error> {
        self.output
            .reload(output(settings, &self.lines)?)
            .map_err(|_| Error::Twice)
    }
}

/// The filter of `directives`. Without directives, it passes the daemon's own lines of `level` and
/// above, and warnings of most libraries.
fn filter(directives: &str, level: &str) -> Result<Targets, Error> {
    // Libraries log only warnings. The libraries of DDS and of Foxglove log none: they warn of
    // harmless things, several times a second or whenever a peer causes it, and they return what
    // matters as an error.
    let unasked = format!("warn,rustdds=off,ros2_client=off,foxglove=off,hardnessd={level}");
    let parts = |directives: &str| -> Vec<String> {
        let parts = directives.split(',').map(str::trim);
        parts
            .filter(|part| !part.is_empty())
            .map(str::to_owned)
            .collect()
    };
    let mut asked = parts(directives);
    if asked.is_empty() {
        asked = parts(&unasked);
    }
    // A bracket begins the name of a span. There are no spans here, so a bracket must be a mistake.
    let is_sound = |part: &String| !part.contains('[') && part.parse::<Targets>().is_ok();
    if let Some(found) = asked.iter().find(|part| !is_sound(part)).cloned() {
        return Err(Error::Filter { found });
    }
    let parsed = asked.join(",").parse();
    Ok(parsed.expect("a list of sound parts is sound"))
}

/// Checks that the log can be written: that the journal is there if it is configured.
pub(crate) fn check(settings: Settings) -> Result<(), Error> {
    match settings.format {
        Format::Text | Format::Json => Ok(()),
        Format::Journald => journal::find().map_err(Error::Journal),
    }
}

fn output(settings: Settings, lines: &Lines) -> Result<Output, Error> {
    let text = tracing_subscriber::fmt::layer()
        .with_writer(lines.clone())
        .with_target(false);
    Ok(match settings.format {
        Format::Text => text.with_ansi(std::io::stderr().is_terminal()).boxed(),
        // Fields are in an object of their own, because a verdict has a `level` and so has the
        // line.
        Format::Json => text.json().boxed(),
        Format::Journald => {
            journal::find().map_err(Error::Journal)?;
            let lines = lines.clone();
            Journal(move |entry| lines.enter(entry)).boxed()
        }
    })
}

/// Writes one line for a numbered event.
pub(crate) fn event(event: &Event) {
    match event {
        Event::Status(status) => {
            let state = name(&status.state);
            let reason = status.reason.as_deref();
            let (sensor, frames) = (status.sensor.as_str(), status.frames);
            let (frames_damaged, bytes_skipped) = (status.frames_damaged, status.bytes_skipped);
            let seq = status.seq;
            if matches!(status.state, LinkState::Lost | LinkState::Stale) || reason.is_some() {
                warn!(
                    seq,
                    sensor, state, reason, frames, frames_damaged, bytes_skipped, "status"
                );
            } else {
                info!(
                    seq,
                    sensor, state, frames, frames_damaged, bytes_skipped, "status"
                );
            }
        }
        Event::Press(press) => {
            let state = name(&press.state);
            let (sensor, number, reason) = (press.sensor.as_str(), press.press, press.reason);
            let (seq, frame, frames) = (press.seq, press.frame, press.frames);
            if press.state == PressState::Aborted {
                warn!(
                    seq,
                    sensor,
                    press = number,
                    state,
                    reason,
                    frame,
                    frames,
                    "press"
                );
            } else {
                info!(
                    seq,
                    sensor,
                    press = number,
                    state,
                    reason,
                    frame,
                    frames,
                    "press"
                );
            }
        }
        // The numbers are rounded for the reader. The event itself has every digit.
        Event::Hardness(verdict) => info!(
            seq = verdict.seq,
            sensor = verdict.sensor.as_str(),
            press = verdict.press,
            phase = name(&verdict.phase),
            level = verdict.level,
            label = verdict.label.as_deref(),
            rejected = verdict.rejected.as_ref().map(name),
            confidence = (f64::from(verdict.confidence) * 1e4).round() / 1e4,
            frame = verdict.frame,
            force_n = round_3(verdict.force_n),
            contact_area_taxels = verdict.contact_area_taxels,
            model = verdict.model.as_str(),
            "hardness"
        ),
        Event::Frame(_) => {}
    }
}

/// Logs the outcome of a tare that a client requested.
pub(crate) fn tare(sensor: &str, outcome: &Result<Tared, RetareError>) {
    match outcome {
        Ok(Tared { old, new, .. }) => info!(
            sensor,
            old_mean_counts = old.mean_counts,
            old_least_counts = old.least_counts,
            old_most_counts = old.most_counts,
            new_mean_counts = new.mean_counts,
            new_least_counts = new.least_counts,
            new_most_counts = new.most_counts,
            "tare"
        ),
        Err(refusal) => warn!(sensor, reason = %refusal, "tare refused"),
    }
}

/// Logs that the model failed on a press.
pub(crate) fn unjudged(unjudged: &Unjudged) {
    error!(
        sensor = unjudged.sensor.as_str(),
        press = unjudged.press,
        phase = name(&unjudged.phase),
        reason = %unjudged.error,
        "no verdict"
    );
}

/// Logs that this machine's calendar clock was set, by `by_ms`, while positions of the arm came.
pub(crate) fn clock_set(sensor: &str, by_ms: f64) {
    warn!(
        sensor,
        by_ms,
        "this machine's calendar clock was set: the approach of a press under way is unknown"
    );
}

/// Logs that a sensor sends frames at another rate than its configuration says.
pub(crate) fn frame_rate(sensor: &str, frame_rate_hz: f64, measured_hz: f64) {
    let measured_hz = (10.0 * measured_hz).round() / 10.0;
    warn!(
        sensor,
        frame_rate_hz,
        measured_hz,
        "the sensor sends frames at another rate: set frame_rate_hz to it"
    );
}

/// Logs that another program had changed the settings of a serial line.
pub(crate) fn line_settings(sensor: &str, changed: &Changed) {
    warn!(
        sensor,
        found = changed.found,
        expected = changed.expected,
        "another program changed the settings of the line: they are set again"
    );
}

/// Logs that a second sender sends datagrams for a sensor.
pub(crate) fn stranger(sensor: &str, address: SocketAddr) {
    warn!(
        sensor,
        %address,
        "ignored: another sender sends for this sensor, and one at a time may"
    );
}

/// Logs the context that a controller reports of its work.
pub(crate) fn context(sensor: &str, context: Option<&serde_json::Value>) {
    info!(
        sensor,
        context = context.map(|context| wording::escaped(&context.to_string())),
        "context"
    );
}

#[cfg(test)]
mod tests {
    use tracing::Level;

    use super::*;

    #[test]
    fn rust_log_chooses_by_target_and_says_what_it_does_not_understand() {
        for (asked, ours, theirs) in [
            ("", Some(Level::INFO), Some(Level::WARN)),
            (" , ", Some(Level::INFO), Some(Level::WARN)),
            ("debug", Some(Level::DEBUG), Some(Level::DEBUG)),
            (
                "hardnessd=debug,info",
                Some(Level::DEBUG),
                Some(Level::INFO),
            ),
            (" WARN, hardnessd=3,", Some(Level::INFO), Some(Level::WARN)),
            ("hardnessd::daemon::log=trace", Some(Level::TRACE), None),
            ("hardnessd", Some(Level::TRACE), None),
            ("off", None, None),
        ] {
            let filter = filter(asked, "info").unwrap();
            let most = |target| {
                let levels = [
                    Level::TRACE,
                    Level::DEBUG,
                    Level::INFO,
                    Level::WARN,
                    Level::ERROR,
                ];
                levels
                    .into_iter()
                    .find(|level| filter.would_enable(target, level))
            };
            assert_eq!(most(module_path!()), ours, "{asked:?}");
            assert_eq!(most("zenoh::net"), theirs, "{asked:?}");
        }
        for (asked, found) in [
            ("info,hardnessd=loud", "hardnessd=loud"),
            ("hardnessd=debug=info", "hardnessd=debug=info"),
            ("info,hardnessd[press]=debug", "hardnessd[press]=debug"),
        ] {
            let message = filter(asked, "info").unwrap_err().to_string();
            assert!(
                message.starts_with(&format!("RUST_LOG: found {found:?}, ")),
                "{message}"
            );
        }
    }
}
