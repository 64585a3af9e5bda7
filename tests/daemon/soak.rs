//! A soak: eight sensors play presses with faults to a daemon for as long as you say, and every press
//! is accounted for.
//!
//!     HARDNESSD_SOAK_MINUTES=120 cargo test --release --workspace --test program soak -- --ignored --nocapture
//!
//! Each sensor sends simulated presses over a pty, with a fault in every second press. Beside them, one
//! UDP port gets frames at ten times the sensor's rate, and one gets noise. There are subscribers of
//! all kinds, recordings, and a reload every ten seconds. At the end, every press must have its verdict,
//! or must be lost with the link, by its number. Memory, descriptors and threads must not have grown,
//! and the two UDP ports must not have filled the log.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, UdpSocket};
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use crate::bench::pair::Pair;
use crate::bench::{Bench, Daemon, Subscriber, drain, free_address, sensor, wait_for, write_all};
use hardnessd_core::wire::{Layout, Settings};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, Sequence, SequenceSettings};
use rustix::process::Signal;

const SENSORS: usize = 8;
const FRAMES_PER_S: f64 = 100.0;
const PERIOD: Duration = Duration::from_millis(10);
/// The number of recordings that are kept.
const KEPT: usize = 16;
/// The time until memory grows no more: the black boxes hold a minute, and up to a stretch of ten
/// seconds more of each sensor that was there all the time, and the first reloads need room for a
/// second model. The events that are held for `since` take minutes more to fill, so a longer run
/// leaves out its first quarter.
const WARM: Duration = Duration::from_secs(120);

/// One simulated press as frames on the wire, with the rest after it.
#[derive(Default)]
struct Press {
    frames: Vec<Vec<u8>>,
    /// The index of a frame in the middle of the contact.
    middle: usize,
}

/// A press of each material, and a frame without load.
fn library() -> (Vec<Press>, Vec<u8>) {
    let layout = Layout::new(&Settings::default()).unwrap();
    let materials = Material::ALL.to_vec();
    let sequence = Sequence::new(SequenceSettings {
        frame_rate_hz: FRAMES_PER_S,
        presses: u32::try_from(materials.len()).ok(),
        materials,
        ..SequenceSettings::default()
    });
    let (mut presses, mut rest): (Vec<Press>, _) = (Vec::new(), Vec::new());
    for frame in sequence {
        let mut bytes = Vec::new();
        layout.encode(&frame.raw, &mut bytes);
        presses.resize_with(frame.press as usize, Press::default);
        let Some(press) = presses.last_mut() else {
            rest = bytes;
            continue;
        };
        press.frames.push(bytes);
        if frame.loaded {
            press.middle = press.frames.len() / 2;
        }
    }
    (presses, rest)
}

const FAULTS: [&str; 7] = [
    "unplug", "silence", "stall", "flip", "drop", "noise", "double",
];

/// A sensor on its cable, a pty behind a link.
struct Player {
    port: PathBuf,
    pair: Pair,
    library: Arc<(Vec<Press>, Vec<u8>)>,
    stream: Stream,
    link: Arc<Link>,
    /// For each press sent, whether it has a verdict.
    sent: Vec<bool>,
    faults: [u64; FAULTS.len()],
    due: Instant,
}

/// How often a subscriber has read that a sensor is live, and that it is lost.
#[derive(Default)]
struct Link {
    lives: AtomicU64,
    losses: AtomicU64,
}

/// A terminal behind a link.
fn plugged(port: &Path) -> Pair {
    let pair = Pair::raw().unwrap();
    symlink(&pair.path, port).unwrap();
    pair
}

impl Player {
    /// Plays until `end`, and then to the end of the press under way.
    fn play(mut self, end: Instant) -> Self {
        self.wake(0);
        while Instant::now() < end {
            let library = Arc::clone(&self.library);
            let press = &library.0[self.stream.below(library.0.len())];
            let fault = self.stream.below(2 * FAULTS.len());
            if fault < FAULTS.len() {
                self.faults[fault] += 1;
            }
            self.press(press, FAULTS.get(fault).copied().unwrap_or_default());
        }
        drain(&self.pair);
        self
    }

    fn press(&mut self, press: &Press, fault: &str) {
        let (middle, mut held) = (press.middle, Vec::new());
        for (index, frame) in press.frames.iter().enumerate() {
            let struck = (middle..middle + 3).contains(&index);
            let mut bytes = frame.clone();
            match fault {
                "unplug" if index == middle => {
                    self.sent.push(false);
                    return self.unplug(&bytes);
                }
                "silence" if index == middle => self.due += Duration::from_millis(400),
                // Send nothing for 30 frames, then send all of them.
                "stall" if (middle..middle + 30).contains(&index) => {
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
            if index == middle + 30 {
                bytes.splice(0..0, std::mem::take(&mut held));
            }
            self.write(&bytes);
        }
        // If the press ended before the held frames were sent, send them now.
        self.write(&held);
        self.sent.push(true);
    }

    /// Pulls the cable in the middle of a frame, and plugs it in again.
    fn unplug(&mut self, frame: &[u8]) {
        let part = self.stream.below(frame.len());
        self.write(&frame[..part]);
        drain(&self.pair);
        let losses = self.link.losses.load(Relaxed);
        fs::remove_file(&self.port).unwrap();
        // Open the new pty before the old one is closed, so that its name is a different one.
        let next = self.port.with_extension("next");
        self.pair = plugged(&next);
        wait_for("the loss", || self.link.losses.load(Relaxed) > losses);
        let lives = self.link.lives.load(Relaxed);
        sleep(Duration::from_secs_f64(self.stream.range(0.0, 1.5)));
        fs::rename(&next, &self.port).unwrap();
        self.wake(lives);
    }

    /// Sends frames without load until the sensor is live once more, and then enough frames for a
    /// tare.
    fn wake(&mut self, lives: u64) {
        let (library, link) = (Arc::clone(&self.library), Arc::clone(&self.link));
        self.due = Instant::now();
        wait_for("the sensor", || {
            self.write(&library.1);
            link.lives.load(Relaxed) > lives
        });
        (0..30).for_each(|_| self.write(&library.1));
    }

    /// Writes when the next frame is due.
    fn write(&mut self, bytes: &[u8]) {
        sleep(self.due.saturating_duration_since(Instant::now()));
        self.due += PERIOD;
        write_all(&self.pair, bytes);
    }
}

/// Reads to the end. The numbers of events and of presses must be consecutive. Returns for each sensor
/// and press how it ended; nothing if it has not ended.
fn receive(mut subscriber: Subscriber, links: &[Arc<Link>]) -> Vec<Vec<String>> {
    let (mut ends, mut last) = (vec![Vec::new(); links.len()], None);
    while let Some(event) = subscriber.next() {
        let text = |key: &str| event[key].as_str().unwrap_or_default();
        assert_ne!(text("type"), "gap", "after event {last:?}");
        let sensor = text("sensor")
            .strip_prefix('s')
            .and_then(|number| number.parse::<usize>().ok());
        if let (Some(sensor), "status") = (sensor, text("type")) {
            let (is_live, is_lost) = (text("state") == "live", text("state") == "lost");
            links[sensor].lives.fetch_add(is_live.into(), Relaxed);
            links[sensor].losses.fetch_add(is_lost.into(), Relaxed);
        }
        // The number in a hello is that of the last event before it.
        let Some(seq) = event["seq"].as_u64() else {
            continue;
        };
        assert!(
            last.is_none_or(|last| seq == last + 1),
            "{seq} after {last:?}"
        );
        last = Some(seq);
        let Some(sensor) = sensor else {
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
    let directory = PathBuf::from(format!("/proc/{}", daemon.process.0.id()));
    let status = fs::read_to_string(directory.join("status")).unwrap();
    let of = |key: &str| -> u64 {
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let number = line.and_then(|line| line.split_whitespace().next());
        number.unwrap().parse().unwrap()
    };
    let descriptors = fs::read_dir(directory.join("fd")).unwrap().count();
    [of("VmRSS:"), descriptors as u64, of("Threads:")]
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
    let more = format!(
        "[model]\nmin_confidence = {min_confidence}\n\
         [record]\ndir = \"rec\"\nrotate_s = 20\nkeep_free_mb = 0\n"
    );
    bench.configure(&tables.chain(udp).collect::<String>(), &more);
}

#[test]
#[ignore = "takes as long as you say, and at least three minutes"]
fn soak() {
    let minutes = std::env::var("HARDNESSD_SOAK_MINUTES").unwrap_or("3".to_owned());
    let length = Duration::from_secs_f64(60.0 * minutes.parse::<f64>().unwrap().max(3.0));
    let bench = Bench::new();
    let library = Arc::new(library());
    let links: Vec<Arc<Link>> = (0..SENSORS).map(|_| Arc::default()).collect();
    let players = links.iter().enumerate().map(|(index, link)| {
        let port = bench.path(&format!("s{index}"));
        Player {
            pair: plugged(&port),
            port,
            library: Arc::clone(&library),
            stream: Stream::new(1, "soak").child(index as u64),
            link: Arc::clone(link),
            sent: Vec::new(),
            faults: [0; FAULTS.len()],
            due: Instant::now(),
        }
    });
    let players: Vec<Player> = players.collect();
    let udp = [free_address(), free_address()];
    configure(&bench, udp, 0.0);
    let mut daemon = bench.daemon_as_configured();

    // Subscribers that read everything until the daemon ends. The first one's links tell the players
    // about their sensors.
    let listening: Vec<_> = (0..17)
        .map(|number| {
            let links: Vec<Arc<Link>> = match number {
                0 => links.clone(),
                _ => links.iter().map(|_| Arc::default()).collect(),
            };
            let subscriber = bench.subscriber();
            thread::spawn(move || receive(subscriber, &links))
        })
        .collect();
    // Subscribers that come and go, and one that never reads.
    let over = Arc::new(AtomicBool::new(false));
    let guests = [0, 1].map(|seed| {
        let (socket, over) = (bench.path("events.sock"), Arc::clone(&over));
        thread::spawn(move || come_and_go(&socket, seed, &over))
    });
    let rest = library.1.clone();
    let floods = [0, 1].map(|number| {
        let (over, rest) = (Arc::clone(&over), rest.clone());
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
    println!(
        "{} presses, {lost} lost with the link; {reloads} reloads",
        ends.len()
    );
    for (kind, name) in FAULTS.iter().enumerate() {
        let count: u64 = sent.iter().map(|player| player.faults[kind]).sum();
        println!("{count} {name}");
    }
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
