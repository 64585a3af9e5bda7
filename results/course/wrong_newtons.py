#!/usr/bin/env python3
"""The presses of a data set with wrong newtons: those of each sensor times a factor of its own.

    pip install numpy
    python3 results/course/wrong_newtons.py m1.npz m1-wrong.npz --share 0.5 --seed 1     # of half of the sensors

Factors are from 0.5 to 2, spread evenly over their logarithm.
"""

import argparse

FACTORS = (0.5, 2.0)
AT_ONCE = 50_000


def wrong_newtons(path, out, share=1.0, seed=2):
    """Writes the data set at `path` with wrong newtons of this share of its sensors, and returns where it is."""
    import numpy

    data = dict(numpy.load(path))
    random = numpy.random.default_rng(seed)
    sensors = data["sensor"].max() + 1
    factors = numpy.exp(random.uniform(*numpy.log(FACTORS), sensors))
    factors = numpy.where(random.random(sensors) < share, factors, 1.0)[data["sensor"]]
    frames = data["frames_mn"]
    for first in range(0, len(frames), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        scaled = frames[rows] * factors[data["press"][rows]][:, None, None]
        frames[rows] = numpy.clip(numpy.round(scaled), -32768, 32767).astype(numpy.int16)
    numpy.savez(out, **data)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("out")
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=2)
    given = parser.parse_args()
    wrong_newtons(given.data, given.out, given.share, given.seed)
