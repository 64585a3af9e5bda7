//! The process whose latency is measured.

use std::fmt::Write as _;
use std::fs;
use std::io::Write;
use std::net::TcpListener;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::clients::FORCES;
use crate::{Args, Failure, Kind, Scheduling};

/// How long a process may take to start.
const PATIENCE: Duration = Duration::from_secs(30);
/// The number of bytes of a frame.
const FRAME_BYTES: usize = 790;

/// The address for clients.
#[derive(Debug, Clone)]
pub(crate) enum Place {
    Unix(PathBuf),
    Tcp(u16),
}

pub(crate) struct Server {
    child: Child,
    place: Place,
    _directory: tempfile::TempDir,
}

impl Server {
    pub(crate) fn start(args: &Args, devices: &[PathBuf]) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        // The port is free now, and nothing else here takes it before the server does.
        let listener = TcpListener::bind(("127.0.0.1", 0))?;
        let port = listener.local_addr()?.port();
        drop(listener);
        let place = if args.tcp || args.server == Kind::Gpsd {
            Place::Tcp(port)
        } else {
            Place::Unix(directory.path().join("events.sock"))
        };
        let mut command = Command::new("chrt");
        match args.scheduling {
            Scheduling::Other => command.args(["--other", "0"]),
            Scheduling::Rr => command.args(["--reset-on-fork", "--rr", "10"]),
        };
        match args.server {
            Kind::Hardnessd => {
                let path = directory.path().join("hardnessd.toml");
                fs::write(&path, configuration(args, devices, port))?;
                command.arg(&args.program).args(["run", "--config"]);
                command.arg(path);
            }
            Kind::Gpsd => {
                command.args(["/usr/sbin/gpsd", "-N", "-n", "-b", "-S"]);
                command.arg(port.to_string()).arg(&devices[0]);
            }
            Kind::Bare => {
                command.arg(std::env::current_exe()?).arg("--copy");
                command.arg(&devices[0]);
                command.args(["--clients", &args.clients.to_string()]);
                let at = match &place {
                    Place::Tcp(port) => port.to_string(),
                    Place::Unix(path) => path.display().to_string(),
                };
                command.args(["--configuration", &at]);
            }
        }
        let child = command
            .stdin(Stdio::null())
            .env("RUST_LOG", "warn")
            .spawn()
            .map_err(|error| format!("chrt: {error}"))?;
        Ok(Self {
            child,
            place,
            _directory: directory,
        })
    }

    pub(crate) fn place(&self) -> Place {
        self.place.clone()
    }

    fn proc(&self, name: &str) -> PathBuf {
        Path::new("/proc")
            .join(self.child.id().to_string())
            .join(name)
    }

    /// Waits until the server has opened `count` terminals, and for a moment after that.
    pub(crate) fn opens(&self, count: usize) -> Result<(), Failure> {
        let start = Instant::now();
        let is_terminal = |file: &fs::DirEntry| {
            fs::read_link(file.path()).is_ok_and(|target| target.starts_with("/dev/pts"))
        };
        // The server's own stdin, stdout or stderr may be a terminal too.
        let own = (0..3).filter(|fd| {
            fs::read_link(self.proc("fd").join(fd.to_string()))
                .is_ok_and(|target| target.starts_with("/dev/pts"))
        });
        let count = count + own.count();
        while fs::read_dir(self.proc("fd"))?
            .flatten()
            .filter(is_terminal)
            .count()
            < count
        {
            if start.elapsed() > PATIENCE {
                return Err("the server does not open the sensors".into());
            }
            sleep(Duration::from_millis(5));
        }
        sleep(Duration::from_millis(500));
        Ok(())
    }

    /// The processor time of all its threads.
    pub(crate) fn processor_time(&self) -> Result<Duration, Failure> {
        let mut taken = 0;
        for thread in fs::read_dir(self.proc("task"))?.flatten() {
            let text = fs::read_to_string(thread.path().join("schedstat"))?;
            let first = text.split_whitespace().next().unwrap_or_default();
            taken += first.parse::<u64>()?;
        }
        Ok(Duration::from_nanos(taken))
    }

    pub(crate) fn anonymous_kb(&self) -> Result<u64, Failure> {
        let status = fs::read_to_string(self.proc("status"))?;
        let line = status
            .lines()
            .find_map(|line| line.strip_prefix("RssAnon:"));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        Ok(number.ok_or("no RssAnon in /proc")?)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(pid) = Pid::from_raw(self.child.id().cast_signed()) {
            let _ = kill_process(pid, Signal::TERM);
        }
        sleep(Duration::from_millis(500));
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn configuration(args: &Args, devices: &[PathBuf], port: u16) -> String {
    let mut text = String::from("robot = \"bench\"\n");
    let (side, pitch_mm) = (args.side, 3.5 * 28.0 / args.side as f64);
    for (index, device) in devices.iter().enumerate() {
        let _ = write!(
            text,
            "[[sensor]]\nname = \"s{index}\"\nport = \"{}\"\nframe_rate_hz = {:?}\n\
             [sensor.frame]\nrows = {side}\ncols = {side}\n\
             [sensor.calibration]\ntare_frames = 0\npitch_mm = {pitch_mm}\n",
            device.display(),
            args.rate
        );
    }
    let most = args.clients + 8;
    let _ = write!(
        text,
        "[publish.unix]\npath = \"events.sock\"\nmax_clients = {most}\n"
    );
    if args.tcp {
        let _ = write!(text, "[publish.tcp]\nlisten = \"127.0.0.1:{port}\"\n");
    }
    // The first taxels carry a number, and must not count as a contact.
    text += "[press]\nbegin_area_taxels = 6\nend_area_taxels = 5\n";
    text + &args.configuration + "\n"
}

/// Reads frames and writes a line of a frame's length for each. It does nothing else, so its cost
/// is that of reading and writing alone.
pub(crate) fn copy(device: &Path, args: &Args) -> Result<(), Failure> {
    let mut clients: Vec<Box<dyn Write>> = Vec::new();
    let device = fs::File::open(device)?;
    if let Ok(port) = args.configuration.parse::<u16>() {
        let listener = TcpListener::bind(("127.0.0.1", port))?;
        while clients.len() < args.clients {
            let (stream, _) = listener.accept()?;
            stream.set_nodelay(true)?;
            clients.push(Box::new(stream));
        }
    } else {
        let listener = UnixListener::bind(&args.configuration)?;
        while clients.len() < args.clients {
            clients.push(Box::new(listener.accept()?.0));
        }
    }
    for client in &mut clients {
        client.write_all(b"{\"type\":\"hello\"}\n")?;
    }
    // These forces are as many bytes as a frame without load.
    let forces = vec!["0.0"; 781].join(",");
    let (mut read, mut bytes) = (0, [0; 4096]);
    for number in 1.. {
        while read < number * FRAME_BYTES {
            read += rustix::io::read(&device, &mut bytes)?;
        }
        // The number is at the same place as from a sensor, in newtons. Here it is the count of
        // frames, because none is lost.
        let force = |byte: u8| 0.04 * f64::from(byte);
        let [a, b, c, ..] = (number as u32 - 1).to_le_bytes().map(force);
        let line = format!(
            "{{\"type\":\"frame\",\"sensor\":\"s0\",\"frame\":{number},{FORCES}{a:.2},{b:.2},{c:.2},{forces}]}}\n"
        );
        for client in &mut clients {
            if client.write_all(line.as_bytes()).is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}
