//! One serial port: opened, read, lost, opened again.
//!
//! In: the configured path and baud rate. Out: one [`Turn`] at a time: bytes, or what happened to the
//! port. It never gives up and never interprets the bytes. The port is opened exclusively (by
//! TIOCEXCL and flock; only flock keeps root out), and stale input is flushed. A read of no bytes
//! means that the port is lost, because a tty that was unplugged gives no bytes for ever.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serialport::{ClearBuffer, ErrorKind, SerialPort, TTYPort};
use tokio::io::AsyncReadExt;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_serial::SerialStream;

/// Pause before the first try to reopen; it doubles with each that fails.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// Longest pause: a sensor plugged in again is read within this.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// Bytes read at once: 20 frames of the JX255N.
const BUFFER_BYTES: usize = 16 * 1024;

/// What happened to the port.
#[derive(Debug)]
pub(crate) enum Turn<'a> {
    /// It is open.
    Opened,
    /// It cannot be opened now.
    Unavailable(String),
    /// Bytes came.
    Bytes(&'a [u8]),
    /// It was open and is gone.
    Lost(String),
}

/// A port and its state.
#[derive(Debug)]
pub(crate) struct Link {
    path: PathBuf,
    baud: u32,
    state: State,
    pause: Duration,
    buffer: Box<[u8]>,
}

#[derive(Debug)]
enum State {
    /// Will be opened at this time.
    Waiting(Instant),
    /// Being opened, on a thread of its own: a driver may take its time over it.
    Opening(JoinHandle<Result<TTYPort, serialport::Error>>),
    Open(SerialStream),
}

impl Link {
    /// A link to `path`. The first turn opens it.
    pub(crate) fn new(path: &Path, baud: u32) -> Self {
        Self {
            path: path.to_owned(),
            baud,
            state: State::Waiting(Instant::now()),
            pause: FIRST_PAUSE,
            buffer: vec![0; BUFFER_BYTES].into(),
        }
    }

    /// Waits for the next thing to happen. It may be cancelled: nothing is lost.
    pub(crate) async fn turn(&mut self) -> Turn<'_> {
        loop {
            match &mut self.state {
                State::Waiting(until) => {
                    tokio::time::sleep_until(*until).await;
                    let (path, baud) = (self.path.clone(), self.baud);
                    self.state =
                        State::Opening(tokio::task::spawn_blocking(move || open(&path, baud)));
                }
                State::Opening(opening) => {
                    let opened = match opening.await {
                        Ok(opened) => opened.and_then(SerialStream::try_from),
                        Err(stopped) => Err(std::io::Error::other(stopped).into()),
                    };
                    match opened {
                        Ok(port) => {
                            self.state = State::Open(port);
                            return Turn::Opened;
                        }
                        Err(error) => {
                            self.wait();
                            return Turn::Unavailable(reason(&error));
                        }
                    }
                }
                State::Open(port) => {
                    // A read that is cancelled has read nothing: it is one system call, made when
                    // bytes are there.
                    let lost = match AsyncReadExt::read(port, &mut self.buffer).await {
                        Ok(0) => "end of file".to_owned(),
                        Ok(read) => return Turn::Bytes(&self.buffer[..read]),
                        Err(error) => error.to_string(),
                    };
                    self.wait();
                    return Turn::Lost(lost);
                }
            }
        }
    }

    /// Says that the port works, so that it is opened again quickly after the next loss. A port that
    /// opens and fails at once never gets so far.
    pub(crate) fn proven(&mut self) {
        self.pause = FIRST_PAUSE;
    }

    fn wait(&mut self) {
        self.state = State::Waiting(Instant::now() + self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }
}

fn open(path: &Path, baud: u32) -> Result<TTYPort, serialport::Error> {
    // 8N1 without flow control, exclusive: the builder's defaults.
    let port = TTYPort::open(&serialport::new(path.to_string_lossy(), baud))?;
    // Bytes from before the port had its settings are of unknown age, and may be garbled.
    port.clear(ClearBuffer::Input)?;
    lower_latency(path);
    Ok(port)
}

/// Asks an FTDI adapter to pass bytes on after 1 ms instead of 16. Failure is no error: most ports
/// have no such timer, and a daemon that is not root leaves it to the udev rule.
fn lower_latency(path: &Path) {
    let Ok(device) = path.canonicalize() else {
        return;
    };
    let Some(name) = device.file_name() else {
        return;
    };
    let timer = Path::new("/sys/bus/usb-serial/devices")
        .join(name)
        .join("latency_timer");
    match std::fs::read_to_string(&timer) {
        Ok(ms) if ms.trim() != "1" => {
            if let Err(error) = std::fs::write(&timer, "1") {
                tracing::debug!(timer = %timer.display(), ms = ms.trim(), %error, "latency timer");
            }
        }
        _ => {}
    }
}

fn reason(error: &serialport::Error) -> String {
    match error.kind() {
        // EBUSY, or the lock is taken: serialport has one kind for both.
        ErrorKind::NoDevice => "port held by another process".to_owned(),
        ErrorKind::Io(std::io::ErrorKind::NotFound) => "no such device".to_owned(),
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => "permission denied".to_owned(),
        _ => of_system(&error.to_string()),
    }
}

/// What the system says of a port, in plain words where its own are not.
fn of_system(text: &str) -> String {
    match text {
        // ENOTTY.
        "Not a typewriter" | "Inappropriate ioctl for device" => "not a serial port".to_owned(),
        text => text.to_owned(),
    }
}
