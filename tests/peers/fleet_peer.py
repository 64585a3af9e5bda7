#!/usr/bin/env python3
"""`examples/fleet.py` behind Eclipse's own zenoh router.

    python -m venv venv && venv/bin/pip install eclipse-zenoh
    cargo build --features zenoh && venv/bin/python tests/peers/fleet_peer.py target/debug/hardnessd

Claims: two daemons behind a router are shown with their states and verdicts; a killed daemon is gone, and there again
after its start; what strangers put at such keys does no harm.
"""

import os
import subprocess
import sys
import threading

from bench import Bench, wait_for
from zenoh_peer import free, session

ROOT = os.path.join(os.path.dirname(os.path.abspath(__file__)), "../..")

ROUTER = """
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_json5(sys.argv[1])):
    print("there", flush=True)
    time.sleep(3600)
"""

PLAIN = """{
  mode: "router",
  listen: { endpoints: ["ENDPOINT"] },
  scouting: { multicast: { enabled: false } },
}"""


class Router:
    """Eclipse zenoh in mode "router", in a process of its own."""

    def __init__(self):
        self.endpoint = free()
        command = [sys.executable, "-c", ROUTER, PLAIN.replace("ENDPOINT", self.endpoint)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout.readline() == "there\n"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


class Fleet:
    """The lines of examples/fleet.py."""

    def __init__(self, endpoint):
        command = [sys.executable, os.path.join(ROOT, "examples/fleet.py"), "--connect", endpoint]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.lines = []
        threading.Thread(target=lambda: self.lines.extend(self.process.stdout), daemon=True).start()

    def until(self, site, what, times=1):
        def count():
            return sum(line.split()[0] == site and what in line for line in self.lines) >= times

        wait_for(f"{what} of {site}", count)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


def robot(binary, name, endpoint):
    more = f'[publish.zenoh]\nlisten = []\nconnect = ["{endpoint}"]\nsite = "{name}"\n'
    return Bench(binary, more=more)


def two_robots(binary):
    """Two daemons; one is killed and started again."""
    one, two = "hall-3/arm-1", "hall-3/arm-2"
    with Router() as router, Fleet(router.endpoint) as fleet:
        with robot(binary, one, router.endpoint) as first, robot(binary, two, router.endpoint) as second:
            daemons = [bench.daemon() for bench in (first, second)]
            for bench in (first, second):
                bench.sensor("forearm", "--force", "15", "--seed", "3")
            for name in (one, two):
                fleet.until(name, " live ")
                fleet.until(name, " press 1: ")
            with session(connect=[router.endpoint]) as stranger:
                for value in ("no JSON", "[" * 100_000, "[]", '{"state": 1}', '{"state": "li\\u001bve", "reason": null}'):
                    stranger.put(f"tactile/{one}/palm/status", value)
                fleet.until(one, " li?ve ")
            daemons[1].kill()
            fleet.until(two, " gone")
            second.daemon()
            fleet.until(two, " there", times=2)
    return "".join(fleet.lines)


if __name__ == "__main__":
    print(two_robots(os.path.abspath(sys.argv[1])))
