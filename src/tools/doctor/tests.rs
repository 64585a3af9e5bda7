//! Each fault is found in a tree that has it, and in no other.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Child, Command};

use tempfile::TempDir;

use super::checks::{User, examine, network, ports, refused};
use crate::tools::pty::Pty;

const PORT: &str = "/dev/serial/by-id/usb-film-if00";

/// The kernel's answer to a process that opens a port.
type Kernel = fn(&Path) -> io::Result<()>;
const GRANTED: Kernel = |_| Ok(());
const REFUSED: Kernel = |_| Err(io::ErrorKind::PermissionDenied.into());

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

    /// The faults for a user in the device's group.
    fn faults(&self, port: &str) -> Vec<String> {
        let gid = fs::metadata(self.path("dev/ttyUSB0")).unwrap().gid();
        self.faults_of(port, vec![gid])
    }

    fn faults_of(&self, port: &str, gids: Vec<u32>) -> Vec<String> {
        // This kernel decides by group and mode alone.
        let gid = fs::metadata(self.path("dev/ttyUSB0")).unwrap().gid();
        let access = if gids.contains(&gid) {
            GRANTED
        } else {
            REFUSED
        };
        self.faults_under(port, gids, access)
    }

    fn faults_under(&self, port: &str, gids: Vec<u32>, access: Kernel) -> Vec<String> {
        let user = User {
            name: "ada".to_owned(),
            uid: 12_345,
            gids,
            access,
        };
        let faults = examine(self.0.path(), Path::new(port), &user);
        faults.iter().map(ToString::to_string).collect()
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
fn a_stranger_to_the_group_is_told_how_to_join() {
    let machine = Machine::new();
    let gid = fs::metadata(machine.path("dev/ttyUSB0")).unwrap().gid();
    // If the tests run as root, the files belong to the group root, which nobody should join.
    let denied = machine.faults_of(PORT, vec![gid + 1]);
    if gid == 0 {
        return one(
            &denied,
            &[
                "permission denied to ada (group root, mode 660)",
                "chgrp dialout",
            ],
        );
    }
    one(&denied, &["usermod -aG"]);
}

#[test]
fn the_group_of_the_device_is_the_one_to_join() {
    let machine = Machine::new();
    // Only root can give a file to another group.
    if std::os::unix::fs::chown(machine.path("dev/ttyUSB0"), None, Some(20)).is_err() {
        return;
    }
    machine.put("etc/group", "root:x:0:\ndialout:x:20:eve\n");
    let join = "sudo usermod -aG dialout ada";
    one(
        &machine.faults_of(PORT, vec![1000]),
        &["(group dialout, mode 660)", join],
    );
    machine.put("etc/group", "root:x:0:\ndialout:x:20:eve,ada\n");
    one(
        &machine.faults_of(PORT, vec![1000]),
        &["log in again, or `newgrp dialout`"],
    );
    assert_eq!(machine.faults_of(PORT, vec![20]), Vec::<String>::new());
}

#[test]
fn what_the_kernel_says_goes_before_mode_and_group() {
    let machine = Machine::new();
    let gid = fs::metadata(machine.path("dev/ttyUSB0")).unwrap().gid();
    // An access list, such as that of systemd's uaccess, can grant access to a user outside the
    // group.
    let stranger = vec![gid + 1];
    let faults = machine.faults_under(PORT, stranger, GRANTED);
    assert_eq!(faults, Vec::<String>::new());
    // Another access list, or a container, can refuse a user in the group.
    one(
        &machine.faults_under(PORT, vec![gid], REFUSED),
        &["refused to ada, whom its mode would let in", "getfacl"],
    );
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
fn the_service_may_open_every_kind_of_serial_port_and_is_told_of_another() {
    let machine = Machine::new();
    machine.put("sys/class/tty/ttyUSB0/dev", "188:0\n");
    machine.put(
        "proc/devices",
        "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n188 sd\n",
    );
    let gid = fs::metadata(machine.path("dev/ttyUSB0")).unwrap().gid();
    let unit = include_str!("../../../systemd/hardnessd.service");
    machine.put("usr/lib/systemd/system/hardnessd.service", unit);
    machine.put("etc/passwd", "hardnessd:x:993:993::/:/usr/sbin/nologin\n");
    machine.put("etc/group", &format!("dialout:x:{gid}:\n"));
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
    for kind in "ttyS ttyAMA ttyTHS ttymxc ttyLP ttyPS ttySTM ttyMSM ttyGS rfcomm".split(' ') {
        machine.put("proc/devices", &format!("Character devices:\n188 {kind}\n"));
        assert_eq!(machine.faults(PORT), Vec::<String>::new(), "{kind}");
    }
    machine.put("proc/devices", "Character devices:\n188 odd\n");
    one(
        &machine.faults(PORT),
        &["Operation not permitted", "DeviceAllow=char-odd rw"],
    );
    machine.put(
        "etc/systemd/system/hardnessd.service.d/override.conf",
        "[Service]\nDeviceAllow=char-odd rw\nSupplementaryGroups=audio plugdev\n",
    );
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
    // The second of two groups on a line counts too.
    machine.put("etc/group", &format!("plugdev:x:{gid}:\n"));
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
    machine.put("etc/group", &format!("radio:x:{gid}:\n"));
    one(
        &machine.faults(PORT),
        &[
            "user hardnessd may not open it",
            "SupplementaryGroups=radio",
        ],
    );
}

#[test]
fn brltty_is_named_where_a_port_is_missing() {
    let machine = Machine::new();
    machine.put("usr/lib/udev/rules.d/85-brltty.rules", "");
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
    let faults = machine.faults("/dev/ttyUSB7");
    assert_eq!(faults.len(), 2, "{faults:?}");
    assert!(faults[1].contains("sudo apt remove brltty"), "{faults:?}");
}

#[test]
fn a_slow_latency_timer_is_a_fault() {
    let machine = Machine::new();
    machine.put("sys/class/tty/ttyUSB0/device/latency_timer", "16\n");
    let line = "echo 1 | sudo tee /sys/class/tty/ttyUSB0/device/latency_timer";
    one(&machine.faults(PORT), &["16 ms", line]);
}

#[test]
fn whoever_holds_the_port_is_named() {
    let machine = Machine::new();
    machine.put("proc/88/comm", "minicom\n");
    fs::create_dir_all(machine.path("proc/88/fd")).unwrap();
    symlink("/dev/ttyUSB0", machine.path("proc/88/fd/3")).unwrap();
    one(
        &machine.faults(PORT),
        &["held by process 88 (minicom)", "kill 88"],
    );
}

#[test]
fn the_daemon_that_holds_the_port_is_stopped_as_a_service() {
    let machine = Machine::new();
    machine.put("proc/88/comm", "hardnessd\n");
    machine.put("proc/88/cmdline", "/usr/bin/hardnessd\0run\0--config\0x\0");
    fs::create_dir_all(machine.path("proc/88/fd")).unwrap();
    symlink("/dev/ttyUSB0", machine.path("proc/88/fd/3")).unwrap();
    one(
        &machine.faults(PORT),
        &["process 88, the daemon", "systemctl stop hardnessd"],
    );
    // Another subcommand of `hardnessd` is not a service.
    machine.put("proc/88/cmdline", "hardnessd\0record\0--config\0x\0");
    one(&machine.faults(PORT), &["(hardnessd): kill 88"]);
    // A simulator made the port and does not keep others from opening it.
    machine.put("proc/88/cmdline", "hardnessd\0simulate\0--link\0port\0");
    assert_eq!(machine.faults(PORT), Vec::<String>::new());
}

#[test]
fn what_is_no_serial_port_is_said_to_be_none() {
    let machine = Machine::new();
    let root = Path::new("/");
    let refusal = |port: &Path| refused(root, port).map(|fault| fault.to_string());
    for (port, found) in [
        (Path::new("/dev/null"), "this is a device of the kind mem"),
        (machine.0.path(), "this is a directory"),
        (&machine.path("etc/group"), "this is a regular file"),
    ] {
        let message = refusal(port).unwrap();
        assert!(message.starts_with(found), "{message}");
        assert!(message.contains("not a serial port"), "{message}");
    }
    let pty = Pty::open(None).unwrap();
    assert_eq!(refusal(pty.path()), None);
    assert_eq!(refusal(Path::new("/dev/no-such")), None);
}

/// A process that ends with the test.
struct Holder(Child);

impl Drop for Holder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_real_port_held_by_a_real_process_is_found() {
    let pty = Pty::open(None).unwrap();
    let root = Path::new("/");
    let user = User::of_this_process(root);
    assert_eq!(examine(root, pty.path(), &user), []);
    let device = File::open(pty.path()).unwrap();
    let holder = Holder(
        Command::new("sleep")
            .arg("60")
            .stdin(device)
            .spawn()
            .unwrap(),
    );
    let faults = examine(root, pty.path(), &user);
    let faults: Vec<String> = faults.iter().map(ToString::to_string).collect();
    one(&faults, &[&format!("held by process {} (", holder.0.id())]);
}

#[test]
fn a_unit_that_forbids_the_network_is_a_fault_of_a_sensor_elsewhere() {
    let machine = Machine::new();
    let unit = include_str!("../../../systemd/hardnessd.service");
    machine.put("usr/lib/systemd/system/hardnessd.service", unit);
    let forbidden = |port: &str| {
        let faults = network::faults(machine.0.path(), &port.parse().unwrap());
        let faults: Vec<String> = faults.iter().map(ToString::to_string).collect();
        faults
            .iter()
            .any(|fault| fault.contains("add `[Service]` and `IPAddressAllow="))
    };
    assert!(!forbidden("udp://127.0.0.1:40917"));
    assert!(forbidden("udp://0.0.0.0:40917"));
    machine.put(
        "etc/systemd/system/hardnessd.service.d/override.conf",
        "[Service]\nIPAddressAllow=192.168.7.9\n",
    );
    assert!(!forbidden("udp://0.0.0.0:40917"));
}

#[test]
fn a_daemon_is_named_with_its_sensor_under_every_name_of_the_port() {
    let machine = Machine::new();
    machine.put("proc/88/comm", "hardnessd\n");
    machine.put(
        "proc/88/cmdline",
        "hardnessd\0run\0--config\0/etc/arm.toml\0",
    );
    machine.put(
        "etc/arm.toml",
        &format!("[[sensor]]\nname = \"palm\"\nport = {PORT:?}\n"),
    );
    fs::create_dir_all(machine.path("proc/88/fd")).unwrap();
    symlink("/dev/ttyUSB0", machine.path("proc/88/fd/3")).unwrap();
    let reads = format!("which reads it as {PORT} for \"palm\"");
    for name in [PORT, "/dev/ttyUSB0"] {
        one(&machine.faults(name), &["process 88, the daemon", &reads]);
    }
}
