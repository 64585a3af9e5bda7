#!/usr/bin/env python3
"""Draws docs/labels.png, accuracy against labels, and prints the tables of that section of docs/results.md.

    pip install matplotlib numpy scipy && python results/labels.py

It reads the counts of every object in results/labels/objects.csv. The intervals are those of intervals.py, over seeds
and shapes.
"""

import pathlib
import statistics

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

import intervals  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
LOOKS = {
    "hrn15-strong": ("#1f77b4", "o", "hrn15-strong: the labels alone, a good recipe"),
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


def counted(wanted):
    """(method, labels) -> the counts of its seeds. The name of a run has its labels unless they are the method's own."""
    counts = intervals.read(HERE / "labels/objects.csv", wanted)
    found = {}
    for method in LOOKS:
        own = 10_000 if method == "features" else 1_500
        for labels in BUDGETS:
            name = method if labels == own else f"{method}-{labels}"
            if name in counts:
                found[method, labels] = counts[name]
    return found


def accuracies(seeds):
    """The accuracy of each seed."""
    sums = ([sum(column) for column in zip(*counts.values())] for counts in seeds.values())
    return [right / samples for right, samples in sums]


def difference(runs, method, labels):
    """A method's accuracy minus that of hrn15-strong, in points, with its 95 % interval."""
    pairs = intervals.less(runs[method, labels], runs["hrn15-strong", labels])
    mean, low, high = (intervals.percent(share, "+") for share in intervals.interval(pairs, -1))
    return f"{mean} ({low} to {high})"


def tables():
    for wanted, title in SETS.items():
        runs = counted(wanted)
        print(f"{title}\n| Labels |", " | ".join(LOOKS), "|")
        for labels in BUDGETS:
            cells = (runs.get((method, labels)) for method in LOOKS)
            cells = (f"{intervals.percent(statistics.mean(accuracies(seeds)))} %" if seeds else "" for seeds in cells)
            print(f"| {labels:,} |", " | ".join(cells), "|")
        print("minus hrn15-strong")
        for labels in BUDGETS[:-1]:
            print(f"| {labels:,} | {difference(runs, 'features', labels)} |")
        print()


def draw(axes, runs, title):
    for shift, (method, (colour, marker, label)) in zip((0.985, 1.015), LOOKS.items()):
        own = [(labels, accuracies(seeds)) for (name, labels), seeds in runs.items() if name == method]
        found = {labels: [100 * share for share in shares] for labels, shares in own}
        # Side by side, so that no method's marks hide another's.
        places = [labels * shift for labels in found]
        axes.plot(places, [statistics.mean(seeds) for seeds in found.values()], color=colour, label=label)
        for place, seeds in zip(places, found.values()):
            axes.plot([place] * len(seeds), seeds, marker, color=colour, markersize=5, alpha=0.6)
    axes.set_xscale("log")
    axes.set_xticks(BUDGETS, [f"{n:,}" for n in BUDGETS])
    axes.minorticks_off()
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)


def main():
    tables()
    figure, grid = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharex=True)
    for axes, (wanted, title) in zip(grid.flat, SETS.items()):
        draw(axes, counted(wanted), title)
    for axes in grid[1]:
        axes.set_xlabel("labelled presses (50 of an object)")
    figure.supylabel("accuracy, per cent (a mark for each seed)", fontsize=10)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2)
    figure.savefig(HERE.parent / "docs/labels.png", dpi=110)


if __name__ == "__main__":
    main()
