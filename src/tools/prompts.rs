//! What a command says to the person who presses.
//!
//! In: texts. Out: the same on stderr, from a thread of its own: a terminal that is stopped stops neither a sensor nor
//! the end of the command.

use std::io::{self, Write as _};
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::thread::{NoThread, spawn_thread};

/// How long the last texts may take at the end.
const PATIENCE: Duration = Duration::from_secs(1);

/// The texts that are on their way to stderr.
#[derive(Debug)]
pub(super) struct Prompts {
    texts: Sender<String>,
    written: oneshot::Receiver<()>,
}

impl Prompts {
    pub(super) fn start() -> Result<Self, NoThread> {
        let (texts, inbox) = channel::<String>();
        let written = spawn_thread("prompts", move || {
            let mut stderr = io::stderr();
            for text in inbox {
                // If the terminal has gone, its signal ends the command.
                let _ = stderr.write_all(text.as_bytes());
                let _ = stderr.flush();
            }
        })?;
        Ok(Self { texts, written })
    }

    /// Writes a text, soon.
    pub(super) fn say(&self, text: &str) {
        // The thread ends only after its texts.
        let _ = self.texts.send(text.to_owned());
    }

    /// Waits until all is written, but not for long.
    pub(super) async fn end(self) {
        drop(self.texts);
        let _ = timeout(PATIENCE, self.written).await;
    }
}
