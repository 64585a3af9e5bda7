//! The socket that the service manager passes to the daemon.

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use crate::bench::{BINARY, Bench, Process};
use rustix::process::Signal;
use serde_json::json;

/// The daemon as the service manager starts it: descriptor 3 is the socket, and the variables are
/// those of sd_listen_fds(3).
fn activated(config: &Path, socket: &UnixListener) -> Command {
    let mut command = Command::new("sh");
    command
        .args([
            "-c",
            "exec 3<&0 </dev/null; LISTEN_FDS=1 LISTEN_PID=$$ exec \"$0\" run --config \"$1\"",
            BINARY,
        ])
        .arg(config)
        .stdin(Stdio::from(OwnedFd::from(socket.try_clone().unwrap())))
        .stderr(Stdio::piped());
    command
}

#[test]
fn a_socket_of_the_service_manager_is_served_and_stays() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let path = bench.path("events.sock");
    let socket = UnixListener::bind(&path).unwrap();
    for _ in 0..2 {
        // A subscriber that connects before the daemon runs waits, and is not refused.
        let mut subscriber = bench.subscriber();
        let mut daemon = Process(activated(&config, &socket).spawn().unwrap());
        subscriber.until(&json!({"type": "hello", "robot": "arm-7"}));
        subscriber.until(&json!({"type": "status", "state": "connecting"}));
        // The daemon makes the sockets that the manager does not listen on.
        assert!(bench.path("control.sock").exists());
        daemon.signal(Signal::TERM);
        assert_eq!(daemon.exit_code(), Some(0));
        assert!(path.exists(), "the manager's socket is not ours to remove");
        assert!(!bench.path("control.sock").exists());
    }
}

#[test]
fn a_socket_that_the_configuration_does_not_name_is_refused() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let socket = UnixListener::bind(bench.path("other.sock")).unwrap();
    let Output { status, stderr, .. } = activated(&config, &socket).output().unwrap();
    let stderr = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(78), "{stderr}");
    for part in ["other.sock", "publish.unix.path"] {
        assert!(stderr.contains(part), "{part} not in {stderr}");
    }
    assert!(!bench.path("events.sock").exists());
}

#[test]
fn what_is_no_unix_socket_is_refused() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let tcp = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let socket = UnixListener::from(OwnedFd::from(tcp));
    let Output { status, stderr, .. } = activated(&config, &socket).output().unwrap();
    let stderr = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(78), "{stderr}");
    assert!(stderr.contains("socket activation"), "{stderr}");
}
