//! Passes log lines to a thread that writes them to stderr.
//!
//! The program that reads the log may stop reading, and the sensor must not wait for that program.
//! So when [`WAITING`] lines wait, further lines are dropped. After the next line that is written,
//! another line gives the number of dropped lines. (`tracing-appender` does not fit: where the
//! system has no thread for it, it panics, and at the end it may wait longer than a second and print
//! to stdout.)

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender, TrySendError};
use std::time::Duration;

use tracing_subscriber::fmt::MakeWriter;

/// The most lines that wait, about 150 kB.
const WAITING: usize = 1024;

enum Message {
    Line(Vec<u8>),
    /// A request for an answer as soon as all earlier lines are written.
    Flush(SyncSender<()>),
}

/// The queue to the thread. Clones share it.
#[derive(Clone)]
pub(super) struct Lines {
    thread: SyncSender<Message>,
    lost: Arc<AtomicU64>,
}

impl Lines {
    /// Starts the thread.
    ///
    /// # Errors
    ///
    /// Fails if the system cannot make the thread.
    pub(super) fn start() -> io::Result<Self> {
        let (thread, messages) = mpsc::sync_channel(WAITING);
        let lost = Arc::new(AtomicU64::new(0));
        let lines = Self {
            thread,
            lost: Arc::clone(&lost),
        };
        std::thread::Builder::new()
            .name("log".to_owned())
            .spawn(move || write(&messages, &lost))?;
        Ok(lines)
    }

    /// Waits until all lines are written, but not longer than `patience`.
    pub(super) fn flush(&self, patience: Duration) {
        let (written, answer) = mpsc::sync_channel(1);
        // When the queue is full, no program reads the log, so waiting is of no use.
        if self.thread.try_send(Message::Flush(written)).is_ok() {
            let _ = answer.recv_timeout(patience);
        }
    }
}

fn write(messages: &Receiver<Message>, lost: &AtomicU64) {
    while let Ok(message) = messages.recv() {
        // A write that fails cannot be logged: stderr is closed.
        match message {
            Message::Line(line) => {
                let _ = io::stderr().write_all(&line);
                let lines = lost.swap(0, Ordering::Relaxed);
                if lines > 0 {
                    let _ = writeln!(io::stderr(), "log: {lines} lines lost: read too slowly");
                }
            }
            Message::Flush(written) => {
                let _ = written.try_send(());
            }
        }
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
        if let Err(TrySendError::Full(_)) = self.thread.try_send(Message::Line(line.to_vec())) {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
