//! Each fault is found in a tree that has it, and in no other.

use std::fs;
use std::io;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::{Access, examine, ports};

const PORT: &str = "/dev/serial/by-id/usb-film-if00";

/// A machine without a fault. Its user may open its FTDI adapter.
struct Machine(TempDir);

impl Machine {
    fn new() -> Self {
        let machine = Self(TempDir::new().unwrap());
        machine.put("dev/ttyUSB0", "");
        fs::set_permissions(
            machine.path("dev/ttyUSB0"),
            fs::Permissions::from_mode(0o660),
        )
        .unwrap();
        fs::create_dir_all(machine.path("dev/serial/by-id")).unwrap();
        symlink("../../ttyUSB0", machine.path(&PORT[1..])).unwrap();
        machine.put("sys/class/tty/ttyUSB0/device/latency_timer", "1\n");
        machine.put("proc/1/comm", "systemd\n");
        machine.put("etc/group", "root:x:0:\n");
        let uid = rustix::process::geteuid().as_raw();
        machine.put("etc/passwd", &format!("ada:x:{uid}:100::/:/bin/sh\n"));
        machine
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn put(&self, name: &str, text: &str) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    /// The faults for a user whom the kernel lets in.
    fn faults(&self, port: &str) -> Vec<String> {
        self.faults_under(port, |_| Ok(()))
    }

    fn faults_under(&self, port: &str, access: Access) -> Vec<String> {
        examine(self.0.path(), Path::new(port), access)
    }
}

fn one(faults: &[String], parts: &[&str]) {
    assert_eq!(faults.len(), 1, "{faults:?}");
    for part in parts {
        assert!(faults[0].contains(part), "{part:?} not in {faults:?}");
    }
}

#[test]
fn a_sound_port_has_no_fault() {
    let machine = Machine::new();
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
    assert_eq!(ports(machine.0.path()), [Path::new(PORT)]);
}

#[test]
fn a_missing_port_is_answered_by_those_that_are_there() {
    let machine = Machine::new();
    one(&machine.faults("/dev/ttyUSB7"), &["no such device", PORT]);
    fs::remove_dir_all(machine.path("dev/serial")).unwrap();
    one(&machine.faults(PORT), &["port = \"/dev/ttyUSB0\""]);
}

#[test]
fn the_group_of_the_device_is_the_one_to_join() {
    let machine = Machine::new();
    let denied = || machine.faults_under(PORT, |_| Err(io::ErrorKind::PermissionDenied.into()));
    // Only root can give a file to another group.
    if std::os::unix::fs::chown(machine.path("dev/ttyUSB0"), None, Some(20)).is_err() {
        return one(&denied(), &["permission denied to ada"]);
    }
    machine.put("etc/group", "root:x:0:\ndialout:x:20:eve\n");
    let join = "sudo usermod -aG dialout ada";
    one(&denied(), &["(group dialout, mode 660)", join]);
    machine.put("etc/group", "root:x:0:\ndialout:x:20:eve,ada\n");
    one(&denied(), &["log in again, or `newgrp dialout`"]);
}

#[test]
fn modem_manager_matters_without_a_rule() {
    let machine = Machine::new();
    machine.put("proc/77/comm", "ModemManager\n");
    let cure = "ENV{ID_SERIAL}==\"Film_A1\", ENV{HARDNESSD}=\"1\"";
    machine.put("sys/class/tty/ttyUSB0/dev", "188:0\n");
    machine.put("run/udev/data/c188:0", "E:ID_SERIAL=Film_A1\n");
    one(&machine.faults(PORT), &["ModemManager (process 77)", cure]);
    // A rule for another device does not help this one.
    machine.put(
        "etc/udev/rules.d/99-modem.rules",
        "ENV{ID_MM_DEVICE_IGNORE}=\"1\"\n",
    );
    machine.put("run/udev/data/c188:1", "E:ID_MM_DEVICE_IGNORE=1\n");
    one(&machine.faults(PORT), &["ModemManager (process 77)"]);
    let database = "E:ID_SERIAL=Film_A1\nE:ID_MM_DEVICE_IGNORE=1\n";
    machine.put("run/udev/data/c188:0", database);
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
}

#[test]
fn a_slow_latency_timer_is_a_fault() {
    let machine = Machine::new();
    machine.put("sys/class/tty/ttyUSB0/device/latency_timer", "16\n");
    let line = "echo 1 | sudo tee /sys/class/tty/ttyUSB0/device/latency_timer";
    one(&machine.faults(PORT), &["16 ms", line]);
}

#[test]
fn who_holds_the_port_is_named_and_the_daemon_is_stopped_as_a_service() {
    let machine = Machine::new();
    machine.put("proc/88/comm", "hardnessd\n");
    // A file that the process names is not opened: this one would never be.
    let pipe = machine.path("pipe");
    rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RWXU).unwrap();
    let line = format!("/usr/bin/hardnessd\0run\0--config\0{}\0", pipe.display());
    machine.put("proc/88/cmdline", &line);
    fs::create_dir_all(machine.path("proc/88/fd")).unwrap();
    symlink("/dev/ttyUSB0", machine.path("proc/88/fd/3")).unwrap();
    one(
        &machine.faults(PORT),
        &["process 88, the daemon", "systemctl stop hardnessd"],
    );
    // Another subcommand of `hardnessd` is not a service.
    machine.put("proc/88/cmdline", "hardnessd\0record\0--config\0x\0");
    one(&machine.faults(PORT), &["(hardnessd): kill 88"]);
}
