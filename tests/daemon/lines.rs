//! Sensors that are no cable: TCP, UDP, sensors that answer, and lines whose settings somebody changes.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::bench::{Bench, Daemon, PATIENCE, Subscriber, hardnessd, wait_for};

/// The bytes of a frame of the JX255N.
const FRAME: usize = 790;
/// The tests send frames this often.
const PERIOD: Duration = Duration::from_millis(20);

/// The frames of a simulated press.
fn frames(bench: &Bench) -> Vec<Vec<u8>> {
    let path = bench.path("press.bin");
    let options = "simulate --presses 1 --fps 20 --force 15 --material hard-plastic --to";
    let options: Vec<&str> = options.split(' ').collect();
    let played = hardnessd(&[&options[..], &[path.to_str().unwrap()]].concat());
    assert!(played.status.success(), "{played:?}");
    let bytes = fs::read(path).unwrap();
    bytes.chunks_exact(FRAME).map(<[u8]>::to_vec).collect()
}

/// A configuration of one sensor at `port`. A silence of half a second is stale.
fn configure(bench: &Bench, port: &str, more: &str) -> PathBuf {
    let path = bench.path("hardnessd.toml");
    let text = format!(
        "[[sensor]]\nname = \"forearm\"\nport = \"{port}\"\nframe_rate_hz = 50.0\nstale_after_ms = 500\n{more}\
         [publish.unix]\npath = \"events.sock\"\n"
    );
    fs::write(&path, text).unwrap();
    path
}

/// The current status of the sensor.
fn status(subscriber: &mut Subscriber) -> Value {
    subscriber.send_line("{\"get\":\"status\"}");
    let mut status = Value::Null;
    loop {
        let line = subscriber.next().unwrap();
        // Published events come between. They have a number.
        if line["type"] == "status" && line["seq"].is_null() {
            status = line;
        } else if line["type"] == "ok" {
            return status;
        }
    }
}

fn accept(listener: &TcpListener) -> TcpStream {
    let (stream, _) = listener.accept().unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

#[test]
fn a_press_over_tcp_is_judged_silence_is_stale_and_the_end_of_the_peer_is_loss() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let config = configure(&bench, &format!("tcp://{address}"), "");
    let checked = hardnessd(&["check", "--config", config.to_str().unwrap()]);
    let checked = String::from_utf8(checked.stdout).unwrap();
    let shown = "28x28 taxels in 790 bytes, 50 frames/s";
    assert!(checked.contains(shown), "{checked}");
    let _daemon = Daemon::start(&config);
    let mut subscriber = bench.subscriber();
    let mut peer = accept(&listener);
    // A frame may come in any pieces, and damage is counted as on a cable.
    peer.write_all(&[7; 100]).unwrap();
    for frame in &frames {
        peer.write_all(&frame[..300]).unwrap();
        peer.write_all(&frame[300..]).unwrap();
        std::thread::sleep(PERIOD);
    }
    subscriber.until(&json!({"type": "status", "state": "live"}));
    subscriber.until(&json!({"type": "press", "state": "begin"}));
    subscriber.until(&json!({"type": "hardness", "phase": "final"}));
    let stale = subscriber.until(&json!({"type": "status", "state": "stale"}));
    assert_eq!(stale["bytes_skipped"], 100);
    assert_eq!(stale["frames"], frames.len());
    drop(peer);
    let lost = subscriber.until(&json!({"type": "status", "state": "lost"}));
    assert_eq!(lost["reason"], "closed by the other end");
    let mut peer = accept(&listener);
    peer.write_all(&frames[0]).unwrap();
    let live = subscriber.until(&json!({"type": "status", "state": "live"}));
    assert_eq!(live["frames"], frames.len() + 1);
    // Nobody listens any more.
    drop(listener);
    drop(peer);
    subscriber.until(&json!({"type": "status", "state": "lost"}));
    wait_for("the reason", || {
        status(&mut subscriber)["reason"] == "Connection refused"
    });
    let doctor = hardnessd(&["doctor", "--port", &format!("tcp://{address}")]);
    let stdout = String::from_utf8(doctor.stdout).unwrap();
    let fault = format!("tcp://{address}: Connection refused: nothing listens there");
    assert!(stdout.starts_with(&fault), "{stdout}");
    assert_eq!(doctor.status.code(), Some(1));
}

#[test]
fn datagrams_are_taken_from_one_sender_until_it_is_silent() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let [first, second] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    let address = UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let config = configure(
        &bench,
        &format!("udp://{address}"),
        "[sensor.frame]\nstart = \"53\"\n",
    );
    let mut daemon = Daemon::start(&config);
    let mut subscriber = bench.subscriber();
    wait_for("the first frame", || {
        first.send_to(&frames[0], address).unwrap();
        status(&mut subscriber)["state"] == "live"
    });
    // The sensor learns whom to answer by its own first datagram.
    let mut got = [0; 16];
    first.set_read_timeout(Some(PATIENCE)).unwrap();
    assert_eq!(first.recv(&mut got).unwrap(), 1);
    assert_eq!(got[0], 0x53);
    // The last frame may still be under way.
    std::thread::sleep(5 * PERIOD);
    let before = status(&mut subscriber);
    for _ in 0..20 {
        second.send_to(&frames[0], address).unwrap();
        second.send_to(&frames[0][..5], address).unwrap();
        first.send_to(&[], address).unwrap();
        // Frames keep the place.
        first.send_to(&frames[0], address).unwrap();
        std::thread::sleep(PERIOD);
    }
    daemon.logged("ignored: another sender");
    // An empty datagram is no end and no frame.
    let after = status(&mut subscriber);
    assert_eq!(after["frames"], before["frames"].as_u64().unwrap() + 20);
    for key in ["frames_damaged", "bytes_skipped"] {
        assert_eq!(after[key], before[key], "{key}");
    }
    wait_for("a stale sensor", || {
        status(&mut subscriber)["state"] == "stale"
    });
    wait_for("the second sender", || {
        second.send_to(&frames[0], address).unwrap();
        std::thread::sleep(PERIOD);
        status(&mut subscriber)["state"] == "live"
    });
    daemon.process.signal(rustix::process::Signal::TERM);
    let log = daemon.whole_log();
    assert_eq!(log.matches("ignored: another sender").count(), 1, "{log}");
}

#[test]
fn a_sensor_that_answers_is_started_once_and_asked_again_and_again() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let frame = "[sensor.frame]\nstart = \"53 0A\"\nrequest = \"52\"\nrequest_ms = 30\n";
    let _daemon = Daemon::start(&configure(&bench, &port, frame));
    let mut subscriber = bench.subscriber();
    for _ in 0..2 {
        let mut peer = accept(&listener);
        let mut got = [0; 3];
        peer.read_exact(&mut got).unwrap();
        assert_eq!(&got, b"S\nR");
        for frame in &frames[..10] {
            peer.write_all(frame).unwrap();
            peer.read_exact(&mut got[..1]).unwrap();
            assert_eq!(got[0], b'R');
        }
        subscriber.until(&json!({"type": "status", "state": "live"}));
    }
}

#[test]
fn a_peer_that_sends_a_frame_and_closes_is_tried_less_and_less() {
    let bench = Bench::new();
    let frame = &frames(&bench)[0];
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let _daemon = Daemon::start(&configure(&bench, &port, ""));
    let begin = Instant::now();
    for _ in 0..8 {
        accept(&listener).write_all(frame).unwrap();
    }
    // The pauses are 50, 100, ... 1600 ms and 2 s.
    let tried = begin.elapsed();
    assert!(tried > Duration::from_secs(5), "8 times in {tried:?}");
    // A link that holds is opened again at once.
    let mut peer = accept(&listener);
    for _ in 0..120 {
        peer.write_all(frame).unwrap();
        std::thread::sleep(PERIOD);
    }
    drop(peer);
    let begin = Instant::now();
    accept(&listener);
    let tried = begin.elapsed();
    assert!(tried < Duration::from_secs(1), "{tried:?}");
}

#[test]
fn bytes_hold_no_place_and_requests_go_to_a_sender_of_frames() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let [noise, sensor] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    let free = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = free.local_addr().unwrap();
    drop(free);
    let frame = "[sensor.frame]\nrequest = \"52\"\nrequest_ms = 30\n";
    let _daemon = Daemon::start(&configure(&bench, &format!("udp://{address}"), frame));
    let mut subscriber = bench.subscriber();
    noise.set_nonblocking(true).unwrap();
    let requests = || {
        let mut got = [0; 16];
        std::iter::from_fn(|| noise.recv(&mut got).ok()).count()
    };
    wait_for("a first answer", || {
        noise.send_to(b"7", address).unwrap();
        requests() > 0
    });
    // A stranger that sends nothing more is asked for as long as a sensor may need, and no longer.
    std::thread::sleep(Duration::from_secs(1));
    requests();
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(requests(), 0);
    // One byte every 20 ms holds the place for half a second at a time.
    let mut place = Vec::new();
    wait_for("the sensor", || {
        noise.send_to(b"7", address).unwrap();
        std::thread::sleep(PERIOD);
        sensor.send_to(&frames[0], address).unwrap();
        let status = status(&mut subscriber);
        place.push(status["frames"].as_u64().unwrap());
        place.last() > Some(&50)
    });
    // Once it has the place, it keeps it.
    let taken = place.iter().filter(|&&frames| frames > 0).count() as u64;
    assert!(place.last().unwrap() + 5 > taken, "{place:?}");
}
