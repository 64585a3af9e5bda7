#!/usr/bin/env python3
"""Streams of boards that nobody knows, through `sniff` and the daemon's own decoder.

    PYTHON tests/peers/layouts.py target/debug/hardnessd [--streams N] [--seed S] [--run]

A generator that shares no code with the product: arrays, cells, axes, marks, counters, lengths, checksums, SLIP,
COBS and text by chance, with rests and noise, pressed at a few places. Claims: the share that is right, and that
hardly any is sure and wrong. Right is: rows, columns and cell as sent, and a replay that reads the frames, tares at
once and has presses. With `--run`, each stream that is right also enters `hardnessd run` through a pty, TCP or UDP, by
its own pace, with the proposal as its configuration: the sensor is live, tares at once and has presses.
"""

import argparse
import binascii
import collections
import contextlib
import functools
import itertools
import json
import operator
import os
import pathlib
import pty
import re
import socket
import struct
import subprocess
import sys
import tempfile
import time
import tomllib
import tty
import zlib
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from bench import Bench, free_port, wait_for
from boards import crc16_modbus

GRIDS = [
    (4, 4), (5, 12), (6, 9), (8, 8), (10, 10), (12, 32), (16, 16), (16, 32), (20, 24), (28, 28), (32, 32), (64, 64)
]
# numpy's type, and full scale.
CELLS = {
    "u8": ("u1", 255), "i8": ("i1", 127), "u16le": ("<u2", 4095), "u16be": (">u2", 4095), "i16le": ("<i2", 8000),
    "i16be": (">i2", 8000), "i32le": ("<i4", 100_000), "f32le": ("<f4", 20), "f32be": (">f4", 20),
}
FRAMINGS = ["marked"] * 5 + ["slip", "cobs", "text"]
# The share that must be right, and the share that may be sure and wrong.
RIGHT, WRONG = 0.85, 0.02


CHECKSUMS = {
    "none": lambda data: b"",
    "sum8": lambda data: bytes([sum(data) & 0xFF]),
    "lrc8": lambda data: bytes([-sum(data) & 0xFF]),
    "sum16": lambda data: struct.pack("<H", sum(data) & 0xFFFF),
    "xor8": lambda data: bytes([functools.reduce(operator.xor, data)]),
    "crc16-modbus": crc16_modbus,
    "crc16-ccitt": lambda data: struct.pack("<H", binascii.crc_hqx(data, 0xFFFF)),
    "crc32": lambda data: struct.pack("<I", zlib.crc32(data)),
}


def slip(data):
    return data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def cobs(data):
    out = b""
    for block in data.split(b"\0"):
        while len(block) >= 254:
            out, block = out + b"\xff" + block[:254], block[254:]
        out += bytes([len(block) + 1]) + block
    return out + b"\0"


def pressed(rng, rows, cols, frames, rate_hz, full):
    """[frames, rows, cols]: what presses add."""
    load, at = np.zeros((frames, rows, cols)), int(1.5 * rate_hz) + 8
    row, col = np.mgrid[:rows, :cols]
    while at < frames - 45:
        length = int(rng.integers(8, min(40, int(1.5 * rate_hz) + 9)))
        centre = rng.uniform(0.2, 0.8, 2) * (rows, cols)
        width = rng.uniform(0.08, 0.22) * min(rows, cols) + 0.7
        shape = np.exp(-((row - centre[0]) ** 2 + (col - centre[1]) ** 2) / (2 * width**2))
        ramp = np.arange(1, length + 1) / (0.3 * length)
        load[at : at + length] += rng.uniform(0.25, 0.85) * full * np.multiply.outer(
            np.clip(np.minimum(ramp, ramp[::-1]), 0, 1), shape
        )
        at += length + int(rng.integers(8, 20) + 0.3 * rate_hz)
    return load


def axes(rng, load, value, full):
    """[rows, cols, 3]: shear by the slope of the load, and the force down."""
    shear = [0.7 * slope + rng.normal(0, 0.003 * full, load.shape) for slope in np.gradient(load)]
    return np.stack([*shear, value], axis=-1)


def stream(seed):
    """What was sent in words, and the bytes of each frame. The first ones are cut."""
    rng = np.random.default_rng(seed)
    rows, cols = GRIDS[rng.integers(len(GRIDS))]
    cell, framing = str(rng.choice(list(CELLS))), str(rng.choice(FRAMINGS))
    numbers, full = CELLS[cell]
    rate_hz = int(rng.choice([10, 20, 30, 50, 100]))
    frames = int(np.clip(15 * rate_hz, 120, 400))
    mark = bytes(rng.integers(1, 255, rng.integers(2, 5)).tolist())
    header, length, tail = (int(rng.integers(n)) for n in (5, 4, 3))
    checksum = str(rng.choice(list(CHECKSUMS)))
    is_signed = not cell.startswith("u")
    has_axes = is_signed and framing != "text" and seed % 4 == 0
    rest = rng.uniform(0, 0.12) if not is_signed or rng.random() < 0.5 else rng.uniform(-0.02, 0.02)
    rest = full * (rest + rng.normal(0, 0.01, (rows, cols)) * (rng.random() < 0.6))
    noise = full * rng.uniform(0, 0.006)
    load, out, began = pressed(rng, rows, cols, frames, rate_hz, full), [], int(rng.integers(1 << 20))
    for frame in range(frames):
        value = rest + load[frame] + rng.normal(0, noise, (rows, cols))
        if framing == "text":
            separator = " ,"[seed % 2]
            counts = np.clip(np.round(value * min(10, 4095 / full)), 0, 4095).astype(int)
            out.append(("\n".join(separator.join(map(str, row)) for row in counts) + "\n\n").encode())
            continue
        if has_axes:
            value = axes(rng, load[frame], value, full)
        if not cell.startswith("f"):
            value = np.clip(np.round(value), -full if is_signed else 0, full)
        clock_ms = began + frame * 1000 // rate_hz
        headers = [b"", bytes([frame & 0xFF]), struct.pack("<H", frame), struct.pack("<I", clock_ms), b"\x01\x02"]
        body = headers[header] + value.astype(numbers).tobytes()
        if framing == "marked":
            lengths = [b"", b"", struct.pack("<H", len(body)), struct.pack(">H", len(body))]
            body = mark + lengths[length] + body
            out.append(body + CHECKSUMS[checksum](body) + (b"\r\n" if tail == 0 else b""))
        else:
            out.append({"slip": slip, "cobs": cobs}[framing](body + CHECKSUMS[checksum](body)))
    sent = {"rows": rows, "cols": cols, "cell": cell, "framing": framing, "checksum": checksum, "frames": frames}
    sent["stride"] = 3 * np.dtype(numbers).itemsize if has_axes else None
    sent["rate_hz"] = rate_hz
    ends = np.cumsum([len(frame) for frame in out]) - int(rng.integers(40))
    whole = b"".join(out)[len(b"".join(out)) - ends[-1] :]
    return sent, [whole[begin:end] for begin, end in itertools.pairwise([0, *ends.clip(0)])]


def judged(binary, directory, sent, data):
    """`right`, `wrong`, `not sure` or `no tare or no press`, and what was said."""
    capture, config = directory / "capture.bin", directory / "found.toml"
    capture.write_bytes(data)
    done = subprocess.run([binary, "sniff", capture, "--out", config], capture_output=True, text=True)
    if done.returncode != 0:
        return "not sure", done.stderr.strip()
    found = tomllib.loads(config.read_text())["sensor"][0]["frame"]
    cell = "text" if found.get("preset") in ("csv", "flexitac") else found.get("cell", "u8")
    wanted = "text" if sent["framing"] == "text" else sent["cell"]
    # A signed cell that is never below 0 is read without its sign.
    is_cell = cell == wanted or cell.replace("u", "i", 1) == wanted.replace("u", "i", 1)
    played = subprocess.run([binary, "replay", capture, "--config", config, "--json"], capture_output=True, text=True)
    events = [json.loads(line) for line in played.stdout.splitlines()]
    frames = events[-1]["frames"] if events else 0
    is_array = (found["rows"], found["cols"]) == (sent["rows"], sent["cols"])
    if found.get("stride_bytes") != sent["stride"]:
        return "wrong", json.dumps(found)
    if not (is_array and is_cell and frames >= 0.95 * sent["frames"] - 2):
        return "wrong", json.dumps(found)
    why = untared_or_unpressed(events)
    return ("no tare or no press", why) if why else ("right", "")


def untared_or_unpressed(events):
    """Why the tare did not pass at once, or that nothing presses. Empty if it did and something does."""
    untared = [event["reason"] for event in events if (event.get("reason") or "").startswith("tare")]
    has_press = any(event["type"] == "press" for event in events)
    return json.dumps(untared[:1]) if untared else "" if has_press else "no press"


@contextlib.contextmanager
def line_of(kind):
    """A port of the daemon, and what sends bytes to it once the daemon has opened it."""
    if kind == "udp":
        port = free_port()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
            yield f"udp://127.0.0.1:{port}", lambda data: ours.sendto(data, ("127.0.0.1", port))
    elif kind == "tcp":
        with socket.create_server(("127.0.0.1", 0)) as listener:
            accepted = functools.cache(lambda: listener.accept()[0])
            yield f"tcp://127.0.0.1:{listener.getsockname()[1]}", lambda data: accepted().sendall(data)
    else:
        ours, theirs = pty.openpty()
        tty.setraw(theirs)

        def send(data):
            while data:
                data = data[os.write(ours, data) :]

        yield os.ttyname(theirs), send
        os.close(theirs)
        os.close(ours)


def live(binary, config, sent, frames, kind):
    """Whether the sensor is `live` in `run` with this proposal, tares at once and has presses, and what was said."""
    # The daemon ends before its port: it would open the next pty of this name.
    with line_of(kind) as (port, send), Bench(binary, sensors=()) as bench:
        text = re.sub(r'(?m)^port = ".*"', f'port = "{port}"', config.read_text())
        text = re.sub(r"(?m)^# frame_rate_hz = .*", f"frame_rate_hz = {sent['rate_hz']}.0", text)
        pathlib.Path(bench.path("hardnessd.toml")).write_text(text + '[publish.unix]\npath = "events.sock"\n')
        bench.daemon()
        tail = bench.events("--types", "status,press")
        begin = time.monotonic()
        for number, frame in enumerate(frames):
            time.sleep(max(0, begin + number / sent["rate_hz"] - time.monotonic()))
            send(frame)
        states = lambda: [event for event in tail.events if event["type"] == "status"]
        with contextlib.suppress(AssertionError):
            wait_for("the end", lambda: states() and states()[-1]["state"] == "stale")
            time.sleep(1)
        tail.kill()
        tail.thread.join()
    # Between frames of a busy machine a sensor may be stale, and a datagram may find no room.
    least = (0.5 if kind == "udp" else 0.95) * sent["frames"] - 2
    is_silent = lambda event: (event["reason"] or "").startswith("no frame for")
    found = [event for event in states() if event["state"] != "connecting"]
    is_live = any(event["state"] == "live" for event in found)
    is_live &= all(event["state"] == "live" or is_silent(event) for event in found)
    if not is_live or found[-1]["frames"] + found[-1]["frames_dropped"] < least:
        return "not live", json.dumps(states()[-2:])
    why = untared_or_unpressed(tail.events)
    return ("not live", why) if why else ("right", "")


def tried(given, seed):
    """What is said of the stream of a seed, and a line about it where that is not `right`."""
    sent, frames = stream(seed)
    with tempfile.TemporaryDirectory() as directory:
        directory = pathlib.Path(directory)
        said, why = judged(given.binary, directory, sent, b"".join(frames))
        if said == "right" and given.run:
            kind = ["pty", "pty", "tcp", "udp"][seed % 4]
            said, why = live(given.binary, directory / "found.toml", sent, frames, kind)
            if "held by another process" in why:
                # Another program waits for a pty that had this name before.
                said, why = live(given.binary, directory / "found.toml", sent, frames, "tcp")
            why = f"{kind}: {why}"
    return said, f"{seed}: {said}: {json.dumps(sent)}: {why[:300]}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary", type=lambda path: pathlib.Path(path).resolve())
    parser.add_argument("--streams", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--run", action="store_true", help="play what is right into `hardnessd run`")
    parser.add_argument("--at-once", type=int, default=1, help="streams at a time")
    given = parser.parse_args()
    counts = collections.Counter()
    with ProcessPoolExecutor(given.at_once) as pool:
        seeds = range(given.seed, given.seed + given.streams)
        for said, line in pool.map(functools.partial(tried, given), seeds):
            counts[said] += 1
            if said != "right":
                print(line, flush=True)
    print(dict(counts))
    wrong = counts["wrong"] + counts["no tare or no press"] + counts["not live"]
    is_as_claimed = counts["right"] >= RIGHT * given.streams and wrong <= WRONG * given.streams
    sys.exit(not is_as_claimed)


if __name__ == "__main__":
    main()
