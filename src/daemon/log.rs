//! The log for the operator, on stderr: a line for each status, final verdict and aborted press.
//!
//! Field names are stable: they are those of the published events. `RUST_LOG` sets the level, as
//! levels and `TARGET=LEVEL` separated by commas. Without it, the level is `info` for the daemon.
//! Nothing here is written to stdout, which is for events.

mod lines;

use std::collections::BTreeMap;
use std::fmt;
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{Level, Subscriber, info, warn};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Registry, reload};

pub(crate) use self::lines::Lines;
use super::Error;
use hardnessd_core::allowance::Allowance;
use hardnessd_core::event::{Event, LinkState, Phase, PressState, Status, Tared, name, round_3};
use hardnessd_core::tare::RetareError;

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
        let lines = Lines::start()?;
        let (layer, output) = reload::Layer::new(output(settings, &lines));
        tracing_subscriber::registry()
            .with(layer)
            .with(filter)
            .try_init()
            .map_err(|_| Error::config("the log was started twice".to_owned()))?;
        Ok(Self { output, lines })
    }

    /// Where lines are written.
    pub(crate) fn lines(&self) -> &Lines {
        &self.lines
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
    // A word that is no level would count as a target, and leave out all others.
    let are_known = parts
        .iter()
        .all(|part| part.contains('=') || part.parse::<LevelFilter>().is_ok());
    let directives = parts.join(",");
    let filter = directives.parse().ok().filter(|_| are_known);
    filter.ok_or_else(|| {
        Error::config(format!(
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

/// Writes a line for a status, an aborted press and a final verdict.
pub(crate) fn event(event: &Event) {
    match event {
        Event::Status(status) => limited(&status.sensor, || line_of(status)),
        Event::Press(press) if press.state == PressState::Aborted => {
            limited(&press.sensor, || {
                warn!(
                    seq = press.seq,
                    sensor = press.sensor.as_str(),
                    press = press.press,
                    state = name(&press.state),
                    reason = press.reason,
                    frame = press.frame,
                    frames = press.frames,
                    "press"
                );
            });
        }
        // The numbers are rounded for the reader. The event itself has every digit.
        Event::Hardness(verdict) if verdict.phase == Phase::Final => {
            limited(&verdict.sensor, || {
                info!(
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
                );
            });
        }
        _ => {}
    }
}

/// Writes the line of a status: a warning if something is wrong.
fn line_of(status: &Status) {
    macro_rules! line {
        ($level:ident) => {
            $level!(
                seq = status.seq,
                sensor = status.sensor.as_str(),
                state = name(&status.state),
                reason = status.reason.as_deref(),
                frames = status.frames,
                frames_damaged = status.frames_damaged,
                frames_dropped = status.frames_dropped,
                bytes_skipped = status.bytes_skipped,
                "status"
            )
        };
    }
    let is_gone = matches!(status.state, LinkState::Lost | LinkState::Stale);
    match is_gone || status.reason.is_some() {
        true => line!(warn),
        false => line!(info),
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

/// The time that a line takes up: 40 lines a minute. That is a press every 1.5 s.
const LINE: Duration = Duration::from_millis(1500);
/// Eight lines may come at once.
const AT_ONCE: Duration = Duration::from_millis(7 * 1500);
/// How often the number of missing lines is logged.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// The lines of one cause in the log.
#[derive(Debug, Default)]
struct LineQuota {
    allowance: Allowance,
    /// The number of lines that were left out and not reported yet, and when the first one was.
    left_out: Option<(u64, Duration)>,
}

impl LineQuota {
    /// Whether a line may be written. If so, returns how many were left out before and are to be reported.
    fn allows(&mut self, now: Duration) -> Option<u64> {
        if !self.allowance.allows(now, LINE, AT_ONCE) {
            self.left_out.get_or_insert((0, now)).0 += 1;
            return None;
        }
        let is_due =
            |left_out: &mut (u64, Duration)| now.saturating_sub(left_out.1) >= REPORT_EVERY;
        Some(self.left_out.take_if(is_due).map_or(0, |(lines, _)| lines))
    }
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

    #[test]
    fn a_sensor_has_fewer_than_50_lines_in_any_minute() {
        let mut quota = LineQuota::default();
        let moments = (0..300_000).step_by(10);
        let is_written = |ms: &u64| quota.allows(Duration::from_millis(*ms)).is_some();
        let written: Vec<u64> = moments.filter(is_written).collect();
        for begin in &written {
            let minute = *begin..begin + 60_000;
            let lines = written.iter().filter(|at| minute.contains(at)).count();
            // One more may report those that were left out.
            assert!(lines + 1 < 50, "{lines} from {begin} ms on");
        }
        assert!(written.len() > 200);
    }
}
