//! The process whose latency is measured.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

use crate::{Args, Failure, Kind, Scheduling};

pub(crate) struct Server {
    child: Child,
    /// Where clients connect: the path of a socket, or a port of this machine.
    pub(crate) place: Result<u16, PathBuf>,
    _directory: tempfile::TempDir,
}

impl Server {
    pub(crate) fn start(args: &Args, devices: &[PathBuf]) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        // The port is free now, and nothing else here takes it before the server does.
        let port = TcpListener::bind(("127.0.0.1", 0))?.local_addr()?.port();
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
        }
        let child = command.stdin(Stdio::null()).env("RUST_LOG", "warn");
        let child = child.spawn().map_err(|error| format!("chrt: {error}"))?;
        let is_tcp = args.tcp || args.server == Kind::Gpsd;
        let socket = directory.path().join("events.sock");
        Ok(Self {
            child,
            place: is_tcp.then_some(port).ok_or(socket),
            _directory: directory,
        })
    }

    fn proc(&self, name: &str) -> PathBuf {
        Path::new("/proc")
            .join(self.child.id().to_string())
            .join(name)
    }

    /// Whether the server has opened all these devices.
    pub(crate) fn has_opened(&self, devices: &[PathBuf]) -> bool {
        let files = fs::read_dir(self.proc("fd")).into_iter().flatten();
        let open: BTreeSet<PathBuf> = files
            .filter_map(|file| fs::read_link(file.ok()?.path()).ok())
            .collect();
        devices.iter().all(|device| open.contains(device))
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
        let mut lines = status.lines();
        let line = lines.find_map(|line| line.strip_prefix("RssAnon:"));
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
        "[publish.unix]\npath = \"events.sock\"\nmax_clients = {most}\n\
         [publish.tcp]\nlisten = \"127.0.0.1:{port}\"\n"
    );
    text + &args.configuration + "\n"
}
