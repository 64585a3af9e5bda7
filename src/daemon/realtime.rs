//! How the kernel runs a process: its scheduling, its sleep, and whether its memory is locked.
//!
//! The daemon does not ask for real-time scheduling. systemd sets it before it starts the daemon
//! (`CPUSchedulingPolicy=` of the unit), and the sandbox then refuses any change. Threads that the
//! daemon starts are scheduled as ordinary ones (`CPUSchedulingResetOnFork=`): they serve clients,
//! log, record and load models. The daemon locks its memory itself, because systemd cannot. It does so where the
//! unit has removed the limit (`LimitMEMLOCK=`), or where the daemon may ignore the limit.

use std::cell::Cell;
use std::time::Duration;

use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, capabilities};
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
    let mine = capabilities(None).map(|mine| mine.effective);
    let may_ignore_limit = mine.is_ok_and(|mine| mine.contains(CapabilitySet::IPC_LOCK));
    if getrlimit(Resource::Memlock).current.is_some() && !may_ignore_limit {
        return;
    }
    let flags = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT;
    if let Err(error) = rustix::mm::mlockall(flags) {
        warn!(%error, "the memory is not locked: a busy machine may delay events");
    }
}
