#!/usr/bin/env python3
"""`hardnessd fleet` behind Eclipse's own zenoh router.

    python -m venv venv && venv/bin/pip install eclipse-zenoh
    cargo build --features zenoh && venv/bin/python tests/peers/fleet_peer.py target/debug/hardnessd [--cut SECONDS]

Claims: two daemons behind a router show with state, age and last verdict, in the table and as JSON; a killed
daemon is gone, and back after its start; a robot that was cut off (SECONDS long, 15 by default) is gone within the
lease of 10 s, and after it is back the events missed are counted exactly; without a router the command says so in
one line with exit code 69; with the two routers of docs/fleet.md, one on the robot, only a robot with the
certificate of its name is let in; what strangers put at such keys reaches no terminal as it is; after a flood in
which messages were dropped, each robot is there or gone as its token is.
"""

import argparse
import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

import zenoh
from bench import Bench, wait_for
from zenoh_peer import free

HERE = os.path.dirname(os.path.abspath(__file__))

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

    def __init__(self, config=PLAIN, named="ENDPOINT", endpoint=None):
        self.endpoint = endpoint or free()
        command = [sys.executable, "-c", ROUTER, config.replace(named, self.endpoint)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout.readline() == "there\n"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


def client(endpoint, **more):
    config = zenoh.Config()
    for key, value in more.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Proxy:
    """Forwards connections to `address`, while it is not cut."""

    def __init__(self, address):
        host, port = address.removeprefix("tcp/").rsplit(":", 1)
        self.target = (host, int(port))
        self.is_cut = False
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self.listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            connection, _ = self.listener.accept()
            try:
                target = socket.create_connection(self.target)
            except OSError:
                connection.close()
                continue
            for one, other in ((connection, target), (target, connection)):
                threading.Thread(target=self._forward, args=(one, other), daemon=True).start()

    def _forward(self, one, other):
        try:
            while data := one.recv(1 << 16):
                # As on a cable that was pulled: nothing arrives, and nobody is told.
                while self.is_cut:
                    time.sleep(0.05)
                other.sendall(data)
        except OSError:
            pass
        for end in (one, other):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass


class Fleet:
    """The newest line of each sensor in `fleet --json`."""

    def __init__(self, binary, endpoint, stderr=None):
        self.command = [binary, "fleet", "--json", "--connect", endpoint]
        self.process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=stderr, text=True)
        self.newest, self.lines = {}, []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for text in self.process.stdout:
            # The last line may be cut, because the process was ended.
            if not text.endswith("\n"):
                break
            line = json.loads(text)
            self.lines.append(line)
            self.newest[line["robot"]] = line

    def until(self, what, there):
        return wait_for(what, lambda: there(self.newest) and dict(self.newest))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        assert self.process.wait(timeout=10) == 0


def robot(binary, name, endpoint):
    more = f'[publish.zenoh]\nlisten = []\nconnect = ["{endpoint}"]\nsite = "{name}"\n'
    return Bench(binary, more=more)


def table(binary, endpoint, seconds=3):
    command = [binary, "fleet", "--connect", endpoint, "--seconds", str(seconds)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def two_robots(binary):
    """Two daemons; one is killed and started again."""
    with Router() as router:
        names = ("hall-3/arm-1", "hall-3/arm-2")
        with robot(binary, names[0], router.endpoint) as one, robot(binary, names[1], router.endpoint) as two:
            daemons = [bench.daemon() for bench in (one, two)]
            for bench in (one, two):
                bench.sensor("forearm", "--force", "15", "--seed", "3")
            with Fleet(binary, router.endpoint) as fleet:
                judged = fleet.until(
                    "verdicts of both",
                    lambda newest: all(name in newest and newest[name]["verdict"] for name in names),
                )
                for name in names:
                    line = judged[name]
                    assert line["there"] and line["state"] == "live" and line["sensor"] == "forearm", line
                    assert line["verdict"]["phase"] == "final" and line["verdict"]["label"], line
                    assert 0 <= line["verdict_age_s"] < 60 and line["missed"] == 0, line
                    assert line["version"] and len(line["model"]) == 12 and line["run"], line
                shown = table(binary, router.endpoint)
                rows = {row.split()[0]: row for row in shown.splitlines() if row.startswith("hall-3/")}
                assert set(rows) == set(names), shown
                for row in rows.values():
                    assert " live " in row and "%" in row and row.endswith(" 0"), shown
                assert shown.endswith("2 robots, 2 there, 0 not there\n"), shown
                killed = time.monotonic()
                daemons[1].kill()
                fleet.until("the end of one", lambda newest: newest[names[1]]["state"] == "gone")
                gone_s = time.monotonic() - killed
                assert gone_s < 12, gone_s
                assert fleet.newest[names[0]]["state"] == "live"
                assert "1 there, 0 not" in table(binary, router.endpoint), "a new look knows only who is there"
                two.daemon()
                is_back = lambda line: line["state"] == "live" and line["restarts"] == 1  # noqa: E731
                back = fleet.until("its return", lambda newest: is_back(newest[names[1]]))[names[1]]
                assert back["there"] and back["gone_s"] is None, back
    return shown, gone_s


def events_of(bench):
    """The numbers of all events that the daemon's socket gives, kept by a thread."""
    command = [bench.binary, "tail", "--json", "--count", "1000000", "--socket", bench.path("events.sock")]
    tail = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    bench.processes.append(tail)
    numbers = []

    def read():
        for line in tail.stdout:
            event = json.loads(line)
            numbers.extend([event["seq"]] if "seq" in event else [])

    threading.Thread(target=read, daemon=True).start()
    return numbers


def cut_off(binary, cut_s):
    """A robot whose network is away for a while."""
    with Router() as router:
        proxy = Proxy(router.endpoint)
        with robot(binary, "arm-7", proxy.endpoint) as bench:
            bench.daemon()
            sent = events_of(bench)
            got = queue.Queue()
            with client(router.endpoint) as other:
                kinds = ("hardness", "press", "status")
                take = lambda sample: got.put(json.loads(sample.payload.to_string()).get("seq"))  # noqa: E731
                declared = [other.declare_subscriber(f"tactile/**/{kind}", take) for kind in kinds]
                with Fleet(binary, router.endpoint) as fleet:
                    # Hears of the robot before its first number.
                    fleet.until("the robot", lambda newest: "arm-7" in newest)
                    bench.sensor("forearm", "--force", "15", "--seed", "3", "--speed", "4")
                    fleet.until("a verdict", lambda newest: newest["arm-7"]["verdict"])
                    assert fleet.newest["arm-7"]["missed"] == 0, fleet.newest
                    proxy.is_cut, start = True, time.monotonic()
                    fleet.until("the end", lambda newest: newest["arm-7"]["state"] == "gone")
                    gone_s = time.monotonic() - start
                    assert gone_s < 13, gone_s
                    time.sleep(max(0, cut_s - gone_s))
                    before = len(sent)
                    proxy.is_cut, start = False, time.monotonic()
                    fleet.until("the return", lambda newest: newest["arm-7"]["state"] == "live")
                    back_s = time.monotonic() - start
                    # What it sends after it is back arrives.
                    wait_for("more events", lambda: len(sent) > before + 30)
                    bench.processes[-1].send_signal(signal.SIGTERM)
                    # The port that is gone costs a few more events.
                    time.sleep(4)

                    def all_counted():
                        came = {seq for seq in list(got.queue) if seq is not None}
                        line, last = fleet.newest["arm-7"], max(sent)
                        is_whole = line["received"] + line["missed"] == last - min(came) + 1
                        return is_whole and max(came) == last and (line, came, last)

                    line, came, last = wait_for("the whole count", all_counted)
                    del declared
            first = min(came)
            missed = set(range(first, last + 1)) - came
            assert len(missed) > 10, missed
            # An answer may give the fleet a verdict that no subscriber got.
            assert 0 <= len(missed) - line["missed"] <= 1, (len(missed), line["missed"], sorted(missed))
            assert line["restarts"] == 0, line
            return cut_s, gone_s, back_s, line["missed"], last - first + 1


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


def encrypted(binary):
    """The two routers of docs/fleet.md, as they are there but for the addresses and the directory."""
    with open(os.path.join(HERE, "../../docs/fleet.md")) as page:
        of_fleet, of_robot = re.findall(r"```json5\n(.*?)```", page.read(), re.DOTALL)
    local, public = "tcp/127.0.0.1:7447", free().replace("tcp/127.0.0.1", "tls/localhost")
    shown = {}
    with tempfile.TemporaryDirectory() as directory:
        certificates(directory, "ca", "router", "arm-7", "arm-8")
        certificates(directory, "foreign", "stranger")
        of_fleet = of_fleet.replace("/etc/zenoh", directory).replace("tls/0.0.0.0:7448", public)
        of_robot = of_robot.replace("/etc/zenoh", directory).replace("tls/ROUTER:7448", public)
        with Router(of_fleet, local) as router, Fleet(binary, router.endpoint) as fleet:
            for name in ("arm-8", "stranger", "arm-7"):
                # All of them claim to be arm-7; one of them has its certificate.
                config = of_robot.replace("/arm-7.", f"/{name}.")
                with Router(config, local) as beside, robot(binary, "hall-3/arm-7", beside.endpoint) as bench:
                    bench.daemon()
                    bench.sensor("forearm", "--force", "15", "--seed", "3")
                    if name == "arm-7":
                        fleet.until("a verdict", lambda newest: any(line["verdict"] for line in newest.values()))
                    else:
                        wait_for("a verdict at the robot", lambda: b'phase="final"' in bench._log(0))
                        time.sleep(2)
                    shown[name] = sorted(fleet.newest)
            ca = os.path.join(directory, "ca.pem")
            try:
                client(public, transport__link__tls__root_ca_certificate=ca).close()
                shown["no certificate"] = "let in"
            except zenoh.ZError:
                shown["no certificate"] = "refused"
    expected = {"arm-8": [], "stranger": [], "arm-7": ["hall-3/arm-7"], "no certificate": "refused"}
    assert shown == expected, shown


def strangers(binary):
    with Router() as router, client(router.endpoint) as stranger:
        named = "arm\x1b[2J\u202e9"
        tokens = [stranger.liveliness().declare_token(f"tactile/{name}") for name in (named, "x" * 300)]
        with Fleet(binary, router.endpoint) as fleet:
            fleet.until("the stranger", lambda newest: named in newest)
            status = {"type": "status", "sensor": "palm", "state": "li\x1bve", "reason": None, "seq": 1}
            for value in (json.dumps(status), "no JSON", "[" * 100_000, json.dumps(status | {"seq": 2**64 - 1})):
                stranger.put(f"tactile/{named}/palm/status", value)
            fleet.until("its status", lambda newest: newest[named]["status"])
            shown = subprocess.Popen(
                [binary, "fleet", "--connect", router.endpoint, "--seconds", "4"], stdout=subprocess.PIPE
            )
            time.sleep(2)
            stranger.put(f"tactile/{named}/palm/status", json.dumps(status))
            out = shown.communicate(timeout=30)[0]
        del tokens
    assert rb"arm\u{1b}[2J\u{202e}9" in out and rb"li\u{1b}ve" in out, out
    assert b"\x1b" not in out and "\u202e".encode() not in out and b"xxx" not in out, out


FLOOD = """
import sys, time, zenoh
config, seconds = zenoh.Config.from_json5(sys.argv[1]), float(sys.argv[2])
session = zenoh.open(config)
# A large status for each of many sensors, so that the lines of all of them take long.
many = '{"type":"status","sensor":"%s","state":"live","x":[' + ",".join(["[]"] * 2600) + "]}"
robots = [f"flood-{number}" for number in range(12)]
tokens = [session.liveliness().declare_token(f"tactile/{name}") for name in robots]
end = time.monotonic() + seconds
turn = 0
while time.monotonic() < end:
    for name in robots:
        for sensor in range(200):
            session.put(f"tactile/{name}/s{sensor}/status", many % f"s{sensor}")
            for _ in range(20):
                session.put(f"tactile/{name}/s{sensor}/press", '{"type":"press","sensor":"s%d"}' % sensor)
print("over", flush=True)
sys.stdin.read()
"""


def flood(binary, seconds=20):
    """Tokens come and go while more messages come than are taken."""
    names = [f"arm-{number}" for number in range(200)]
    with Router() as router, client(router.endpoint) as robots, tempfile.TemporaryFile("w+") as said:
        tokens = {name: robots.liveliness().declare_token(f"tactile/{name}") for name in names[::2]}
        with Fleet(binary, router.endpoint, stderr=said) as fleet:
            fleet.until("the robots", lambda newest: all(name in newest for name in tokens))
            config = {"mode": "client", "connect": {"endpoints": [router.endpoint]}}
            command = [sys.executable, "-c", FLOOD, json.dumps(config), str(seconds)]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            stranger = subprocess.Popen(command, **pipes)
            try:
                # Each robot comes or goes once, spread over the flood.
                for name in names:
                    time.sleep(0.9 * seconds / len(names))
                    if name in tokens:
                        tokens.pop(name).undeclare()
                    else:
                        tokens[name] = robots.liveliness().declare_token(f"tactile/{name}")
                assert stranger.stdout.readline() == "over\n"
                over = time.monotonic()
                is_right = lambda newest: all(  # noqa: E731
                    name in newest and newest[name]["there"] == (name in tokens) for name in names
                )
                fleet.until("every state", is_right)
                took_s = time.monotonic() - over
            finally:
                stranger.kill()
                stranger.wait()
        said.seek(0)
        dropped = [int(line.split()[1]) for line in said if "were dropped" in line]
    assert dropped, "nothing was dropped: the flood was too small"
    return len(names), dropped[-1], took_s


def other_ways(binary):
    """A daemon in place of a router, and a router that is started again."""
    endpoint = free()
    with Bench(binary, more=f'[publish.zenoh]\nlisten = ["{endpoint}"]\n') as bench:
        bench.daemon()
        with Fleet(binary, endpoint) as fleet:
            fleet.until("the daemon", lambda newest: "arm-7" in newest and newest["arm-7"]["run"])
    with Router(endpoint=endpoint) as router, robot(binary, "arm-7", endpoint) as bench, Fleet(binary, endpoint) as fleet:
        bench.daemon()
        bench.sensor()
        fleet.until("the robot", lambda newest: "arm-7" in newest and newest["arm-7"]["state"] == "live")
        router.process.kill()
        fleet.until("its end", lambda newest: newest["arm-7"]["state"] == "gone")
        with Router(endpoint=endpoint):
            back = fleet.until("its return", lambda newest: newest["arm-7"]["state"] == "live")["arm-7"]
            assert back["restarts"] == 0 and back["there"], back


def without_a_router(binary):
    command = [binary, "fleet", "--connect", free()]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert run.returncode == 69 and len(run.stderr.splitlines()) == 1, run
    return run.stderr.strip()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("binary", type=os.path.abspath)
    parser.add_argument("--cut", type=float, default=15)
    given = parser.parse_args()
    shown, gone_s = two_robots(given.binary)
    print(shown + f"killed: gone after {gone_s:.1f} s, and back after its start")
    print(
        "cut off for %.0f s: gone after %.1f s, back %.1f s after the end; %d of %d events missed, all counted"
        % cut_off(given.binary, given.cut)
    )
    encrypted(given.binary)
    print("mTLS and access by the routers of docs/fleet.md: only the robot with its own certificate is shown")
    other_ways(given.binary)
    print("a daemon in place of a router is enough; a router that is started again is found")
    strangers(given.binary)
    print("strangers: bounded and escaped")
    print("a flood: %d tokens came or went, %d messages were dropped; every state was right after %.1f s" % flood(given.binary))
    print("without a router:", without_a_router(given.binary))
