#!/usr/bin/env python3
"""`examples/fleet.py` behind Eclipse's own zenoh router.

    python -m venv venv && venv/bin/pip install eclipse-zenoh
    cargo build --features zenoh && venv/bin/python tests/peers/fleet_peer.py target/debug/hardnessd

Claims: two daemons behind a router are shown with their states and verdicts; a killed daemon is gone, and there again
after its start; what strangers put at such keys does no harm; with the two routers of results/fleet-encryption.md, one on the robot,
only a robot with the certificate of its name is let in.
"""

import os
import re
import subprocess
import sys
import tempfile
import threading
import time

import zenoh
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

    def __init__(self, config=PLAIN, named="ENDPOINT"):
        self.endpoint = free()
        command = [sys.executable, "-c", ROUTER, config.replace(named, self.endpoint)]
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


def openssl(*arguments):
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


EC = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")


def certificates(directory, authority, *names):
    """An authority of its own, and certificates that it signed."""
    path = lambda name: os.path.join(directory, name)  # noqa: E731
    ca, ca_key = path(f"{authority}.pem"), path(f"{authority}.key")
    openssl("req", "-x509", *EC, "-days", "2", "-subj", f"/CN={authority}", "-keyout", ca_key, "-out", ca)
    for name in names:
        key, request, extensions = (path(f"{name}.{kind}") for kind in ("key", "csr", "ext"))
        with open(extensions, "w") as file:
            file.write("subjectAltName=DNS:localhost\nextendedKeyUsage=serverAuth,clientAuth\n")
        openssl("req", *EC, "-subj", f"/CN={name}", "-keyout", key, "-out", request)
        signed = ("-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-days", "2", "-extfile", extensions)
        openssl("x509", "-req", "-in", request, *signed, "-out", path(f"{name}.pem"))


def is_let_in(endpoint, directory):
    """Whether a client without a certificate is."""
    config = zenoh.Config()
    for key, value in (
        ("mode", '"client"'),
        ("connect/endpoints", f'["{endpoint}"]'),
        ("transport/link/tls/root_ca_certificate", f'"{directory}/ca.pem"'),
    ):
        config.insert_json5(key, value)
    try:
        zenoh.open(config).close()
        return True
    except zenoh.ZError:
        return False


def encrypted(binary):
    """The two routers of results/fleet-encryption.md, as they are there but for the addresses and the directory."""
    with open(os.path.join(ROOT, "results/fleet-encryption.md")) as page:
        of_fleet, of_robot = re.findall(r"```json5\n(.*?)```", page.read(), re.DOTALL)
    local, public = "tcp/127.0.0.1:7447", free().replace("tcp/127.0.0.1", "tls/localhost")
    shown = {}
    with tempfile.TemporaryDirectory() as directory:
        certificates(directory, "ca", "router", "arm-7", "arm-8")
        certificates(directory, "foreign", "stranger")
        of_fleet = of_fleet.replace("/etc/zenoh", directory).replace("tls/0.0.0.0:7448", public)
        of_robot = of_robot.replace("/etc/zenoh", directory).replace("tls/ROUTER:7448", public)
        with Router(of_fleet, local) as router, Fleet(router.endpoint) as fleet:
            for name in ("arm-8", "stranger", "arm-7"):
                # All of them claim to be arm-7; one of them has its certificate.
                config = of_robot.replace("/arm-7.", f"/{name}.")
                with Router(config, local) as beside, robot(binary, "hall-3/arm-7", beside.endpoint) as bench:
                    bench.daemon()
                    bench.sensor("forearm", "--force", "15", "--seed", "3")
                    if name == "arm-7":
                        fleet.until("hall-3/arm-7", " press ")
                    else:
                        wait_for("a verdict at the robot", lambda: b'phase="final"' in bench._log(0))
                        time.sleep(2)
                    shown[name] = {line.split()[0] for line in fleet.lines}
            shown["no certificate"] = "let in" if is_let_in(public, directory) else "refused"
    expected = {"arm-8": set(), "stranger": set(), "arm-7": {"hall-3/arm-7"}, "no certificate": "refused"}
    assert shown == expected, shown


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    print(two_robots(binary))
    encrypted(binary)
    print("mTLS and access by the routers of results/fleet-encryption.md: only the robot with its own certificate is shown")
