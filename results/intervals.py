#!/usr/bin/env python3
"""Accuracies or their differences, with 95 % intervals, computed again from the committed counts of objects.

    pip install numpy scipy
    python3 results/intervals.py results/paper                            # accuracies, set `matched`
    python3 results/intervals.py results/paper --less hrn15               # each accuracy minus that of hrn15
    python3 results/intervals.py results/paper --set fresh                # another set of objects.csv

A difference is taken object by object under the same seed, so what is hard for both methods cancels out.

With one seed, the interval is that of a bootstrap over the geometries, or over the objects of each level where the
set has no geometries. With several seeds, the variance of the mean over the seeds is added, and the interval is
Student's, with the degrees of freedom of Welch and Satterthwaite. Draws of n units out of n vary less than new units
would, by (n - 1) / n: their spread is widened by the root of n / (n - 1).
"""

import argparse
import collections
import csv
import math
import pathlib
import re

import numpy
import scipy.stats

DRAWS = 20_000


def read(path, wanted):
    """Right and all samples, by method, seed, stratum and cluster."""
    counts = collections.defaultdict(lambda: collections.defaultdict(dict))
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            if row["set"] != wanted:
                continue
            method, seed = re.fullmatch(r"(.+)-(\d+)", row["run"]).groups()
            paired = row["geometry"] != ""
            cluster = ("", row["geometry"]) if paired else (row["level"], row["object"])
            sums = counts[method][int(seed)].setdefault(cluster, [0, 0])
            sums[0] += int(row["right"])
            sums[1] += int(row["samples"])
    return counts


def less(seeds, others):
    """[right minus the other method's right, samples] by cluster, of the seeds that both methods have."""
    return [
        {
            cluster: [right - others[seed][cluster][0], samples]
            for cluster, (right, samples) in seeds[seed].items()
        }
        for seed in sorted(seeds.keys() & others.keys())
    ]


def redrawn(draw, units):
    """Sums of as many units, drawn at random, of [unit, right and samples]."""
    count, whole = len(units), units.sum(0)
    sums = units[draw.integers(count, size=(DRAWS, count))].sum(1)
    return whole + math.sqrt(count / max(count - 1, 1)) * (sums - whole)


def interval(seeds, least):
    """The share over all seeds, and its interval, from `least` to 1. `seeds` has [right, samples] by cluster."""
    clusters = sorted(seeds[0])
    sums = numpy.array([[seed[cluster] for cluster in clusters] for seed in seeds], float)
    of_seeds = sums.sum(1)
    mean = sums[:, :, 0].sum() / sums[:, :, 1].sum()
    strata = collections.defaultdict(list)
    for place, (stratum, _) in enumerate(clusters):
        strata[stratum].append(place)
    draw = numpy.random.default_rng(0)
    joined = sums.sum(0)
    drawn = sum(redrawn(draw, joined[places]) for places in strata.values())
    draws = drawn[:, 0] / drawn[:, 1]
    if len(seeds) == 1:
        return mean, *numpy.quantile(draws, [0.025, 0.975])
    means = of_seeds[:, 0] / of_seeds[:, 1]
    parts = [
        (means.var(ddof=1) / len(means), len(means) - 1),
        (draws.var(ddof=1), len(clusters) - len(strata)),
    ]
    total = sum(variance for variance, _ in parts)
    if total == 0:
        return mean, mean, mean
    free = total**2 / sum(variance**2 / degrees for variance, degrees in parts)
    reach = scipy.stats.t.ppf(0.975, free) * total**0.5
    return mean, max(mean - reach, least), min(mean + reach, 1)


def percent(share, sign=""):
    """A share in per cent, with one digit. Halves are rounded away from 0."""
    text = f"{100 * share + math.copysign(1e-9, share):{sign}.1f}"
    return "0.0" if text in ("+0.0", "-0.0") else text


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--set", default="matched")
    parser.add_argument("--less", metavar="METHOD")
    options = parser.parse_args()
    methods = read(options.folder / "objects.csv", options.set)
    if not methods:
        parser.error(f"there is no set {options.set}")
    if options.less and options.less not in methods:
        parser.error(f"found no {options.less}; the methods are {', '.join(methods)}")
    for method, seeds in methods.items():
        if method == options.less:
            continue
        sign, counts, least = "", list(seeds.values()), 0
        if options.less:
            sign, counts, least = "+", less(seeds, methods[options.less]), -1
        if not counts:
            continue
        mean, low, high = (percent(share, sign) for share in interval(counts, least))
        print(f"{method:22} {len(counts)} seeds  {mean}  {low} to {high}")


if __name__ == "__main__":
    main()
