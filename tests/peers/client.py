#!/usr/bin/env python3
"""The Python client against the real daemon: it resumes, it notices, it commands.

    python3 tests/peers/client.py target/debug/hardnessd

Claims: over connections broken at random each numbered event is given once and in order; a daemon
that ends and comes back is said, and its events follow; a client closed at any moment ends; the control
socket's answers arrive.
"""

import pathlib
import random
import sys
import threading
import time

from bench import PATIENCE_S, Bench, wait_for

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "clients/python"))
import hardnessd  # noqa: E402  (found by the line above)


def collect(client, events):
    """Reads on a thread of its own."""
    thread = threading.Thread(target=lambda: events.extend_from(client), daemon=True)
    thread.start()
    return thread


class Events(list):
    """What a client gave."""

    def extend_from(self, client):
        for event in client:
            self.append(event)

    def numbers(self):
        return [event["seq"] for event in list(self) if event.get("seq")]

    def of_type(self, kind):
        return [event for event in list(self) if event["type"] == kind]


def resumes(bench, address):
    random.seed(1)
    steady, broken = Events(), Events()
    clients = [hardnessd.Client(address), hardnessd.Client(address)]
    threads = [collect(clients[0], steady), collect(clients[1], broken)]
    wait_for("both clients", lambda: all(client.hello for client in clients))
    sensor = bench.sensor("forearm", "--force", "15")
    breaks = 0
    start = time.monotonic()
    while breaks < 40 or len(steady.numbers()) < 24:
        assert time.monotonic() - start < PATIENCE_S, f"{len(steady.numbers())} events"
        time.sleep(random.uniform(0, 0.4))
        connection = clients[1].connection
        if connection:
            # As a network does: without a word, at any byte.
            connection.close()
            breaks += 1
    sensor.kill()
    wait_for("the loss", lambda: steady.of_type("status")[-1]["state"] == "lost")
    last = wait_for("the end", lambda: steady.numbers() and steady.numbers()[-1])
    wait_for("the same end", lambda: broken.numbers() and max(broken.numbers()) >= last)
    for client in clients:
        client.close()
    for thread in threads:
        thread.join(PATIENCE_S)
    numbers = [number for number in broken.numbers() if number <= last]
    first = numbers[0]
    assert sorted(numbers) == list(range(first, last + 1)), numbers
    assert not broken.of_type("gap"), broken.of_type("gap")
    assert len(broken.of_type("disconnected")) >= breaks / 2
    print(f"{address}: {len(numbers)} events over {breaks} breaks, each once")


def ends_when_closed(bench):
    client, events = hardnessd.Client(bench.path("events.sock")), Events()

    def connect(address):
        connection = connected(address)
        # Another thread, at the worst of moments: it finds no connection to close.
        client.close()
        return connection

    connected, hardnessd.Connection = hardnessd.Connection, connect
    try:
        thread = collect(client, events)
        thread.join(PATIENCE_S)
    finally:
        hardnessd.Connection = connected
    assert not thread.is_alive() and not events, events
    print("a client closed while it connects is at its end")


def notices_a_restart(bench, daemon):
    client, events = hardnessd.Client(bench.path("events.sock")), Events()
    thread = collect(client, events)
    wait_for("a status", lambda: events.of_type("status"))
    run = client.hello["run"]
    daemon.kill()
    daemon.wait()
    wait_for("the loss", lambda: events.of_type("disconnected"))
    daemon = bench.daemon()
    wait_for("the daemon", lambda: client.hello["run"] != run)
    sensor = bench.sensor("forearm", "--force", "15")
    wait_for("an unknown gap", lambda: {"type": "gap", "lost": None} in list(events))
    wait_for("a verdict", lambda: events.of_type("hardness"))
    client.close()
    thread.join(PATIENCE_S)
    sensor.kill()
    print("a daemon that came back is told apart, and its events follow")


def commands(bench):
    control = hardnessd.Control(bench.path("control.sock"))
    bench.sensor("forearm", "--force", "15")
    client, events = hardnessd.Client(bench.path("events.sock")), Events()
    collect(client, events)
    control.context("forearm", tag="pick-17")
    wait_for("the context", lambda: [
        event for event in events.of_type("press")
        if event["context"] == {"sensor": "forearm", "tag": "pick-17"}
    ])
    final = wait_for("a verdict", lambda: [
        event for event in events.of_type("hardness") if event["phase"] == "final"
    ])[0]
    assert control.last()[0]["press"] >= final["press"]
    assert control.status()[0]["sensor"] == "forearm"

    def tared():
        try:
            return control.tare("forearm")
        except hardnessd.Refused as refusal:
            assert "tare" in str(refusal)
            return None

    offsets = wait_for("a tare", tared)
    assert offsets["old"]["least_counts"] <= offsets["new"]["most_counts"]
    try:
        control.tare("wrist")
        raise AssertionError("there is no wrist")
    except hardnessd.Refused as refusal:
        assert "forearm" in str(refusal)
    client.close()
    print("commands are carried out or refused with a reason")


def main(binary):
    with Bench(binary, more='[publish.tcp]\nlisten = "127.0.0.1:0"\n') as bench:
        daemon = bench.daemon()
        host, port = bench.address("tcp").rsplit(":", 1)
        resumes(bench, bench.path("events.sock"))
        resumes(bench, (host, int(port)))
        ends_when_closed(bench)
        notices_a_restart(bench, daemon)
        commands(bench)


if __name__ == "__main__":
    main(*sys.argv[1:])
