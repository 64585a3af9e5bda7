#!/usr/bin/env python3
"""The course model on the same presses in tract and onnxruntime, and at three frame rates.

    python tests/peers/course.py target/debug [OBJECTS]

Claims: onnxruntime's probabilities and Shore hardness of 1,000 simulated presses are those of the daemon's own
code, and a press that a sensor sees at 5, 20 and 100 frames/s gets the same level in most cases. OBJECTS: how many
of each level; 6 by default.
"""

import csv
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import onnxruntime

ROOT = pathlib.Path(__file__).parents[2]
MODEL = ROOT / "models/course.onnx"
MOST = 48


def judged(binaries, directory, name, *options):
    """Simulates test presses, and reads what the daemon's own code says of them."""
    program = pathlib.Path(binaries).absolute() / "hrn-train"
    data, verdicts = f"{name}.npz", f"{name}.csv"
    simulate = [program, "simulate", "--sequences", "--objects", "0", "--out", data, *options]
    evaluate = [program, "evaluate", "--model", MODEL, "--data", data, "--verdicts", verdicts]
    for command in [simulate, evaluate]:
        subprocess.run(command, cwd=directory, check=True, capture_output=True, timeout=600)
    with open(pathlib.Path(directory, verdicts)) as file:
        return np.load(pathlib.Path(directory, data)), list(csv.DictReader(file))


def inputs(data, press):
    """A press as docs/formats.md describes the inputs of format 2."""
    rows = np.flatnonzero((data["press"] == press) & (data["time_s"] >= 0))[:MOST]
    count = len(rows)

    def padded(values):
        return np.pad(values.astype(np.float32), (0, MOST - count))[None]

    frames = np.zeros((1, MOST, 28, 28), np.float32)
    frames[0, :count] = data["frames_mn"][rows] * np.float32(1e-3)
    return {
        "frames": frames,
        "time_s": padded(data["time_s"][rows]),
        "approach_mm": padded(data["approach_mm"][rows]),
        "known": padded(data["known"][rows]),
        "mask": padded(np.ones(count)),
        "arm_n_per_mm": data["arm_n_per_mm"][press].reshape(1, 1).astype(np.float32),
    }


def onnxruntime_agrees(binaries, directory):
    broad = "--materials broad --gaps --test-objects 42 --presses 6 --fps 5..60 --unknown 0.3 --seed 77".split()
    archive, verdicts = judged(binaries, directory, "thousand", *broad)
    data = {name: archive[name] for name in archive}
    assert len(verdicts) >= 1000, len(verdicts)
    session = onnxruntime.InferenceSession(MODEL)
    worst, worst_shore = 0.0, 0.0
    for press, verdict in enumerate(verdicts):
        probabilities, shore = session.run(["probabilities", "shore"], inputs(data, press))
        ours = [float(verdict[f"probability_{level}"]) for level in range(1, 5)]
        worst = max(worst, np.abs(probabilities[0] - ours).max())
        ours = [float(verdict[name]) for name in ["shore", "shore_low", "shore_high"]]
        # The daemon puts the interval's ends in order, and bounds all to 0 to 100.
        value, low, high = np.clip(shore[0], 0, 100)
        theirs = [value, min(value, low), max(value, high)]
        worst_shore = max(worst_shore, np.abs(np.subtract(theirs, ours)).max())
    assert worst < 1e-4 and worst_shore < 0.01, (worst, worst_shore)
    print(f"onnxruntime {onnxruntime.__version__}: {len(verdicts)} presses, probabilities off by at most "
          f"{worst:.1e}, Shore by {worst_shore:.4f}")


def rates_agree(binaries, directory, objects):
    """The same seed presses the same objects with the same forces, whatever the frame rate."""
    for name, materials in [("broad", ["--materials", "broad", "--gaps"]), ("named", ["--all-test"])]:
        options = [*materials, "--shapes", "wide", "--test-objects", objects, "--presses", "3", "--seed", "78"]
        levels = []
        for rate in ["5", "20", "100"]:
            data, verdicts = judged(binaries, directory, f"at{rate}", *options, "--fps", f"{rate}..{rate}")
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
        onnxruntime_agrees(binaries, directory)
        rates_agree(binaries, directory, objects)


if __name__ == "__main__":
    main(*sys.argv[1:])
