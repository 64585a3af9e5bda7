#!/usr/bin/env python3
"""The daemon under systemd's own programs, as far as they run without a booted systemd.

    apt-get install systemd
    unshare --mount --map-root-user python3 tests/peers/service.py target/debug/hardnessd

As root leave out --map-root-user: the real-time claim is then tried, too.

In a mount namespace of its own, where /run is its own too. Claims: the shipped unit is at most 2.0
in `systemd-analyze security`; the daemon starts under the sandbox's umask with a socket from
`systemd-socket-activate`; without a journal `format = "journald"` is refused with 78; in a real
journal every line has its fields; a journal that takes nothing delays nobody and what is lost is
counted; a device that is lost is one line; under the unit's scheduling the daemon's main thread is in
real time and says so, every thread it starts is an ordinary one, and its memory is locked.
"""

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import time

from bench import Bench, wait_for

HERE = os.path.dirname(os.path.abspath(__file__))
UNITS = os.path.join(HERE, "..", "..", "systemd")
JOURNALD = "/usr/lib/systemd/systemd-journald"
JOURNAL = "/run/systemd/journal/socket"
MOST_EXPOSED = 2.0


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    binary = os.path.abspath(parser.parse_args().binary)
    subprocess.run(["mount", "-t", "tmpfs", "none", "/run"], check=True)
    exposure()
    no_journal(binary)
    stalled_journal(binary)
    if os.path.exists(JOURNALD) and os.access("/proc/1/environ", os.R_OK):
        real_journal(binary)
    else:
        print("skipped: a real journald needs root")
    socket_activate(binary)
    if subprocess.run(["chrt", "--reset-on-fork", "--rr", "10", "true"], stderr=subprocess.DEVNULL).returncode == 0:
        real_time(binary)
    else:
        print("skipped: real-time scheduling needs root")


def exposure():
    unit = os.path.join(UNITS, "hardnessd.service")
    # The threshold is in tenths.
    command = ["systemd-analyze", "security", "--offline=true", f"--threshold={10 * MOST_EXPOSED:.0f}"]
    analysed = subprocess.run([*command, unit], capture_output=True, text=True)
    assert analysed.returncode == 0, analysed.stdout + analysed.stderr
    print(analysed.stdout.strip().splitlines()[-1])


def journald(binary, **more):
    return Bench(binary, more='[log]\nformat = "journald"\n', **more)


def no_journal(binary):
    with journald(binary) as bench:
        ended = subprocess.run(
            [binary, "run", "--config", bench.path("hardnessd.toml")], capture_output=True, text=True
        )
        assert ended.returncode == 78, ended
        assert "log.format" in ended.stderr and JOURNAL in ended.stderr, ended.stderr
        assert len(ended.stderr.splitlines()) == 1, ended.stderr


def start(bench):
    """A daemon that says nothing on stderr: it is there when its socket is."""
    process = bench._start(["run", "--config", bench.path("hardnessd.toml")], "log")
    wait_for("the daemon", lambda: os.path.exists(bench.path("events.sock")))
    return process


def hello(bench):
    with socket.socket(socket.AF_UNIX) as subscriber:
        subscriber.settimeout(5)
        subscriber.connect(bench.path("events.sock"))
        return subscriber.makefile().readline()


def stalled_journal(binary):
    os.makedirs(os.path.dirname(JOURNAL))
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    peer.bind(JOURNAL)
    os.environ["RUST_LOG"] = "debug"
    with journald(binary) as bench:
        daemon = start(bench)
        # Each leaves an entry: more than the system and the daemon keep.
        for _ in range(3000):
            assert '"hello"' in hello(bench)
        peer.settimeout(2)
        entries = []
        while not (entries and b"lines lost" in entries[-1]):
            entries.append(peer.recv(65536))
        assert any(b"MESSAGE=started\n" in entry for entry in entries[:9]), entries[:9]
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(5) == 0
        print(f"a stalled journal: {entries[-1].decode().splitlines()[2]}")
    del os.environ["RUST_LOG"]
    peer.close()
    shutil.rmtree("/run/systemd")


def entries(field):
    command = ["journalctl", "-D", "/run/log/journal", "-o", "json", "-t", "hardnessd", field]
    shown = subprocess.run(command, capture_output=True, text=True)
    return [json.loads(line) for line in shown.stdout.splitlines()]


def real_journal(binary):
    os.makedirs("/run/log")
    process = subprocess.Popen([JOURNALD], stderr=subprocess.DEVNULL)
    wait_for("the journal", lambda: os.path.exists(JOURNAL))
    with journald(binary) as bench:
        daemon = start(bench)
        sensor = bench.sensor("forearm", "--force", "15", "--material", "hard-plastic")
        verdicts = wait_for(
            "a verdict", lambda: entries("HARDNESSD_PHASE=final") and entries("HARDNESSD_PHASE=final")
        )
        verdict = verdicts[0]
        for name in "SENSOR PRESS LEVEL LABEL CONFIDENCE FORCE_N MODEL SEQ".split():
            assert f"HARDNESSD_{name}" in verdict, (name, verdict)
        assert verdict["MESSAGE"] == "hardness" and verdict["PRIORITY"] == "6", verdict
        assert verdict["HARDNESSD_SENSOR"] == "forearm" and "CODE_FILE" in verdict, verdict
        sensor.kill()
        wait_for("the loss", lambda: entries("HARDNESSD_STATE=lost"))
        # Some tries to open it again later there is still one line.
        time.sleep(3)
        lost = entries("HARDNESSD_STATE=lost")
        # It may say twice why: the end of the file, then that there is no such device.
        assert 1 <= len(lost) <= 2 and {entry["PRIORITY"] for entry in lost} == {"4"}, lost
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(5) == 0
        wait_for("the last line", lambda: entries("MESSAGE=stopping"))
    process.terminate()
    process.wait()
    print(f"a real journal: {len(verdict)} fields of a verdict, a loss is one line")


def real_time(binary):
    with Bench(binary, more="[record]\ndir = \"recordings\"\n") as bench:
        # Root may lock memory whatever the limit.
        schedule = ["prlimit", "--rttime=500000", "chrt", "--reset-on-fork", "--rr", "10"]
        command = [*schedule, binary, "run", "--config", bench.path("hardnessd.toml")]
        with open(bench.path("log"), "wb") as log:
            daemon = subprocess.Popen(command, stderr=log)
        bench.processes.append(daemon)
        started = wait_for("the daemon", lambda: [line for line in bench._log(0).splitlines() if b" started " in line])
        assert b'scheduling="real time (rr, priority 10), memory locked"' in started[0], started
        # Fields 40 and 41 of proc_pid_stat(5), the first after the name being field 3.
        scheduled = {}
        for thread in os.listdir(f"/proc/{daemon.pid}/task"):
            with open(f"/proc/{daemon.pid}/task/{thread}/stat") as stat:
                fields = stat.read().rsplit(") ", 1)[1].split()
            scheduled[int(thread)] = (fields[37], fields[38])
        assert scheduled.pop(daemon.pid) == ("10", "2"), scheduled
        # Those that log and record.
        assert len(scheduled) >= 2 and set(scheduled.values()) == {("0", "0")}, scheduled
        print(f"real time: one thread of {len(scheduled) + 1}")


def socket_activate(binary):
    with Bench(binary) as bench:
        path = bench.path("events.sock")
        command = ["systemd-socket-activate", f"--listen={path}"]
        with open(bench.path("activate"), "wb") as log:
            activator = subprocess.Popen(
                [*command, binary, "run", "--config", bench.path("hardnessd.toml")], stderr=log
            )
        bench.processes.append(activator)
        wait_for("the socket", lambda: os.path.exists(path))
        assert not os.path.exists(bench.path("control.sock")), "started before anybody asked"
        assert '"hello"' in hello(bench)
        activator.send_signal(signal.SIGTERM)
        assert activator.wait(5) == 0
        assert os.path.exists(path)
        print("systemd-socket-activate: started by the first subscriber, the socket stays")


if __name__ == "__main__":
    main()
