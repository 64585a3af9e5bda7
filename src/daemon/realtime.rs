//! How the kernel runs a process: its scheduling, and whether its memory is locked.
//!
//! The daemon does not ask for real-time scheduling. systemd sets it before it starts the daemon
//! (`CPUSchedulingPolicy=` of the unit), and the sandbox then refuses any change. Threads that the
//! daemon starts are scheduled as ordinary ones (`CPUSchedulingResetOnFork=`): they serve clients,
//! log, record and load models. The daemon locks its memory itself, because systemd cannot. It does so where the
//! unit has removed the limit (`LimitMEMLOCK=`), or where the daemon may ignore the limit.

use std::path::Path;
use std::{fmt, fs};

use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use serde::Serialize;
use tracing::warn;

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
pub struct Standing {
    /// The scheduling of its main thread.
    pub scheduling: Scheduling,
    /// Its real-time priority; 0 for ordinary scheduling.
    pub priority: u32,
    /// Whether its pages stay in memory once they are there.
    pub memory_locked: bool,
}

/// A scheduling policy of sched(7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Scheduling {
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

impl Standing {
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
        let scheduling = match fields.next()? {
            "0" => Scheduling::Other,
            "1" => Scheduling::Fifo,
            "2" => Scheduling::Rr,
            "3" => Scheduling::Batch,
            "5" => Scheduling::Idle,
            "6" => Scheduling::Deadline,
            _ => return None,
        };
        let locked = status
            .lines()
            .find_map(|line| line.strip_prefix("VmLck:"))?;
        Some(Self {
            scheduling,
            priority,
            memory_locked: locked.split_whitespace().next()? != "0",
        })
    }
}

impl fmt::Display for Standing {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.scheduling {
            Scheduling::Fifo => write!(out, "real time (fifo, priority {})", self.priority)?,
            Scheduling::Rr => write!(out, "real time (rr, priority {})", self.priority)?,
            Scheduling::Deadline => out.write_str("real time (deadline)")?,
            Scheduling::Other => out.write_str("ordinary")?,
            Scheduling::Batch => out.write_str("batch")?,
            Scheduling::Idle => out.write_str("idle")?,
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
        let expected = Standing {
            scheduling: Scheduling::Rr,
            priority: 10,
            memory_locked: true,
        };
        assert_eq!(
            Standing::read(&stat("10", "2"), &status("  4096")),
            Some(expected)
        );
        let expected = Standing {
            scheduling: Scheduling::Other,
            priority: 0,
            memory_locked: false,
        };
        assert_eq!(
            Standing::read(&stat("0", "0"), &status("     0")),
            Some(expected)
        );
        assert_eq!(Standing::read("7 (cut) S 1", &status("0")), None);
        // /proc also exists where tests run.
        assert!(Standing::of(Path::new("/proc/self")).is_some());
        assert_eq!(expected.to_string(), "ordinary");
        let locked = Standing {
            scheduling: Scheduling::Rr,
            priority: 10,
            memory_locked: true,
        };
        assert_eq!(
            locked.to_string(),
            "real time (rr, priority 10), memory locked"
        );
    }
}
