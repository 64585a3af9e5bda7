//! What one sensor may cost: the log, the processor and the others.

use std::fs;
use std::io::Write;
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::thread;
use std::time::{Duration, Instant};

use hardnessd_simulator::random::Stream;
use tempfile::TempDir;

use crate::bench::{Bench, RECORD, frame, free_address, sensor};

const PERIOD: Duration = Duration::from_millis(20);
const STALE_AFTER: Duration = Duration::from_millis(500);
/// The frames that the good sensor sends.
const FRAMES: u32 = 400;
const FLOODS: usize = 6;

/// Sends the good sensor's frames: a press of half a second every two seconds. Returns the longest pause, which a busy
/// machine may cause.
fn play(mut good: TcpStream) -> Duration {
    let (free, pressed) = (frame(0.0), frame(60.0));
    let begin = Instant::now();
    let (mut last, mut longest) = (begin, Duration::ZERO);
    for number in 0..FRAMES {
        let bytes = if number % 100 >= 75 { &pressed } else { &free };
        good.write_all(bytes).unwrap();
        longest = longest.max(last.elapsed());
        last = Instant::now();
        thread::sleep((PERIOD * (number + 1)).saturating_sub(begin.elapsed()));
    }
    longest
}

/// Six floods beside a good sensor. Returns how often that was stale, or nothing if its own sender was late.
fn stale_beside_six_floods() -> Option<u64> {
    let bench = Bench::new();
    let listeners = [(); FLOODS + 1].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    let tables = (0..).zip(&listeners).map(|(number, listener)| {
        let port = format!("tcp://{}", listener.local_addr().unwrap());
        sensor(&format!("s{number}"), &port, 50) + "stale_after_ms = 500\n"
    });
    let mut daemon = bench.daemon_of(&tables.collect::<String>(), "");
    let mut peers = listeners
        .map(|listener| listener.accept().unwrap().0)
        .into_iter();
    let mut subscriber = bench.subscriber();
    subscriber.ask(r#"{"subscribe":["frame","status","press","hardness"]}"#);
    let good = peers.next().unwrap();
    let short = [frame(0.0).repeat(4), frame(60.0).repeat(4)].concat();
    // They end with the daemon.
    for mut flood in peers {
        let short = short.clone();
        thread::spawn(move || while flood.write_all(&short).is_ok() {});
    }
    let playing = thread::spawn(move || play(good));
    let begin = Instant::now();
    let (mut stale, mut next) = (0, 0);
    while next < u64::from(FRAMES) && begin.elapsed() < 4 * PERIOD * FRAMES {
        let line = subscriber.next().unwrap();
        if line["sensor"] != "s0" {
            continue;
        }
        stale += u64::from(line["state"] == "stale");
        if line["type"] == "frame" {
            assert_eq!(line["frame"], next, "none is missing");
            next += 1;
        }
    }
    // While they flood: some seconds later nothing is said of it any more.
    let flood = bench.subscriber().status("s1");
    let longest = playing.join().unwrap();
    assert_eq!(next, u64::from(FRAMES), "frames in time");
    let log = daemon.end();
    for number in 1..=FLOODS {
        let lines = log.matches(&format!("sensor=\"s{number}\"")).count();
        assert!(lines < 50, "{lines} in 8 s");
    }
    assert_eq!(flood["reason"], "frames above 100 Hz are dropped");
    assert!(flood["frames_dropped"].as_u64() > Some(0));
    // What was not read is counted too, and what was taken is at most twice the rate and a burst.
    assert!(
        flood["frames"].as_u64() < Some(2 * 50 * 20 + 500),
        "{flood}"
    );
    // A busy machine may delay the good sender itself.
    (longest < STALE_AFTER - 5 * PERIOD).then_some(stale)
}

#[test]
fn six_floods_take_nothing_from_a_good_sensor() {
    let of_try = |_| Some(stale_beside_six_floods()).filter(|stale| *stale != Some(0));
    let tries: Vec<_> = (0..3).map_while(of_try).collect();
    assert!(tries.len() < 3, "stale in each of three tries: {tries:?}");
}

#[test]
fn noise_over_udp_is_recorded_at_no_more_than_the_line_carries() {
    let bench = Bench::new();
    let address = free_address();
    let mut daemon = bench.daemon_of(&sensor("noisy", &format!("udp://{address}"), 50), RECORD);
    let before_kb = daemon.process.number("VmRSS");
    let noise: Vec<u8> = (0..60_000_u32).map(|n| ((n * n) >> 7) as u8).collect();
    let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(5) {
        let _ = sender.send_to(&noise, address);
    }
    let taken_s = begin.elapsed().as_secs_f64();
    let grown_kb = daemon.process.number("VmRSS").saturating_sub(before_kb);
    let status = bench.subscriber().status("noisy");
    let skipped = status["bytes_skipped"].as_u64().unwrap();
    let log = daemon.end();
    // The reason is said once, and the place that noise holds for a while is nothing to say.
    let said = log.lines().filter(|line| line.contains(" status "));
    assert!(said.count() <= 4, "{log}");
    let sizes = bench.recordings("hardnessd-").into_iter();
    let sizes = sizes.map(|name| fs::metadata(bench.path(&name)).unwrap().len());
    let recorded: u64 = sizes.sum();
    // Four times the bytes of the frames, for the time and for what may come at once.
    let most = 4.0 * 50.0 * 790.0 * (taken_s + 5.0) + 2e5;
    assert!((recorded as f64) < most, "{recorded} of {most}");
    assert!(skipped > recorded, "{skipped}");
    assert!(grown_kb < 40 << 10, "{grown_kb}");
}

#[test]
fn a_flood_leaves_the_room_that_is_to_stay_free() {
    const MB: u64 = 1_000_000;
    let disk = TempDir::new_in("/dev/shm").unwrap();
    let free = || {
        let disk = rustix::fs::statvfs(disk.path()).unwrap();
        disk.f_bavail * disk.f_frsize
    };
    let least = free() / MB - 1;
    let record = format!(
        "[record]\ndir = {:?}\nkeep_free_mb = {least}\n",
        disk.path()
    );
    let bench = Bench::new();
    let address = free_address();
    let large = sensor("large", &format!("udp://{address}"), 100)
        + "[sensor.frame]\nrows = 64\ncols = 64\ncell = \"u16le\"\n";
    let mut daemon = bench.daemon_of(&large, &record);
    // Compression makes it no shorter.
    let mut stream = Stream::new(1, "noise");
    let noise: Vec<u8> = (0..60_000).map(|_| stream.next_u64() as u8).collect();
    let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
    let begin = Instant::now();
    let mut lowest = free();
    while begin.elapsed() < Duration::from_secs(8) {
        let _ = sender.send_to(&noise, address);
        lowest = lowest.min(free());
    }
    let log = daemon.end();
    assert!(log.contains("(record.keep_free_mb)"), "{log}");
    assert!(lowest + MB > least * MB, "{lowest} of {least} MB");
}
