//! How the kernel runs a process: its scheduling, its sleep, and whether its memory is locked.
//!
//! The daemon does not ask for real-time scheduling. systemd sets it before it starts the daemon
//! (`CPUSchedulingPolicy=` of the unit), and the sandbox then refuses any change. Threads that the
//! daemon starts are scheduled as ordinary ones (`CPUSchedulingResetOnFork=`): they serve clients,
//! log, record and load models. The daemon locks its memory itself, because systemd cannot. It does so where the
//! unit has removed the limit (`LimitMEMLOCK=`), or where the daemon may ignore the limit.

use std::cell::Cell;
use std::fs;
use std::time::Duration;

use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use rustix::time::{ClockId, clock_gettime};
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

/// How the kernel schedules the main thread of this process, in words, and whether its memory is locked.
/// `None` where /proc does not say it.
pub(super) fn scheduling() -> Option<String> {
    let stat = fs::read_to_string("/proc/self/stat").ok()?;
    let status = fs::read_to_string("/proc/self/status").ok()?;
    in_words(&stat, &status)
}

/// Reads proc_pid_stat(5) and proc_pid_status(5). The policies are those of sched(7).
fn in_words(stat: &str, status: &str) -> Option<String> {
    // The name of the process may have spaces and parentheses. Field 3 follows the last parenthesis.
    let (_, fields) = stat.rsplit_once(") ")?;
    let mut fields = fields.split_whitespace().skip(40 - 3);
    let priority = fields.next()?;
    let mut words = match fields.next()? {
        "1" => format!("real time (fifo, priority {priority})"),
        "2" => format!("real time (rr, priority {priority})"),
        _ => "ordinary".to_owned(),
    };
    let mut lines = status.lines();
    let locked = lines.find_map(|line| line.strip_prefix("VmLck:"))?;
    if locked.split_whitespace().next()? != "0" {
        words += ", memory locked";
    }
    Some(words)
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
        for (priority, policy, locked, expected) in [
            (
                "10",
                "2",
                "  4096",
                "real time (rr, priority 10), memory locked",
            ),
            ("0", "0", "     0", "ordinary"),
        ] {
            let status = format!("VmPeak:\t 9 kB\nVmLck:\t{locked} kB\n");
            let found = in_words(&stat(priority, policy), &status);
            assert_eq!(found.as_deref(), Some(expected));
        }
        assert_eq!(in_words("7 (cut) S 1", "VmLck:\t0 kB\n"), None);
        // /proc also exists where tests run.
        assert!(scheduling().is_some());
    }
}
