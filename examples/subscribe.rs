//! A subscriber in Rust. It prints verdicts as they come, and connects again when the connection
//! breaks.
//!
//!     cargo run --example subscribe -- /run/hardnessd/events.sock
//!
//! It needs the standard library and a JSON parser. It shows three things:
//!
//! - Each line is one event.
//! - The subscriber keeps its place in the daemon's run (`RUN:SEQ`) and sends it when it connects
//!   again, so that it misses nothing. An event that came before the daemon took the subscription
//!   may come a second time.
//! - While there is no connection, nothing is known about the sensor.

use std::convert::Infallible;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use serde_json::{Value, json};

/// The longest line that is read. Lines of the daemon are far shorter, so a longer one does not
/// come from hardnessd.
const LONGEST_LINE_BYTES: u64 = 1 << 20;

fn main() {
    let socket = std::env::args().nth(1);
    let socket = socket.unwrap_or_else(|| "/run/hardnessd/events.sock".to_owned());
    let mut place = None;
    loop {
        let Err(error) = follow(&socket, &mut place);
        println!("{socket}: {error}: nothing is known until it is back");
        std::thread::sleep(Duration::from_millis(500));
    }
}

/// Prints verdicts until the connection ends, which is always an error.
fn follow(socket: &str, place: &mut Option<String>) -> io::Result<Infallible> {
    let mut stream = UnixStream::connect(socket)?;
    let mut subscription = json!({"subscribe": ["hardness", "status"]});
    if let Some(place) = place {
        subscription["since"] = json!(place);
    }
    writeln!(stream, "{subscription}")?;
    let mut input = BufReader::new(stream);
    let mut run = String::new();
    let mut subscribed = false;
    loop {
        let event = receive(&mut input)?;
        match event["type"].as_str() {
            Some("hello") => run = event["run"].as_str().unwrap_or_default().to_owned(),
            Some("ok") => subscribed = true,
            Some("gap") => println!("missed {} events", event["lost"]),
            Some("error") => return Err(io::Error::other(event["message"].to_string())),
            Some("status") => println!("{} is {}", event["sensor"], event["state"]),
            Some("hardness") if event["rejected"].is_null() => println!(
                "{} press {} ({}): {} at {:.0} %",
                event["sensor"],
                event["press"],
                event["phase"],
                event["label"],
                100.0 * event["confidence"].as_f64().unwrap_or_default()
            ),
            // A later version may send types that this program does not know.
            _ => {}
        }
        if let Some(seq) = event["seq"].as_u64().filter(|_| subscribed) {
            *place = Some(format!("{run}:{seq}"));
        }
    }
}

/// Reads the next event.
fn receive(input: &mut BufReader<UnixStream>) -> io::Result<Value> {
    let mut line = String::new();
    input.take(LONGEST_LINE_BYTES).read_line(&mut line)?;
    if !line.ends_with('\n') {
        let what = if line.len() as u64 == LONGEST_LINE_BYTES {
            "a line is too long: this is not hardnessd"
        } else {
            "the daemon closed the connection"
        };
        return Err(io::Error::other(what));
    }
    Ok(serde_json::from_str(&line)?)
}
