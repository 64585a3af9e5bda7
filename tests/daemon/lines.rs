//! Sensors that are no cable: TCP, UDP, sensors that answer, and lines whose settings somebody changes.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use crate::bench::{Bench, Daemon, PATIENCE, frame, free_address, sensor, wait_for};

/// The tests send frames this often.
const PERIOD: Duration = Duration::from_millis(20);

/// A daemon of one sensor at this address. A silence of half a second is stale.
fn daemon(bench: &Bench, port: &str, frame_keys: &str) -> Daemon {
    let keys = format!("stale_after_ms = 500\n[sensor.frame]\n{frame_keys}");
    bench.daemon_of(&(sensor("forearm", port, 50) + &keys), "")
}

/// A server that the sensor connects to, and the sensor's port.
fn server() -> (TcpListener, String) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    (listener, port)
}

fn accept(listener: &TcpListener) -> TcpStream {
    let (stream, _) = listener.accept().unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

fn udp() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

#[test]
fn a_press_over_tcp_is_judged_silence_is_stale_and_the_end_of_the_peer_is_loss() {
    let bench = Bench::new();
    let (listener, port) = server();
    let _daemon = daemon(&bench, &port, "start = \"53 0A\"\n");
    let checked = bench.succeeds("check --config hardnessd.toml");
    let shown = "28x28 taxels in 790 bytes, 50 frames/s";
    assert!(checked.contains(shown), "{checked}");
    let mut subscriber = bench.subscriber();
    // Each connection begins with what starts the sensor.
    let started = || {
        let mut peer = accept(&listener);
        let mut got = [0; 2];
        peer.read_exact(&mut got).unwrap();
        assert_eq!(&got, b"S\n");
        peer
    };
    let mut peer = started();
    // A frame may come in any pieces, and damage is counted as on a cable.
    peer.write_all(&[7; 100]).unwrap();
    for (counts, frames) in [(0.0, 10), (60.0, 12), (0.0, 6)] {
        for _ in 0..frames {
            let frame = frame(counts);
            peer.write_all(&frame[..300]).unwrap();
            peer.write_all(&frame[300..]).unwrap();
            std::thread::sleep(PERIOD);
        }
    }
    subscriber.state("live");
    subscriber.press("begin");
    subscriber.verdict();
    let stale = subscriber.state("stale");
    assert_eq!(stale["bytes_skipped"], 100);
    assert_eq!(stale["frames"], 28);
    drop(peer);
    assert_eq!(
        subscriber.state("lost")["reason"],
        "closed by the other end"
    );
    let mut peer = started();
    peer.write_all(&frame(0.0)).unwrap();
    assert_eq!(subscriber.state("live")["frames"], 29);
    // Nobody listens any more.
    drop(listener);
    drop(peer);
    subscriber.state("lost");
    wait_for("the reason", || {
        subscriber.status("forearm")["reason"] == "Connection refused"
    });
    let (code, stdout, _) = bench.run(&format!("doctor --port {port}"));
    let fault = format!("{port}: Connection refused: nothing listens there");
    assert!(code == 1 && stdout.starts_with(&fault), "{code}: {stdout}");
}

#[test]
fn datagrams_are_taken_from_one_sender_until_it_is_silent() {
    let bench = Bench::new();
    let (first, second, address) = (udp(), udp(), free_address());
    let mut daemon = daemon(&bench, &format!("udp://{address}"), "start = \"53\"\n");
    let mut subscriber = bench.subscriber();
    let send = |sender: &UdpSocket| {
        sender.send_to(&frame(0.0), address).unwrap();
        std::thread::sleep(PERIOD);
    };
    wait_for("the first frame", || {
        send(&first);
        subscriber.status("forearm")["state"] == "live"
    });
    // The sensor learns whom to answer by its own first datagram.
    let mut got = [0; 16];
    assert_eq!(first.recv(&mut got).unwrap(), 1);
    assert_eq!(got[0], 0x53);
    // The last frame may still be under way.
    std::thread::sleep(5 * PERIOD);
    let before = subscriber.status("forearm");
    for _ in 0..20 {
        second.send_to(&frame(0.0), address).unwrap();
        second.send_to(&frame(0.0)[..5], address).unwrap();
        // An empty datagram is no end and no frame.
        first.send_to(&[], address).unwrap();
        // Frames keep the place.
        send(&first);
    }
    daemon.logged("ignored: another sender");
    wait_for("20 frames", || {
        let after = subscriber.status("forearm");
        for key in ["frames_damaged", "bytes_skipped"] {
            assert_eq!(after[key], before[key], "{key}");
        }
        after["frames"] == before["frames"].as_u64().unwrap() + 20
    });
    subscriber.state("stale");
    wait_for("the second sender", || {
        send(&second);
        subscriber.status("forearm")["state"] == "live"
    });
    let log = daemon.end();
    assert_eq!(log.matches("ignored: another sender").count(), 1, "{log}");
}

#[test]
fn a_peer_that_sends_a_frame_and_closes_is_tried_less_and_less() {
    let bench = Bench::new();
    let (listener, port) = server();
    let _daemon = daemon(&bench, &port, "");
    let begin = Instant::now();
    for _ in 0..8 {
        accept(&listener).write_all(&frame(0.0)).unwrap();
    }
    // The pauses are 50, 100, ... 1600 ms and 2 s.
    let tried = begin.elapsed();
    assert!(tried > Duration::from_secs(5), "8 times in {tried:?}");
    // A link that holds is opened again at once.
    let mut peer = accept(&listener);
    for _ in 0..120 {
        peer.write_all(&frame(0.0)).unwrap();
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
    let (noise, sensor, address) = (udp(), udp(), free_address());
    let port = format!("udp://{address}");
    let _daemon = daemon(&bench, &port, "request = \"52\"\nrequest_ms = 30\n");
    let mut subscriber = bench.subscriber();
    noise.set_nonblocking(true).unwrap();
    let requests = || std::iter::from_fn(|| noise.recv(&mut [0; 16]).ok()).count();
    wait_for("a first answer", || {
        noise.send_to(b"7", address).unwrap();
        requests() > 0
    });
    // A stranger that sends nothing more is asked as often as a sensor may need, and no more.
    std::thread::sleep(Duration::from_secs(2));
    assert!(requests() > 20);
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(requests(), 0);
    // Then it has no more sent than it sends.
    for _ in 0..4 {
        noise.send_to(b"7", address).unwrap();
        std::thread::sleep(10 * PERIOD);
    }
    assert!((1..=4).contains(&requests()));
    // One byte every 20 ms holds the place for half a second at a time.
    let mut place = Vec::new();
    wait_for("the sensor", || {
        noise.send_to(b"7", address).unwrap();
        std::thread::sleep(PERIOD);
        sensor.send_to(&frame(0.0), address).unwrap();
        let status = subscriber.status("forearm");
        place.push(status["frames"].as_u64().unwrap());
        place.last() > Some(&50)
    });
    // Once it has the place, it keeps it.
    let taken = place.iter().filter(|&&frames| frames > 0).count() as u64;
    assert!(place.last().unwrap() + 5 > taken, "{place:?}");
}

#[test]
fn silent_modules_at_a_port_of_datagrams_leave_the_other_one_live() {
    let bench = Bench::new();
    let (board, address) = (udp(), free_address());
    let module = |name: &str, request: &str| {
        let keys = format!("[sensor.frame]\nrequest = \"{request}\"\n");
        sensor(name, &format!("udp://{address}"), 50) + &keys
    };
    let modules = ["01", "02", "03"].map(|number| module(&format!("m{number}"), number));
    let _daemon = bench.daemon_of(&modules.concat(), "");
    let mut subscriber = bench.subscriber();
    // It says where it is, once the port is open.
    board.set_nonblocking(true).unwrap();
    wait_for("a first request", || {
        board.send_to(b"7", address).unwrap();
        board.peek(&mut [0; 16]).is_ok()
    });
    board.set_nonblocking(false).unwrap();
    let mut answers = 0;
    while answers < 50 {
        let mut request = [0; 16];
        board.recv(&mut request).unwrap();
        if request[0] == 3 {
            board.send_to(&frame(0.0), address).unwrap();
            answers += 1;
        }
    }
    wait_for("frames", || {
        subscriber.status("m03")["frames"].as_u64() > Some(40)
    });
}
