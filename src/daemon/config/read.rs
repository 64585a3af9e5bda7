//! Reads the files of a configuration: the file itself, the model and the gains.
//!
//! Each may be a pipe, such as `<(...)` of a shell. At the start, reading waits for the program that
//! writes to the pipe, and a signal ends the wait. A reload does not wait for ever: see [`Until`].

use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Instant;

use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::fs::OFlags;

/// How long reading may wait for a program that writes to a pipe. `None`: without end.
pub(super) type Until = Option<Instant>;

/// The bytes that are read at a time.
const CHUNK_BYTES: usize = 1 << 16;

/// Reads at most one byte more than `most` from a file. That byte shows that the file is too long.
pub(super) fn read(path: &Path, most: usize, until: Until) -> io::Result<Vec<u8>> {
    let most = most as u64 + 1;
    let Some(until) = until else {
        let mut bytes = Vec::new();
        File::open(path)?.take(most).read_to_end(&mut bytes)?;
        return Ok(bytes);
    };
    // Opening a pipe that no program writes to would wait, and nothing could end that wait.
    let nonblocking = OFlags::NONBLOCK.bits().cast_signed();
    let file = File::options()
        .read(true)
        .custom_flags(nonblocking)
        .open(path)?;
    let mut source = (&file).take(most);
    let (mut bytes, mut chunk) = (Vec::new(), vec![0; CHUNK_BYTES]);
    loop {
        wait(&file, until)?;
        match source.read(&mut chunk) {
            Ok(0) => return Ok(bytes),
            Ok(count) => bytes.extend_from_slice(&chunk[..count]),
            Err(error)
                if [ErrorKind::WouldBlock, ErrorKind::Interrupted].contains(&error.kind()) => {}
            Err(error) => return Err(error),
        }
    }
}

/// Waits until `file` has bytes or has ended. A pipe ends when its last writer has closed it. As
/// long as none has opened it, it has not ended.
fn wait(file: &File, until: Instant) -> io::Result<()> {
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            let problem = "it did not end in time: name a file, or a pipe that a program writes to";
            return Err(io::Error::new(ErrorKind::TimedOut, problem));
        }
        let left = Timespec::try_from(left).map_err(io::Error::other)?;
        let mut polled = [PollFd::new(file, PollFlags::IN)];
        match rustix::event::poll(&mut polled, Some(&left)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => {}
            Ok(_) => return Ok(()),
            Err(error) => return Err(error.into()),
        }
    }
}
