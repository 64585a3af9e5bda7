#!/usr/bin/env python3
"""The Debian package on a booted machine: systemd, udev and a kernel's serial drivers.

    apt-get install qemu-system-x86 qemu-utils mmdebstrap e2fsprogs
    python3 tests/peers/machine.py target/package-dist/debian/hardnessd_*.deb

Boots the host's release of Debian, for the package's processor, in qemu (by KVM where it boots, else
emulated: then the times say little) with an FTDI adapter and a PCI port, at which `hardnessd simulate`
of the same package plays, or that of another one where this machine is of another processor.
Claims: apt installs the package, which starts nothing and whose rules act on the adapter that is
plugged in; the daemon lives in its sandbox, reads both drivers and answers systemd in all that the
unit promises; who may read and who may open is as documented; a cable that is pulled is `lost` and
goes on when it is back; what is removed is gone.
"""

import argparse
import json
import os
import re
import tempfile
import threading
import time

import guest
from guest import Machine, wait_for

PORT = "/dev/serial/by-id/usb-QEMU_QEMU_USB_SERIAL_film7-if00-port0"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("package")
    parser.add_argument("simulator", nargs="?", help="a hardnessd for this machine; default: the package's")
    args = parser.parse_args()
    package = os.path.abspath(args.package)
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        guest.run("dpkg-deb", "-x", package, place)
        with Machine(package, args.simulator or f"{place}/usr/bin/hardnessd") as machine:
            say("booted", f"{machine.architecture}, {machine.accelerator}, {machine.boot_s:.0f} s")
            machine.film("forearm", "--fps", "10", "--force", "15", "--material", "hard-plastic")
            machine.film("palm", "--fps", "5", "--force", "15", "--material", "wood")
            for claim in [
                installs, starts, reaches_subscribers, is_sandboxed, is_watched, cable_is_pulled, stops, is_removed,
            ]:
                claim(machine)
    say("done", f"{time.monotonic() - start:.0f} s")


def say(what, figures):
    print(f"{what}: {figures}", flush=True)


def within(machine, seconds):
    """A limit; an emulated machine on a busy host is granted ten times as much."""
    return seconds if machine.accelerator == "kvm" else 10 * seconds


def timed(machine, command):
    start = time.monotonic()
    return machine.run(command), time.monotonic() - start


def show(machine, *names, unit="hardnessd.service"):
    """Properties of the unit."""
    shown = machine.run(f"systemctl show {unit} -p {','.join(names)}")
    properties = dict(line.split("=", 1) for line in shown.splitlines())
    return [properties[name] for name in names]


def adapter(machine):
    """What the rules have to do with: latency timer (ms), ModemManager's mark, HUPCL."""
    return machine.run(f"""
        cat /sys/bus/usb-serial/devices/ttyUSB0/latency_timer
        udevadm info /dev/ttyUSB0 | grep -c ID_MM_DEVICE_IGNORE=1
        stty -F {PORT} -a | grep -o .hupcl
        true
    """).split()


def installs(machine):
    # As the kernel and qemu leave it.
    wait_for("the adapter", lambda: adapter(machine) == ["0", "0", "hupcl"])
    machine.run("tar -xf /dev/vdb -C /srv")
    output, seconds = timed(machine, "apt-get install -y -o Dpkg::Use-Pty=0 /srv/hardnessd_*.deb 2>&1")
    assert "warning" not in output.lower() and "error" not in output.lower(), output
    assert machine.run("getent passwd hardnessd").endswith(":/usr/sbin/nologin")
    assert "dialout" in machine.run("id -nG hardnessd")
    assert machine.run("stat -c '%U %G %a' /run/hardnessd") == "hardnessd hardnessd 755"
    assert show(machine, "ActiveState", "UnitFileState") == ["inactive", "disabled"]
    conffiles = machine.run("dpkg-query -W -f '${Conffiles}' hardnessd").split()
    assert conffiles[::2] == ["/etc/hardnessd.toml"], conffiles
    assert machine.run("dpkg --verify hardnessd") == ""
    # The rules touch no port that the user has not named.
    assert adapter(machine) == ["0", "0", "hupcl"], adapter(machine)
    machine.run(r"""
        serial=$(udevadm info --query=property /dev/ttyUSB0 | sed -n s/^ID_SERIAL=//p)
        echo "SUBSYSTEM==\"tty\", ENV{ID_SERIAL}==\"$serial\", ENV{HARDNESSD}=\"1\"" \
            > /etc/udev/rules.d/98-hardnessd.rules
        udevadm control --reload
        udevadm trigger --settle --action=add /dev/ttyUSB0
    """)
    assert adapter(machine) == ["1", "1", "-hupcl"], adapter(machine)
    say("installed", f"{seconds:.1f} s; nothing started; the rules act on the adapter once it is named")


def config(palm):
    """The adapter, and a port at the PCI bus."""
    return f"""robot = "arm-7"
[[sensor]]
name = "forearm"
port = "{PORT}"
frame_rate_hz = 10.0
[[sensor]]
name = "palm"
port = "/dev/{palm}"
frame_rate_hz = 5.0
[log]
format = "journald"
"""


def configure(machine, text):
    machine.run(f"cat >/etc/hardnessd.toml <<'END'\n{text}END")


def statuses(machine):
    """The state of each sensor, as a new subscriber hears it."""
    lines = machine.run("hardnessd tail --json --types status --count 2 --timeout 60").splitlines()
    return {event["sensor"]: event for event in map(json.loads, lines)}


def is_live(machine):
    found = statuses(machine)
    return all(event["state"] == "live" and not event["reason"] for event in found.values()) and found


def starts(machine):
    configure(machine, config(machine.pci_port))
    _, seconds = timed(machine, "systemctl start hardnessd")
    start = time.monotonic()
    found = wait_for("live sensors", lambda: is_live(machine))
    live_s = time.monotonic() - start
    wait_for("notify text", lambda: show(machine, "StatusText") == ["2 of 2 sensors live"])
    assert 'Status: "2 of 2 sensors live"' in machine.run("systemctl status hardnessd")
    damaged = {name: event["frames_damaged"] for name, event in found.items()}
    say("started", f"{seconds:.1f} s, both live after {live_s:.1f} s more, damaged frames {damaged}")


def reaches_subscribers(machine):
    machine.run("useradd reader -G hardnessd,dialout && useradd stranger")
    sockets = machine.run("cd /run/hardnessd && stat -c '%n %U %G %a' *").splitlines()
    assert sockets == [
        "control.sock hardnessd hardnessd 600", "events.sock hardnessd hardnessd 660"
    ], sockets
    heard = machine.cables["forearm"].heard
    tail = "hardnessd tail --json --types hardness --timeout 100 --count 8"
    lines, seconds = timed(machine, f"runuser -u reader -- {tail}")
    verdicts = [json.loads(line) for line in lines.splitlines()]
    finals = [event for event in verdicts if event["phase"] == "final"]
    found = {(event["sensor"], event["label"]) for event in finals}
    assert len(finals) >= 2 and {sensor for sensor, _ in found} == {"forearm", "palm"}, verdicts
    assert all(event["level"] == 1 for event in finals if event["sensor"] == "forearm"), finals
    ages = sorted(event["latency_us"] / 1000 for event in finals)
    assert machine.cables["forearm"].heard == heard, "neither the daemon nor ModemManager writes"
    code, output = machine.ask(f"runuser -u stranger -- {tail}")
    assert code == 69 and "ermission denied" in output, (code, output)
    control = "hardnessd tail --socket /run/hardnessd/control.sock --count 1 --timeout 5"
    code, output = machine.ask(f"runuser -u reader -- {control}")
    assert code == 69 and "ermission denied" in output, (code, output)
    say("subscribed", f"{len(finals)} final verdicts in {seconds:.1f} s, latency {ages[0]:.1f} to "
        f"{ages[-1]:.1f} ms; strangers are refused")


def is_sandboxed(machine):
    (pid,) = show(machine, "MainPID")
    lines = machine.run(f"cat /proc/{pid}/status").splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    uid = machine.run("id -u hardnessd")
    assert status["Uid"].split() == [uid] * 4 and uid != "0", status["Uid"]
    assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
    assert status["NoNewPrivs"] == "1" and status["Seccomp"] == "2"
    exposure = machine.run("systemd-analyze security hardnessd --no-pager").splitlines()[-1]
    assert float(re.search(r"\d+\.\d+", exposure)[0]) <= 2.0, exposure
    memory_mib = int(status["VmRSS"].split()[0]) / 1024
    say("sandboxed", f"user {uid}, no capabilities, {exposure.split(': ', 1)[1]}; "
        f"{memory_mib:.1f} MiB resident, with two sensors")


def is_watched(machine):
    pid, restarts = show(machine, "MainPID", "NRestarts")
    started = int(show(machine, "ExecMainStartTimestampMonotonic")[0])
    up_s = float(machine.run("cut -d' ' -f1 /proc/uptime")) - started / 1e6
    assert restarts == "0" and up_s > 12, "fed for longer than WatchdogSec"
    start = time.monotonic()
    machine.run(f"kill -STOP {pid}")
    wait_for("restart", lambda: show(machine, "NRestarts", "ActiveState") == ["1", "active"])
    seconds = time.monotonic() - start
    assert "Watchdog timeout" in machine.run("journalctl -u hardnessd -o cat -n 200")
    wait_for("live sensors", lambda: is_live(machine))
    say("watched", f"fed for {up_s:.0f} s; stopped by SIGSTOP it was new after {seconds:.1f} s")


class Listener(threading.Thread):
    """All events of a daemon from now on, each with when it came here."""

    def __init__(self, machine):
        super().__init__(daemon=True)
        self.lines = machine.events.makefile()
        self.events = []
        machine.events.settimeout(None)
        command = "exec hardnessd tail --json >/dev/virtio-ports/events"
        machine.run(f"systemd-run --quiet --unit=listener sh -c '{command}'")
        self.start()

    def run(self):
        for line in self.lines:
            self.events.append((time.monotonic(), json.loads(line)))

    def first(self, since, **fields):
        """The first one with these fields from that time on."""
        def there():
            for at, event in list(self.events):
                if at >= since and all(event.get(name) == value for name, value in fields.items()):
                    return at, event
        return wait_for(str(fields), there)


def cable_is_pulled(machine, times=3):
    before = show(machine, "MainPID", "NRestarts")
    listener = Listener(machine)
    figures = []
    for _ in range(times):
        _, press = listener.first(time.monotonic(), type="press", sensor="forearm", state="begin")
        pulled = time.monotonic()
        machine.pull()
        at, lost = listener.first(pulled, type="status", sensor="forearm", state="lost")
        lost_s = at - pulled
        assert lost_s < within(machine, 0.1), lost_s
        _, aborted = listener.first(pulled, type="press", sensor="forearm", press=press["press"])
        assert aborted["state"] in ("aborted", "end"), aborted
        plugged = time.monotonic()
        machine.plug()
        at, live = listener.first(plugged, type="status", sensor="forearm", state="live")
        live_s = at - plugged
        # 2 s between tries, the kernel's own time and a frame.
        assert live_s < within(machine, 4), live_s
        assert live["frames"] > lost["frames"], (lost, live)
        _, begin = listener.first(plugged, type="press", sensor="forearm", state="begin")
        assert begin["press"] == press["press"] + 1, (press, begin)
        assert begin["frame"] > press["frame"], (press, begin)
        assert adapter(machine) == ["1", "1", "-hupcl"], adapter(machine)
        figures.append(f"lost after {lost_s * 1000:.0f} ms, live {live_s:.1f} s after it is back")
    numbers = [event["seq"] for _, event in listener.events if "seq" in event]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), numbers
    assert show(machine, "MainPID", "NRestarts") == before
    machine.run("systemctl stop listener")
    for one in figures:
        say("cable", one)


def stops(machine):
    timing = """
        start=$(date +%s%N); systemctl stop hardnessd; end=$(date +%s%N)
        echo $(((end - start) / 1000000))
    """
    stop_ms = int(machine.run(timing))
    assert stop_ms < within(machine, 2000), stop_ms
    found = show(machine, "ActiveState", "Result", "ExecMainStatus")
    assert found == ["inactive", "success", "0"], found
    assert machine.run("ls /run/hardnessd") == ""
    for user in ["root", "hardnessd"]:
        output = machine.run(f"runuser -u {user} -- hardnessd doctor --port {PORT}")
        assert output.endswith("no fault found"), output
    assert adapter(machine)[2] == "-hupcl"
    say("stopped", f"{stop_ms} ms, with 0; doctor finds no fault, the daemon's user may open the port")


def left(machine):
    """What stands anywhere under the package's name."""
    return machine.run("""
        find / -xdev -name '*hardnessd*' -not -path '/srv/*' -not -path '/proc/*' -not -path '/sys/*'
        find /run -xdev -name '*hardnessd*'
    """).splitlines()


def is_removed(machine):
    machine.run("apt-get remove -y -o Dpkg::Use-Pty=0 hardnessd 2>&1")
    assert machine.ask("pgrep -x hardnessd")[0] == machine.ask("command -v hardnessd")[0] == 1
    assert machine.run("cat /etc/hardnessd.toml") == config(machine.pci_port).strip()
    machine.run("apt-get purge -y -o Dpkg::Use-Pty=0 hardnessd 2>&1")
    # Where recordings lie, and a directory that goes with the next boot; and the user, as is usual.
    assert sorted(left(machine)) == ["/run/hardnessd", "/var/lib/hardnessd"], left(machine)
    assert machine.run("getent passwd hardnessd")
    assert machine.run("systemctl --failed --no-legend; systemctl list-unit-files -q 'hardness*'; true") == ""
    say("removed", "stopped and removed, the configuration by purge; user and recordings stay")


if __name__ == "__main__":
    main()
