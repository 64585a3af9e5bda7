//! The trial of a model file in a child process, before this process loads the file.
//!
//! In: the bytes of a model file, and how long a verdict may take. Out: the [`Model`], or the reason
//! why the file is refused. With some files the inference library panics, fills the memory or never
//! ends. That happens to the child. This process then reports it in one line and continues. The
//! child is the same program, which calls [`entry`] first. If nobody has called [`entry`], as in a
//! test of the library, there is no trial.

use std::io::{Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use rustix::process::{Resource, Rlimit, Signal};
use rustix::time::ClockId;

use crate::verdict::{self, Model, ModelError};

/// The name (argv 0) by which a process of the program knows that it is a trial.
const NAME: &str = "hardnessd-trial";
/// The share of a frame's period that a verdict may take.
const SHARE: f64 = 0.1;
/// A verdict may take the first time whatever the sensor's rate is, and never more than the second,
/// because the daemon does nothing else during a verdict.
const VERDICT_MOST: [Duration; 2] = [Duration::from_millis(1), Duration::from_millis(20)];
/// The address space of a trial, in bytes.
const MEMORY_BYTES: u64 = 1 << 30;
/// The processor time of a trial.
const PROCESSOR: Duration = Duration::from_secs(10);
/// The number of verdicts that are timed.
const VERDICTS: usize = 15;
/// After this much processor time, no further verdict is timed.
const TIMED: Duration = Duration::from_secs(1);
/// The program that runs as a trial. Without it, there is no trial.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// The answer of a trial, as a line of JSON: the median of the processor time of verdicts, in
/// microseconds, or why the file is refused.
type Answer = Result<f64, String>;

/// The longest time for a verdict if the fastest sensor sends `frame_rate_hz` frames a second.
pub fn verdict_most(frame_rate_hz: f64) -> Duration {
    let [least, most] = VERDICT_MOST;
    let share = Duration::try_from_secs_f64(SHARE / frame_rate_hz).unwrap_or(most);
    share.clamp(least, most)
}

/// Allows this process to try models. If this process is itself a trial, runs the trial and returns
/// its exit code.
pub fn entry() -> Option<ExitCode> {
    if std::env::args_os().next().is_some_and(|name| name == NAME) {
        return Some(trial());
    }
    // This is still the same program if another one has been installed in its place.
    set_program("/proc/self/exe".into());
    None
}

/// Tries models with another program, which calls [`entry`]. This is for tests, whose own program
/// does not call it.
pub fn set_program(program: PathBuf) {
    let _ = PROGRAM.set(program);
}

/// Loads a model file after a trial. If `most` is given, a verdict may take no longer.
///
/// # Errors
///
/// Returns the errors of [`Model::load`], and an error if the trial does not complete or a verdict takes too
/// long.
pub fn load(bytes: &[u8], most: Option<Duration>) -> Result<Model, ModelError> {
    if bytes.len() > verdict::MAX_FILE_BYTES {
        return Err(ModelError::too_large(bytes.len()));
    }
    if let Some(program) = PROGRAM.get() {
        let found = tried(Command::new(program).arg0(NAME), bytes)?;
        if let Some(expected) = most
            && found > expected
        {
            let [found, expected] = [found, expected].map(|time| time.as_secs_f64() * 1e3);
            return Err(ModelError::new(format!(
                "model takes {found:.1} ms for a verdict: expected at most {expected:.1} ms, a tenth of the \
                 fastest sensor's frame period (but 1 to 20 ms)"
            )));
        }
    }
    Model::load(bytes)
}

/// Runs a trial of the file in a child. Returns how long a verdict takes.
fn tried(command: &mut Command, bytes: &[u8]) -> Result<Duration, ModelError> {
    let refused = |problem: String| ModelError::new(format!("model: {problem}"));
    let mut child = command
        // At its start, the trainer's allocator takes a GiB of address space. That is all that a
        // trial may have, so good models sometimes failed.
        .env("MIMALLOC_ARENA_RESERVE", "64MiB")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .map_err(|error| refused(format!("no process to try it in: {error}")))?;
    let mut stdin = child.stdin.take().expect("it is piped");
    // A child that does not read says so by its end.
    let _ = stdin.write_all(bytes);
    drop(stdin);
    let output = child.wait_with_output();
    let output =
        output.map_err(|error| refused(format!("the process that tried it is lost: {error}")))?;
    match serde_json::from_slice::<Answer>(&output.stdout) {
        Ok(Ok(verdict_us)) => {
            let verdict = Duration::try_from_secs_f64(verdict_us / 1e6);
            Ok(verdict.unwrap_or(Duration::MAX))
        }
        Ok(Err(problem)) => Err(ModelError::new(problem)),
        Err(_) => Err(refused(why_silent(output.status))),
    }
}

/// The reason why a child that has ended gave no answer.
fn why_silent(status: ExitStatus) -> String {
    match status.signal().and_then(Signal::from_named_raw) {
        Some(Signal::XCPU | Signal::KILL) => format!(
            "it takes more than {} s of processor time to load, or more memory than there is",
            PROCESSOR.as_secs()
        ),
        Some(Signal::ABORT) => format!(
            "it takes more than {} MB of memory, or the inference library failed on it",
            MEMORY_BYTES >> 20
        ),
        _ => format!("the inference library failed on it ({status})"),
    }
}

/// Runs in the child: tries the file on stdin and answers on stdout.
fn trial() -> ExitCode {
    limit();
    let mut bytes = Vec::new();
    let read = std::io::stdin()
        .take(verdict::MAX_FILE_BYTES as u64 + 1)
        .read_to_end(&mut bytes);
    let judged: Answer = match read {
        Err(error) => Err(error.to_string()),
        Ok(_) => Model::load(&bytes)
            .and_then(|hrn| median_us(&hrn))
            .map_err(|error| error.to_string()),
    };
    // If writing fails, nobody is left to tell.
    let _ = serde_json::to_writer(std::io::stdout(), &judged);
    ExitCode::SUCCESS
}

/// Limits the resources of this process.
fn limit() {
    for (resource, most) in [
        (Resource::As, MEMORY_BYTES),
        (Resource::Core, 0),
        (Resource::Cpu, PROCESSOR.as_secs()),
    ] {
        // Where the system forbids a limit, the others still hold.
        let (current, maximum) = (Some(most), Some(most));
        let _ = rustix::process::setrlimit(resource, Rlimit { current, maximum });
    }
    // When memory is short, the system kills this process before the daemon.
    let _ = std::fs::write("/proc/self/oom_score_adj", "1000");
    let _ = rustix::process::set_parent_process_death_signal(Some(Signal::KILL));
}

/// The median of the processor time of verdicts. Processor time excludes that of other processes.
fn median_us(hrn: &Model) -> Result<f64, ModelError> {
    let now = || {
        let time = rustix::time::clock_gettime(ClockId::ThreadCPUTime);
        Duration::try_from(time).unwrap_or_default()
    };
    let begun = now();
    let mut times = Vec::new();
    for index in (0..hrn.checks().count()).cycle().take(VERDICTS) {
        let before = now();
        hrn.judge_check(index)?;
        times.push(now().saturating_sub(before));
        if now().saturating_sub(begun) > TIMED {
            break;
        }
    }
    times.sort_unstable();
    Ok(times[times.len() / 2].as_secs_f64() * 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_verdict_may_take_a_tenth_of_a_period_within_bounds() {
        for (hz, ms) in [(5.0, 20), (50.0, 2), (100.0, 1), (1e6, 1), (1e-3, 20)] {
            assert_eq!(verdict_most(hz), Duration::from_millis(ms), "{hz}");
        }
    }

    #[test]
    fn a_child_that_fails_in_any_way_is_a_line() {
        // A pipe holds less than this, and no child reads it.
        let bytes = vec![0; 1 << 20];
        let tried = |script: &str| tried(Command::new("sh").args(["-c", script]), &bytes);
        for (script, expected) in [
            ("kill -ABRT $$", "more than 1024 MB of memory, or"),
            (
                "kill -SEGV $$",
                "the inference library failed on it (signal: 11",
            ),
            ("kill -XCPU $$", "more than 10 s of processor time"),
            ("echo nonsense", "the inference library failed on it"),
            (r#"echo '{"Err":"model of clay"}'"#, "model of clay"),
        ] {
            let line = tried(script).unwrap_err().to_string();
            assert!(line.contains(expected), "{script}: {line}");
            assert!(!line.contains('\n'), "{line}");
        }
        let good = tried(r#"echo '{"Ok":2000.0}'"#);
        assert_eq!(good.unwrap(), Duration::from_millis(2));
        let none = super::tried(&mut Command::new("/nonexistent"), b"").unwrap_err();
        assert!(
            none.to_string().contains("no process to try it in"),
            "{none}"
        );
    }
}
