#!/usr/bin/env python3
"""Draws docs/labels.png, accuracy against labels, and prints the tables of that section of docs/results.md.

    pip install matplotlib numpy scipy && python results/labels.py

`fixmatch` is in results/quick/results.json, the other methods are in results/labels/results.json. Both
comparisons learnt from the same data under the same seeds. Runs that are in both have the same accuracies: the script
ends with an error if one differs.

Intervals of differences with 1,500 labels are those of intervals.py, over seeds and shapes. With fewer labels there are
no counts of objects: those intervals are Student's over the seeds alone, and too narrow.
"""

import json
import pathlib
import statistics

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import scipy.stats  # noqa: E402

import intervals  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
LOOKS = {
    "hrn15-strong": ("#1f77b4", "o", "hrn15-strong: the labels alone, a good recipe"),
    "self-training": ("#2ca02c", "^", "self-training: unlabelled presses, too"),
    "fixmatch": ("#9467bd", "D", "fixmatch: unlabelled presses, too"),
    "features": ("#d62728", "s", "features: logistic regression on 18 features"),
}
# Set -> its description.
SETS = {
    "matched": "the four test materials, matched shapes",
    "wide": "the four test materials, wide shapes",
    "broad": "random materials, matched shapes",
    "broad_wide": "random materials, wide shapes",
}
BUDGETS = (60, 150, 375, 1500, 10000)


def accuracies(folder, wanted):
    """(method, labels) -> seed -> accuracy in per cent, of the runs whose labels are of whole objects."""
    found = {}
    for run in json.loads((HERE / folder / "results.json").read_text()):
        if run["method"] in LOOKS and run["label_choice"] == "object":
            seeds = found.setdefault((run["method"], run["labels"]), {})
            seeds[run["seed"]] = 100 * ({"matched": run["matched"]} | run["shifts"])[wanted]["accuracy"]
    return found


def joined(wanted):
    """The accuracies on a set of both comparisons."""
    runs, later = accuracies("labels", wanted), accuracies("quick", wanted)
    for shared in runs.keys() & later.keys():
        assert runs[shared] == later[shared], f"{shared} differs: {runs[shared]}, {later[shared]}"
    return runs | later


def signed(mean, low, high):
    return f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"


def difference(wanted, runs, method, labels):
    """A method's accuracy less that of hrn15-strong under the same seeds, in points, with its 95 % interval."""
    seeds, others = runs[method, labels], runs["hrn15-strong", labels]
    if labels == 1500:
        counts = intervals.read(HERE / "quick/objects.csv", wanted)
        pairs = intervals.less(counts[method], counts["hrn15-strong"])
        return signed(*(100 * value for value in intervals.interval(pairs, -1)))
    values = [seeds[seed] - others[seed] for seed in seeds]
    mean = statistics.mean(values)
    reach = scipy.stats.t.ppf(0.975, len(values) - 1) * statistics.stdev(values) / len(values) ** 0.5
    return signed(mean, mean - reach, mean + reach)


def tables():
    for wanted, title in SETS.items():
        runs = joined(wanted)
        print(f"{title}\n| Labels |", " | ".join(LOOKS), "|")
        for labels in BUDGETS:
            cells = (runs.get((method, labels)) for method in LOOKS)
            print(f"| {labels:,} |", " | ".join(f"{statistics.mean(c.values()):.1f} %" if c else "" for c in cells), "|")
        print("less hrn15-strong")
        for labels in BUDGETS[:-1]:
            cells = (difference(wanted, runs, method, labels) for method in ("self-training", "fixmatch"))
            print(f"| {labels:,} |", " | ".join(cells), "|")
        print()


def draw(axes, runs, title):
    for shift, (method, (colour, marker, label)) in zip((0.955, 0.985, 1.015, 1.045), LOOKS.items()):
        labels = sorted(number for name, number in runs if name == method)
        means = [sum(runs[method, n].values()) / len(runs[method, n]) for n in labels]
        # Side by side, so that no method's marks hide another's.
        places = [n * shift for n in labels]
        axes.plot(places, means, color=colour, label=label)
        for n, place in zip(labels, places):
            seeds = runs[method, n].values()
            axes.plot([place] * len(seeds), list(seeds), marker, color=colour, markersize=5, alpha=0.6)
    axes.set_xscale("log")
    axes.set_xticks(BUDGETS, [f"{n:,}" for n in BUDGETS])
    axes.minorticks_off()
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)


def main():
    tables()
    figure, grid = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharex=True)
    for axes, (wanted, title) in zip(grid.flat, SETS.items()):
        draw(axes, joined(wanted), title)
    for axes in grid[1]:
        axes.set_xlabel("labelled presses (50 of an object)")
    figure.supylabel("accuracy, per cent (a mark for each seed)", fontsize=10)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2)
    figure.savefig(HERE.parent / "docs/labels.png", dpi=110)


if __name__ == "__main__":
    main()
