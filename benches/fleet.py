#!/usr/bin/env python3
"""Simulated robots through one zenoh router to `hardnessd fleet`: what is sent, received, lost and late.

    python -m venv venv && venv/bin/pip install eclipse-zenoh
    cargo build --features zenoh
    venv/bin/python benches/fleet.py target/debug/hardnessd [--robots 100] [--seconds 30] [--presses 0.5]

Each robot is a session of Eclipse zenoh with a liveliness token of its own, with the keys of a daemon. What it sends and
answers are the events of one press of a real daemon, recorded here first, with the robot's own numbers and times. The
robots are spread over four processes. The delay of a verdict is from the put in the robot to the callback in
`fleet`, by the one clock of this machine.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from datetime import datetime, timezone

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(HERE, "../tests/peers"))

import zenoh  # noqa: E402
from bench import Bench, wait_for  # noqa: E402
from fleet_peer import Fleet, Router, client  # noqa: E402

PROCESSES = 4


def one_press(binary, endpoint):
    """The events of a whole press of a real daemon, and its hello."""
    more = f'[publish.zenoh]\nlisten = []\nconnect = ["{endpoint}"]\n'
    with Bench(binary, more=more) as bench, client(endpoint) as peer:
        events = []
        take = lambda sample: events.append(json.loads(sample.payload.to_string()))  # noqa: E731
        declared = [peer.declare_subscriber(f"tactile/arm-7/forearm/{kind}", take) for kind in ("press", "hardness")]
        bench.daemon()
        bench.sensor("forearm", "--force", "15", "--seed", "3")
        wait_for("two presses", lambda: sum(event.get("phase") == "final" for event in events) == 2)
        answers = {str(reply.ok.key_expr): reply.ok.payload.to_string() for reply in peer.get("tactile/arm-7/**")}
        del declared
    press = [event for event in events if event["press"] == 2]
    assert {event["type"] for event in press} == {"press", "hardness"}, press
    status = json.loads(answers["tactile/arm-7/forearm/status"])
    return press, status, json.loads(answers["tactile/arm-7"])


def now():
    return datetime.now(timezone.utc).isoformat(timespec="microseconds").replace("+00:00", "Z")


class Robot:
    def __init__(self, name, endpoint, press, status, hello):
        config = zenoh.Config()
        for key, value in (
            ("mode", '"peer"'),
            ("listen/endpoints", "[]"),
            ("connect/endpoints", json.dumps([endpoint])),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/autoconnect", "[]"),
        ):
            config.insert_json5(key, value)
        self.session = zenoh.open(config)
        self.key = f"tactile/{name}"
        self.press, self.status, self.hello = press, status, hello | {"robot": name, "run": os.urandom(8).hex()}
        self.last, self.seq, self.presses = {}, 0, 0
        self.publishers = {
            kind: self.session.declare_publisher(
                f"{self.key}/forearm/{kind}",
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=kind == "hardness",
            )
            for kind in ("hardness", "press", "status")
        }
        self.queryable = self.session.declare_queryable(f"{self.key}/**", self.answer)
        self.token = self.session.liveliness().declare_token(self.key)

    def answer(self, query):
        answers = dict(self.last)
        answers[self.key] = json.dumps(self.hello | {"seq": self.seq})
        answers[f"{self.key}/forearm/status"] = json.dumps(self.status | {"time": now()})
        for key, value in answers.items():
            query.reply(key, value, encoding=zenoh.Encoding.APPLICATION_JSON)

    def send(self, event):
        self.seq += 1
        text = json.dumps(event | {"seq": self.seq, "time": now()})
        self.publishers[event["type"]].put(text)
        if event.get("phase") == "final":
            self.last[f"{self.key}/forearm/hardness"] = text

    def do_press(self):
        self.presses += 1
        for event in self.press:
            self.send(event | {"press": self.presses})


def robots(endpoint, given):
    """One process of robots: its task comes as a line on stdin."""
    task = json.loads(given)
    all = [Robot(name, endpoint, *task["said"]) for name in task["names"]]
    print("there", flush=True)
    assert sys.stdin.readline() == "go\n"
    start, done = time.monotonic(), 0
    between = 1 / (task["presses"] * len(all))
    # In turns, so that the robots do not press at the same moment.
    while (at := done * between) < task["seconds"]:
        time.sleep(max(0, start + at - time.monotonic()))
        all[done % len(all)].do_press()
        done += 1
    print(json.dumps({robot.key.removeprefix("tactile/"): robot.seq for robot in all}), flush=True)
    sys.stdin.readline()


def processor_s(pid):
    with open(f"/proc/{pid}/stat") as stat:
        fields = stat.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid):
    with open(f"/proc/{pid}/status") as status:
        (line,) = [line for line in status if line.startswith("RssAnon")]
    return int(line.split()[1]) / 1000


def main(given):
    with Router() as router:
        said = one_press(given.binary, router.endpoint)
        with Fleet(given.binary, router.endpoint) as fleet:
            names = [f"hall/arm-{number:03}" for number in range(given.robots)]
            workers = []
            for number in range(PROCESSES):
                command = [sys.executable, os.path.abspath(__file__), "--robots-at", router.endpoint]
                pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
                workers.append(subprocess.Popen(command, **pipes))
                task = {"names": names[number::PROCESSES], "said": said}
                task |= {"seconds": given.seconds, "presses": given.presses}
                workers[-1].stdin.write(json.dumps(task) + "\n")
                workers[-1].stdin.flush()
            try:
                measure(router, fleet, workers, names)
            finally:
                for worker in workers:
                    worker.kill()
                    worker.wait()


def measure(router, fleet, workers, names):
    for worker in workers:
        assert worker.stdout.readline() == "there\n"
    fleet.until("every robot", lambda newest: all(newest.get(name, {}).get("status") for name in names))
    before = processor_s(fleet.process.pid), processor_s(router.process.pid)
    begin = len(fleet.lines)
    start = time.monotonic()
    for worker in workers:
        worker.stdin.write("go\n")
        worker.stdin.flush()
    sent = {}
    for worker in workers:
        sent |= json.loads(worker.stdout.readline())
    lasted_s = time.monotonic() - start
    # What is on its way arrives; the last question is asked and answered.
    time.sleep(14)
    after = processor_s(fleet.process.pid), processor_s(router.process.pid)
    newest = dict(fleet.newest)
    received = sum(newest[name]["received"] for name in names)
    missed = sum(newest[name]["missed"] for name in names)
    verdicts = {}
    for line in fleet.lines[begin:]:
        if line["verdict"]:
            verdicts.setdefault((line["robot"], line["verdict"]["press"]), line)
    late_ms = []
    for line in verdicts.values():
        heard, put = (datetime.fromisoformat(text) for text in (line["verdict_heard"], line["verdict"]["time"]))
        late_ms.append((heard - put).total_seconds() * 1e3)
    late_ms.sort()
    took_s = lasted_s + 14
    print(f"{len(names)} robots, {lasted_s:.0f} s, load {os.getloadavg()[0]:.1f}")
    print(f"sent {sum(sent.values())}, received {received}, lost {sum(sent.values()) - received}, told as missed {missed}")
    quantile = lambda share: late_ms[min(len(late_ms) - 1, int(share * len(late_ms)))]  # noqa: E731
    print(
        f"late ({len(late_ms)} verdicts): p50 {statistics.median(late_ms):.1f} ms, "
        f"p99 {quantile(0.99):.1f} ms, greatest {late_ms[-1]:.1f} ms"
    )
    shares = [100 * (b - a) / took_s for a, b in zip(before, after, strict=True)]
    print(f"fleet: {shares[0]:.1f} % of a core, {memory_mb(fleet.process.pid):.0f} MB; router: {shares[1]:.1f} %")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("binary", nargs="?", type=os.path.abspath)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--presses", type=float, default=0.5, help="of each robot in a second")
    parser.add_argument("--robots-at", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.robots_at:
        robots(given.robots_at, sys.stdin.readline())
    else:
        main(given)
