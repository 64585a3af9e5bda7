//! The log for the operator, on stderr: a line for each status, verdict and aborted press. The level
//! `debug` also has the other events of a press.
//!
//! Field names are stable: they are those of the published events. `RUST_LOG` sets the level, as
//! levels and `TARGET=LEVEL` separated by commas. Without it, the level is `info` for the daemon.
//! Nothing here is written to stdout, which is for events.

mod lines;
mod quota;

use std::collections::BTreeMap;
use std::fmt;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{Level, Subscriber, debug, error, info, warn};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Registry, reload};

use self::lines::Lines;
use self::quota::LineQuota;
use super::Error;
use crate::thread::NoThread;
use hardnessd_core::event::{Event, LinkState, Phase, PressState, Tared, name, round_3};
use hardnessd_core::judge::Unjudged;
use hardnessd_core::port::Port;
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
    /// Text on stderr as journald reads it: each line begins with its priority, and has no time.
    Journald,
}

/// How long the process waits at its end until its last lines are written.
const LAST_LINES: Duration = Duration::from_millis(200);

type Output = Box<dyn Layer<Registry> + Send + Sync>;

/// The log of this process. Its format may change while the process runs.
pub struct Log {
    output: reload::Handle<Output, Registry>,
    lines: Lines,
}

/// Writes the last lines before the process ends.
impl Drop for Log {
    fn drop(&mut self) {
        self.lines.flush(LAST_LINES);
    }
}

impl Log {
    /// Starts the log of the process, once. `level` is used if `RUST_LOG` is not set.
    ///
    /// # Errors
    ///
    /// Fails if `RUST_LOG` is malformed, the thread of the log cannot be started, or a log has been
    /// started before.
    pub fn start(settings: Settings, level: &str) -> Result<Self, Error> {
        let filter = filter(&std::env::var("RUST_LOG").unwrap_or_default(), level)?;
        // The filter is a layer beside the output: a filter inside the output would be lost when
        // the output is exchanged.
        let lines = Lines::start().map_err(NoThread)?;
        let (layer, output) = reload::Layer::new(output(settings, &lines));
        tracing_subscriber::registry()
            .with(layer)
            .with(filter)
            .try_init()
            .map_err(|_| Error::Config("the log was started twice".to_owned()))?;
        Ok(Self { output, lines })
    }

    /// Waits until all lines so far are written, but not longer than `LAST_LINES`.
    pub fn flush(&self) {
        self.lines.flush(LAST_LINES);
    }

    /// Writes in the format of `settings` from now on.
    pub fn change(&self, settings: Settings) {
        // It fails only after the log has ended.
        let _ = self.output.reload(output(settings, &self.lines));
    }
}

/// The filter of `directives`. Without directives, it passes the daemon's own lines of `level` and
/// above, and warnings of most libraries.
fn filter(directives: &str, level: &str) -> Result<Targets, Error> {
    // Libraries log only warnings. The libraries of DDS and of Foxglove log none: they warn of
    // harmless things, several times a second or whenever a peer causes it, and they return what
    // matters as an error.
    let unasked = format!("warn,rustdds=off,ros2_client=off,foxglove=off,hardnessd={level}");
    let parts = directives.split(',').map(str::trim);
    let parts: Vec<&str> = parts.filter(|part| !part.is_empty()).collect();
    if parts.is_empty() {
        return Ok(unasked.parse().expect("these are directives"));
    }
    let directives = parts.join(",");
    directives.parse().map_err(|_| {
        Error::Config(format!(
            "RUST_LOG: found {directives:?}, expected off, error, warn, info, debug or trace, or \
             TARGET=LEVEL, as in \"warn,hardnessd=debug\""
        ))
    })
}

fn output(settings: Settings, lines: &Lines) -> Output {
    let text = tracing_subscriber::fmt::layer()
        .with_writer(lines.clone())
        .with_target(false);
    match settings.format {
        Format::Text => text.with_ansi(std::io::stderr().is_terminal()).boxed(),
        // Fields are in an object of their own, because a verdict has a `level` and so has the
        // line.
        Format::Json => text.json().boxed(),
        Format::Journald => text
            .with_ansi(false)
            .with_level(false)
            .without_time()
            .map_event_format(Prioritised)
            .boxed(),
    }
}

/// Writes the priority of a line before the line, as journald reads it on stderr (sd-daemon(3)).
struct Prioritised<F>(F);

impl<S, N, F> FormatEvent<S, N> for Prioritised<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut line: Writer<'_>,
        event: &tracing::Event<'_>,
    ) -> fmt::Result {
        // syslog(3): 3 error, 4 warning, 6 informational, 7 debug.
        let priority = match *event.metadata().level() {
            Level::ERROR => 3,
            Level::WARN => 4,
            Level::INFO => 6,
            Level::DEBUG | Level::TRACE => 7,
        };
        write!(line, "<{priority}>")?;
        self.0.format_event(context, line, event)
    }
}

/// A line of this level: `warn` if something is wrong, `info` or `debug`.
macro_rules! line {
    ($level:expr, $($fields:tt)*) => {
        match $level {
            Level::WARN => warn!($($fields)*),
            Level::INFO => info!($($fields)*),
            _ => debug!($($fields)*),
        }
    };
}

/// The level of the line of an event.
fn level_of(event: &Event) -> Level {
    let is_wrong = match event {
        Event::Status(status) => {
            let is_gone = matches!(status.state, LinkState::Lost | LinkState::Stale);
            is_gone || status.reason.is_some()
        }
        Event::Press(press) if press.state != PressState::Aborted => return Level::DEBUG,
        Event::Press(_) => true,
        Event::Hardness(verdict) if verdict.phase == Phase::Early => return Level::DEBUG,
        Event::Hardness(_) => false,
        Event::Frame(_) => return Level::DEBUG,
    };
    if is_wrong { Level::WARN } else { Level::INFO }
}

/// Writes one line for an event, but none for a frame. Lines that are only for the level `debug` have no limit.
pub(crate) fn event(event: &Event) {
    match level_of(event) {
        Level::DEBUG => line_of(event),
        _ => limited(event.sensor(), || line_of(event)),
    }
}

fn line_of(event: &Event) {
    match event {
        Event::Status(status) => line!(
            level_of(event),
            seq = status.seq,
            sensor = status.sensor.as_str(),
            state = name(&status.state),
            reason = status.reason.as_deref(),
            frames = status.frames,
            frames_damaged = status.frames_damaged,
            frames_dropped = status.frames_dropped,
            bytes_skipped = status.bytes_skipped,
            "status"
        ),
        Event::Press(press) => line!(
            level_of(event),
            seq = press.seq,
            sensor = press.sensor.as_str(),
            press = press.press,
            state = name(&press.state),
            reason = press.reason,
            frame = press.frame,
            frames = press.frames,
            "press"
        ),
        // The numbers are rounded for the reader. The event itself has every digit.
        Event::Hardness(verdict) => line!(
            level_of(event),
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
    limited(sensor, || match outcome {
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
    });
}

/// Logs that the model failed on a press.
pub(crate) fn unjudged(unjudged: &Unjudged) {
    limited(&unjudged.sensor, || {
        error!(
            sensor = unjudged.sensor.as_str(),
            press = unjudged.press,
            phase = name(&unjudged.phase),
            reason = %unjudged.error,
            "no verdict"
        );
    });
}

/// Writes a line about a sensor, or one that somebody outside can cause again and again, unless there were too
/// many of this cause.
pub(crate) fn limited(cause: &str, line: impl FnOnce()) {
    static QUOTAS: Mutex<BTreeMap<String, LineQuota>> = Mutex::new(BTreeMap::new());
    let now = super::now().mono;
    // Nobody has to wait until the line is written.
    let allowed = {
        let mut quotas = QUOTAS.lock().unwrap_or_else(PoisonError::into_inner);
        quotas.entry(cause.to_owned()).or_default().allows(now)
    };
    let Some(left_out) = allowed else { return };
    if left_out > 0 {
        warn!(
            cause,
            lines = left_out,
            "left out of the log: too many lines of this cause"
        );
    }
    line();
}

/// Logs why what somebody sent is refused.
pub(crate) fn refused(sensor: &str, reason: &str) {
    limited(sensor, || warn!(sensor, reason, "refused"));
}

/// Logs that datagrams of `other` are ignored, because `sender` sends.
pub(crate) fn other_sender(sender: SocketAddr, other: SocketAddr) {
    limited("udp", || {
        warn!(%sender, %other, "ignored: another sender sends for this sensor, and one at a time may");
    });
}

/// Logs that the other end of a port is a telnet server, which changes some bytes.
pub(crate) fn telnet(port: &Port) {
    limited("tcp", || warn!(%port, "{}", hardnessd_core::wire::TELNET));
}

/// Logs the context that a controller reports of its work.
pub(crate) fn context(sensor: &str, context: Option<&serde_json::Value>) {
    limited(sensor, || {
        info!(
            sensor,
            context = context.map(|context| wording::escaped(&context.to_string())),
            "context"
        );
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rust_log_chooses_by_target_and_says_what_it_does_not_understand() {
        for (asked, ours, theirs) in [
            (" , ", Level::INFO, Level::WARN),
            ("hardnessd=debug,info", Level::DEBUG, Level::INFO),
            (" WARN, hardnessd=3,", Level::INFO, Level::WARN),
        ] {
            let filter = filter(asked, "info").unwrap();
            for (target, most) in [(module_path!(), ours), ("zenoh::net", theirs)] {
                let passes = |level| filter.would_enable(target, &level);
                assert!(passes(most), "{asked:?}");
                assert!(!passes(Level::TRACE) && (most == Level::DEBUG || !passes(Level::DEBUG)));
            }
        }
        for asked in ["info,hardnessd=loud", "hardnessd=debug=info"] {
            let message = filter(asked, "info").unwrap_err().to_string();
            let expected = format!("RUST_LOG: found {asked:?}, ");
            assert!(message.starts_with(&expected), "{message}");
        }
    }
}
