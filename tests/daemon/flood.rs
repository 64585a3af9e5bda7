//! What one sensor may cost: the log, the processor and the others.

use std::fs;
use std::io::Write;
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::json;

use crate::bench::{Bench, Daemon, get, recordings_in};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{Layout, Settings};

const PERIOD: Duration = Duration::from_millis(20);
/// The frames that the good sensor sends.
const FRAMES: u64 = 400;
const FLOODS: usize = 6;

fn bytes(load: f32) -> Vec<u8> {
    let layout = Layout::new(&Settings::default()).unwrap();
    let mut raw = RawFrame::default();
    for row in 11..17 {
        raw.counts[row * 28 + 11..row * 28 + 17].fill(load);
    }
    let mut bytes = Vec::new();
    layout.encode(&raw, &mut bytes);
    bytes
}

/// Six sensors that send short presses without end, and a good one.
fn configure(bench: &Bench, ports: &[String]) -> PathBuf {
    let path = bench.path("hardnessd.toml");
    let sensors = ports.iter().enumerate().map(|(number, port)| {
        let name = if number == 0 {
            "good".to_owned()
        } else {
            format!("flood{number}")
        };
        format!("[[sensor]]\nname = \"{name}\"\nport = \"{port}\"\nframe_rate_hz = 50.0\nstale_after_ms = 500\n")
    });
    let sensors: String = sensors.collect();
    let more = "[publish.unix]\npath = \"events.sock\"\n[http]\nlisten = \"127.0.0.1:0\"\n";
    fs::write(&path, sensors + more).unwrap();
    path
}

/// The good sensor's frames and stale statuses.
#[derive(Debug, Default)]
struct Received {
    frames: u64,
    missing: u64,
    stale: u64,
}

#[test]
fn six_floods_take_nothing_from_a_good_sensor() {
    let bench = Bench::new();
    let listeners = [(); FLOODS + 1].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    let ports = listeners
        .iter()
        .map(|listener| format!("tcp://{}", listener.local_addr().unwrap()));
    let mut daemon = Daemon::start(&configure(&bench, &ports.collect::<Vec<_>>()));
    let mut peers: Vec<TcpStream> = listeners
        .iter()
        .map(|listener| listener.accept().unwrap().0)
        .collect();

    let mut subscriber = bench.subscriber();
    let wanted = json!({"subscribe": ["frame", "status", "press", "hardness"]});
    subscriber.ask(&wanted.to_string());
    let (free, pressed) = (bytes(0.0), bytes(60.0));
    let mut short = free.repeat(4);
    short.extend(pressed.repeat(4));
    let done = Arc::new(AtomicBool::new(false));
    let floods: Vec<_> =
        peers
            .drain(1..)
            .map(|mut peer| {
                let (done, short) = (Arc::clone(&done), short.repeat(8));
                thread::spawn(move || {
                    while !done.load(Ordering::Relaxed) && peer.write_all(&short).is_ok() {}
                })
            })
            .collect();
    let mut good = peers.pop().unwrap();
    let playing = thread::spawn(move || {
        let begin = Instant::now();
        let (mut last, mut longest) = (begin, Duration::ZERO);
        for number in 0..FRAMES as u32 {
            // A press of half a second every two seconds.
            let bytes = if number % 100 >= 75 { &pressed } else { &free };
            good.write_all(bytes).unwrap();
            longest = longest.max(last.elapsed());
            last = Instant::now();
            thread::sleep((PERIOD * (number + 1)).saturating_sub(begin.elapsed()));
        }
        (good, longest)
    });

    let mut received = Received::default();
    let mut next = 0;
    let begin = Instant::now();
    while received.frames < FRAMES && begin.elapsed() < 4 * PERIOD * FRAMES as u32 {
        let line = subscriber.next().unwrap();
        match (line["type"].as_str(), line["sensor"].as_str()) {
            (Some("frame"), Some("good")) => {
                let number = line["frame"].as_u64().unwrap();
                received.missing += number - next;
                (next, received.frames) = (number + 1, number + 1);
            }
            (Some("status"), Some("good")) => {
                received.stale += u64::from(line["state"] == "stale");
            }
            _ => {}
        }
    }
    done.store(true, Ordering::Relaxed);
    let metrics = get(&daemon.address("http").to_string(), "/metrics");
    let mut asker = bench.subscriber();
    let flood = loop {
        let line = asker.next().unwrap();
        if line["type"] == "status" && line["sensor"] == "flood1" {
            break line;
        }
    };
    let (_, longest) = playing.join().unwrap();
    daemon.end();
    for flood in floods {
        flood.join().unwrap();
    }
    let log = daemon.whole_log();
    let lines = |sensor: &str| {
        let is_of = |line: &&str| line.contains(&format!("sensor=\"{sensor}\""));
        log.lines().filter(is_of).count()
    };
    // A busy machine may delay the good sender itself.
    let may_be_stale = longest > 3 * PERIOD;
    assert!(
        may_be_stale || received.stale == 0,
        "{received:?}, {longest:?}"
    );
    assert_eq!(received.missing, 0, "{received:?}");
    for number in 1..=FLOODS {
        let lines = lines(&format!("flood{number}"));
        assert!(lines < 50, "{lines} in 8 s");
    }
    assert_eq!(flood["reason"], "frames above 100 Hz are dropped");
    let dropped = flood["frames_dropped"].as_u64().unwrap();
    assert!(dropped > 0);
    assert!(
        metrics.contains("hardnessd_frames_dropped_total{robot="),
        "{metrics}"
    );
    // What was not read is counted too, and what was taken is at most twice the rate and a burst.
    assert!(
        flood["frames"].as_u64().unwrap() < 2 * 50 * 20 + 500,
        "{flood}"
    );
}

/// The resident memory of a process, in bytes.
fn resident(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let mut lines = status.lines();
    let line = lines.find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}

#[test]
fn noise_over_udp_is_recorded_at_no_more_than_the_line_carries() {
    let bench = Bench::new();
    let free = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = free.local_addr().unwrap();
    drop(free);
    let path = bench.path("hardnessd.toml");
    let text = format!(
        "[[sensor]]\nname = \"noisy\"\nport = \"udp://{address}\"\nframe_rate_hz = 50.0\n\
         [publish.unix]\npath = \"events.sock\"\n[record]\ndir = \"records\"\nkeep_free_mb = 0\n"
    );
    fs::write(&path, text).unwrap();
    let mut daemon = Daemon::start(&path);
    let process = daemon.process.0.id();
    let before = resident(process);
    let noise: Vec<u8> = (0..60_000_u32).map(|n| ((n * n) >> 7) as u8).collect();
    let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(5) {
        let _ = sender.send_to(&noise, address);
    }
    let taken_s = begin.elapsed().as_secs_f64();
    let grown = resident(process).saturating_sub(before);
    let mut asker = bench.subscriber();
    asker.next().unwrap();
    let skipped = asker.next().unwrap()["bytes_skipped"].as_u64().unwrap();
    daemon.end();
    let files = recordings_in(&bench.path("records"), "hardnessd-");
    let recorded: u64 = files
        .iter()
        .map(|file| fs::metadata(file).unwrap().len())
        .sum();
    // Four times the bytes of the frames, for the time and for what may come at once.
    let most = 4.0 * 50.0 * 790.0 * (taken_s + 5.0) + 2e5;
    assert!((recorded as f64) < most, "{recorded} of {most}");
    assert!(skipped > recorded, "{skipped}");
    assert!(grown < 40 << 20, "{grown}");
}
