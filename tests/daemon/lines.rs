//! Sensors that are no cable: TCP, UDP, sensors that answer, and lines whose settings somebody changes.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::time::Duration;

use rustix::termios::{InputModes, LocalModes, OptionalActions, tcgetattr, tcsetattr};
use serde_json::{Value, json};

use crate::bench::pair::Pair;
use crate::bench::{Bench, Daemon, PATIENCE, Subscriber, hardnessd, wait_for};

/// The bytes of a frame of the JX255N.
const FRAME: usize = 790;
/// The tests send frames this often.
const PERIOD: Duration = Duration::from_millis(20);

/// The frames of a simulated press.
fn frames(bench: &Bench) -> Vec<Vec<u8>> {
    let path = bench.path("press.bin");
    let played = hardnessd(&[
        "simulate",
        "--presses",
        "1",
        "--fps",
        "20",
        "--force",
        "15",
        "--material",
        "hard-plastic",
        "--to",
        path.to_str().unwrap(),
    ]);
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
    let load =
        format!("tcp://{address}, 28x28 taxels in 790 bytes, 50 frames/s: 39500 bytes/s, whatever");
    assert!(checked.contains(&load), "{checked}");
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

/// In real-time scheduling, the system kills a process whose thread does not sleep for half a second.
#[test]
fn a_sensor_that_sends_without_end_leaves_the_daemon_its_sleep() {
    let bench = Bench::new();
    let still = frames(&bench)[0].repeat(2000);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let mut daemon = Daemon::start(&configure(&bench, &port, ""));
    let mut peer = accept(&listener);
    // Until the daemon has ended.
    let flood = std::thread::spawn(move || while peer.write_all(&still).is_ok() {});
    bench
        .subscriber()
        .until(&json!({"type": "status", "state": "live"}));
    // The first thread is that of the sensors.
    let task = format!("/proc/{0}/task/{0}", daemon.process.0.id());
    let sleeps = || -> u64 {
        let status = fs::read_to_string(format!("{task}/status")).unwrap();
        let mut lines = status.lines();
        let count = lines.find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
        count.unwrap().trim().parse().unwrap()
    };
    let worked_ticks = || -> u64 {
        let stat = fs::read_to_string(format!("{task}/stat")).unwrap();
        // After the name, which may have spaces, come 11 fields before the times of user and system.
        let (_, fields) = stat.rsplit_once(") ").unwrap();
        let times = fields.split(' ').skip(11).take(2);
        times.map(|ticks| ticks.parse::<u64>().unwrap()).sum()
    };
    let (begun, before) = (worked_ticks(), sleeps());
    // A second of work: a tick is 10 ms.
    wait_for("work", || worked_ticks() >= begun + 100);
    let slept = sleeps() - before;
    assert!(slept >= 20, "{slept} times in a second of work");
    daemon.process.signal(rustix::process::Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    flood.join().unwrap();
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
        std::thread::sleep(PERIOD);
    }
    daemon.logged("ignored: another sender");
    // An empty datagram is no end and no frame.
    let after = status(&mut subscriber);
    for key in ["frames", "frames_damaged", "bytes_skipped"] {
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
fn half_a_frame_of_a_silent_sender_is_not_joined_to_the_bytes_of_the_next() {
    let bench = Bench::new();
    let [first, second] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    let address = UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    // Without a checksum, the two halves look like a frame.
    let frame = "[sensor.frame]\npreset = \"flexitac\"\n";
    let _daemon = Daemon::start(&configure(&bench, &format!("udp://{address}"), frame));
    let mut subscriber = bench.subscriber();
    let [of_first, of_second] = [10, 20].map(|count| [&[0xAA, 0x55][..], &[count; 512]].concat());
    wait_for("the first frame", || {
        first.send_to(&of_first, address).unwrap();
        status(&mut subscriber)["state"] == "live"
    });
    first.send_to(&of_first[..300], address).unwrap();
    wait_for("a stale sensor", || {
        status(&mut subscriber)["state"] == "stale"
    });
    // The half frame came a little later than the frame whose age makes the sensor stale.
    std::thread::sleep(5 * PERIOD);
    let before = status(&mut subscriber);
    assert_eq!(before["bytes_skipped"], 0);
    second.send_to(&of_second[300..], address).unwrap();
    for _ in 0..5 {
        second.send_to(&of_second, address).unwrap();
        std::thread::sleep(PERIOD);
    }
    let expected = before["frames"].as_u64().unwrap() + 5;
    wait_for("the frames of the second sender", || {
        status(&mut subscriber)["frames"].as_u64().unwrap() >= expected
    });
    std::thread::sleep(5 * PERIOD);
    let after = status(&mut subscriber);
    assert_eq!(after["frames"], expected);
    assert_eq!(after["bytes_skipped"], of_second.len());
    assert_eq!(after["frames_damaged"], 0);
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

/// A pty whose other end the test is. Its settings are those of a sensor.
fn pty() -> Pair {
    let pair = Pair::open().unwrap();
    rustix::io::ioctl_fionbio(&pair.master, true).unwrap();
    let mut raw = tcgetattr(&pair.device).unwrap();
    raw.make_raw();
    tcsetattr(&pair.device, OptionalActions::Now, &raw).unwrap();
    pair
}

/// Everything that was written to the other end so far.
fn written(master: &OwnedFd) -> Vec<u8> {
    let mut file = fs::File::from(master.try_clone().unwrap());
    let mut bytes = Vec::new();
    let end = file.read_to_end(&mut bytes).unwrap_err();
    assert_eq!(end.kind(), ErrorKind::WouldBlock);
    bytes
}

#[test]
fn a_serial_sensor_that_answers_is_asked_too() {
    let bench = Bench::new();
    let pair = pty();
    let frame = "[sensor.frame]\nstart = \"53\"\nrequest = \"52 0A\"\n";
    let _daemon = Daemon::start(&configure(&bench, pair.path.to_str().unwrap(), frame));
    let mut bytes = Vec::new();
    wait_for("five requests", || {
        bytes.extend(written(&pair.master));
        bytes.len() >= 11
    });
    assert!(bytes.starts_with(b"SR\nR\nR\nR\nR\n"), "{bytes:?}");
}

#[test]
fn settings_of_the_line_that_somebody_changed_are_shown_and_set_again() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let pair = pty();
    let port = pair.path.to_str().unwrap();
    let mut daemon = Daemon::start(&configure(&bench, port, ""));
    let mut subscriber = bench.subscriber();
    let send = || {
        // Where nobody reads, the frame is lost.
        let _ = rustix::io::write(&pair.master, &frames[0]);
        std::thread::sleep(PERIOD);
    };
    wait_for("a live sensor", || {
        send();
        status(&mut subscriber)["state"] == "live"
    });
    // As a getty does. The line then waits for the end of a line of text.
    let mut cooked = tcgetattr(&pair.device).unwrap();
    cooked.local_modes |= LocalModes::ICANON | LocalModes::ECHO;
    cooked.input_modes |= InputModes::ICRNL;
    cooked.set_speed(9600).unwrap();
    tcsetattr(&pair.device, OptionalActions::Now, &cooked).unwrap();
    // Others may not open the port.
    if rustix::process::geteuid().is_root() {
        let doctor = hardnessd(&["doctor", "--port", port]);
        let stdout = String::from_utf8(doctor.stdout).unwrap();
        let fault = "another program changed the settings of the line: found echo icanon icrnl ispeed 9600 \
                     ospeed 9600, expected -echo -icanon -icrnl ispeed 115200 ospeed 115200";
        assert!(stdout.contains(fault), "{stdout}");
        let reads = format!(", which reads it as {port} for \"forearm\"");
        assert!(stdout.contains(&reads), "{stdout}");
    }
    let line = daemon.logged("another program changed the settings of the line");
    assert!(line.contains("found=\"echo icanon"), "{line}");
    wait_for("a live sensor", || {
        send();
        status(&mut subscriber)["state"] == "live"
    });
    daemon.process.signal(rustix::process::Signal::TERM);
    let log = daemon.whole_log();
    assert_eq!(log.matches("another program changed").count(), 1, "{log}");
}

#[test]
fn a_second_name_of_a_port_that_the_daemon_reads_is_said_to_be_its_own() {
    let bench = Bench::new();
    let pair = pty();
    // The names do not exist yet, so nobody can see that they are one port.
    let more = format!(
        "[[sensor]]\nname = \"wrist\"\nport = \"{}\"\n",
        bench.path("two").display()
    );
    let _daemon = Daemon::start(&configure(&bench, "one", &more));
    let mut subscriber = bench.subscriber();
    for name in ["one", "two"] {
        std::os::unix::fs::symlink(&pair.path, bench.path(name)).unwrap();
    }
    let reason = "this daemon reads that port already, for another sensor";
    subscriber.until(&json!({"type": "status", "state": "connecting", "reason": reason}));
}

#[test]
fn the_tools_take_an_address_in_place_of_a_port() {
    let bench = Bench::new();
    let frames = frames(&bench);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let bytes = frames.concat();
    let logged_lines = format!("# {port}: {} bytes\n", bytes.len());
    let sensor = std::thread::spawn(move || {
        let mut peer = accept(&listener);
        peer.write_all(&bytes).unwrap();
    });
    let sniffed = hardnessd(&["sniff", "--port", &port, "--seconds", "20"]);
    sensor.join().unwrap();
    let stdout = String::from_utf8(sniffed.stdout).unwrap();
    assert!(stdout.starts_with(&logged_lines), "{stdout}");
    // Nobody listens any more.
    let config = configure(&bench, &port, "");
    let out = bench.path("out.mcap");
    let recorded = hardnessd(&[
        "record",
        "--config",
        config.to_str().unwrap(),
        "--out",
        out.to_str().unwrap(),
    ]);
    assert_eq!(recorded.status.code(), Some(69));
    let stderr = String::from_utf8(recorded.stderr).unwrap();
    let error = format!("sensor \"forearm\": {port}: Connection refused");
    assert!(stderr.contains(&error), "{stderr}");
    let held = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = format!("udp://{}", held.local_addr().unwrap());
    let doctor = hardnessd(&["doctor", "--port", &port]);
    let stdout = String::from_utf8(doctor.stdout).unwrap();
    let fault = format!("{port}: Address already in use: another program receives there");
    assert!(stdout.starts_with(&fault), "{stdout}");
    drop(held);
    let doctor = hardnessd(&["doctor", "--port", &port]);
    assert_eq!(doctor.status.code(), Some(0), "{doctor:?}");
    // A name that is neither is wrong usage.
    let doctor = hardnessd(&["doctor", "--port", "serial://x"]);
    assert_eq!(doctor.status.code(), Some(2), "{doctor:?}");
}
