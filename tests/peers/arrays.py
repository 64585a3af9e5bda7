#!/usr/bin/env python3
"""Arrays of other sizes than the JX255N's, from a real pty to every reader.

    venv/bin/pip install mcap mcap-ros2-support
    venv/bin/python tests/peers/arrays.py target/debug/hardnessd

Claims: the same contact, pressed on arrays of 4x4 to 64x64 taxels, is a press with a verdict on each; frames, areas and
forces are in the sensor's own grid, in events, in the recording and in its replay. 64x64 taxels at 100 frames/s cost
little.
"""

import argparse
import json
import math
import os
import subprocess
import threading
import time
import tty
import urllib.request

from bench import Bench, wait_for
from mcap_ros2.reader import read_ros2_messages

# Name, rows, columns, pitch from row to row and from column to column in mm, frames a second.
ARRAYS = [
    ("coarse", 4, 4, 10.0, 10.0, 20),
    ("strip", 12, 32, 2.0, 2.0, 50),
    ("oblong", 28, 56, 3.5, 1.75, 50),
    ("fine", 64, 64, 1.5, 1.5, 100),
]
RADIUS_MM, FORCE_N = 11.0, 20.0
# The pitches that the built-in model has learnt from.
TRAINED_MM = (2.0, 7.0)


def contact(rows, cols, rows_mm, cols_mm):
    """The newtons on each taxel under a smooth round contact in the middle (Hertz), and the largest of them."""
    parts = 6
    taxels = []
    for row in range(rows):
        for col in range(cols):
            pressure = 0.0
            for part in range(parts * parts):
                y = (row + (part // parts + 0.5) / parts - rows / 2) * rows_mm
                x = (col + (part % parts + 0.5) / parts - cols / 2) * cols_mm
                pressure += math.sqrt(max(0.0, 1 - (x * x + y * y) / RADIUS_MM**2))
            taxels.append(pressure / parts**2 * rows_mm * cols_mm * 1.5 * FORCE_N / (math.pi * RADIUS_MM**2))
    return taxels


class Board:
    """A board on a pty that sends `AA 55` and a byte a taxel, and presses for 1 s of every 2.5 s."""

    def __init__(self, path, rows, cols, rows_mm, cols_mm, rate):
        self.pressed_n = contact(rows, cols, rows_mm, cols_mm)
        self.newtons_per_count = max(self.pressed_n) / 240
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        self.fd, self.held = ours, theirs
        if os.path.lexists(path):
            os.unlink(path)
        os.symlink(os.ttyname(theirs), path)
        self.rate, self.ended = rate, threading.Event()
        self.thread = threading.Thread(target=self._send)
        self.thread.start()

    def _send(self):
        start = time.monotonic()
        counts = [n / self.newtons_per_count for n in self.pressed_n]
        steps = [bytes(round(share / 10 * n) for n in counts) for share in range(11)]
        for number in range(1 << 30):
            due = start + number / self.rate
            if self.ended.wait(max(0, due - time.monotonic())):
                return
            phase = (number / self.rate) % 2.5 - 1.0
            share = max(0.0, min(1.0, phase / 0.3, (1.3 - phase) / 0.3))
            try:
                os.write(self.fd, b"\xaa\x55" + steps[round(10 * share)])
            except BlockingIOError:
                pass  # Nobody reads yet.

    def end(self):
        self.ended.set()
        self.thread.join()
        os.close(self.fd)
        os.close(self.held)


def configure(bench, boards):
    text = 'robot = "arm-7"\n[http]\nlisten = "127.0.0.1:0"\n[publish.unix]\npath = "events.sock"\n'
    text += '[record]\ndir = "rec"\n'
    for (name, rows, cols, rows_mm, cols_mm, rate), board in zip(ARRAYS, boards, strict=True):
        text += f"""
[[sensor]]
name = "{name}"
port = "{name}"
frame_rate_hz = {float(rate)}
[sensor.frame]
preset = "flexitac"
rows = {rows}
cols = {cols}
[sensor.calibration]
newtons_per_count = {board.newtons_per_count:.9f}
pitch_mm = {f"[{rows_mm}, {cols_mm}]" if rows_mm != cols_mm else rows_mm}
"""
    with open(bench.path("hardnessd.toml"), "w") as config:
        config.write(text)


def check_events(hello, events, boards):
    """Every array has presses with verdicts, in its own grid."""
    for card, (name, rows, cols, rows_mm, cols_mm, _) in zip(hello["sensors"], ARRAYS, strict=True):
        pitch = [rows_mm, cols_mm] if rows_mm != cols_mm else rows_mm
        assert card == {"name": name, "rows": rows, "cols": cols, "pitch_mm": pitch}, card
    for (name, rows, cols, rows_mm, cols_mm, _), board in zip(ARRAYS, boards, strict=True):
        own = [event for event in events if event.get("sensor") == name]
        frames = [event for event in own if event["type"] == "frame"]
        assert all((f["rows"], f["cols"], len(f["newtons"])) == (rows, cols, rows * cols) for f in frames), name
        peak = max(frames, key=lambda frame: sum(frame["newtons"]))
        errors = [abs(found - n) for found, n in zip(peak["newtons"], board.pressed_n, strict=True)]
        assert max(errors) < 1.1 * board.newtons_per_count, (name, max(errors))
        finals = [event for event in own if event.get("phase") == "final"]
        assert len(finals) >= 2, (name, len(finals))
        for verdict in finals:
            taxel = rows_mm * cols_mm
            assert abs(verdict["force_n"] / FORCE_N - 1) < 0.05, verdict
            assert math.isclose(verdict["contact_area_mm2"], verdict["contact_area_taxels"] * taxel, abs_tol=0.001)
            share = verdict["contact_area_mm2"] / (math.pi * RADIUS_MM**2)
            assert 0.7 < share < (1 + max(rows_mm, cols_mm) / RADIUS_MM) ** 2, (name, share)
            assert "resampled" in verdict["notes"], verdict
            is_outside = min(rows_mm, cols_mm) < TRAINED_MM[0] or max(rows_mm, cols_mm) > TRAINED_MM[1]
            assert ("outside_training" in verdict["notes"]) == is_outside, verdict
        print(f"{name}: {rows}x{cols}, {len(frames)} frames, {len(finals)} verdicts, {finals[-1]['label']}, "
              f"{finals[-1]['contact_area_mm2']:.0f} mm2")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("binary")
    arguments = parser.parse_args()
    with Bench(arguments.binary, sensors=()) as bench:
        boards = [Board(bench.path(name), *rest) for name, *rest in ARRAYS]
        try:
            configure(bench, boards)
            daemon = bench.daemon()
            tail = bench.events("--types", "frame,press,hardness,status")
            finals = lambda: [e for e in tail.events if e.get("phase") == "final"]
            wait_for("verdicts", lambda: all(
                sum(e["sensor"] == name for e in finals()) >= 2 for name, *_ in ARRAYS))
            with urllib.request.urlopen(f"http://{bench.address('http')}/api/status") as answer:
                hello = json.load(answer)["hello"]
            ticks = os.sysconf("SC_CLK_TCK")
            used = lambda: sum(map(int, open(f"/proc/{daemon.pid}/stat").read().rsplit(")")[-1].split()[11:13])) / ticks
            before, start = used(), time.monotonic()
            time.sleep(5)
            share = (used() - before) / (time.monotonic() - start)
            print(f"processor: {100 * share:.1f} % of a core, with a reader of all frames and a recording")
            daemon.terminate()
            assert daemon.wait(timeout=10) == 0
            wait_for("the end", lambda: tail.poll() is not None or tail.kill() is None)
            tail.thread.join()
        finally:
            for board in boards:
                board.end()
        check_events(hello, tail.events, boards)

        (recording,) = [name for name in os.listdir(bench.path("rec")) if name.startswith("hardnessd-")]
        recording = os.path.join(bench.path("rec"), recording)
        shapes = {}
        for found in read_ros2_messages(recording):
            if found.channel.topic.endswith("/frame"):
                image = found.ros_msg
                assert len(image.data) == 4 * image.height * image.width == image.step * image.height
                shapes[found.channel.topic.split("/")[2]] = (image.height, image.width)
        assert shapes == {name: (rows, cols) for name, rows, cols, *_ in ARRAYS}, shapes
        replay = subprocess.run([arguments.binary, "replay", recording], stdout=subprocess.PIPE, check=True, text=True)
        played = {}
        for event in map(json.loads, replay.stdout.splitlines()):
            if event.get("phase") == "final":
                played[event["sensor"], event["press"]] = event["probabilities"]
        live = {(e["sensor"], e["press"]): e["probabilities"] for e in tail.events if e.get("phase") == "final"}
        shared = played.keys() & live.keys()
        assert len(shared) >= 2 * len(ARRAYS) and all(played[key] == live[key] for key in shared)
        print(f"replay: {len(shared)} verdicts as live")


if __name__ == "__main__":
    main()
