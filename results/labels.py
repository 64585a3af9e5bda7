#!/usr/bin/env python3
"""Draws docs/labels.png, accuracy against labels.

    pip install matplotlib && python results/labels.py

`fixmatch` is in results/quick-three-seeds/results.json, the other methods are in results/labels/results.json. Both
comparisons learnt from the same data under the same seeds. Runs that are in both have the same accuracies: the script
ends with an error if one differs.
"""

import json
import pathlib

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
LOOKS = {
    "hrn15-strong": ("#1f77b4", "o", "hrn15-strong: the labels alone, a good recipe"),
    "self-training": ("#2ca02c", "^", "self-training: unlabelled presses, too"),
    "fixmatch": ("#9467bd", "D", "fixmatch: unlabelled presses, too"),
    "features": ("#d62728", "s", "features: logistic regression on 18 features"),
}


def accuracies(folder):
    """(method, labels) -> seed -> accuracy in per cent, of the runs whose labels are of whole objects."""
    found = {}
    for run in json.loads((HERE / folder / "results.json").read_text()):
        if run["method"] in LOOKS and run["label_choice"] == "object":
            seeds = found.setdefault((run["method"], run["labels"]), {})
            seeds[run["seed"]] = 100 * run["matched"]["accuracy"]
    return found


def main():
    runs, later = accuracies("labels"), accuracies("quick-three-seeds")
    for shared in runs.keys() & later.keys():
        assert runs[shared] == later[shared], f"{shared} differs: {runs[shared]}, {later[shared]}"
    runs.update(later)
    figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
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
    ticks = [60, 150, 375, 1500, 10000]
    axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axes.minorticks_off()
    axes.set_xlabel("labelled presses (50 of an object)")
    axes.set_ylabel("accuracy, per cent (a mark for each seed)")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(HERE.parent / "docs/labels.png", dpi=110)


if __name__ == "__main__":
    main()
