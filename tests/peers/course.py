#!/usr/bin/env python3
"""The course model on the same presses in tract and onnxruntime, and at three frame rates.

    python tests/peers/course.py target/debug [OBJECTS]

Claims: of simulated presses, onnxruntime's bins give the probabilities and Shore hardness that the daemon's own code
says, without references and with two presses of each rigid piece, and a press that a sensor sees at 5, 20 and 100
frames/s gets the same level in most cases. OBJECTS: how many of each level; 6 by default.
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
# References of a sensor, and numbers that the model keeps of each.
REFERENCES = (32, 64)
FLAT, BALL = 1, 2
# The ends of the levels' parts of the scale, in Shore OO, the hardest first.
BORDERS = [100, 70, 60, 50]


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


def inputs(data, press, features):
    """A press as docs/formats.md describes the inputs of format 3, on a sensor without references."""
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
        "piece": np.zeros((1, 7), np.float32),
        "references": np.zeros((1, *REFERENCES), np.float32),
        "given": np.zeros((1, REFERENCES[0]), np.float32),
        "features": features[press][None],
    }


def with_references(session, data, features, sensor):
    """The inputs `references` and `given` of a sensor, of two presses of each of its rigid pieces."""
    references, given = np.zeros((1, *REFERENCES), np.float32), np.zeros((1, REFERENCES[0]), np.float32)
    chosen = []
    for kind in [FLAT, BALL]:
        presses = np.flatnonzero((data["sensor"] == sensor) & (data["reference"] == kind))
        chosen += [presses[number * len(presses) // 2 - 1] for number in [1, 2]]
    for place, press in enumerate(chosen):
        told = inputs(data, press, features)
        size = data["reference_mm"][press]
        told["piece"][0, :4] = [1, size, 0, 0] if data["reference"][press] == FLAT else [0, 0, 1, size]
        references[0, place] = session.run(["reference"], told)[0]
        given[0, place] = 1
    return {"references": references, "given": given}


def said(bins):
    """Probabilities of the levels, and Shore hardness with its interval, of the logits of the bins."""
    shares = np.exp(bins.astype(np.float64) - bins.max())
    ends = np.linspace(0, 100, len(bins) + 1)
    below = np.concatenate([[0], np.cumsum(shares / shares.sum())])
    of_levels = np.diff(np.interp([*BORDERS, 0][::-1], ends, below))[::-1]
    level = of_levels.argmax()
    middle = np.interp([BORDERS[level], [*BORDERS, 0][level + 1]], ends, below).mean()
    value, low, high = np.interp([middle, 0.05, 0.95], below, ends)
    return of_levels, [value, min(low, value), max(high, value)]


def onnxruntime_agrees(binaries, directory):
    session = onnxruntime.InferenceSession(MODEL)
    broad = "--materials broad --gaps --presses 6 --unknown 0.3 --seed 77".split()
    for name, options, given in [
        ("thousand", ["--test-objects", "42", "--fps", "5..60"], []),
        ("sensors", "--sensors broad --test-objects 4 --test-covers 4 --electronics 2".split(), ["--rigid", "2"]),
    ]:
        data = simulated(binaries, directory, name, *broad, *options)
        verdicts = judged(binaries, directory, name, "--features", f"{name}-features.csv", *given)
        features = np.loadtxt(pathlib.Path(directory, f"{name}-features.csv"), np.float32, delimiter=",")
        presses = np.flatnonzero(data["level"] > 0)
        assert len(verdicts) == len(presses), (len(verdicts), len(presses))
        references = {}
        if given:
            for sensor in np.unique(data["sensor"][presses]):
                references[sensor] = with_references(session, data, features, sensor)
        worst, worst_shore = 0.0, 0.0
        for press, verdict in zip(presses, verdicts):
            told = inputs(data, press, features)
            told.update(references[data["sensor"][press]] if given else {})
            of_levels, shore = said(session.run(["bins"], told)[0][0])
            ours = [float(verdict[f"probability_{level}"]) for level in range(1, 5)]
            worst = max(worst, np.abs(of_levels - ours).max())
            ours = [float(verdict[name]) for name in ["shore", "shore_low", "shore_high"]]
            worst_shore = max(worst_shore, np.abs(np.subtract(shore, ours)).max())
        print(f"onnxruntime {onnxruntime.__version__}, {name}: {len(verdicts)} presses, probabilities off by at most "
              f"{worst:.1e}, Shore by {worst_shore:.4f}")
        assert len(verdicts) >= 100 and worst < 1e-4 and worst_shore < 0.01


def rates_agree(binaries, directory, objects):
    """The same seed presses the same objects with the same forces, whatever the frame rate."""
    for name, materials in [("broad", ["--materials", "broad", "--gaps"]), ("named", ["--all-test"])]:
        options = [*materials, "--shapes", "wide", "--test-objects", objects, "--presses", "3", "--seed", "78"]
        levels = []
        for rate in ["5", "20", "100"]:
            data = simulated(binaries, directory, f"{name}-{rate}", *options, "--fps", f"{rate}..{rate}")
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
        onnxruntime_agrees(binaries, directory)
        rates_agree(binaries, directory, objects)


if __name__ == "__main__":
    main(*sys.argv[1:])
