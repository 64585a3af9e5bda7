//! A subscriber in Rust: verdicts as they come, over breaks of the connection.
//!
//!     cargo run --example subscribe -- /run/hardnessd/events.sock
//!
//! It needs the standard library and a JSON parser. What it shows: a line is an event; a place in
//! the run (`RUN:SEQ`) is kept, so that nothing is missed when the connection is made again (what
//! came before the daemon took the subscription may come once more); and while there is none,
//! nothing is known of the sensor.

use std::convert::Infallible;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use serde_json::{Value, json};

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
    let mut run = String::new();
    let mut subscribed = false;
    for line in BufReader::new(stream).lines() {
        let event: Value = serde_json::from_str(&line?)?;
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
            // What a later version adds is passed over.
            _ => {}
        }
        if let Some(seq) = event["seq"].as_u64().filter(|_| subscribed) {
            *place = Some(format!("{run}:{seq}"));
        }
    }
    Err(io::Error::new(io::ErrorKind::UnexpectedEof, "closed"))
}
