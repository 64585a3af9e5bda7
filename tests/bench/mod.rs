//! The real binary on a real pty, with sockets and configurations, in a directory of its own.
#![allow(
    unreachable_pub,
    reason = "the binary of the tests has it as a module of its own"
)]

mod cable;
mod http;
#[path = "../../src/tools/pty/pair.rs"]
pub mod pair;
mod subscriber;
mod terminal;

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

pub use cable::{Cable, PERIOD};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::recording::{Found, Reader};
use hardnessd_core::wire::{Layout, Settings};
pub use http::{Answer, HTTP, answer, ask, get, open};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
pub use subscriber::Subscriber;
pub use terminal::{Terminal, on_terminal};

pub const BINARY: &str = env!("CARGO_BIN_EXE_hardnessd");

/// The file of the paper's network.
pub const HRN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/hrn.onnx");

/// A table that records into the directory `rec`. Further keys may follow.
pub const RECORD: &str = "[record]\ndir = \"rec\"\nkeep_free_mb = 0\n";

/// A table for a socket at a free port.
pub const TCP: &str = "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n";

/// The trainer, which `cargo test --workspace` builds beside the daemon.
pub fn hrn_train() -> PathBuf {
    let trainer = Path::new(BINARY).with_file_name("hrn-train");
    assert!(
        trainer.exists(),
        "no hrn-train: run `cargo test --workspace`"
    );
    trainer
}

/// How long anything may take before a test fails. It is long, for a busy machine.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// How long a process may take to end by itself.
const FAREWELL: Duration = Duration::from_secs(2);

/// The program with the words of `line` as its arguments, in the directory of the sources.
///
/// SIGHUP is as a terminal has it. Tests may run under `nohup`, whose setting is inherited.
pub fn command(line: &str) -> Command {
    let mut command = Command::new("env");
    command
        .args(["--default-signal=HUP", BINARY])
        .args(line.split_whitespace());
    command
}

/// Runs a command to its end. Returns exit code, stdout and stderr.
pub fn ran(command: &mut Command) -> (i32, String, String) {
    let output = command.output().unwrap();
    let [stdout, stderr] =
        [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.code().unwrap(), stdout, stderr)
}

/// Runs the program in the directory of the sources.
pub fn run(line: &str) -> (i32, String, String) {
    ran(&mut command(line))
}

/// An address that nobody has, neither over TCP nor over UDP.
pub fn free_address() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    UdpSocket::bind(address).map_or_else(|_| free_address(), |_| address)
}

/// The bytes of a frame of the JX255N that has these counts on 36 taxels in its middle.
pub fn frame(counts: f32) -> Vec<u8> {
    let mut raw = RawFrame::default();
    for row in 11..17 {
        raw.counts[row * 28 + 11..row * 28 + 17].fill(counts);
    }
    let mut bytes = Vec::new();
    let layout = Layout::new(&Settings::default()).unwrap();
    layout.encode(&raw, &mut bytes);
    bytes
}

/// A directory with a port, a socket and a configuration.
pub struct Bench {
    directory: tempfile::TempDir,
}

/// The table of a sensor. Further keys may follow.
pub fn sensor(name: &str, port: &str, fps: u32) -> String {
    format!("[[sensor]]\nname = \"{name}\"\nport = \"{port}\"\nframe_rate_hz = {fps}.0\n")
}

impl Bench {
    pub fn new() -> Self {
        Self {
            directory: tempfile::tempdir().unwrap(),
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    pub fn text_path(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    /// Makes a pipe with a name.
    pub fn fifo(&self, name: &str) -> PathBuf {
        let path = self.path(name);
        let mode = Mode::RUSR | Mode::WUSR;
        mknodat(CWD, &path, FileType::Fifo, mode, 0).unwrap();
        path
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).unwrap();
    }

    pub fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// Writes `hardnessd.toml` with these sensors. `more` begins with keys of `[publish.unix]`.
    pub fn configure(&self, sensors: &str, more: &str) {
        let unix = "[publish.unix]\npath = \"events.sock\"\n";
        self.write(
            "hardnessd.toml",
            format!("robot = \"arm-7\"\n{sensors}{unix}{more}"),
        );
    }

    /// The same with one sensor at 20 frames/s.
    pub fn configure_forearm(&self, more: &str) {
        self.configure(&sensor("forearm", "port", 20), more);
    }

    /// The program in this directory.
    pub fn command(&self, line: &str) -> Command {
        let mut command = command(line);
        command.current_dir(self.directory.path());
        command
    }

    /// Starts the program in this directory. Nothing is read of what it writes.
    pub fn start(&self, line: &str) -> Process {
        let mut command = self.command(line);
        command.stdout(Stdio::null()).stderr(Stdio::null());
        Process::start(&mut command)
    }

    /// Runs the program in this directory. Returns exit code, stdout and stderr.
    pub fn run(&self, line: &str) -> (i32, String, String) {
        ran(&mut self.command(line))
    }

    /// The output of the program, which does what it is asked.
    pub fn succeeds(&self, line: &str) -> String {
        let (code, stdout, stderr) = self.run(line);
        assert_eq!(code, 0, "{line}: {stderr}");
        stdout
    }

    /// The program must fail with this exit code and one line that has all these parts.
    pub fn fails(&self, line: &str, code: i32, parts: &[&str]) {
        let (found, _, stderr) = self.run(line);
        assert_eq!(
            (found, stderr.lines().count()),
            (code, 1),
            "{line}: {stderr}"
        );
        for part in parts {
            assert!(stderr.contains(part), "{line}: {part:?} not in {stderr:?}");
        }
    }

    /// The same for each line of a table: the command, its exit code, and the parts, with ` | ` between.
    pub fn fails_each(&self, table: &str) {
        for row in table.trim().lines() {
            let row: Vec<&str> = row.trim().split(" | ").collect();
            let [line, code, parts @ ..] = &row[..] else {
                panic!("{row:?}");
            };
            self.fails(line, code.parse().unwrap(), parts);
        }
    }

    /// The final verdicts of a replay.
    pub fn finals(&self, arguments: &str) -> Vec<Value> {
        let mut events = events(&self.succeeds(&format!("replay --json {arguments}")));
        events.retain(|event| event["phase"] == "final");
        events
    }

    /// A daemon of one sensor at 20 frames/s.
    pub fn daemon(&self) -> Daemon {
        self.daemon_with("")
    }

    /// The same with more tables.
    pub fn daemon_with(&self, more: &str) -> Daemon {
        self.configure_forearm(more);
        self.daemon_as_configured()
    }

    /// A daemon of these sensors, with more tables.
    pub fn daemon_of(&self, sensors: &str, more: &str) -> Daemon {
        self.configure(sensors, more);
        self.daemon_as_configured()
    }

    pub fn daemon_as_configured(&self) -> Daemon {
        Daemon::start(self.command("run --config hardnessd.toml"))
    }

    pub fn subscriber(&self) -> Subscriber {
        Subscriber::connect(&self.path("events.sock"))
    }

    pub fn control(&self) -> Subscriber {
        Subscriber::connect(&self.path("control.sock"))
    }

    /// A sensor at the port, with enough force that every contact counts as a press.
    pub fn sensor(&self, options: &str) -> Process {
        self.sensor_at("port", 20, options)
    }

    /// A sensor at another port and rate.
    pub fn sensor_at(&self, port: &str, fps: u32, options: &str) -> Process {
        let link = self.path(port);
        // A killed sensor leaves its link, which must not be taken for that of the new sensor.
        let _ = fs::remove_file(&link);
        let usual = format!("--force 15 --material hard-plastic --fps {fps} --link {port}");
        let sensor = self.start(&format!("simulate {usual} {options}"));
        wait_for("the port", || {
            fs::read_link(&link).is_ok_and(|pty| pty.exists())
        });
        sensor
    }

    /// Pulls the cable of the sensor at the first port.
    ///
    /// The link goes first. The kernel gives the number of a closed pseudo-terminal to the next one
    /// that a test beside this opens, and a daemon that follows a left link would read that.
    pub fn unplug(&self, sensor: &mut Process) {
        fs::remove_file(self.path("port")).unwrap();
        sensor.0.kill().unwrap();
    }

    /// All entries of a recording.
    pub fn entries(&self, recording: &str) -> Vec<Found> {
        let file = BufReader::new(File::open(self.path(recording)).unwrap());
        Reader::new(file).map(Result::unwrap).collect()
    }

    /// The names of the files in the directory `rec` that begin with `what`, with `rec/`, sorted.
    pub fn recordings(&self, what: &str) -> Vec<String> {
        let found = fs::read_dir(self.path("rec")).into_iter().flatten();
        let names = found.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| name.starts_with(what)).collect();
        names.sort();
        names.iter().map(|name| format!("rec/{name}")).collect()
    }
}

/// A process that does not outlive its test.
pub struct Process(pub Child);

impl Process {
    pub fn start(command: &mut Command) -> Self {
        Self(command.spawn().unwrap())
    }

    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(i32::try_from(self.0.id()).unwrap()).unwrap();
        kill_process(pid, signal).unwrap();
    }

    pub fn exit_code(&mut self) -> Option<i32> {
        let mut status = None;
        wait_for("the end of the process", || {
            status = self.0.try_wait().unwrap();
            status.is_some()
        });
        status.unwrap().code()
    }

    /// A number that the kernel tells of it, such as its memory in kB: `VmRSS`.
    pub fn number(&self, key: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.0.id())).unwrap();
        let mut lines = status.lines();
        let line = lines.find_map(|line| line.strip_prefix(key)?.strip_prefix(':'));
        let number = line.unwrap().split_whitespace().next();
        number.unwrap().parse().unwrap()
    }

    /// What it wrote to stderr, until its end.
    pub fn errors(&mut self) -> String {
        let mut text = String::new();
        let mut stderr = self.0.stderr.take().unwrap();
        stderr.read_to_string(&mut text).unwrap();
        text
    }

    /// It must end soon after this signal, with this exit code.
    pub fn ends_at(&mut self, signal: Signal, code: i32) {
        let start = Instant::now();
        self.signal(signal);
        assert_eq!(self.exit_code(), Some(code), "{signal:?}");
        let took = start.elapsed();
        assert!(took < Duration::from_secs(5), "{signal:?}: {took:?}");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Let a simulator remove its link if it can. The pty of a remaining link may become that of
        // another test.
        if matches!(self.0.try_wait(), Ok(None)) {
            self.signal(Signal::TERM);
            let start = Instant::now();
            while matches!(self.0.try_wait(), Ok(None)) && start.elapsed() < FAREWELL {
                std::thread::sleep(Duration::from_millis(2));
            }
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The lines that a process writes.
pub struct Lines {
    lines: mpsc::Receiver<String>,
    /// The lines read so far.
    pub seen: Vec<String>,
}

impl Lines {
    pub fn of(output: impl Read + Send + 'static) -> Self {
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let seen = Vec::new();
        Self { lines, seen }
    }

    /// Waits for a line that has all these parts.
    pub fn until(&mut self, parts: &[&str]) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| {
                panic!("{parts:?} was not written, but {:#?}", self.seen);
            });
            self.seen.push(line.clone());
            if parts.iter().all(|part| line.contains(part)) {
                return line;
            }
        }
    }
}

/// A running daemon and its log.
pub struct Daemon {
    pub process: Process,
    pub log: Lines,
}

impl Daemon {
    /// Starts a daemon and waits until it serves.
    fn start(mut command: Command) -> Self {
        // Own presses of one test are none of another.
        command.env_remove("XDG_STATE_HOME").env_remove("HOME");
        let mut process = Process::start(command.env("RUST_LOG", "info").stderr(Stdio::piped()));
        let log = Lines::of(process.0.stderr.take().unwrap());
        let mut daemon = Self { process, log };
        daemon.logged("started");
        daemon
    }

    /// The address of `way`, including the port.
    pub fn address(&self, way: &str) -> SocketAddr {
        let part = format!("way=\"{way}\"");
        // All addresses are logged before "started".
        let line = self.log.seen.iter().find(|line| line.contains(&part));
        let line = line.unwrap();
        let (_, address) = line.split_once("address=").unwrap();
        address.trim().parse().unwrap()
    }

    /// Reads the configuration again. Returns the line that says what came of it.
    pub fn reload(&mut self, answer: &str) -> String {
        self.process.signal(Signal::HUP);
        self.logged(answer)
    }

    /// Asks it to end, which it does without an error. Returns the whole log.
    pub fn end(&mut self) -> String {
        self.process.signal(Signal::TERM);
        assert_eq!(self.process.exit_code(), Some(0));
        self.log.seen.extend(self.log.lines.iter());
        self.log.seen.join("\n")
    }

    /// Waits for a log line that contains `part`.
    pub fn logged(&mut self, part: &str) -> String {
        self.log.until(&[part])
    }
}

/// The clock whose times a daemon's events have.
pub fn mono() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Duration::try_from(now).unwrap()
}

pub fn wait_for(what: &str, mut there: impl FnMut() -> bool) {
    let start = Instant::now();
    while !there() {
        assert!(start.elapsed() < PATIENCE, "{what} does not come");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The events in lines of JSON.
pub fn events(text: &str) -> Vec<Value> {
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

/// An event without the fields that only a live event has.
pub fn timeless(mut event: Value) -> Value {
    for key in ["mono_ns", "age_at_publish_ms", "latency_us"] {
        if let Some(value) = event.get_mut(key) {
            *value = Value::Null;
        }
    }
    event
}
