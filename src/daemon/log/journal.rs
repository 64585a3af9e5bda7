//! Log lines for the journal: one entry for each event, with the event's fields.
//!
//! An entry is a datagram of `FIELD=value` lines in systemd's native protocol
//! (<https://systemd.io/JOURNAL_NATIVE_PROTOCOL>). Its field names are those of the published
//! events, in capitals and with `HARDNESSD_` before them. The crate `tracing-journald` would wait
//! for a journal that reads nothing, so we do not use it. Here an entry is passed to a function
//! that does not wait.

use std::fmt::{Debug, Write as _};
use std::io::{self, ErrorKind};
use std::os::unix::net::UnixDatagram;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// The path of the journal's socket.
pub(super) const SOCKET: &str = "/run/systemd/journal/socket";

/// The prefix of every field name of the daemon.
const PREFIX: &str = "HARDNESSD_";

/// The layer that makes an entry of each event and gives it to a function.
pub(super) struct Journal<F>(pub(super) F);

/// Checks that the journal is there.
///
/// # Errors
///
/// Fails if no process listens at [`SOCKET`].
pub(super) fn find() -> io::Result<()> {
    let socket = UnixDatagram::unbound()?;
    socket.set_nonblocking(true)?;
    // The journal ignores an entry without fields. If its queue is full, the journal is still
    // there.
    match socket.send_to(&[], SOCKET) {
        Err(error) if error.kind() != ErrorKind::WouldBlock => Err(error),
        _ => Ok(()),
    }
}

impl<S: Subscriber, F: Fn(Vec<u8>) + 'static> Layer<S> for Journal<F> {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let meta = event.metadata();
        // syslog(3): 3 error, 4 warning, 6 informational, 7 debug.
        let priority = match *meta.level() {
            Level::ERROR => "3",
            Level::WARN => "4",
            Level::INFO => "6",
            Level::DEBUG | Level::TRACE => "7",
        };
        let mut entry = Entry::default();
        entry.put("PRIORITY", priority);
        entry.put("SYSLOG_IDENTIFIER", "hardnessd");
        if let (Some(file), Some(line)) = (meta.file(), meta.line()) {
            entry.put("CODE_FILE", file);
            entry.put("CODE_LINE", &line.to_string());
        }
        event.record(&mut entry);
        self.0(entry.bytes);
    }
}

/// An entry with the number of lost lines.
pub(super) fn lost(lines: u64) -> Vec<u8> {
    let mut entry = Entry::default();
    entry.put("PRIORITY", "4");
    entry.put("SYSLOG_IDENTIFIER", "hardnessd");
    entry.put("MESSAGE", &format!("{lines} lines lost: read too slowly"));
    entry.put("HARDNESSD_LINES", &lines.to_string());
    entry.bytes
}

#[derive(Default)]
struct Entry {
    bytes: Vec<u8>,
}

impl Entry {
    fn put(&mut self, name: &str, value: &str) {
        self.bytes.extend(name.bytes());
        if value.contains('\n') {
            self.bytes.push(b'\n');
            self.bytes.extend((value.len() as u64).to_le_bytes());
        } else {
            self.bytes.push(b'=');
        }
        self.bytes.extend(value.bytes());
        self.bytes.push(b'\n');
    }
}

impl Visit for Entry {
    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "message" {
            self.put("MESSAGE", value);
        } else {
            self.put(&name(field.name()), value);
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let mut text = String::new();
        write!(text, "{value:?}").expect("writing to a string cannot fail");
        self.record_str(field, &text);
    }
}

/// A field name that the journal accepts: capitals, digits and `_`.
fn name(field: &str) -> String {
    let plain = |c: char| match c.to_ascii_uppercase() {
        c @ ('A'..='Z' | '0'..='9') => c,
        _ => '_',
    };
    PREFIX.chars().chain(field.chars().map(plain)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_is_lines_of_fields_and_a_value_of_several_lines_has_its_length() {
        let mut entry = Entry::default();
        entry.put("MESSAGE", "status");
        entry.put(&name("frame.rate-hz"), "two\nlines");
        let mut expected = b"MESSAGE=status\nHARDNESSD_FRAME_RATE_HZ\n".to_vec();
        expected.extend([9, 0, 0, 0, 0, 0, 0, 0]);
        expected.extend(b"two\nlines\n");
        assert_eq!(entry.bytes, expected);
    }
}
