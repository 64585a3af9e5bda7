#!/usr/bin/env python3
"""The daemon under systemd's own programs, as far as they run without a booted systemd.

    apt-get install systemd
    unshare --mount --map-root-user python3 tests/peers/service.py target/debug/hardnessd

As root leave out --map-root-user: the real-time claim is then tried, too.

In a mount namespace of its own, where /run is its own too. Claims: the shipped unit is at most 2.0
in `systemd-analyze security`; under the unit's scheduling the daemon's main thread is in
real time, every thread it starts is an ordinary one, and its memory is locked.
"""

import os
import socket
import subprocess
import sys

from bench import Bench, wait_for

HERE = os.path.dirname(os.path.abspath(__file__))
UNITS = os.path.join(HERE, "..", "..", "systemd")
MOST_EXPOSED = 2.0


def main(binary):
    subprocess.run(["mount", "-t", "tmpfs", "none", "/run"], check=True)
    exposure()
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


def hello(bench):
    with socket.socket(socket.AF_UNIX) as subscriber:
        subscriber.settimeout(5)
        subscriber.connect(bench.path("events.sock"))
        return subscriber.makefile().readline()


def real_time(binary):
    with Bench(binary, more="[record]\ndir = \"recordings\"\n") as bench:
        # Root may lock memory whatever the limit.
        schedule = ["prlimit", "--rttime=500000", "chrt", "--reset-on-fork", "--rr", "10"]
        command = [*schedule, binary, "run", "--config", bench.path("hardnessd.toml")]
        with open(bench.path("log"), "wb") as log:
            daemon = subprocess.Popen(command, stderr=log)
        bench.processes.append(daemon)
        wait_for("the daemon", lambda: [line for line in bench._log(0).splitlines() if b" started " in line])
        with open(f"/proc/{daemon.pid}/status") as status:
            locked = [line.split()[1] for line in status if line.startswith("VmLck:")]
        assert locked and locked[0] != "0", locked
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


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
