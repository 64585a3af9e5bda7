"""Verdicts on a stamp of 200 to 900 g that was set down 17 times on a Weiss Robotics DSA array.

In: the recording's `.dsa` file and the daemon's binary. Out: printed verdicts of a sensor of which nothing is known,
and of the same sensor with three of the presses as references, by `hardnessd identify`.
"""

import bz2
import json
import pathlib
import subprocess
import sys
import tempfile
import xml.etree.ElementTree

import numpy as np

STAMP = "pressure_profiles/calibration_weight_and_temperature/room temperature/allinone.dsa"
GRID = 28
RATE_HZ = 31
# By the mass of the heaviest stamp (900 g) it would be 0.00025.
NEWTONS_PER_COUNT = 0.0003
# Nobody measured the stamp's hardness. A stamp is stiff, so level 1 is right.
STAMP_LEVEL = 1
# The presses that become references, counted from 1, and the confidence that a wrong verdict must not have.
REFERENCES = (1, 8, 16)
SURE = 0.7
PRESSES = 17
# Frames before a reference press, for the daemon's zero, and after it.
BEFORE, AFTER = 120, 60
SYNC = bytes.fromhex("AA55C33C")
CONFIG = """
[[sensor]]
name = "pad"
port = "/dev/null"
baud = 921600
frame_rate_hz = %(rate_hz)d
%(of_sensor)s
[sensor.frame]
rows = %(grid)d
cols = %(grid)d
cell = "u16le"
sync = "AA 55 C3 3C"
checksum = "none"
length = "none"
[sensor.calibration]
newtons_per_count = %(newtons_per_count)g
pitch_mm = 3.4
"""


def dsa_row(hexadecimal):
    """All taxels of a frame of a `.dsa` file: floats, where a negative one is a run of so many zeros."""
    tokens = np.frombuffer(bytes.fromhex("".join(hexadecimal.split())), ">f4")
    return np.concatenate([np.zeros(int(-token)) if token < 0 else [token] for token in tokens])


def stamp_frames(path):
    """u16 [frames, 28, 28], in counts: the six pads of a `.dsa` file, three above three with a gap between."""
    with bz2.open(path) as file:
        root = xml.etree.ElementTree.parse(file).getroot()
    rows = np.array([dsa_row(frame.findtext("frame_data")) for frame in root.iterfind("data/frame")])
    frames, at = np.zeros((len(rows), GRID, GRID), "<u2"), 0
    for pad, matrix in enumerate(root.iterfind("sensor/matrix")):
        height, width = int(matrix.findtext("cells_y")), int(matrix.findtext("cells_x"))
        top, left = 0 if pad % 2 else GRID // 2, 4 + 7 * (pad // 2)
        cells = rows[:, at : at + height * width].reshape(-1, height, width)
        frames[:, top : top + height, left : left + width] = cells
        at += height * width
    return frames


def loaded_spans(frames):
    """[(first, last)] of the presses: an unloaded DSA array reads 0, and a second of that ends a press."""
    loaded = np.flatnonzero(frames.any(axis=(1, 2)))
    breaks = np.flatnonzero(np.diff(loaded) > RATE_HZ)
    return list(zip(loaded[np.r_[0, breaks + 1]], loaded[np.r_[breaks, -1]]))


class Daemon:
    """`hardnessd` on frames, with its files in a directory."""

    def __init__(self, binary, model, newtons_per_count, directory):
        self.binary, self.directory = binary, directory
        self.settings = {"rate_hz": RATE_HZ, "grid": GRID, "newtons_per_count": newtons_per_count}
        self.model = f'[model]\npath = "{model.resolve()}"\n' if model else ""
        self.configure("")

    def configure(self, of_sensor):
        (self.directory / "pad.toml").write_text(CONFIG % {**self.settings, "of_sensor": of_sensor} + self.model)

    def call(self, command, frames, *options):
        raw = b"".join(SYNC + frame.tobytes() for frame in frames)
        (self.directory / "frames.bin").write_bytes(raw)
        arguments = [self.binary.resolve(), command, "frames.bin", "--config", "pad.toml", *options]
        done = subprocess.run(arguments, cwd=self.directory, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"hardnessd {command}: {done.stderr}")
        return done.stdout

    def verdicts(self, frames):
        """{press: event}, the presses counted from 1."""
        events = map(json.loads, self.call("replay", frames, "--json").splitlines())
        verdicts = [event for event in events if event["type"] == "hardness" and event["phase"] == "final"]
        return {event["press"]: event for event in verdicts}


def print_verdicts(title, verdicts):
    """Prints the verdicts, {press: event}, then how many are right and which are wrong but sure."""
    print(title)
    wrong = {}
    for number, event in verdicts.items():
        level, confidence = 1 + int(np.argmax(event["probabilities"])), max(event["probabilities"])
        shares = " ".join(f"{share:.2f}" for share in event["probabilities"])
        print(f"  press {number:2}, {event['force_n']:4.1f} N: level {level}, of levels 1 to 4 {shares}")
        if level != STAMP_LEVEL:
            wrong[number] = confidence
    sure = [number for number, confidence in wrong.items() if confidence > SURE]
    right = len(verdicts) - len(wrong)
    print(f"  right: {right} of {len(verdicts)}; wrong with a confidence over {SURE}: {sure or 'none'}")


def report(directory, hardnessd, model, newtons_per_count):
    frames = stamp_frames(directory / STAMP)
    spans = loaded_spans(frames)
    with tempfile.TemporaryDirectory() as place:
        daemon = Daemon(hardnessd, model, newtons_per_count, pathlib.Path(place))
        verdicts = daemon.verdicts(frames)
        if not len(spans) == len(verdicts) == PRESSES:
            sys.exit(f"found {len(spans)} spans and {len(verdicts)} presses, expected {PRESSES}")
        print(f"{len(frames)} frames, {PRESSES} presses of one stamp, model {verdicts[1]['model']}")
        print_verdicts("nothing known of the sensor:", verdicts)
        for number in REFERENCES:
            first, last = spans[number - 1]
            press = frames[max(0, first - BEFORE) : last + AFTER]
            daemon.call("identify", press, "--out", "references.npz", "--as", f"level:{STAMP_LEVEL}", "--append")
        daemon.configure('references = "references.npz"')
        others = {number: event for number, event in daemon.verdicts(frames).items() if number not in REFERENCES}
        print_verdicts(f"presses {REFERENCES} are references of level {STAMP_LEVEL}; the others:", others)
