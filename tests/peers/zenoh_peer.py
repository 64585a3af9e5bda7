#!/usr/bin/env python3
"""Events on zenoh, read by Eclipse's own implementation.

    python -m venv venv && venv/bin/pip install eclipse-zenoh
    cargo build --features zenoh && venv/bin/python tests/peers/zenoh_peer.py target/debug/hardnessd

Claims: a peer gets, under the keys of docs/protocol.md, the very lines of the Unix socket; a late peer
asks for the last verdict and status, beside 100 frames/s too; the liveliness token goes when the daemon is killed; a router
that comes later is found; a frozen peer costs no other subscriber an event, nor the stop its second;
and nothing listens that was not named.
"""

import json
import os
import queue
import socket
import sys
import time

import zenoh
from bench import Bench, free_port, wait_for


def free():
    return f"tcp/127.0.0.1:{free_port()}"


def session(connect=(), listen=()):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Subscriber:
    """All that comes under a key, in order."""

    def __init__(self, session, key):
        self.samples = queue.Queue()
        take = lambda sample: self.samples.put((str(sample.key_expr), sample.payload.to_string()))  # noqa: E731
        self.declared = session.declare_subscriber(key, take)

    def until(self, there):
        got = []
        while not got or not there(json.loads(got[-1][1])):
            got.append(self.samples.get(timeout=60))
        return got


def final(event):
    return event.get("phase") == "final"


def same_as_the_socket(binary):
    endpoint = free()
    with Bench(binary, more=f'[publish.zenoh]\nlisten = ["{endpoint}"]\n') as bench:
        daemon = bench.daemon()
        lines = bench.tail("--timeout", "60", "--count", "1000")
        with session(connect=[endpoint]) as peer:
            numbered = [Subscriber(peer, f"tactile/arm-7/*/{kind}") for kind in ("hardness", "press", "status")]
            frames = Subscriber(peer, "tactile/arm-7/forearm/frame")
            tokens = queue.Queue()
            alive = peer.liveliness().declare_subscriber("tactile/*", tokens.put, history=True)
            assert tokens.get(timeout=10).kind == zenoh.SampleKind.PUT
            time.sleep(0.5)
            sensor = bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3")
            sensor.wait(timeout=60)
            hardness = numbered[0].until(lambda event: final(event) and event["press"] == 2)
            presses = numbered[1].until(lambda event: event["press"] == 2 and event["state"] == "end")
            states = numbered[2].until(lambda event: event["state"] == "lost")
            listened = listening(daemon.pid)
            assert all(key == "tactile/arm-7/forearm/hardness" for key, _ in hardness), hardness
            answers = {
                str(reply.ok.key_expr): json.loads(reply.ok.payload.to_string())
                for reply in peer.get("tactile/arm-7/**")
            }
            daemon.kill()
            assert tokens.get(timeout=10).kind == zenoh.SampleKind.DELETE
            del alive
            frame = json.loads(frames.samples.get(timeout=10)[1])
        lines.kill()
        read = lines.communicate()[0].splitlines()
        # A status of the connection itself has no number.
        numbered = [line for line in read if "seq" in json.loads(line)]
        got = [text for _, text in hardness + presses + states if "seq" in json.loads(text)]
        assert len(got) >= 7 and set(got) <= set(numbered), (got, numbered)
        for kind in (hardness, presses, states):
            seqs = [json.loads(text).get("seq", 0) for _, text in kind]
            assert seqs == sorted(seqs), seqs
        last = answers["tactile/arm-7/forearm/hardness"]
        assert last == json.loads(hardness[-1][1]), last
        assert answers["tactile/arm-7/forearm/status"]["state"] == "lost", answers
        assert frame["type"] == "frame" and len(frame["newtons"]) == 784, frame
        assert listened == [endpoint.removeprefix("tcp/")], listened
        return len(got)


def listening(pid):
    """Where a process listens, and every UDP socket it has."""
    inodes = set()
    for name in os.listdir(f"/proc/{pid}/fd"):
        try:
            target = os.readlink(f"/proc/{pid}/fd/{name}")
        except FileNotFoundError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = []
    for table, states in (("tcp", {"0A"}), ("tcp6", {"0A"}), ("udp", None), ("udp6", None)):
        with open(f"/proc/net/{table}") as file:
            for line in file.readlines()[1:]:
                fields = line.split()
                if fields[9] in inodes and (states is None or fields[3] in states):
                    address, port = fields[1].split(":")
                    if len(address) == 8:
                        address = socket.inet_ntoa(bytes.fromhex(address)[::-1])
                    found.append(f"{address}:{int(port, 16)}")
    return found


def a_router_that_comes_later(binary):
    endpoint = free()
    more = f'[publish.zenoh]\nlisten = []\nconnect = ["{endpoint}"]\nsite = "hall/3"\n'
    with Bench(binary, more=more) as bench:
        bench.daemon()
        bench.sensor("forearm", "--force", "15")
        time.sleep(2)
        with session(listen=[endpoint]) as peer:
            subscriber = Subscriber(peer, "tactile/hall/3/**")
            keys = {key for key, _ in subscriber.until(final)}
        assert "tactile/hall/3/forearm/hardness" in keys, keys


FROZEN = """
import sys, time
from zenoh_peer import session
peer = session(connect=[sys.argv[1]])
subscriber = peer.declare_subscriber("tactile/**", lambda sample: None)
print("there", flush=True)
time.sleep(600)
"""


def a_frozen_peer(binary):
    endpoint = free()
    more = f'[publish.zenoh]\nlisten = ["{endpoint}"]\n'
    with Bench(binary, frame_rate_hz=100, more=more) as bench:
        daemon = bench.daemon()
        bench.sensor("forearm", "--force", "15", "--baud", "921600")
        first = bench.tail("--types", "frame", "--count", "100", "--timeout", "60").communicate()[0]
        assert len(first.splitlines()) == 100
        with session(connect=[endpoint]) as asker:
            for _ in range(20):
                key = "tactile/arm-7/forearm/status"
                answers = [json.loads(reply.ok.payload.to_string()) for reply in asker.get(key)]
                assert [answer["state"] for answer in answers] == ["live"], answers
        return bench.freeze(daemon, FROZEN, endpoint)


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    print("numbered events, as on the socket:", same_as_the_socket(binary))
    a_router_that_comes_later(binary)
    print("a router that comes later is found")
    print("a frozen peer: %d frames, none missed; verdicts after %d us at most; stop in %.2f s" % a_frozen_peer(binary))
