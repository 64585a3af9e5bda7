//! Properties that hold for any bytes, for every input of the programs. `fuzz/` searches for bytes
//! that break them, guided by coverage. `tests/daemon/doors.rs` tries the kept bytes, and changes to them.
//!
//! A property panics if it does not hold. Each takes bytes that a stranger may choose.

#![allow(unreachable_pub, reason = "the package fuzz/ uses it, too")]

use std::fs;
use std::io::{BufRead, BufReader, Cursor, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use hardnessd::daemon::Daemon;
use hardnessd::daemon::config::{Config, Setup};
use hardnessd::tools::replay::motion as table;
use hardnessd_core::motion::{Point, Track};
use hardnessd_core::recording::{Playback, Reader, recover};
use hardnessd_core::references as known;
use hardnessd_core::trial;
use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
use hardnessd_core::wire::{
    Cell, Checksum, ChecksumOver, Decoder, Framing, HexBytes, Layout, LengthField, Packets, Preset,
    Settings,
};
use tempfile::NamedTempFile;

/// How long the daemon may take to answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long an answer that may have no end is read.
const HTTP_PATIENCE: Duration = Duration::from_millis(200);
/// The longest line of a subscriber.
const LONGEST_LINE_BYTES: usize = 64 * 1024;

/// A property of one door.
pub type Property = fn(&[u8]);

/// Every property, by the name of its target in `fuzz/`.
pub const ALL: &[(&str, Property)] = &[
    ("configuration", configuration),
    ("http", http),
    ("lines", lines),
    ("model", model),
    ("motion", motion),
    ("recording", recording),
    ("recover", recovered),
    ("references", references),
    ("wire", wire),
];

/// Takes bytes from the front, and zeros when there are no more bytes.
struct Choices<'a>(&'a [u8]);

impl Choices<'_> {
    fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    fn of<T: Copy>(&mut self, from: &[T]) -> T {
        from[usize::from(self.byte()) % from.len()]
    }

    fn bytes(&mut self, most: u8) -> Vec<u8> {
        let length = self.byte() % (most + 1);
        (0..length).map(|_| self.byte()).collect()
    }

    fn i64(&mut self) -> i64 {
        i64::from_le_bytes(std::array::from_fn(|_| self.byte()))
    }
}

/// A preset, half of them of a small array, so that whole frames are short. Some have other keys too.
fn layout(choices: &mut Choices) -> Option<Layout> {
    let how = choices.byte();
    let mut settings = Settings {
        preset: Some(choices.of(&[
            Preset::Jx255n,
            Preset::Jx255nU16,
            Preset::Jq,
            Preset::JqTail,
            Preset::JqU16,
            Preset::JqGlove,
            Preset::Csv,
            Preset::Flexitac,
            Preset::M1616,
        ])),
        ..Settings::default()
    };
    if how & 1 != 0 {
        settings.rows = Some(usize::from(choices.byte() % 5));
        settings.cols = Some(usize::from(choices.byte() % 5));
    }
    if how & 2 != 0 {
        settings.sync = Some(HexBytes(choices.bytes(4)));
        settings.tail = Some(HexBytes(choices.bytes(4)));
        settings.header_bytes = Some(usize::from(choices.byte() % 5));
        settings.footer_bytes = Some(usize::from(choices.byte() % 5));
        settings.length = Some(choices.of(&[LengthField::None, LengthField::U16be]));
        settings.checksum = Some(choices.of(&[Checksum::None, Checksum::Sum8, Checksum::Crc32Be]));
    }
    if how & 4 != 0 {
        settings.packets = Some(Packets {
            count: usize::from(choices.byte() % 5),
            number_at: usize::from(choices.byte() % 5),
            number: choices.of(&[Cell::U8, Cell::U16be]),
            first: choices.byte().into(),
            step: u16::from(choices.byte() % 3),
        });
    }
    if how & 8 != 0 {
        settings.framing = Some(choices.of(&[Framing::None, Framing::Slip, Framing::Cobs]));
        settings.cell = Some(choices.of(&[Cell::I8, Cell::I16be, Cell::I32le, Cell::F32le]));
        settings.stride_bytes = Some(usize::from(choices.byte() % 9));
        settings.checksum_over = Some(choices.of(&[ChecksumOver::AfterSync, ChecksumOver::Cells]));
    }
    if how & 16 != 0 {
        settings.heading = Some("R1".to_owned());
    }
    Layout::new(&settings).ok()
}

/// The output of a decoder for bytes in chunks of `sizes`: frames and damage in order, and the
/// number of skipped bytes.
fn decoded(layout: &Layout, mut bytes: &[u8], sizes: &[usize]) -> (Vec<String>, u64) {
    let mut decoder = Decoder::new(layout.clone());
    let mut found = Vec::new();
    for size in sizes.iter().cycle() {
        let (chunk, rest) = bytes.split_at((*size).min(bytes.len()));
        decoder.push(chunk);
        while let Some(frame) = decoder.next_frame() {
            found.push(format!("{frame:?}"));
        }
        if rest.is_empty() {
            break;
        }
        bytes = rest;
    }
    (found, decoder.skipped())
}

/// Any chunking of any bytes gives the same result as one chunk.
pub fn wire(bytes: &[u8]) {
    let mut choices = Choices(bytes);
    let sizes: Vec<usize> = (0..3).map(|_| 1 + usize::from(choices.byte())).collect();
    let Some(layout) = layout(&mut choices) else {
        return;
    };
    let stream = choices.0;
    let (one, one_skipped) = decoded(&layout, stream, &[stream.len().max(1)]);
    let (many, many_skipped) = decoded(&layout, stream, &sizes);
    assert_eq!(one, many, "chunks of {sizes:?}");
    // The numbers of skipped bytes may differ by less than a frame, because some bytes are still
    // pending.
    let differ = one_skipped.abs_diff(many_skipped);
    assert!(differ < layout.most_pending_bytes() as u64, "{differ}");
}

/// A daemon in this process without a sensor at its port, and its addresses.
struct Served {
    directory: PathBuf,
    http: SocketAddr,
}

static SERVED: LazyLock<Served> = LazyLock::new(|| {
    // The directory stays after the process, because there is no point at which to remove it.
    let directory = tempfile::tempdir().expect("a directory").keep();
    let path = directory.join("hardnessd.toml");
    let text = "robot = \"r\"\n[[sensor]]\nname = \"a\"\nport = \"absent\"\n\
                [publish.unix]\npath = \"events.sock\"\n[http]\nlisten = \"0.0.0.0:0\"\n";
    fs::write(&path, text).expect("a configuration");
    let (bound, address) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .expect("a runtime");
        runtime.block_on(async {
            let setup = Setup::load(&path, None).expect("a configuration that is good");
            let daemon = Daemon::start(setup).expect("sockets");
            bound.send(daemon.http_address()).expect("who waits");
            let ended = daemon.run(std::future::pending(), None).await;
            panic!("the daemon ended: {ended:?}");
        });
    });
    let http = address.recv().expect("a daemon").expect("an address");
    Served { directory, http }
});

/// Each line of a subscriber or a controller is answered by one line of JSON, whatever the line is.
/// The next question after the lines is answered too. Only a line that is too long ends the
/// connection.
pub fn lines(bytes: &[u8]) {
    let (socket, message) = match bytes.split_first() {
        Some((first, message)) if first % 2 == 1 => ("control.sock", message),
        Some((_, message)) => ("events.sock", message),
        None => return,
    };
    let mut stream = UnixStream::connect(SERVED.directory.join(socket)).expect("a daemon");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    let last = b"\n{\"get\":\"status\",\"id\":\"the last question\"}\n";
    let longest = message.split(|&byte| byte == b'\n').map(<[u8]>::len).max();
    let is_too_long = longest > Some(LONGEST_LINE_BYTES);
    let mut writer = stream.try_clone().expect("another handle");
    let sent = writer
        .write_all(message)
        .and_then(|()| writer.write_all(last));
    assert!(is_too_long || sent.is_ok(), "{sent:?}");
    let mut answers = BufReader::new(&mut stream);
    let mut line = String::new();
    loop {
        line.clear();
        let length = answers.read_line(&mut line);
        match length {
            Ok(1..) => {}
            Ok(0) | Err(_) if is_too_long => return,
            other => panic!("no answer to the last question: {other:?}"),
        }
        let answer: serde_json::Value = serde_json::from_str(&line).expect("a line of JSON");
        assert!(answer.is_object(), "{answer}");
        if answer["id"] == "the last question" {
            return;
        }
    }
}

/// Whatever the head of a request is, the answer is HTTP or the end of the connection, and the next
/// connection is served.
pub fn http(bytes: &[u8]) {
    let answer = ask(bytes, Some(Shutdown::Write), HTTP_PATIENCE);
    assert!(
        answer.is_empty() || answer.starts_with(b"HTTP/1."),
        "{:?}",
        String::from_utf8_lossy(&answer)
    );
    // For the server, the end of the requests is the end of the connection, so leave it open here.
    let whole = b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    let alive = ask(whole, None, PATIENCE);
    assert!(alive.starts_with(b"HTTP/1.1 200"), "{alive:?}");
}

/// The answer until the end of the connection, or until `patience` has passed.
fn ask(request: &[u8], end: Option<Shutdown>, patience: Duration) -> Vec<u8> {
    // Each connection uses another address of this machine, because a closed port cannot be reused
    // for a while.
    static NEXT: AtomicU32 = AtomicU32::new(1);
    let next = NEXT.fetch_add(1, Ordering::Relaxed) % 0x00ff_fff0 + 1;
    let address = Ipv4Addr::from_bits((127 << 24) | next);
    let port = SERVED.http.port();
    let mut stream = TcpStream::connect((address, port)).expect("a daemon");
    stream.set_read_timeout(Some(patience)).expect("a timeout");
    // The other end may close before everything is sent.
    let _ = stream.write_all(request);
    if let Some(end) = end {
        let _ = stream.shutdown(end);
    }
    let mut answer = Vec::new();
    // The connection may be reset, or be one of events, which has no end.
    let _ = stream.take(4 << 20).read_to_end(&mut answer);
    answer
}

/// A configuration is used, or refused in a line that begins with the file's name.
pub fn configuration(bytes: &[u8]) {
    static FILE: LazyLock<NamedTempFile> = LazyLock::new(|| NamedTempFile::new().expect("a file"));
    let path = FILE.path();
    fs::write(path, bytes).expect("room for a small file");
    if let Err(error) = Config::load(path) {
        let line = error.to_string();
        let name = path.display().to_string();
        assert!(line.starts_with(&name) && !line.contains('\n'), "{line}");
    }
}

/// A recording is played up to its first damage.
pub fn recording(bytes: &[u8]) {
    static HRN: LazyLock<Arc<Model>> =
        LazyLock::new(|| Arc::new(Model::load(BUILT_IN_HRN).expect("the model built in")));
    let mut playback = Playback::new(Arc::clone(&HRN));
    for found in Reader::new(bytes) {
        let Ok(found) = found else { break };
        if playback.feed(found).is_err() {
            break;
        }
    }
    playback.end();
}

/// The saved part of a damaged recording can be read to its end, and is not much larger.
pub fn recovered(bytes: &[u8]) {
    let (_, good) = recover(Cursor::new(bytes), Vec::new()).expect("memory takes all");
    let whole: Result<Vec<_>, _> = Reader::new(good.as_slice()).collect();
    assert!(whole.is_ok(), "{whole:?}");
    assert!(good.len() < 4 * bytes.len() + 65_536, "{}", good.len());
}

/// A model file is refused, or judges its check frames.
pub fn model(bytes: &[u8]) {
    if let Ok(hrn) = trial::load(bytes, None) {
        hrn.judge_check(0).expect("a model that was loaded judges");
    }
}

/// A file of references is refused in one line, or its presses are written and read again.
pub fn references(bytes: &[u8]) {
    match known::read(bytes) {
        Ok(presses) => {
            // The first writing rounds forces to millinewtons.
            let written = known::write(&presses).expect("memory takes all");
            let again = known::read(&written).expect("presses that were read before");
            assert_eq!(known::write(&again).expect("memory takes all"), written);
        }
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
}

/// Whatever the positions of an arm are, as a table or as points, the known approach is finite.
pub fn motion(bytes: &[u8]) {
    let mut choices = Choices(bytes);
    let points = if choices.byte() % 2 == 0 {
        let text = String::from_utf8_lossy(choices.0);
        match table::parse(&text) {
            Ok(points) => points,
            Err(error) => {
                assert!(!error.contains('\n'), "{error}");
                return;
            }
        }
    } else {
        let mut points = Vec::new();
        let mut at_ns = choices.i64();
        while !choices.0.is_empty() && points.len() < 4096 {
            // Most steps are those of an arm, and some are not.
            let step = match choices.byte() {
                0 => choices.i64(),
                step => i64::from(step) * 1_000_000,
            };
            at_ns = at_ns.saturating_add(step);
            let mm = f64::from(choices.byte()) / 8.0;
            points.push(Point { at_ns, mm });
        }
        points
    };
    let points: Vec<Point> = points.into_iter().filter(Point::is_usable).collect();
    let mut track = Track::default();
    for several in points.chunks(7) {
        let _ = track.push(several);
        let moment = |point: &Point| Duration::from_nanos(point.at_ns.max(0).unsigned_abs());
        let begin = moment(&several[0]);
        let mut moments: Vec<Duration> = several.iter().map(moment).collect();
        moments.sort();
        if let Some(ways) = track.approach(begin, &moments, 1.5) {
            assert_eq!(ways.len(), moments.len());
            assert!(ways.iter().flatten().all(|mm| mm.is_finite()), "{ways:?}");
        }
        track.judged(moments[moments.len() - 1], 1.5);
    }
    assert_eq!(track.counts().0, points.len() as u64);
    let _ = track.since(Duration::from_secs(1));
}
