#!/usr/bin/env python3
"""Draws results/paper-steps.png from results/paper/results.json: accuracy with the paper's own number of steps.

    pip install matplotlib && python results/paper_steps.py
"""

import json
import pathlib

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
# Method -> its description, and the paper's accuracy on its own test split (Table 2).
METHODS = {
    "hrn15": ("1,500 labels, no GAN", 64.2),
    "nahrn": ("ours without augmentation", 85.7),
    "nihrn": ("ours without USTGAN's start", 90.1),
    "ours": ("the paper's method", 94.4),
    "ours-steady": ("ours, GAN does not break", None),
    "sgan": ("one GAN, Odena", 86.2),
    "igan": ("one GAN, Salimans", 87.8),
    "hrn50": ("5,000 labels, no GAN", 86.6),
    "hrn100": ("10,000 labels, no GAN", 95.9),
    "hrn15-long": ("no GAN, the steps of ours", None),
    "hrn15-tuned": ("no GAN, Adam, stops early", None),
    "hrn15-strong": ("no GAN, a good recipe", None),
    "features": ("1,500 labels, 18 hand-made features", None),
    "frame": ("10,000 labels, default model's method", None),
}
LABELS = {"hrn50": 5_000, "hrn100": 10_000, "frame": 10_000}
SETS = {
    "paper_split": ("#1f77b4", "o", "test split, as in the paper"),
    "matched": ("#ff7f0e", "s", "fresh presses, `matched` shapes"),
    "wide": ("#2ca02c", "^", "fresh presses, `wide` shapes"),
}


def main():
    runs = json.loads((HERE / "paper/results.json").read_text())
    figure, axes = plt.subplots(figsize=(8.4, 0.42 * len(METHODS) + 1.2), layout="constrained")
    names = []
    for method, (what, _) in METHODS.items():
        own = [run for run in runs if run["method"] == method and run["label_choice"] == "object"]
        own = [run for run in own if run["labels"] == LABELS.get(method, 1_500)]
        if own:
            seeds = "1 seed" if len(own) == 1 else f"{len(own)} seeds"
            names.append((method, f"{method} ({what}), {seeds}", own))
    names.reverse()
    for place, (method, _, own) in enumerate(names):
        for shift, (key, (colour, marker, label)) in zip((0.22, 0, -0.22), SETS.items()):
            found = [(run | run["shifts"])[key] for run in own]
            percents = [100 * one["accuracy"] for one in found if one]
            if not percents:
                continue
            at = [place + shift] * len(percents)
            axes.plot(percents, at, "|", color=colour, markersize=9, alpha=0.7)
            mean = sum(percents) / len(percents)
            first = place == len(names) - 1
            axes.plot([mean], [place + shift], marker, color=colour, label=label if first else None)
        paper = METHODS[method][1]
        if paper is not None:
            first = place == len(names) - 1
            label = "the paper's figure, on its own data" if first else None
            axes.plot([paper], [place + 0.13], "o", mfc="none", mec="black", markersize=9, label=label)
    axes.set_yticks(range(len(names)), [title for _, title, _ in names])
    axes.set_xlabel("accuracy, per cent (strokes: seeds; mark: mean)")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(HERE.parent / "results/paper-steps.png", dpi=110)


if __name__ == "__main__":
    main()
