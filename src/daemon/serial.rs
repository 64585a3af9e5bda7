//! One serial port, which is opened, read, and opened again when it is lost.
//!
//! In: the configured path and baud rate. Out: one [`Turn`] at a time: bytes, or what happened to
//! the port. This module tries to open the port for as long as it runs, and never interprets the
//! bytes. The port is opened exclusively (by TIOCEXCL and flock; only flock keeps root out), and
//! stale input is flushed. A read of no bytes means that the port is lost, because every read of an
//! unplugged tty gives no bytes.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serialport::{ClearBuffer, ErrorKind, SerialPort, TTYPort};
use tokio::io::AsyncReadExt;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tokio_serial::SerialStream;

/// The pause before the first try to reopen. It doubles with each try that fails.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// The longest pause. A sensor that is plugged in again is read within this time.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// The most bytes read at once: 20 frames of the JX255N.
const BUFFER_BYTES: usize = 16 * 1024;

/// A change of the port, or bytes from it.
#[derive(Debug)]
pub(crate) enum Turn<'a> {
    /// The port was opened.
    Opened,
    /// The port cannot be opened now, for this reason.
    Unavailable(String),
    /// Bytes arrived.
    Bytes(&'a [u8]),
    /// The port was open and is lost, for this reason.
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
    /// The port will be opened at this time.
    Waiting(Instant),
    /// A separate thread is opening the port, because a driver may be slow.
    Opening(oneshot::Receiver<Result<TTYPort, serialport::Error>>),
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

    /// Waits for the next turn of the port. Cancelling the wait loses nothing.
    pub(crate) async fn turn(&mut self) -> Turn<'_> {
        loop {
            match &mut self.state {
                State::Waiting(until) => {
                    tokio::time::sleep_until(*until).await;
                    match start_opening(self.path.clone(), self.baud) {
                        Ok(opening) => self.state = State::Opening(opening),
                        Err(error) => {
                            self.wait();
                            return Turn::Unavailable(format!("no thread to open it: {error}"));
                        }
                    }
                }
                State::Opening(opening) => {
                    let opened = match opening.await {
                        Ok(opened) => opened.and_then(SerialStream::try_from),
                        Err(ended) => Err(std::io::Error::other(ended).into()),
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
                    // A read that is cancelled has read nothing, because a read is one system call,
                    // made when bytes are there.
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

    /// Records that the port works, so that it is opened again quickly after the next loss. A port
    /// that fails as soon as it is opened never gets so far.
    pub(crate) fn proven(&mut self) {
        self.pause = FIRST_PAUSE;
    }

    fn wait(&mut self) {
        self.state = State::Waiting(Instant::now() + self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }
}

/// Opens the port in a thread of its own.
///
/// # Errors
///
/// Fails if the system has no thread to spare. The runtime's own threads would panic then.
fn start_opening(
    path: PathBuf,
    baud: u32,
) -> std::io::Result<oneshot::Receiver<Result<TTYPort, serialport::Error>>> {
    let (opened, opening) = oneshot::channel();
    let thread = std::thread::Builder::new().name("port".to_owned());
    thread.spawn(move || {
        // The daemon may have ended meanwhile.
        let _ = opened.send(open(&path, baud));
    })?;
    Ok(opening)
}

fn open(path: &Path, baud: u32) -> Result<TTYPort, serialport::Error> {
    // The builder's defaults are 8N1 without flow control, and exclusive access.
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
        // This is EBUSY or a lock that is taken: serialport has one kind for both.
        ErrorKind::NoDevice => "port held by another process".to_owned(),
        ErrorKind::Io(std::io::ErrorKind::NotFound) => "no such device".to_owned(),
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => "permission denied".to_owned(),
        _ => of_system(&error.to_string()),
    }
}

/// The system's error of a port, in plain words where the system's own are not plain.
fn of_system(text: &str) -> String {
    match text {
        // These are the texts of ENOTTY.
        "Not a typewriter" | "Inappropriate ioctl for device" => "not a serial port".to_owned(),
        text => text.to_owned(),
    }
}
