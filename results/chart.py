#!/usr/bin/env python3
"""Draws docs/results.png from results/quick-three-seeds/tables.md.

    pip install matplotlib && python results/chart.py
"""

import pathlib
import re

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
METHODS = {
    "hrn15-strong": "hrn15-strong (no GAN, a good recipe)",
    "fixmatch, 1,500 labels": "fixmatch (no GAN, unlabelled too)",
    "self-training": "self-training (no GAN, unlabelled too)",
    "features, 1,500 labels": "features (18 hand-made features)",
    "sgan": "sgan (one GAN, Odena)",
    "igan": "igan (one GAN, Salimans)",
    "hrn15-long": "hrn15-long (no GAN, steps of ours)",
    "hrn15-tuned": "hrn15-tuned (no GAN, Adam)",
    "nihrn": "nihrn (ours without USTGAN's start)",
    "ours": "ours (the paper's method)",
    "hrn15": "hrn15 (no GAN, the paper's baseline)",
    "nahrn": "nahrn (ours without augmentation)",
    "frame": "frame (10,000 labels, the default model's)",
    "hrn100": "hrn100 (10,000 labels, no GAN)",
    "hrn50": "hrn50 (5,000 labels, no GAN)",
}
# Of METHODS, at the end.
WITH_MORE_LABELS = 3


def accuracies():
    """Method -> accuracy and its interval, of the first table."""
    text = (HERE / "quick-three-seeds/tables.md").read_text().split("## Table 2")[0]
    found = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        interval = re.fullmatch(r"([\d.]+) to ([\d.]+)", cells[3]) if len(cells) == 8 else None
        if interval:
            found[cells[0]] = float(cells[2].split()[0]), float(interval[1]), float(interval[2])
    return found


def main():
    figure, axes = plt.subplots(figsize=(8, 5.6), layout="constrained")
    names = list(METHODS)[::-1]
    found = accuracies()
    values = [found[name] for name in names]
    axes.errorbar(
        [value for value, _, _ in values],
        range(len(names)),
        xerr=[[value - low for value, low, _ in values], [high - value for value, _, high in values]],
        fmt="o", capsize=3, markersize=6,
    )
    axes.set_yticks(range(len(names)), [METHODS[name] for name in names])
    axes.set_xlim(45, 95)
    axes.set_xlabel("accuracy on other materials, per cent (three seeds, 95 % interval)")
    axes.grid(axis="x", alpha=0.3)
    border = WITH_MORE_LABELS - 0.5
    axes.axhline(border, color="grey", linewidth=0.8, linestyle=":")
    axes.text(94.5, border + 0.12, "above: 1,500 labels; below: more", color="grey", fontsize=8, ha="right")
    figure.savefig(HERE.parent / "docs/results.png", dpi=110)


if __name__ == "__main__":
    main()
