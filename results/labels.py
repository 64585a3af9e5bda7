#!/usr/bin/env python3
"""Draws docs/labels.png, accuracy against labels, from results/labels/results.json.

    pip install matplotlib && python results/labels.py
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
    "fixmatch": ("#9467bd", "D", "fixmatch: unlabelled presses, too (one seed)"),
    "features": ("#d62728", "s", "features: logistic regression on 18 features"),
}


def main():
    runs = json.loads((HERE / "labels/results.json").read_text())
    figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    for method, (colour, marker, label) in LOOKS.items():
        seeds = {}
        for run in runs:
            if run["method"] == method:
                seeds.setdefault(run["labels"], []).append(100 * run["matched"]["accuracy"])
        if not seeds:
            continue
        labels = sorted(seeds)
        axes.plot(labels, [sum(seeds[n]) / len(seeds[n]) for n in labels], color=colour, label=label)
        for n in labels:
            axes.plot([n] * len(seeds[n]), seeds[n], marker, color=colour, markersize=5, alpha=0.6)
    axes.set_xscale("log")
    ticks = [60, 150, 375, 1500, 10000]
    axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axes.minorticks_off()
    axes.set_xlabel("labelled presses (50 of an object)")
    axes.set_ylabel("accuracy, per cent; a mark a seed")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(HERE.parent / "docs/labels.png", dpi=110)


if __name__ == "__main__":
    main()
