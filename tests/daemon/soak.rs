//! A soak: eight sensors play presses with faults to a daemon for as long as you say, and every press
//! is accounted for.
//!
//!     HARDNESSD_SOAK_MINUTES=120 cargo test --release --workspace --test program soak -- --ignored --nocapture
//!
//! Each sensor sends presses over a pty, with a fault in every second press. Beside them, one
//! UDP port gets frames at ten times the sensor's rate, and one gets noise. There are subscribers of
//! all kinds, recordings, and a reload every ten seconds. At the end, every press must have its verdict,
//! or must be lost with the link, by its number. Memory, descriptors and threads must not have grown,
//! and the two UDP ports must not have filled the log.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, UdpSocket};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use crate::bench::{
    Bench, Cable, Daemon, PERIOD, RECORD, Subscriber, frame, free_address, sensor, wait_for,
};
use hardnessd_simulator::random::Stream;
use rustix::process::Signal;

const SENSORS: usize = 8;
/// The frames of a press, and those of the rest after it.
const PRESSED: usize = 60;
const FREE: usize = 120;
/// The frame of a press at which its fault begins.
const MIDDLE: usize = PRESSED / 2;
/// The number of recordings that are kept.
const KEPT: usize = 16;
/// The time until memory grows no more: the black boxes hold a minute, and up to a stretch of ten
/// seconds more of each sensor that was there all the time, and the first reloads need room for a
/// second model. The events that are held for `since` take minutes more to fill, so a longer run
/// leaves out its first quarter.
const WARM: Duration = Duration::from_secs(120);

const FAULTS: [&str; 7] = [
    "unplug", "silence", "stall", "flip", "drop", "noise", "double",
];

/// A sensor on its cable.
struct Player {
    bench: Arc<Bench>,
    name: String,
    cable: Cable,
    stream: Stream,
    /// For each press sent, whether it has a verdict.
    sent: Vec<bool>,
    faults: u64,
}

impl Player {
    /// Plays until `end`, and then to the end of the press under way.
    fn play(mut self, end: Instant) -> Self {
        self.wake();
        while Instant::now() < end {
            let fault = self.stream.below(2 * FAULTS.len());
            self.faults += u64::from(fault < FAULTS.len());
            self.press(FAULTS.get(fault).copied().unwrap_or_default());
        }
        self.cable.drain();
        self
    }

    fn press(&mut self, fault: &str) {
        let (free, pressed, mut held) = (frame(0.0), frame(60.0), Vec::new());
        for index in 0..PRESSED + FREE {
            let frame = if index < PRESSED { &pressed } else { &free };
            let struck = (MIDDLE..MIDDLE + 3).contains(&index);
            let mut bytes = frame.clone();
            match fault {
                "unplug" if index == MIDDLE => {
                    self.sent.push(false);
                    return self.unplug(&bytes);
                }
                "silence" if index == MIDDLE => sleep(Duration::from_millis(400)),
                // Send nothing for 30 frames, then send all of them.
                "stall" if (MIDDLE..MIDDLE + 30).contains(&index) => {
                    held.append(&mut bytes);
                }
                "flip" if struck => bytes[self.stream.below(frame.len())] ^= 1,
                "drop" if struck => {
                    bytes.remove(self.stream.below(frame.len()));
                }
                "noise" if struck => {
                    let noise = (0..300).map(|_| self.stream.next_u64() as u8);
                    bytes.splice(0..0, noise.collect::<Vec<u8>>());
                }
                "double" if struck => bytes.extend_from_slice(frame),
                _ => {}
            }
            if index == MIDDLE + 30 {
                bytes.splice(0..0, std::mem::take(&mut held));
            }
            self.cable.write(&bytes);
            sleep(PERIOD);
        }
        self.sent.push(true);
    }

    /// Pulls the cable in the middle of a frame, and plugs it in again.
    fn unplug(&mut self, frame: &[u8]) {
        let part = self.stream.below(frame.len());
        self.cable.write(&frame[..part]);
        self.cable.unplug();
        let mut subscriber = self.bench.subscriber();
        wait_for("the loss", || {
            subscriber.status(&self.name)["state"] == "lost"
        });
        sleep(Duration::from_secs_f64(self.stream.range(0.0, 1.5)));
        self.cable.replug();
        self.wake();
    }

    /// Waits until the sensor is live, and sends enough frames for a tare.
    fn wake(&self) {
        self.cable.wake(&self.bench, &self.name);
        self.cable.play(0.0, 30);
    }
}

/// Reads to the end. The numbers of events and of presses must be consecutive. Returns for each sensor
/// and press how it ended; nothing if it has not ended.
fn receive(mut subscriber: Subscriber) -> Vec<Vec<String>> {
    let (mut ends, mut last) = (vec![Vec::new(); SENSORS], None);
    while let Some(event) = subscriber.next() {
        let text = |key: &str| event[key].as_str().unwrap_or_default();
        assert_ne!(text("type"), "gap", "after event {last:?}");
        // The number in a hello is that of the last event before it.
        let Some(seq) = event["seq"].as_u64() else {
            continue;
        };
        assert!(
            last.is_none_or(|last| seq == last + 1),
            "{seq} after {last:?}"
        );
        last = Some(seq);
        let number = text("sensor").strip_prefix('s');
        let Some(sensor) = number.and_then(|number| number.parse::<usize>().ok()) else {
            continue;
        };
        let ends = &mut ends[sensor];
        let press = event["press"].as_u64().unwrap_or_default() as usize;
        match (text("type"), text("state")) {
            ("press", "begin") => {
                assert_eq!(press, ends.len() + 1, "s{sensor}");
                ends.push(String::new());
            }
            ("press", "aborted") => ends[press - 1] += text("reason"),
            ("hardness", _) if text("phase") == "final" => ends[press - 1] += "final",
            _ => {}
        }
    }
    ends
}

/// Again and again, connects, listens for a moment and disconnects.
fn come_and_go(socket: &Path, seed: u64, over: &AtomicBool) {
    let mut stream = Stream::new(seed, "guest");
    while !over.load(Relaxed) {
        let mut connection = UnixStream::connect(socket).unwrap();
        let request = b"{\"subscribe\":[\"frame\",\"press\"]}\n";
        connection.write_all(request).unwrap();
        let _ = connection.read(&mut [0; 4096]).unwrap();
        sleep(Duration::from_secs_f64(stream.range(0.1, 2.0)));
    }
}

/// Sends a datagram every two milliseconds.
fn flood(address: SocketAddr, over: &AtomicBool, mut datagram: impl FnMut() -> Vec<u8>) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    while !over.load(Relaxed) {
        // The daemon opens its ports again after a reload that changes them.
        let _ = socket.send_to(&datagram(), address);
        sleep(Duration::from_millis(2));
    }
}

/// The daemon's memory in kB, descriptors and threads.
fn usage(daemon: &Daemon) -> [u64; 3] {
    let descriptors = format!("/proc/{}/fd", daemon.process.0.id());
    let descriptors = fs::read_dir(descriptors).unwrap().count();
    let of = |key| daemon.process.number(key);
    [of("VmRSS"), descriptors as u64, of("Threads")]
}

/// Compares the medians of the two halves of the time after the start.
fn check_growth(samples: &[(Duration, [u64; 3])]) {
    let length = samples.last().map_or(Duration::ZERO, |(at, _)| *at);
    let warm = |at: Duration| at > WARM.max(length / 4);
    let warm: Vec<_> = samples.iter().filter(|(at, _)| warm(*at)).collect();
    let (first, second) = warm.split_at(warm.len() / 2);
    // Memory may vary by a twentieth and a MB. Guests, files and the threads that open ports come
    // and go.
    let kinds = [
        ("kB of memory", 0.05, 1024),
        ("descriptors", 0.0, 2),
        ("threads", 0.0, 2),
    ];
    for (kind, (name, share, more)) in kinds.into_iter().enumerate() {
        let median = |samples: &[&(Duration, [u64; 3])]| {
            let mut values: Vec<u64> = samples.iter().map(|(_, sample)| sample[kind]).collect();
            values.sort_unstable();
            values.get(values.len() / 2).copied().unwrap_or_default()
        };
        let (before, after) = (median(first), median(second));
        println!("{name}: {before}, then {after}");
        let most = before as f64 * (1.0 + share) + f64::from(more);
        assert!(after as f64 <= most, "{name} grew from {before} to {after}");
    }
}

fn configure(bench: &Bench, udp: [SocketAddr; 2], min_confidence: f64) {
    let tables = (0..SENSORS).map(|number| {
        let name = format!("s{number}");
        sensor(&name, &name, 100) + "baud = 3000000\n"
    });
    let udp = ["flood", "noise"]
        .into_iter()
        .zip(udp)
        .map(|(name, address)| sensor(name, &format!("udp://{address}"), 50));
    let more = format!("[model]\nmin_confidence = {min_confidence}\n{RECORD}rotate_s = 20\n");
    bench.configure(&tables.chain(udp).collect::<String>(), &more);
}

#[test]
#[ignore = "takes as long as you say, and at least three minutes"]
fn soak() {
    let minutes = std::env::var("HARDNESSD_SOAK_MINUTES").unwrap_or("3".to_owned());
    let length = Duration::from_secs_f64(60.0 * minutes.parse::<f64>().unwrap().max(3.0));
    let bench = Arc::new(Bench::new());
    let players: Vec<Player> = (0..SENSORS)
        .map(|index| {
            let name = format!("s{index}");
            Player {
                cable: Cable::plug(bench.path(&name)),
                bench: Arc::clone(&bench),
                name,
                stream: Stream::new(1, "soak").child(index as u64),
                sent: Vec::new(),
                faults: 0,
            }
        })
        .collect();
    let udp = [free_address(), free_address()];
    configure(&bench, udp, 0.0);
    let mut daemon = bench.daemon_as_configured();

    // Subscribers that read everything until the daemon ends.
    let listening = [(); 17].map(|()| {
        let subscriber = bench.subscriber();
        thread::spawn(move || receive(subscriber))
    });
    // Subscribers that come and go, and one that never reads.
    let over = Arc::new(AtomicBool::new(false));
    let guests = [0, 1].map(|seed| {
        let (socket, over) = (bench.path("events.sock"), Arc::clone(&over));
        thread::spawn(move || come_and_go(&socket, seed, &over))
    });
    let floods = [0, 1].map(|number| {
        let (over, rest) = (Arc::clone(&over), frame(0.0));
        let mut stream = Stream::new(number, "flood");
        thread::spawn(move || match number {
            0 => flood(udp[0], &over, || rest.clone()),
            _ => flood(udp[1], &over, || {
                (0..rest.len()).map(|_| stream.next_u64() as u8).collect()
            }),
        })
    });
    let mut deaf = bench.subscriber();
    deaf.send_line(r#"{"subscribe":["frame","press","hardness","status"]}"#);

    // Meanwhile the daemon is reloaded, old recordings are removed, and its usage is looked at.
    let start = Instant::now();
    let playing: Vec<_> = players
        .into_iter()
        .map(|player| thread::spawn(move || player.play(start + length)))
        .collect();
    let (mut usages, mut reloads) = (Vec::new(), 0);
    while playing.iter().any(|player| !player.is_finished()) {
        if start.elapsed().as_secs() / 10 > reloads {
            reloads += 1;
            configure(&bench, udp, 0.001 * (reloads % 2) as f64);
            daemon.process.signal(Signal::HUP);
            for old in bench.recordings("").iter().rev().skip(KEPT) {
                fs::remove_file(bench.path(old)).unwrap();
            }
        }
        usages.push((start.elapsed(), usage(&daemon)));
        sleep(Duration::from_secs(1));
    }
    let sent: Vec<Player> = playing
        .into_iter()
        .map(|player| player.join().unwrap())
        .collect();
    over.store(true, Relaxed);
    guests.into_iter().for_each(|guest| guest.join().unwrap());
    floods.into_iter().for_each(|flood| flood.join().unwrap());
    // Let the subscribers read the events so far.
    sleep(Duration::from_secs(1));
    let log = daemon.end();

    let expected: Vec<Vec<&str>> = sent
        .iter()
        .map(|player| {
            let ends = player.sent.iter();
            ends.map(|&is_judged| if is_judged { "final" } else { "lost" })
                .collect()
        })
        .collect();
    for listener in listening {
        assert_eq!(listener.join().unwrap(), expected, "ends of presses");
    }
    let ends = expected.concat();
    let lost = ends.iter().filter(|&&end| end == "lost").count();
    let faults: u64 = sent.iter().map(|player| player.faults).sum();
    println!(
        "{} presses, {lost} lost with the link; {faults} faults, {reloads} reloads",
        ends.len()
    );
    // Errors are above all those of refused reloads.
    let errors: Vec<&str> = log.lines().filter(|line| line.contains("ERROR")).collect();
    assert!(errors.is_empty(), "{errors:?}");
    for name in ["flood", "noise"] {
        let lines = log.matches(&format!("sensor=\"{name}\"")).count();
        println!("{lines} lines of log about {name}");
        assert!(
            (lines as f64) < 50.0 * length.as_secs_f64() / 60.0,
            "{name}"
        );
    }
    for recording in bench.recordings("") {
        assert!(!bench.entries(&recording).is_empty(), "{recording}");
    }
    check_growth(&usages);
}
