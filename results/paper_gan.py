#!/usr/bin/env python3
"""Draws docs/gan-breaks.png from the runs of `ours` in results/paper: how the USTGAN goes over 500 epochs.

    pip install matplotlib && python results/paper_gan.py
"""

import csv
import pathlib

import matplotlib

matplotlib.use("Agg")
import matplotlib.image  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
RUNS = HERE / "paper/runs"
# Columns of metrics.csv -> their description.
CURVES = {
    "loss": "loss of the discriminator",
    "sigma_mean": "mean of sigma",
    "feature_distance": "feature distance to real frames",
}
# Rows of the sheets of samples: the epoch, and the row's place and name.
SHEETS = [(75, 0, "real"), (75, 1, "epoch 75"), (500, 1, "epoch 500")]
# The first row of a sheet, a row's height without its caption, and the distance of two rows, in pixels.
TOP, HEIGHT, STEP = 40, 112, 136
# The first and the last column of pixels with frames.
LEFT, RIGHT = 112, 1544


def main():
    figure = plt.figure(figsize=(10, 6.4), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[1.1, 1])
    for axes, (column, label) in zip(above.subplots(1, len(CURVES)), CURVES.items()):
        for run in sorted(RUNS.glob("ours-[0-9]*")):
            with open(run / "metrics.csv", newline="") as file:
                rows = [row for row in csv.DictReader(file) if row["stage"] == "ustgan" and row[column]]
            epochs, values = [int(row["epoch"]) for row in rows], [float(row[column]) for row in rows]
            axes.plot(epochs, values, linewidth=1.2, label=f"seed {run.name.split('-')[1]}")
        axes.set_yscale("linear" if column == "feature_distance" else "log")
        axes.set_title(label, fontsize=9)
        axes.set_xlabel("epoch", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    for axes, (epoch, row, name) in zip(below.subplots(len(SHEETS), 1), SHEETS):
        sheet = matplotlib.image.imread(RUNS / f"ours-1/samples/ustgan-{epoch:06}.png")
        top = TOP + row * STEP
        axes.imshow(sheet[top : top + HEIGHT, LEFT:RIGHT])
        axes.set_axis_off()
        axes.set_title(f"{name}, seed 1" if row else name, fontsize=9, loc="left")
    figure.savefig(HERE.parent / "docs/gan-breaks.png", dpi=110)


if __name__ == "__main__":
    main()
