//! A connection to a socket of the daemon.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::Path;

use serde_json::{Value, json};

use super::{PATIENCE, wait_for};

/// The stream of a connection.
pub trait Stream: Read + Write + Send {}
impl<S: Read + Write + Send> Stream for S {}

/// A connection to a socket.
pub struct Subscriber {
    pub lines: BufReader<Box<dyn Stream>>,
}

impl Subscriber {
    fn new(stream: impl Stream + 'static) -> Self {
        Self {
            lines: BufReader::new(Box::new(stream)),
        }
    }

    /// Connects to a socket of a daemon that may still be starting.
    pub fn connect(socket: &Path) -> Self {
        let mut stream = None;
        wait_for("the socket", || {
            stream = UnixStream::connect(socket).ok();
            stream.is_some()
        });
        let stream = stream.unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Self::new(stream)
    }

    pub fn over_tcp(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Self::new(stream)
    }

    /// Sends a line and waits for the answer.
    pub fn ask(&mut self, line: &str) -> Value {
        self.send_line(line);
        loop {
            let answer = self.next().unwrap();
            if ["ok", "error"].contains(&answer["type"].as_str().unwrap()) {
                return answer;
            }
        }
    }

    /// Sends a line that is refused, in words that have this part.
    pub fn is_refused(&mut self, line: &str, part: &str) {
        let answer = self.ask(line);
        let message = answer["message"].as_str().unwrap_or_default();
        assert!(message.contains(part), "{part:?} not in {answer}");
    }

    pub fn send_line(&mut self, line: &str) {
        self.lines
            .get_mut()
            .write_all(format!("{line}\n").as_bytes())
            .unwrap();
    }

    /// The next line. `None` if the connection is closed.
    pub fn next(&mut self) -> Option<Value> {
        let mut line = String::new();
        (self.lines.read_line(&mut line).unwrap() > 0).then(|| serde_json::from_str(&line).unwrap())
    }

    /// Reads until a line has all of `fields`.
    pub fn until(&mut self, fields: &Value) -> Value {
        let fields = fields.as_object().unwrap();
        loop {
            let line = self
                .next()
                .unwrap_or_else(|| panic!("closed before {fields:?}"));
            if fields.iter().all(|(key, value)| &line[key] == value) {
                return line;
            }
        }
    }

    /// Reads until a press begins, ends or is aborted.
    pub fn press(&mut self, state: &str) -> Value {
        self.until(&json!({"type": "press", "state": state}))
    }

    /// Reads until the final verdict of a press.
    pub fn verdict(&mut self) -> Value {
        self.until(&json!({"phase": "final"}))
    }

    /// Reads until the state of a sensor is this one.
    pub fn state(&mut self, state: &str) -> Value {
        self.until(&json!({"type": "status", "state": state}))
    }

    /// The status of a sensor as an answer: that of an event has a number.
    pub fn status(&mut self, sensor: &str) -> Value {
        self.send_line(r#"{"get":"status"}"#);
        let status = self.until(&json!({"type": "status", "seq": null, "sensor": sensor}));
        // Those of the other sensors are read too, so that none is left for the next question.
        self.until(&json!({"type": "ok"}));
        status
    }
}
