//! How the kernel runs a process: its scheduling, its sleep, and whether its memory is locked.
//!
//! The daemon does not ask for real-time scheduling. systemd sets it before it starts the daemon
//! (`CPUSchedulingPolicy=` of the unit), and the sandbox then refuses any change. Threads that the
//! daemon starts are scheduled as ordinary ones (`CPUSchedulingResetOnFork=`): they serve clients,
//! log, record and load models. The daemon locks its memory itself, because systemd cannot. It does so where the
//! unit has removed the limit (`LimitMEMLOCK=`), or where the daemon may ignore the limit.

use std::cell::Cell;
use std::path::Path;
use std::time::Duration;
use std::{fmt, fs};

use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;
use tracing::warn;

/// Work for this long is followed by a pause. `LimitRTTIME` in the unit is 500 ms.
const MOST: Duration = Duration::from_millis(20);
const PAUSE: Duration = Duration::from_micros(100);
/// One of so many calls of [`rest`] reads the thread's clock, which takes a system call. What lies
/// between two calls takes some milliseconds at most.
const CALLS_A_READING: u32 = 16;

/// Pauses this thread for a moment after each 20 ms of work. In real-time scheduling the system kills
/// a process whose thread never sleeps. Clients that subscribe again and again, each time since the
/// start, or a sensor that sends without end could leave it no sleep of its own: where something is
/// there, a wait returns at once. Call it between two pieces of work for others.
pub(super) fn rest() {
    thread_local! {
        static CALLS: Cell<u32> = const { Cell::new(0) };
        /// The processor time of this thread at its last pause.
        static RESTED: Cell<Duration> = const { Cell::new(Duration::ZERO) };
    }
    CALLS.set((CALLS.get() + 1) % CALLS_A_READING);
    if CALLS.get() != 0 {
        return;
    }
    let used = Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default();
    if used.saturating_sub(RESTED.get()) > MOST {
        RESTED.set(used);
        std::thread::sleep(PAUSE);
    }
}

/// Keeps the pages of this process in memory, each from its first use on. This takes no more memory
/// than before. If the memory that the process may lock is limited, this locks nothing: at the
/// limit, the system would refuse memory that the process needs later.
pub(super) fn lock_memory() {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    if getrlimit(Resource::Memlock).current.is_some() && !may_lock(&status) {
        return;
    }
    let flags = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT;
    if let Err(error) = rustix::mm::mlockall(flags) {
        warn!(%error, "the memory is not locked: a busy machine may delay events");
    }
}

/// Whether a process may ignore the limit, because it has CAP_IPC_LOCK in its proc_pid_status(5).
fn may_lock(status: &str) -> bool {
    const IPC_LOCK: u32 = 14;
    let mut lines = status.lines();
    let capabilities = lines.find_map(|line| line.strip_prefix("CapEff:"));
    let bits = capabilities.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok());
    bits.is_some_and(|bits| bits >> IPC_LOCK & 1 == 1)
}

/// The scheduling of a process, and whether its memory is locked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Scheduling {
    /// The policy of its main thread.
    #[serde(rename = "scheduling")]
    pub policy: Policy,
    /// Its real-time priority; 0 for ordinary scheduling.
    pub priority: u32,
    /// Whether its pages stay in memory once they are there.
    pub memory_locked: bool,
}

/// A scheduling policy of sched(7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Policy {
    /// Ordinary scheduling: SCHED_OTHER.
    Other,
    /// Real time, until the thread waits: SCHED_FIFO.
    Fifo,
    /// Real time, in turns with threads of the same priority: SCHED_RR.
    Rr,
    /// Ordinary scheduling for work that does not interact: SCHED_BATCH.
    Batch,
    /// Only when nothing else runs: SCHED_IDLE.
    Idle,
    /// Real time, by deadlines: SCHED_DEADLINE.
    Deadline,
}

impl Scheduling {
    /// Reads the scheduling of a process from its directory in /proc. Returns `None` if the
    /// directory does not have it.
    pub fn of(process: &Path) -> Option<Self> {
        let stat = fs::read_to_string(process.join("stat")).ok()?;
        let status = fs::read_to_string(process.join("status")).ok()?;
        Self::read(&stat, &status)
    }

    /// Reads proc_pid_stat(5) and proc_pid_status(5).
    fn read(stat: &str, status: &str) -> Option<Self> {
        // The name of the process may have spaces and parentheses. Field 3 follows the last
        // parenthesis.
        let (_, fields) = stat.rsplit_once(") ")?;
        let mut fields = fields.split_whitespace().skip(40 - 3);
        let priority = fields.next()?.parse().ok()?;
        let policy = match fields.next()? {
            "0" => Policy::Other,
            "1" => Policy::Fifo,
            "2" => Policy::Rr,
            "3" => Policy::Batch,
            "5" => Policy::Idle,
            "6" => Policy::Deadline,
            _ => return None,
        };
        let locked = status
            .lines()
            .find_map(|line| line.strip_prefix("VmLck:"))?;
        Some(Self {
            policy,
            priority,
            memory_locked: locked.split_whitespace().next()? != "0",
        })
    }
}

impl fmt::Display for Scheduling {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.policy {
            Policy::Fifo => write!(out, "real time (fifo, priority {})", self.priority)?,
            Policy::Rr => write!(out, "real time (rr, priority {})", self.priority)?,
            Policy::Deadline => out.write_str("real time (deadline)")?,
            Policy::Other => out.write_str("ordinary")?,
            Policy::Batch => out.write_str("batch")?,
            Policy::Idle => out.write_str("idle")?,
        }
        if self.memory_locked {
            out.write_str(", memory locked")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_who_may_lock_everything_locks() {
        assert!(may_lock(
            "CapPrm:\t0000000000000000\nCapEff:\t0000000000004000\n"
        ));
        assert!(may_lock("CapEff:\t000001ffffffffff\n"));
        assert!(!may_lock(
            "CapPrm:\t000001ffffffffff\nCapEff:\t0000000000000000\n"
        ));
        assert!(!may_lock("CapEff:\t000001ffffffbfff\n") && !may_lock(""));
    }

    #[test]
    fn a_process_is_read_whatever_its_name() {
        let numbers: Vec<String> = (4..=52).map(|field| field.to_string()).collect();
        let stat = |priority: &str, policy: &str| {
            let mut fields = numbers.clone();
            fields[40 - 4] = priority.to_owned();
            fields[41 - 4] = policy.to_owned();
            format!("7 (a ) S b) S {}\n", fields.join(" "))
        };
        let status = |locked: &str| format!("VmPeak:\t 9 kB\nVmLck:\t{locked} kB\n");
        let expected = Scheduling {
            policy: Policy::Rr,
            priority: 10,
            memory_locked: true,
        };
        assert_eq!(
            Scheduling::read(&stat("10", "2"), &status("  4096")),
            Some(expected)
        );
        let expected = Scheduling {
            policy: Policy::Other,
            priority: 0,
            memory_locked: false,
        };
        assert_eq!(
            Scheduling::read(&stat("0", "0"), &status("     0")),
            Some(expected)
        );
        assert_eq!(Scheduling::read("7 (cut) S 1", &status("0")), None);
        // /proc also exists where tests run.
        assert!(Scheduling::of(Path::new("/proc/self")).is_some());
        assert_eq!(expected.to_string(), "ordinary");
        let locked = Scheduling {
            policy: Policy::Rr,
            priority: 10,
            memory_locked: true,
        };
        assert_eq!(
            locked.to_string(),
            "real time (rr, priority 10), memory locked"
        );
    }
}
