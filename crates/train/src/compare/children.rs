//! Runs trainings as child processes, several at a time.
//!
//! In: the jobs. Out: the failures. Each process computes on one thread, so that a run gives the
//! same weights whatever runs beside it, and writes a log. When this process ends for any reason,
//! the system ends the child processes. Running the same command again resumes unfinished runs from
//! their last checkpoints.

use std::ffi::OsStr;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use indicatif::{HumanDuration, MultiProgress, ProgressBar, ProgressStyle};

/// How often the processes are polled.
const LOOKED_AFTER_EVERY: Duration = Duration::from_millis(100);

/// One run to start.
#[derive(Debug, Clone)]
pub(super) struct Job {
    /// The run's name in messages.
    pub(super) name: String,
    /// The subcommand and its arguments.
    pub(super) arguments: Vec<String>,
    /// The directory of a run to take finished stages from, if it exists when this run starts.
    pub(super) from: Option<PathBuf>,
    /// The file that receives standard output and standard error.
    pub(super) log: PathBuf,
    /// The file that exists when the run is done.
    pub(super) product: PathBuf,
    /// The name of a run to wait for if it is among the jobs, because this run takes finished
    /// stages from it.
    pub(super) after: Option<String>,
    /// The cost relative to other runs, in any unit.
    pub(super) effort: f64,
}

impl Job {
    /// The arguments that name the run to take stages from, if its directory exists. Its method may
    /// not be among those compared.
    fn taking(&self) -> Vec<&OsStr> {
        match &self.from {
            Some(run) if run.is_dir() => vec![OsStr::new("--from"), run.as_os_str()],
            _ => Vec::new(),
        }
    }
}

/// A run that ended without its product.
#[derive(Debug)]
pub(super) struct Failure {
    /// The name of the run.
    pub(super) name: String,
    /// The last line of its log, or its exit status.
    pub(super) reason: String,
}

struct Running {
    job: Job,
    process: Child,
    since: Instant,
    bar: ProgressBar,
}

/// Runs `jobs` in their order, `at_once` at a time, and calls `ended` with each that succeeded.
///
/// # Errors
///
/// Fails if a process cannot be started, a log cannot be written, or `ended` fails.
pub(super) fn run(
    jobs: Vec<Job>,
    at_once: usize,
    mut ended: impl FnMut(&Job) -> anyhow::Result<()>,
) -> anyhow::Result<Vec<Failure>> {
    let board = Board::new(&jobs, at_once);
    let mut progress = Progress::default();
    let mut waiting = jobs;
    let mut running: Vec<Running> = Vec::new();
    let mut failures = Vec::new();
    loop {
        while running.len() < at_once {
            let Some(next) = next(&waiting, &running) else {
                break;
            };
            running.push(start(waiting.remove(next), &board)?);
        }
        if running.is_empty() {
            break;
        }
        std::thread::sleep(LOOKED_AFTER_EVERY);
        let ended_before = board.total.position();
        let mut still = Vec::with_capacity(running.len());
        for mut child in running {
            let Some(status) = child.process.try_wait().context("a run's process")? else {
                child.bar.set_message(last_line(&child.job.log));
                still.push(child);
                continue;
            };
            child.bar.finish_and_clear();
            let seconds = child.since.elapsed().as_secs_f64();
            if status.success() && child.job.product.exists() {
                progress.add(&child.job, seconds);
                ended(&child.job)?;
                board.print(&format!("{}: done in {seconds:.0} s", child.job.name));
            } else {
                let reason = last_words(status, &child.job.log);
                board.print(&format!("{}: failed: {reason}", child.job.name));
                failures.push(Failure {
                    name: child.job.name,
                    reason,
                });
            }
            board.total.inc(1);
        }
        running = still;
        let left = progress.seconds_left(&waiting, &running, at_once);
        board.time_left(left, board.total.position() > ended_before);
    }
    board.total.finish_and_clear();
    Ok(failures)
}

/// The first waiting run that does not wait for an unfinished run.
fn next(waiting: &[Job], running: &[Running]) -> Option<usize> {
    let to_end = |name: &String| {
        let mut jobs = waiting.iter().chain(running.iter().map(|child| &child.job));
        jobs.any(|job| job.name == *name)
    };
    waiting
        .iter()
        .position(|job| !job.after.as_ref().is_some_and(to_end))
}

fn start(job: Job, board: &Board) -> anyhow::Result<Running> {
    let log = File::create(&job.log).with_context(|| job.log.display().to_string())?;
    let program = std::env::current_exe().context("this program's own path")?;
    let process = Command::new(program)
        .args(&job.arguments)
        .args(job.taking())
        .args(["--parent", &std::process::id().to_string()])
        .env("RAYON_NUM_THREADS", "1")
        .stdin(std::process::Stdio::null())
        .stdout(log.try_clone().context("a run's log")?)
        .stderr(log)
        .spawn()
        .with_context(|| format!("{}: cannot be started", job.name))?;
    Ok(Running {
        bar: board.child(&job.name),
        process,
        since: Instant::now(),
        job,
    })
}

/// The reason a run ended without its product.
fn last_words(status: ExitStatus, log: &Path) -> String {
    if matches!(status.code(), Some(0 | 130 | 143)) {
        return "it was stopped; the same command continues it".to_owned();
    }
    let line = last_line(log);
    if line.is_empty() {
        status.to_string()
    } else {
        line
    }
}

/// The last line of a log.
fn last_line(log: &Path) -> String {
    let text = std::fs::read(log).unwrap_or_default();
    let tail = &text[text.len().saturating_sub(4096)..];
    let text = String::from_utf8_lossy(tail);
    text.trim_end()
        .rsplit(['\n', '\r'])
        .next()
        .unwrap_or_default()
        .to_owned()
}

/// The cost of the finished runs, and the time they took.
#[derive(Default)]
struct Progress {
    effort: f64,
    seconds: f64,
}

impl Progress {
    fn add(&mut self, job: &Job, seconds: f64) {
        self.effort += job.effort;
        self.seconds += seconds;
    }

    /// The seconds left at the rate so far; `None` before the first run has ended.
    fn seconds_left(&self, waiting: &[Job], running: &[Running], at_once: usize) -> Option<f64> {
        let begun = |child: &Running| (child.job.effort, child.since.elapsed().as_secs_f64());
        let begun: Vec<(f64, f64)> = running.iter().map(begun).collect();
        let waiting: Vec<f64> = waiting.iter().map(|job| job.effort).collect();
        self.left(&waiting, &begun, at_once)
    }

    /// The seconds left, from the efforts of waiting runs, and the efforts and seconds so far of
    /// those that have begun. `None` before the first run has ended, and when no run is left.
    fn left(&self, waiting: &[f64], begun: &[(f64, f64)], at_once: usize) -> Option<f64> {
        let nothing_is_left = waiting.is_empty() && begun.is_empty();
        if self.effort <= 0.0 || nothing_is_left {
            return None;
        }
        let rate = self.seconds / self.effort;
        // For a run that takes longer than expected from the others, assume that a tenth of its
        // time so far is left.
        let left_of = |(effort, so_far): &(f64, f64)| (rate * effort - so_far).max(0.1 * so_far);
        let of_begun: Vec<f64> = begun.iter().map(left_of).collect();
        let not_begun: f64 = waiting.iter().map(|effort| rate * effort).sum();
        let spread = (of_begun.iter().sum::<f64>() + not_begun) / at_once as f64;
        let longest = of_begun.iter().copied().fold(0.0, f64::max);
        Some(spread.max(longest).max(1.0))
    }
}

/// The display of progress: bars on a terminal, lines elsewhere.
struct Board {
    bars: MultiProgress,
    total: ProgressBar,
}

impl Board {
    fn new(jobs: &[Job], at_once: usize) -> Self {
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len} runs{msg}")
            .expect("the template is right");
        let bars = MultiProgress::new();
        let total = bars.add(ProgressBar::new(jobs.len() as u64).with_style(style));
        let board = Self { bars, total };
        if !jobs.is_empty() {
            board.print(&format!("{} runs, {at_once} at a time", jobs.len()));
        }
        board
    }

    fn child(&self, name: &str) -> ProgressBar {
        let style = ProgressStyle::with_template("{prefix:16} {elapsed:>4} {wide_msg}")
            .expect("the template is right");
        let bar = ProgressBar::no_length()
            .with_style(style)
            .with_prefix(name.to_owned());
        if self.total.is_hidden() {
            hardnessd_core::stderr_line!("{name}: started");
        }
        self.bars.insert_before(&self.total, bar)
    }

    fn print(&self, line: &str) {
        if self.total.is_hidden() {
            hardnessd_core::stderr_line!("{line}");
        } else {
            // Only this call prints past the bars. It fails when the terminal is gone, where nobody
            // reads the line.
            let _ = self.bars.println(line);
        }
    }

    /// Shows the time left: always on a terminal, elsewhere only when a run has just `ended`.
    fn time_left(&self, seconds: Option<f64>, ended: bool) {
        let left = seconds.map_or_else(String::new, |seconds| {
            let left = HumanDuration(Duration::from_secs_f64(seconds));
            format!(", about {left} left")
        });
        if self.total.is_hidden() && ended {
            let (done, all) = (self.total.position(), self.total.length());
            hardnessd_core::stderr_line!("{done} of {} runs{left}", all.unwrap_or_default());
        }
        self.total.set_message(left);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_is_never_none_while_a_run_goes_on() {
        let mut progress = Progress::default();
        assert_eq!(progress.left(&[1.0], &[], 2), None);
        progress.effort = 2.0;
        progress.seconds = 20.0;
        // At 10 s per unit of effort, 30 s of work wait, and the running one has 10 of 20 s left.
        assert_eq!(progress.left(&[3.0], &[(2.0, 10.0)], 2), Some(20.0));
        // This run is far overdue.
        assert_eq!(progress.left(&[], &[(2.0, 300.0)], 2), Some(30.0));
        assert_eq!(progress.left(&[], &[(0.01, 0.0)], 2), Some(1.0));
        assert_eq!(progress.left(&[], &[], 2), None);
    }

    #[test]
    fn stages_are_taken_only_from_a_run_that_is_there() {
        let directory = tempfile::tempdir().unwrap();
        let job = |from: &str| Job {
            name: String::new(),
            arguments: Vec::new(),
            from: Some(directory.path().join(from)),
            log: PathBuf::new(),
            product: PathBuf::new(),
            after: None,
            effort: 1.0,
        };
        assert_eq!(job("missing").taking(), Vec::<&OsStr>::new());
        assert_eq!(
            job("").taking(),
            [OsStr::new("--from"), directory.path().join("").as_os_str()]
        );
    }
}
