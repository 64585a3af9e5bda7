#!/usr/bin/env python3
"""Accuracies or their differences, with 95 % intervals, computed again from the committed counts of objects.

    pip install numpy scipy
    python3 results/intervals.py results/quick                            # accuracies, set `matched`
    python3 results/intervals.py results/quick --less hrn15               # each accuracy minus that of hrn15
    python3 results/intervals.py results/quick --set fresh                # another set of objects.csv
    python3 results/intervals.py results/course --set others-matched      # a set of course.json

A difference is taken object by object under the same seed, so what is hard for both methods cancels out.

With one seed, the interval is that of a bootstrap over the geometries, or over the objects of each level where the
set has no geometries. With several seeds, the variance of the mean over the seeds is added, and the interval is
Student's, with the degrees of freedom of Welch and Satterthwaite. The draws are not those of hrn-train, so the ends
may differ by some tenths of a point.
"""

import argparse
import collections
import csv
import json
import math
import pathlib
import re

import numpy
import scipy.stats

DRAWS = 20_000


def of_objects(objects, geometries):
    """[right, samples] by cluster. Objects whose numbers are equal modulo `geometries` are pressed alike."""
    sums = {}
    for number, right, samples in objects:
        own = sums.setdefault(("", number % geometries), [0, 0])
        own[0] += right
        own[1] += samples
    return sums


def read_course(path, wanted):
    """Right and all samples, by model, seed and cluster. Each shape has four objects, whose numbers are equal modulo a
    quarter of the number of objects."""
    counts = {}
    for model in json.loads(path.read_text()):
        for found in model["sets"]:
            if found["set"] == wanted:
                objects = [(one["object"], one["right"], one["samples"]) for one in found["objects"]]
                counts[model["name"]] = {1: of_objects(objects, len(objects) // 4)}
    return counts


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
    drawn = sum(
        joined[draw.choice(places, (DRAWS, len(places)))].sum(1) for places in strata.values()
    )
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
    course = options.folder / "course.json"
    is_course = course.exists()
    methods = read_course(course, options.set) if is_course else read(options.folder / "objects.csv", options.set)
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
