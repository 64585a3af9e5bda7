//! The trial of a model file in a child process, before this process loads the file.
//!
//! In: the bytes of a model file, and how long a verdict may take. Out: the [`Hrn`], or the reason
//! why the file is refused. With some files the inference library panics, fills the memory or never
//! ends. That happens to the child. This process then reports it in one line and continues. The
//! child is the same program, which calls [`entry`] first. If nobody has called [`entry`], as in a
//! test of the library, there is no trial.

use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::panic::{self, PanicHookInfo};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::MemfdFlags;
use rustix::io::Errno;
use rustix::process::{Resource, Rlimit, Signal};
use rustix::time::ClockId;
use serde::{Deserialize, Serialize};

use crate::verdict::{self, Hrn, ModelError};

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
/// The wall-clock time of a trial. It is longer, because other processes may be busy.
const DEADLINE: Duration = Duration::from_secs(30);
/// The number of verdicts that are timed.
const VERDICTS: usize = 15;
/// After this much processor time, no further verdict is timed.
const TIMED: Duration = Duration::from_secs(1);
/// The longest answer of a trial.
const ANSWER_BYTES: u64 = 64 << 10;

/// The program that runs as a trial. Without it, there is no trial.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// The answer of a trial, as a line of JSON.
#[derive(Debug, Serialize, Deserialize)]
enum Answer {
    /// The file is good. The number is the median of the processor time of its verdicts.
    Good {
        verdict_us: f64,
    },
    Refused(String),
    Panicked(String),
}

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
/// Returns the errors of [`Hrn::load`]. Also returns [`ModelError::Trial`] if the trial refuses the
/// file or does not complete, and [`ModelError::Slow`] if a verdict takes too long.
pub fn load(bytes: &[u8], most: Option<Duration>) -> Result<Hrn, ModelError> {
    if bytes.len() > verdict::MAX_FILE_BYTES {
        return Err(ModelError::TooLarge { found: bytes.len() });
    }
    if let Some(program) = PROGRAM.get() {
        let found = tried(child(program), bytes, DEADLINE)?;
        if let Some(expected) = most
            && found > expected
        {
            return Err(ModelError::Slow { found, expected });
        }
    }
    Hrn::load(bytes)
}

/// Tries a model file, without a limit for the time of a verdict. Succeeds if the trial completes,
/// even if it refuses the file: [`Hrn::load`] and [`Hrn::read`] then return an error of their own
/// here, which names the refused part.
///
/// # Errors
///
/// Returns [`ModelError::Trial`] if the trial does not complete, and [`ModelError::TooLarge`].
pub fn survives(bytes: &[u8]) -> Result<(), ModelError> {
    if bytes.len() > verdict::MAX_FILE_BYTES {
        return Err(ModelError::TooLarge { found: bytes.len() });
    }
    if let Some(program) = PROGRAM.get() {
        let _ = answered(child(program), bytes, DEADLINE)?;
    }
    Ok(())
}

/// The command that starts a trial.
fn child(program: &Path) -> Command {
    let mut command = Command::new(program);
    command.arg0(NAME);
    // At its start, the trainer's allocator takes a GiB of address space. That is all that a trial
    // may have, so good models sometimes failed.
    command.env("MIMALLOC_ARENA_RESERVE", "64MiB");
    command
}

/// Runs a trial of the file in a child. Returns how long a verdict takes.
fn tried(command: Command, bytes: &[u8], deadline: Duration) -> Result<Duration, ModelError> {
    answered(command, bytes, deadline)?.map_err(ModelError::Trial)
}

/// Runs a trial of the file in a child. Returns how long a verdict takes, or why the child refuses
/// the file. A trial that does not complete is an error.
fn answered(
    mut command: Command,
    bytes: &[u8],
    deadline: Duration,
) -> Result<Result<Duration, String>, ModelError> {
    let trial = |problem: String| ModelError::Trial(format!("model: {problem}"));
    let file =
        in_memory(bytes).map_err(|error| trial(format!("no memory to try it from: {error}")))?;
    let mut child = command
        .stdin(file)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .map_err(|error| trial(format!("no process to try it in: {error}")))?;
    let answer = read_answer(&mut child, deadline);
    // The child may have answered and still hang.
    let _ = child.kill();
    let ended = child.wait();
    match answer {
        Some(Answer::Good { verdict_us }) => {
            let verdict = Duration::try_from_secs_f64(verdict_us / 1e6);
            Ok(Ok(verdict.unwrap_or(Duration::MAX)))
        }
        Some(Answer::Refused(problem)) => Ok(Err(problem)),
        Some(Answer::Panicked(problem)) => Err(trial(format!(
            "the inference library failed on it: {problem}"
        ))),
        None => Err(trial(match ended {
            Ok(status) => why_silent(status),
            Err(error) => format!("the process that tried it is lost: {error}"),
        })),
    }
}

/// A file that holds `bytes` and is nowhere on a disk. A child that does not read it keeps nobody
/// waiting, as a pipe would.
fn in_memory(bytes: &[u8]) -> io::Result<File> {
    let mut file = File::from(rustix::fs::memfd_create("model", MemfdFlags::CLOEXEC)?);
    file.write_all(bytes)?;
    file.rewind()?;
    Ok(file)
}

/// Waits for the child's answer, in this thread: there may be no other. `None` if there is no answer.
fn read_answer(child: &mut Child, deadline: Duration) -> Option<Answer> {
    let mut stdout = child.stdout.take()?.take(ANSWER_BYTES);
    let end = Instant::now() + deadline;
    let mut line = Vec::new();
    let mut read = 1;
    while read > 0 {
        let left = end.checked_duration_since(Instant::now())?;
        let mut waiting = [PollFd::new(stdout.get_ref(), PollFlags::IN)];
        match poll(&mut waiting, Some(&left.try_into().ok()?)) {
            Ok(0) | Err(Errno::INTR) => continue,
            ready => ready.ok()?,
        };
        let mut part = [0; 4096];
        read = stdout.read(&mut part).ok()?;
        line.extend(&part[..read]);
    }
    // After a panic, a second answer may follow. Only the first answer counts.
    let mut answers = serde_json::Deserializer::from_slice(&line).into_iter();
    answers.next()?.ok()
}

/// The reason why a child that has ended gave no answer.
fn why_silent(status: ExitStatus) -> String {
    let signal = status.signal().and_then(Signal::from_named_raw);
    match signal {
        Some(Signal::XCPU) => format!(
            "it takes more than {} s of processor time to load",
            PROCESSOR.as_secs()
        ),
        Some(Signal::KILL) => format!(
            "it took more than {} s to load, or more memory than there is",
            DEADLINE.as_secs()
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
    panic::set_hook(Box::new(|info| {
        write_answer(&Answer::Panicked(one_line(info)));
    }));
    let mut bytes = Vec::new();
    let read = std::io::stdin()
        .take(verdict::MAX_FILE_BYTES as u64 + 1)
        .read_to_end(&mut bytes);
    let answer = match read {
        Err(error) => Answer::Refused(error.to_string()),
        Ok(_) => match Hrn::load(&bytes).and_then(|hrn| median_us(&hrn)) {
            Ok(verdict_us) => Answer::Good { verdict_us },
            Err(error) => Answer::Refused(error.to_string()),
        },
    };
    write_answer(&answer);
    ExitCode::SUCCESS
}

/// Limits the resources of this process. Where the system forbids a limit, the deadline still
/// holds.
fn limit() {
    let bound = |most: u64| Rlimit {
        current: Some(most),
        maximum: Some(most),
    };
    let _ = rustix::process::setrlimit(Resource::As, bound(MEMORY_BYTES));
    let _ = rustix::process::setrlimit(Resource::Core, bound(0));
    let _ = rustix::process::setrlimit(
        Resource::Cpu,
        Rlimit {
            current: Some(PROCESSOR.as_secs()),
            maximum: Some(PROCESSOR.as_secs() + 1),
        },
    );
    // When memory is short, the system kills this process before the daemon.
    let _ = std::fs::write("/proc/self/oom_score_adj", "1000");
    let _ = rustix::process::set_parent_process_death_signal(Some(Signal::KILL));
}

/// The median of the processor time of verdicts. Processor time excludes that of other processes.
fn median_us(hrn: &Hrn) -> Result<f64, ModelError> {
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

fn one_line(info: &PanicHookInfo<'_>) -> String {
    let text = info.payload_as_str().unwrap_or("a panic");
    text.chars()
        .map(|char| if char.is_control() { ' ' } else { char })
        .take(200)
        .collect()
}

fn write_answer(answer: &Answer) {
    // If writing fails, nobody is left to tell.
    let _ = serde_json::to_writer(std::io::stdout(), answer);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_verdict_may_take_a_tenth_of_a_period_within_bounds() {
        for (hz, ms) in [
            (5.0, 20.0),
            (50.0, 2.0),
            (100.0, 1.0),
            (1e6, 1.0),
            (1e-3, 20.0),
        ] {
            let found = verdict_most(hz);
            assert!(
                (found.as_secs_f64() * 1e3 - ms).abs() < 1e-9,
                "{hz}: {found:?}"
            );
        }
    }

    #[test]
    fn a_child_that_fails_in_any_way_is_a_line() {
        let check = |script: &str, expected: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            // A pipe holds less than this, and no child reads it.
            let bytes = vec![0; 1 << 20];
            let error = tried(command, &bytes, Duration::from_millis(500)).unwrap_err();
            let line = error.to_string();
            assert!(line.contains(expected), "{script}: {line}");
            assert!(!line.contains('\n'), "{line}");
        };
        check("kill -ABRT $$", "more than 1024 MB of memory, or");
        check(
            "kill -SEGV $$",
            "the inference library failed on it (signal: 11",
        );
        check("kill -XCPU $$", "more than 10 s of processor time");
        check("exec sleep 60", "took more than 30 s to load");
        check("echo nonsense", "the inference library failed on it");
        check(
            r#"echo '{"Panicked":"at sea"}{"Refused":"so"}'"#,
            "failed on it: at sea",
        );
        check(r#"echo '{"Refused":"model of clay"}'"#, "model of clay");
        let none = tried(Command::new("/nonexistent"), b"", DEADLINE).unwrap_err();
        assert!(
            none.to_string().contains("no process to try it in"),
            "{none}"
        );
    }

    #[test]
    fn a_refusal_is_told_from_a_trial_that_does_not_complete() {
        let answered = |script: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            answered(command, b"", DEADLINE).map_err(|error| error.to_string())
        };
        let refused = answered(r#"echo '{"Refused":"model of clay"}'"#).unwrap();
        assert_eq!(refused, Err("model of clay".to_owned()));
        let good = answered(r#"echo '{"Good":{"verdict_us":2000.0}}'"#).unwrap();
        assert_eq!(good, Ok(Duration::from_millis(2)));
        let panicked = answered(r#"echo '{"Panicked":"at sea"}'"#).unwrap_err();
        assert!(panicked.contains("failed on it: at sea"), "{panicked}");
        assert!(answered("exit 3").is_err());
    }

    #[test]
    fn a_file_within_its_limits_is_timed() {
        let hrn = Hrn::load(verdict::BUILT_IN_HRN).unwrap();
        let us = median_us(&hrn).unwrap();
        assert!(us > 0.0 && us < 1e6, "{us}");
    }
}
