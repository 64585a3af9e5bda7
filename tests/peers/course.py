#!/usr/bin/env python3
"""The course model at three frame rates.

    python tests/peers/course.py target/debug [OBJECTS]

Claims: a press that a sensor sees at 5, 20 and 100 frames/s gets the same level in most cases. OBJECTS: how many of each
level; 6 by default.
"""

import csv
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

ROOT = pathlib.Path(__file__).parents[2]
MODEL = ROOT / "models/course.onnx"


def run(binaries, directory, *command):
    program = pathlib.Path(binaries).absolute() / "hrn-train"
    subprocess.run([program, *command], cwd=directory, check=True, capture_output=True, timeout=600)


def simulated(binaries, directory, name, *options):
    """Simulates test presses. Returns the data set's arrays."""
    run(binaries, directory, "simulate", "--sequences", "--objects", "0", "--out", f"{name}.npz", *options)
    archive = np.load(pathlib.Path(directory, f"{name}.npz"))
    return {array: archive[array] for array in archive}


def judged(binaries, directory, name, *options):
    """What the daemon's own code says of each test press."""
    verdicts = f"{name}.csv"
    run(binaries, directory, "evaluate", "--model", MODEL, "--data", f"{name}.npz", "--verdicts", verdicts, *options)
    with open(pathlib.Path(directory, verdicts)) as file:
        return list(csv.DictReader(file))


def rates_agree(binaries, directory, objects):
    """The same seed presses the same objects with the same forces, whatever the frame rate."""
    for name, materials in [("broad", 'borders = "gaps"'), ("named", "all_test = true")]:
        options = ["--materials", name, "--config", "own.toml", "--shapes", "wide", "--test-objects", objects, "--presses", "3", "--seed", "78"]
        levels = []
        for rate in ["5", "20", "100"]:
            settings = f"frame_rate_hz = [{rate}, {rate}]\n[objects]\n{materials}\n"
            pathlib.Path(directory, "own.toml").write_text(settings)
            data = simulated(binaries, directory, f"{name}-{rate}", *options)
            verdicts = judged(binaries, directory, f"{name}-{rate}")
            levels.append({
                (verdict["object"], float(force)): verdict["judged"]
                for verdict, force in zip(verdicts, data["force"])
            })
        five, twenty, hundred = levels
        shared = five.keys() & twenty.keys() & hundred.keys()
        assert len(shared) > 0.95 * len(five), (len(shared), len(five))

        def same(*rates):
            return np.mean([len({rate[press] for rate in rates}) == 1 for press in shared])

        print(f"{name}: {len(shared)} presses, the same level at 20 and 100 frames/s {same(twenty, hundred):.1%}, "
              f"at 5 and 20 {same(five, twenty):.1%}, at all three {same(*levels):.1%}")
        assert same(twenty, hundred) > 0.85 and same(*levels) > 0.7


def main(binaries, objects="6"):
    with tempfile.TemporaryDirectory() as directory:
        rates_agree(binaries, directory, objects)


if __name__ == "__main__":
    main(*sys.argv[1:])
