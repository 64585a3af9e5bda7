//! The real binary on a real pty, with sockets and configurations: shared by the tests of the
//! daemon.
#![allow(
    unreachable_pub,
    reason = "the binary of the tests has it as a module of its own"
)]

#[path = "../../src/tools/pty/pair.rs"]
pub mod pair;

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use pair::Pair;
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

pub const BINARY: &str = env!("CARGO_BIN_EXE_hardnessd");

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

/// A directory with a port, a socket and a configuration.
pub struct Bench {
    directory: tempfile::TempDir,
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

    /// Makes a pipe with a name.
    pub fn fifo(&self, name: &str) -> PathBuf {
        let path = self.path(name);
        let mode = Mode::RUSR | Mode::WUSR;
        mknodat(CWD, &path, FileType::Fifo, mode, 0).unwrap();
        path
    }

    /// Writes a configuration of one sensor at 20 frames/s, with `more` tables.
    pub fn configure(&self, name: &str, socket: &str, more: &str) -> PathBuf {
        let path = self.path(name);
        let text = format!(
            "robot = \"arm-7\"\n[[sensor]]\nname = \"forearm\"\nport = \"port\"\n\
             frame_rate_hz = 20.0\n[publish.unix]\npath = \"{socket}\"\n{more}"
        );
        fs::write(&path, text).unwrap();
        path
    }

    pub fn daemon(&self) -> Daemon {
        self.daemon_with("")
    }

    /// A daemon of one sensor, with `more` tables.
    pub fn daemon_with(&self, more: &str) -> Daemon {
        Daemon::start(&self.configure("hardnessd.toml", "events.sock", more))
    }

    pub fn subscriber(&self) -> Subscriber {
        Subscriber::connect(&self.path("events.sock"))
    }

    /// A sensor at the port, with enough force that every contact counts as a press.
    pub fn sensor(&self, more: &[&str]) -> Process {
        self.sensor_at("port", 20, more)
    }

    /// A sensor at another port and rate.
    pub fn sensor_at(&self, port: &str, fps: u32, more: &[&str]) -> Process {
        let link = self.path(port);
        // A killed sensor leaves its link, which must not be taken for that of the new sensor.
        let _ = fs::remove_file(&link);
        let mut command = by_terminal();
        command.args(["simulate", "--force", "15", "--material", "hard-plastic"]);
        command
            .args(["--fps", &fps.to_string()])
            .arg("--link")
            .arg(&link)
            .args(more)
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let sensor = Process(command.spawn().unwrap());
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
}

/// The program with SIGHUP as a terminal starts it. Tests may run under `nohup`, whose setting is
/// inherited.
pub fn by_terminal() -> Command {
    let mut command = Command::new("env");
    command.args(["--default-signal=HUP", BINARY]);
    command
}

/// A process that does not outlive its test.
pub struct Process(pub Child);

impl Process {
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(i32::try_from(self.0.id()).unwrap()).unwrap();
        kill_process(pid, signal).unwrap();
    }

    pub fn exit_code(&mut self) -> Option<i32> {
        let start = Instant::now();
        loop {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code();
            }
            assert!(start.elapsed() < PATIENCE, "the process does not end");
            std::thread::sleep(Duration::from_millis(2));
        }
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

/// Starts a command on a terminal. Returns its process, and what it writes.
///
/// The command must be run by `setsid`, which keeps it from using the terminal that the test was
/// started from.
pub fn start_on(pair: &Pair, mut command: Command) -> (Process, mpsc::Receiver<Vec<u8>>) {
    let end = || Stdio::from(pair.device.try_clone().unwrap());
    command.stdin(end()).stdout(end()).stderr(end());
    let process = Process(command.spawn().unwrap());
    let mut output = File::from(pair.master.try_clone().unwrap());
    let (sender, bytes) = mpsc::channel();
    std::thread::spawn(move || {
        let mut read = [0; 4096];
        while let Ok(length @ 1..) = output.read(&mut read) {
            if sender.send(read[..length].to_vec()).is_err() {
                return;
            }
        }
    });
    (process, bytes)
}

/// The output of a program on a terminal until the program ends, and its exit code.
pub fn on_a_terminal(mut command: Command, stop_after: Option<&str>) -> (String, Option<i32>) {
    let Pair { master, device, .. } = Pair::open().unwrap();
    command.stdout(Stdio::from(device)).stderr(Stdio::null());
    let mut process = Process(command.spawn().unwrap());
    // `command` holds the last descriptor of the device.
    drop(command);
    let text = |written: &[u8]| String::from_utf8(written.to_vec()).unwrap();
    let mut written = Vec::new();
    let mut master = File::from(master);
    let mut read = [0; 4096];
    while let Ok(length @ 1..) = master.read(&mut read) {
        written.extend(&read[..length]);
        if stop_after.is_some_and(|part| text(&written).contains(part)) {
            process.signal(Signal::INT);
        }
    }
    let written = text(&written).replace("\r\n", "\n");
    (written, process.exit_code())
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
    pub fn start(config: &Path) -> Self {
        let mut process = Process(
            Command::new(BINARY)
                .args(["run", "--config"])
                .arg(config)
                .env("RUST_LOG", "info")
                // Own presses of one test are none of another.
                .env_remove("XDG_STATE_HOME")
                .env_remove("HOME")
                .stderr(Stdio::piped())
                .spawn()
                .unwrap(),
        );
        let log = Lines::of(process.0.stderr.take().unwrap());
        let mut daemon = Self { process, log };
        daemon.logged("started");
        daemon
    }

    /// The address of `way`, including the port.
    pub fn address(&mut self, way: &str) -> SocketAddr {
        let part = format!("way=\"{way}\"");
        // All addresses are logged before "started".
        let line = self.log.seen.iter().find(|line| line.contains(&part));
        let line = line.unwrap();
        let (_, address) = line.split_once("address=").unwrap();
        address.trim().parse().unwrap()
    }

    /// Asks it to end, which it does without an error.
    pub fn end(&mut self) {
        self.process.signal(Signal::TERM);
        assert_eq!(self.process.exit_code(), Some(0));
    }

    /// The whole log, once the daemon has ended.
    pub fn whole_log(&mut self) -> String {
        self.log.seen.extend(self.log.lines.iter());
        self.log.seen.join("\n")
    }

    /// Waits for a log line that contains `part`.
    pub fn logged(&mut self, part: &str) -> String {
        self.log.until(&[part])
    }
}

/// The stream of a connection.
pub trait Stream: Read + Write + Send {}
impl<S: Read + Write + Send> Stream for S {}

/// A connection to a socket.
pub struct Subscriber {
    pub lines: BufReader<Box<dyn Stream>>,
}

impl Subscriber {
    /// Connects to a socket of a daemon that may still be starting.
    pub fn connect(socket: &Path) -> Self {
        let mut stream = UnixStream::connect(socket);
        wait_for("the socket", || {
            if stream.is_err() {
                stream = UnixStream::connect(socket);
            }
            stream.is_ok()
        });
        let stream = stream.unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Self {
            lines: BufReader::new(Box::new(stream)),
        }
    }

    pub fn over_tcp(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Self {
            lines: BufReader::new(Box::new(stream)),
        }
    }

    /// Sends a line and waits for the answer.
    pub fn ask(&mut self, line: &str) -> Value {
        self.send_line(line);
        loop {
            let answer = self.next().unwrap();
            if ["ok", "error"].contains(&answer["type"].as_str().unwrap()) {
                return answer;
            }
        }
    }

    pub fn send_line(&mut self, line: &str) {
        self.lines
            .get_mut()
            .write_all(format!("{line}\n").as_bytes())
            .unwrap();
    }

    /// The next line. `None` if the connection is closed.
    pub fn next(&mut self) -> Option<Value> {
        let mut line = String::new();
        (self.lines.read_line(&mut line).unwrap() > 0).then(|| serde_json::from_str(&line).unwrap())
    }

    /// Reads until a line has all of `fields`.
    pub fn until(&mut self, fields: &Value) -> Value {
        let fields = fields.as_object().unwrap();
        loop {
            let line = self
                .next()
                .unwrap_or_else(|| panic!("closed before {fields:?}"));
            if fields.iter().all(|(key, value)| &line[key] == value) {
                return line;
            }
        }
    }
}

pub fn wait_for(what: &str, mut there: impl FnMut() -> bool) {
    let start = Instant::now();
    while !there() {
        assert!(start.elapsed() < PATIENCE, "{what} does not come");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// What the web server at `address` answers, with its head.
pub fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
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

/// The files in a directory whose names begin with `what`, sorted.
pub fn recordings_in(directory: &Path, what: &str) -> Vec<PathBuf> {
    let Ok(found) = fs::read_dir(directory) else {
        return Vec::new();
    };
    let mut found: Vec<PathBuf> = found.map(|entry| entry.unwrap().path()).collect();
    found.retain(|path| {
        path.file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with(what)
    });
    found.sort();
    found
}

pub fn hardnessd(arguments: &[&str]) -> Output {
    Command::new(BINARY).args(arguments).output().unwrap()
}

/// Runs the binary to its end. Returns exit code, stdout and stderr.
pub fn run(arguments: &[&str]) -> (i32, String, String) {
    ran(Command::new(BINARY).args(arguments))
}

/// Runs a command to its end. Returns exit code, stdout and stderr.
pub fn ran(command: &mut Command) -> (i32, String, String) {
    let output = command.output().unwrap();
    let [stdout, stderr] =
        [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.code().unwrap(), stdout, stderr)
}

/// The binary must fail with this exit code and one line that has all these parts.
pub fn fails(arguments: &[&str], code: i32, parts: &[&str]) {
    let (found, _, stderr) = run(arguments);
    assert_eq!(found, code, "{arguments:?}: {stderr}");
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    for part in parts {
        assert!(stderr.contains(part), "{part:?} not in {stderr:?}");
    }
}
