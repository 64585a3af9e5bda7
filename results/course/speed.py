#!/usr/bin/env python3
"""Accuracy of a course model if the robot sends no positions, but its speed is known.

    hrn-train simulate --sequences --seed 51 --objects 0 --test-objects 60 --presses 6 --fps 20..20 \\
        --materials broad --gaps --shapes matched --out others.npz
    pip install numpy onnxruntime
    python3 results/course/speed.py models/course.onnx others.npz

It does what the daemon does with `speed_mm_s`: the arm stops at the first frame with 95 % of the greatest
force, and stays there until the force falls below 80 % of it. Then the approach is unknown.
"""

import sys

import numpy
import onnxruntime

FRAMES = 48
STOPS, LEAVES = 0.95, 0.8


def thinned(count, best):
    """At most FRAMES of `count` frames: evenly spaced, with the first, the best and the last."""
    if count <= FRAMES:
        return numpy.arange(count)
    places = set(numpy.linspace(0, count - 1, FRAMES - 1).round().astype(int)) | {best}
    return numpy.array(sorted(places))


def with_speed(force, approach):
    """The approach that follows from the speed, and where it is known."""
    stop = numpy.argmax(force >= STOPS * force.max())
    peak = force.argmax()
    falls = numpy.flatnonzero(force[peak:] < LEAVES * force.max())
    end = peak + falls[0] if len(falls) else len(force)
    held = numpy.where(numpy.arange(len(force)) < stop, approach, approach[stop])
    return held, (numpy.arange(len(force)) < end).astype(numpy.float32)


def main():
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(sys.argv[1], options)
    for path in sys.argv[2:]:
        with numpy.load(path) as packed:
            data = dict(packed)
        right = {"positions": 0, "speed": 0, "none": 0}
        presses = len(data["level"])
        for press in range(presses):
            rows = numpy.flatnonzero((data["press"] == press) & (data["time_s"] >= 0))
            frames = data["frames_mn"][rows].astype(numpy.float32) * 1e-3
            force = frames.sum((1, 2))
            approach = data["approach_mm"][rows]
            every = numpy.ones(len(rows), numpy.float32)
            known = {
                "positions": (approach, every),
                "speed": with_speed(force, approach),
                "none": (approach, 0 * every),
            }
            places = thinned(len(rows), (frames > 0).sum((1, 2)).argmax())

            def padded(values):
                whole = numpy.zeros((1, FRAMES, *values.shape[1:]), numpy.float32)
                whole[0, : len(places)] = values[places]
                return whole

            for name, (mm, is_known) in known.items():
                arm = data["arm_n_per_mm"][press] if is_known.any() else 0
                inputs = {
                    "frames": padded(frames),
                    "time_s": padded(data["time_s"][rows]),
                    "approach_mm": padded(mm * is_known),
                    "known": padded(is_known),
                    "mask": padded(every),
                    "arm_n_per_mm": numpy.array([[arm]], numpy.float32),
                }
                logits = session.run(["logits"], inputs)[0][0]
                right[name] += logits.argmax() + 1 == data["level"][press]
        shares = ", ".join(f"{name} {100 * count / presses:.1f} %" for name, count in right.items())
        print(f"{path}: {presses} presses: right with {shares}", flush=True)


main()
