#!/usr/bin/env python3
"""The Python client against the real daemon.

    python3 -m venv venv && venv/bin/pip install './clients/python[dataset,recording]'
    venv/bin/python tests/peers/client.py target/debug/hardnessd

Claims, for Client and AsyncClient alike: over connections that break at random, each numbered event
is given once and in order; a daemon that ends and comes back is noticed, and its events follow.
A wait that is cancelled loses nothing. The control socket's answers arrive. The program ends with the exit codes of
its help, and the README's programs run.
"""

import asyncio
import inspect
import json
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest.mock

import hardnessd
from bench import PATIENCE_S, Bench, wait_for

ROOT = pathlib.Path(__file__).parents[2]
ONE_FILE = ROOT / "clients/python/hardnessd.py"
NOBODY = "No such file or directory: start `hardnessd run`, or name its socket"


class Events(list):
    """What a client gave, read on a thread of its own."""

    def __init__(self, client):
        self.client = client
        self.cancelled = 0
        follow = self._follow_async if isinstance(client, hardnessd.AsyncClient) else self._follow
        self.thread = threading.Thread(target=follow, daemon=True)
        self.thread.start()

    def _follow(self):
        for event in self.client:
            self.append(event)

    def _follow_async(self):
        async def follow():
            self.loop = asyncio.get_running_loop()
            while True:
                try:
                    # Most waits are cancelled.
                    event = await asyncio.wait_for(self.client.__anext__(), random.uniform(0, 0.01))
                    self.append(event)
                except asyncio.TimeoutError:
                    self.cancelled += 1
                except StopAsyncIteration:
                    break

        asyncio.run(follow())

    def end(self):
        if isinstance(self.client, hardnessd.AsyncClient):
            self.loop.call_soon_threadsafe(self.client.close)
        else:
            self.client.close()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive(), "the client does not end"

    def break_connection(self):
        """As a network does: without a word, at any byte. Says whether there was one."""
        if isinstance(self.client, hardnessd.AsyncClient):
            if streams := self.client._streams:
                self.loop.call_soon_threadsafe(streams[1].transport.abort)
            return bool(streams)
        if connection := self.client.connection:
            connection.close()
        return bool(connection)

    def numbers(self):
        return [event["seq"] for event in list(self) if event.get("seq")]

    def of_type(self, kind):
        return [event for event in list(self) if event["type"] == kind]


def resumes(bench, address, kind):
    steady, broken = Events(hardnessd.Client(address)), Events(kind(address))
    wait_for("both clients", lambda: steady.client.hello and broken.client.hello)
    sensor = bench.sensor("forearm", "--force", "15")
    breaks = 0
    start = time.monotonic()
    while breaks < 40 or len(steady.numbers()) < 24:
        assert time.monotonic() - start < PATIENCE_S, f"{len(steady.numbers())} events"
        time.sleep(random.uniform(0, 0.4))
        breaks += broken.break_connection()
    sensor.terminate()
    sensor.wait()
    wait_for("the loss", lambda: steady.of_type("status")[-1]["state"] == "lost")
    last = wait_for("the end", lambda: steady.numbers() and steady.numbers()[-1])
    wait_for("the same end", lambda: broken.numbers() and max(broken.numbers()) >= last)
    steady.end()
    broken.end()
    numbers = [number for number in broken.numbers() if number <= last]
    first = numbers[0]
    assert sorted(numbers) == list(range(first, last + 1)), numbers
    assert not broken.of_type("gap"), broken.of_type("gap")
    for verdict in broken.of_type("hardness"):
        assert hardnessd.answer(verdict, broken.client.hello) in str(verdict), str(verdict)
        assert json.loads(json.dumps(verdict)) == verdict
    assert len(broken.of_type("disconnected")) >= breaks / 2
    assert broken.cancelled > 100 or kind is hardnessd.Client, broken.cancelled
    run = broken.client.hello["run"]
    assert broken.client.place == f"{run}:{max(broken.numbers())}", broken.client.place
    continued = Events(kind(address, since=f"{run}:{last - 3}"))
    wait_for("what came since", lambda: last in continued.numbers())
    continued.end()
    assert continued.numbers()[:3] == [last - 2, last - 1, last], continued.numbers()
    print(f"{kind.__name__} at {address}: {len(numbers)} events over {breaks} breaks, each once")


def notices_a_restart(bench, daemon):
    both = [Events(kind(bench.path("events.sock"))) for kind in (hardnessd.Client, hardnessd.AsyncClient)]
    for events in both:
        wait_for("a status", lambda e=events: e.of_type("status"))
    run = both[0].client.hello["run"]
    daemon.kill()
    daemon.wait()
    for events in both:
        wait_for("the loss", lambda e=events: e.of_type("disconnected"))
    daemon = bench.daemon()
    for events in both:
        wait_for("the daemon", lambda e=events: e.client.hello["run"] != run)
    sensor = bench.sensor("forearm", "--force", "15")
    for events in both:
        wait_for("an unknown gap", lambda e=events: {"type": "gap", "lost": None} in list(e))
        wait_for("a verdict", lambda e=events: e.of_type("hardness"))
        events.end()
    sensor.terminate()
    sensor.wait()
    print("a daemon that came back is told apart, and its events follow")


def commands(bench):
    control = hardnessd.Control(bench.path("control.sock"))
    bench.sensor("forearm", "--force", "15")
    events = Events(hardnessd.Client(bench.path("events.sock")))
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
    for request in (control.tare, control.context, control.blackbox):
        try:
            request("wrist")
            raise AssertionError("there is no wrist")
        except hardnessd.Refused as refusal:
            assert "forearm" in str(refusal)
    assert os.path.getsize(control.blackbox("forearm")) > 10_000
    # An answer that comes after its request was given up is not taken for the next one's.
    control.connection.send({"get": "last", "id": 1_000})
    assert control.status()[0]["type"] == "status"
    control.close()
    events.end()
    print("commands are carried out or refused with a reason")


def a_verdict_in_words():
    """The same words as the daemon's tools."""
    table = json.loads((ROOT / "fixtures/answers.json").read_text())
    for case in table["cases"]:
        said = hardnessd.answer(case["verdict"], table["hello"])
        assert said == case["text"], (said, case)
    assert hardnessd.answer(table["cases"][2]["verdict"]) == "level 3 or level 4"
    for case in table["shores"]:
        said = hardnessd._with_shore({**table["cases"][0]["verdict"], "shore": case["shore"]}, table["hello"])
        assert said == f"{case['text']}, firm", said


def program(bench):
    """`python3 -m hardnessd`, and the one file by itself."""
    events = bench.path("events.sock")
    copy = bench.path("copied.py")
    pathlib.Path(copy).write_bytes(ONE_FILE.read_bytes())
    for start in ([sys.executable, "-m", "hardnessd"], [sys.executable, copy]):

        def done(*arguments, start=start, **more):
            return subprocess.run([*start, *arguments], capture_output=True, text=True, timeout=60, **more)

        helped = done("--help")
        assert helped.returncode == 0 and "--timeout" in helped.stdout, helped
        lines = done(events, "--json", "--count", "2", "--types", "hardness").stdout.splitlines()
        assert [json.loads(line)["type"] for line in lines] == ["hardness"] * 2, lines
        shown = done(events, "--count", "3", "--types", "press,status,hardness,frame").stdout
        assert re.match(r"\d\d:\d\d:\d\d\.\d{3}  forearm       status    live  ", shown), shown
        for code, arguments, said in [
            (1, [events, "--types", "hardness", "--timeout", "0.01"], "timed out after 0.01 s (0 events)"),
            (1, [bench.path("nobody.sock"), "--timeout", "0.5"], "timed out after 0.5 s (0 events)"),
            (1, [events, "--since", "7"], "the daemon refused: subscribe: since"),
            (2, ["127.0.0.1:99999"], "127.0.0.1:99999: no address: "),
            (2, [events, "--types", "touch"], "found 'touch'"),
            (2, [events, "--count", "0"], "found '0', expected a whole number above 0"),
            (2, [events, "--timeout", "nan"], "found 'nan', expected a number of seconds above 0"),
        ]:
            ended = done(*arguments)
            assert ended.returncode == code and said in ended.stderr, (arguments, ended)
            assert "Traceback" not in ended.stderr, ended
        nobody = done(bench.path("nobody.sock"), "--timeout", "0.5").stdout
        assert nobody == f"-- disconnected: {bench.path('nobody.sock')}: {NOBODY} --\n", nobody
        piped = subprocess.run(
            ["bash", "-c", '"$@" | head -n 1; echo "${PIPESTATUS[0]}"', "-", *start, events, "--types", "frame"],
            capture_output=True, text=True, timeout=60,
        )
        assert piped.stdout.splitlines()[1] == "0" and not piped.stderr, piped
        # Ctrl-C while events come, and while nobody is there.
        for address in (events, bench.path("nobody.sock")):
            running = subprocess.Popen(
                [*start, address, "--types", "frame"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                # A shell in the background starts its programs with SIGINT ignored.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
            running.stdout.readline()
            running.send_signal(signal.SIGINT)
            _, said = running.communicate(timeout=10)
            assert running.returncode == 130 and not said, (running.returncode, said)
    print("the program: exit codes, broken pipe, full disk, Ctrl-C")


def finds_the_socket(bench):
    """By itself: in the service's directory, the user's, and a demonstration's."""
    service = os.path.dirname(bench.path("events.sock"))
    with tempfile.TemporaryDirectory() as user, unittest.mock.patch.dict(os.environ, {"XDG_RUNTIME_DIR": user}):
        os.environ.pop("RUNTIME_DIRECTORY", None)
        own, demo = (os.path.join(user, name, "events.sock") for name in ("hardnessd", "hardnessd-demo-1"))
        assert hardnessd.default_address() == own
        assert next(iter(hardnessd.Client())) == {"type": "disconnected", "reason": f"{own}: {NOBODY}"}
        try:
            hardnessd.Control(own)
            raise AssertionError("nobody is there")
        except FileNotFoundError as error:
            assert str(error) == f"[Errno 2] {NOBODY}: {own!r}", error
        for socket in (demo, own):
            os.mkdir(os.path.dirname(socket))
            os.symlink(bench.path("events.sock"), socket)
            assert hardnessd.default_address() == socket
        assert next(iter(hardnessd.Client()))["type"] == "status"
        os.environ["RUNTIME_DIRECTORY"] = f"{service}:/nowhere"
        assert hardnessd.default_address() == bench.path("events.sock")


def readme(bench):
    """Its programs about a running daemon, as they are."""
    text = (ROOT / "clients/python/README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    for block in blocks:
        if "recording.open" in block:
            continue
        env = {**os.environ, "RUNTIME_DIRECTORY": os.path.dirname(bench.path("events.sock"))}
        ends = "Control" in block
        running = subprocess.Popen(
            [sys.executable, "-u", "-c", block], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        # A tare that meets a press is refused, so that program may have to try again.
        first = running.stdout.readline()
        if not ends:
            running.terminate()
        _, said = running.communicate(timeout=60)
        assert first or "press" in said, (block, said)
    print(f"the README's {len(blocks)} programs")


def main(binary):
    random.seed(1)
    assert pathlib.Path(inspect.getfile(hardnessd)).read_bytes() == ONE_FILE.read_bytes(), (
        "another version is installed: pip install ./clients/python"
    )
    more = '[publish.tcp]\nlisten = "127.0.0.1:0"\n[record]\ndir = "rec"\nkeep_free_mb = 0\n'
    with Bench(binary, more=more) as bench:
        try:
            daemon = bench.daemon()
            tcp = bench.address("tcp")
            host, port = tcp.rsplit(":", 1)
            resumes(bench, bench.path("events.sock"), hardnessd.Client)
            resumes(bench, (host, int(port)), hardnessd.AsyncClient)
            resumes(bench, tcp, hardnessd.Client)
            resumes(bench, pathlib.Path(bench.path("events.sock")), hardnessd.AsyncClient)
            notices_a_restart(bench, daemon)
            commands(bench)
            a_verdict_in_words()
            program(bench)
            finds_the_socket(bench)
            readme(bench)
        except AssertionError:
            print(pathlib.Path(bench.path("log")).read_text()[-3000:], file=sys.stderr)
            raise


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
