"""A daemon, its simulated sensors and its sockets in a directory of their own."""

import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

PATIENCE_S = 60


def wait_for(what, there, patience_s=PATIENCE_S):
    """The first true value of `there()`."""
    start = time.monotonic()
    while time.monotonic() - start < patience_s:
        if found := there():
            return found
        time.sleep(0.01)
    raise AssertionError(f"{what} does not come")


def run(*command, code=0, path=None, env=None, **more):
    """Runs a program to its end, which must have this exit code. It is looked for in `path` first."""
    env = {**(env or os.environ)}
    if path:
        env["PATH"] = f"{os.path.abspath(path)}:{env['PATH']}"
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=900, env=env, **more)
    assert done.returncode == code, (command, done.returncode, done.stdout[-2000:], done.stderr[-2000:])
    return done


def free_port():
    """A port that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def same(found, expected, key):
    """A field of a ROS message is that of the JSON event."""
    if key == "object":
        return found == (expected["name"] if expected else "")
    if key == "age_at_publish_ms":
        return math.isclose(found, expected)
    if key == "levels":
        return list(found) == (expected or [])
    if key == "shore" and expected:
        return math.isclose(found, expected["value"], abs_tol=0.0005 + 1e-6)
    if key == "context":
        return (json.loads(found) if found else None) == expected
    if expected is None:
        # A ROS message has no null.
        return found in (0, "") or math.isnan(found)
    if key == "probabilities":
        # JSON has six digits after the point.
        return all(math.isclose(a, b, rel_tol=0, abs_tol=1e-6) for a, b in zip(found, expected, strict=True))
    if key == "notes":
        return list(found) == expected
    if isinstance(expected, float):
        # JSON has forces and areas rounded to 0.001, confidence as f32.
        return abs(found - expected) <= 0.0005 + 1e-6
    return found == expected


def same_messages(kind, messages, events):
    """The ROS messages of a kind are the events that have their numbers, field by field. Says how many there are."""
    found = {message.seq: message for message in messages}
    told = [event for event in events if event["type"] == kind and event.get("seq") in found]
    for event in told:
        message = found[event["seq"]]
        for key, value in event.items():
            assert key == "type" or same(getattr(message, key), value, key), (kind, key, message, value)
        assert message.header.frame_id == event["sensor"]
    return len(told)


def taken(binary, path, *sensor, more=""):
    """Writes the daemon's own recording of three presses to `path`. Gives what a subscriber read meanwhile."""
    import hardnessd

    with Bench(str(binary), more=f'[record]\ndir = "rec"\nkeep_free_mb = 0\n{more}') as bench:
        daemon = bench.daemon()
        client = hardnessd.Client(bench.path("events.sock"), types=hardnessd.TYPES)
        live = []
        reader = threading.Thread(target=lambda: live.extend(client))
        reader.start()
        options = [option.format(control=bench.path("control.sock")) for option in sensor]
        bench.sensor("forearm", "--presses", "3", "--force", "15", "--seed", "3", *options).wait(timeout=60)
        time.sleep(0.5)
        daemon.terminate()
        daemon.wait(timeout=10)
        client.close()
        reader.join()
        (recording,) = [name for name in os.listdir(bench.path("rec")) if name.startswith("hardnessd-")]
        shutil.copy(os.path.join(bench.path("rec"), recording), path)
    return live


class Bench:
    """Use it with `with`: what it started ends with it."""

    def __init__(self, binary, sensors=("forearm",), frame_rate_hz=20, more=""):
        self.binary = binary
        self.frame_rate_hz = frame_rate_hz
        self.sensors = sensors
        self.directory = tempfile.TemporaryDirectory()
        self.processes = []
        text = 'robot = "arm-7"\n'
        for sensor in sensors:
            text += f'[[sensor]]\nname = "{sensor}"\nport = "{sensor}"\nframe_rate_hz = {frame_rate_hz}\n'
        text += f'[publish.unix]\npath = "events.sock"\n{more}'
        with open(self.path("hardnessd.toml"), "w") as config:
            config.write(text)

    def path(self, name):
        return os.path.join(self.directory.name, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.processes:
            # A simulator takes its link with it. The pty of a link that stays may become another test's.
            if process.poll() is None:
                process.terminate()
                process.send_signal(signal.SIGCONT)
            try:
                process.wait(2)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.directory.cleanup()

    def _start(self, arguments, log):
        with open(self.path(log), "ab") as output:
            process = subprocess.Popen(
                [self.binary, *arguments], stdout=subprocess.DEVNULL, stderr=output
            )
        self.processes.append(process)
        return process

    def daemon(self):
        """Starts the daemon and waits until it answers."""
        log = self.path("log")
        before = os.path.getsize(log) if os.path.exists(log) else 0
        process = self._start(["run", "--config", self.path("hardnessd.toml")], "log")
        wait_for("the daemon", lambda: b" started " in self._log(before))
        return process

    def address(self, way):
        """Where the daemon that was started last listens, such as 127.0.0.1:4711."""
        lines = [line for line in self._log(0).splitlines() if f'way="{way}"'.encode() in line]
        return lines[-1].decode().split("address=")[1].strip()

    def _log(self, start):
        with open(self.path("log"), "rb") as log:
            log.seek(start)
            return log.read()

    def sensor(self, name="forearm", *more):
        """Starts a simulated sensor and waits for its port."""
        link = self.path(name)
        if os.path.islink(link):
            os.unlink(link)
        rate = str(self.frame_rate_hz)
        process = self._start(["simulate", "--link", link, "--fps", rate, *more], "sensors")
        wait_for("the port", lambda: os.path.exists(link))
        return process

    def tail(self, *more):
        """Reads the Unix socket, JSON a line, on stdout."""
        arguments = [self.binary, "tail", "--json", "--socket", self.path("events.sock")]
        return subprocess.Popen([*arguments, *more], stdout=subprocess.PIPE, text=True)

    def events(self, *more):
        """Reads the Unix socket into the list `events` until it is killed, because a pipe is soon full of frames."""
        tail = self.tail("--count", "1000000", *more)
        tail.events = []
        tail.thread = threading.Thread(target=lambda: tail.events.extend(map(json.loads, tail.stdout)))
        tail.thread.start()
        return tail

    def freeze(self, daemon, program, *arguments):
        """Runs the Python `program`, which prints `there` once it reads another way, and stops it for 1,500 events of
        a sensor at 100 frames/s: a subscriber of the socket misses none of them and waits for none, nor does the
        daemon's stop. Says how many frames there were, the latest verdict in us and how long the stop took in s."""
        here = os.path.dirname(os.path.abspath(__file__))
        command = [sys.executable, "-c", program, *arguments]
        peer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": here})
        self.processes.append(peer)
        assert peer.stdout.readline() == "there\n"
        peer.send_signal(signal.SIGSTOP)
        lines = self.tail("--types", "frame,hardness,press,status", "--count", "1500", "--timeout", "60")
        read = [json.loads(line) for line in lines.communicate()[0].splitlines()]
        numbers = [event["frame"] for event in read if event["type"] == "frame"]
        assert len(numbers) > 1400 and numbers == list(range(numbers[0], numbers[-1] + 1)), numbers
        late = [event["latency_us"] for event in read if event["type"] == "hardness"]
        assert late and max(late) < 50_000, late
        start = time.monotonic()
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(timeout=10) == 0
        stopped_s = time.monotonic() - start
        assert stopped_s < 1, stopped_s
        return len(numbers), max(late), stopped_s
