//! Passes log lines to a thread that writes them to stderr, and what a command says to the person who presses.
//!
//! The program or the terminal that shows them may stop reading, and the sensor must not wait for it.
//! So when [`WAITING`] lines wait, further lines are dropped. After the next line that is written,
//! another line gives the number of dropped lines. (`tracing-appender` does not fit: where the
//! system has no thread for it, it panics, and at the end it may wait longer than a second and print
//! to stdout.)

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use tracing_subscriber::fmt::MakeWriter;

use crate::thread::{NoThread, start};

/// The most lines that wait, about 150 kB.
const WAITING: usize = 1024;

/// The queue to the thread. Clones share it.
#[derive(Clone)]
pub(crate) struct Lines {
    thread: SyncSender<Vec<u8>>,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    /// The number of lines that wait.
    waiting: AtomicU64,
    /// The number of lines that were dropped and not reported yet.
    lost: AtomicU64,
}

impl Lines {
    /// Starts the thread.
    ///
    /// # Errors
    ///
    /// Fails if the system cannot make the thread.
    pub(crate) fn start() -> Result<Self, NoThread> {
        let (thread, lines) = sync_channel(WAITING);
        let counts = Arc::new(Counts::default());
        let of_thread = Arc::clone(&counts);
        start("log", move || write(&lines, &of_thread))?;
        Ok(Self { thread, counts })
    }

    /// Writes a text, soon.
    pub(crate) fn say(&self, text: &[u8]) {
        self.counts.waiting.fetch_add(1, Ordering::Relaxed);
        if self.thread.try_send(text.to_vec()).is_err() {
            self.counts.waiting.fetch_sub(1, Ordering::Relaxed);
            self.counts.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits until all lines are written, but not longer than `patience`.
    pub(crate) fn flush(&self, patience: Duration) {
        let end = Instant::now() + patience;
        while self.counts.waiting.load(Ordering::Acquire) > 0 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn write(lines: &Receiver<Vec<u8>>, counts: &Counts) {
    for line in lines {
        // A write that fails cannot be logged: stderr is closed.
        let _ = io::stderr().write_all(&line);
        let lost = counts.lost.swap(0, Ordering::Relaxed);
        if lost > 0 {
            let _ = writeln!(io::stderr(), "log: {lost} lines lost: read too slowly");
        }
        counts.waiting.fetch_sub(1, Ordering::Release);
    }
}

impl<'a> MakeWriter<'a> for Lines {
    type Writer = &'a Self;

    fn make_writer(&'a self) -> Self::Writer {
        self
    }
}

/// The formatter writes each line in one call.
impl Write for &Lines {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.say(line);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
