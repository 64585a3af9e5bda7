#!/usr/bin/env python3
"""Draws docs/results.png from results/quick/objects.csv.

    pip install matplotlib numpy scipy && python results/chart.py
"""

import pathlib

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

import intervals  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
METHODS = {
    "hrn15-strong": "hrn15-strong (no GAN, a good recipe)",
    "features-1500": "features (18 hand-made features)",
    "sgan": "sgan (one GAN, Odena)",
    "igan": "igan (one GAN, Salimans)",
    "hrn15-long": "hrn15-long (no GAN, steps of ours)",
    "hrn15-tuned": "hrn15-tuned (no GAN, Adam, stops early)",
    "nihrn": "nihrn (ours without USTGAN's start)",
    "ours": "ours (the paper's method)",
    "hrn15": "hrn15 (no GAN, the paper's baseline)",
    "nahrn": "nahrn (ours without augmentation)",
    "frame": "frame (10,000 labels, default model's method)",
    "hrn100": "hrn100 (10,000 labels, no GAN)",
    "hrn50": "hrn50 (5,000 labels, no GAN)",
}
# Of METHODS, at the end.
WITH_MORE_LABELS = 3
SETS = {
    "matched": "the four test materials, matched shapes",
    "wide": "the four test materials, wide shapes",
    "broad": "random materials, matched shapes",
}


def main():
    figure, panels = plt.subplots(1, len(SETS), figsize=(12, 5), layout="constrained", sharey=True)
    names = list(METHODS)[::-1]
    border = WITH_MORE_LABELS - 0.5
    for axes, (wanted, title) in zip(panels, SETS.items()):
        methods = intervals.read(HERE / "quick/objects.csv", wanted)
        for place, name in enumerate(names):
            mean, low, high = (100 * value for value in intervals.interval(list(methods[name].values()), 0))
            axes.errorbar(mean, place, xerr=[[mean - low], [high - mean]], fmt="o", color="#1f77b4", capsize=3)
        axes.set_title(title, fontsize=10)
        axes.grid(axis="x", alpha=0.3)
        axes.axhline(border, color="grey", linewidth=0.8, linestyle=":")
    panels[0].set_yticks(range(len(names)), [METHODS[name] for name in names])
    figure.supxlabel(
        "accuracy, per cent (three seeds, 95 % interval; above the dotted line 1,500 labels)", fontsize=10
    )
    figure.savefig(HERE.parent / "docs/results.png", dpi=110)


if __name__ == "__main__":
    main()
