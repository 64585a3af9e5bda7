#!/usr/bin/env python3
"""Accuracies and their 95 % intervals, computed again from the committed counts of objects.

    pip install numpy scipy
    python3 results/intervals.py results/quick [SET]        # SET: matched unless you name another

With one seed, the interval is that of a bootstrap over the geometries, or over the objects of each level where the
set has no geometries. With several seeds, the variance of the mean over the seeds is added, and the interval is
Student's, with the degrees of freedom of Welch and Satterthwaite. The draws are not those of hrn-train, so the ends
may differ by some tenths of a point.
"""

import collections
import csv
import pathlib
import re
import sys

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


def interval(seeds):
    """The accuracy over all seeds, and its interval. `seeds` has [right, samples] by cluster."""
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
    free = total**2 / sum(variance**2 / degrees for variance, degrees in parts)
    reach = scipy.stats.t.ppf(0.975, free) * total**0.5
    return mean, max(mean - reach, 0), min(mean + reach, 1)


def main():
    folder = pathlib.Path(sys.argv[1])
    wanted = sys.argv[2] if len(sys.argv) > 2 else "matched"
    for method, seeds in read(folder / "objects.csv", wanted).items():
        mean, low, high = interval(list(seeds.values()))
        print(f"{method:22} {len(seeds)} seeds  {100 * mean:.1f}  {100 * low:.1f} to {100 * high:.1f}")


main()
