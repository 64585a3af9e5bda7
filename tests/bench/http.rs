//! A client of the daemon's web server.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use super::PATIENCE;

/// A table for a web server at a free port.
pub const HTTP: &str = "[http]\nlisten = \"127.0.0.1:0\"\n";

pub struct Answer {
    pub code: u16,
    /// In lower case.
    pub head: String,
    pub body: String,
}

impl Answer {
    pub fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.body).unwrap()
    }
}

/// Sends a request unchanged. Without a `Host` among `headers`, the right one is added.
pub fn open(address: SocketAddr, request: &str, headers: &[&str]) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut text = format!("{request} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|header| header.starts_with("Host:")) {
        text += &format!("Host: {address}\r\n");
    }
    for header in headers {
        text += &format!("{header}\r\n");
    }
    stream.write_all((text + "\r\n").as_bytes()).unwrap();
    stream
}

pub fn answer(mut stream: TcpStream) -> Answer {
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    let head = head.to_ascii_lowercase();
    // hyper panics while it writes a date before 1970.
    assert!(!head.contains("\r\ndate:"), "{head}");
    Answer {
        code: head.split(' ').nth(1).unwrap().parse().unwrap(),
        head,
        body: body.to_owned(),
    }
}

pub fn ask(address: SocketAddr, request: &str, headers: &[&str]) -> Answer {
    answer(open(address, request, headers))
}

pub fn get(address: SocketAddr, path: &str) -> Answer {
    ask(address, &format!("GET {path}"), &[])
}
