"""`python3 -m hardnessd.plot RUN | evaluation.json | fit.json | data.npz`: pictures of a training, of figures, of presses.

A run directory of `hrn-train train` becomes its learning curves, and the figures of its evaluation. A file of `hrn-train
evaluate --json` becomes a confusion matrix, and how often each confidence is right. A file of `hrn-train fit --json`
becomes the candidates, the confusion of the best one and its wrong presses. A data set becomes presses as pictures.

It needs matplotlib and numpy: pip install './clients/python[plot]'
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import pathlib
from typing import Any, Dict, List, Tuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from hardnessd.dataset import best_frames  # noqa: E402
from hardnessd.files import ending, reading, save  # noqa: E402

# Pictures of a level.
SHOWN = 8
# A course from the frame that began it is shown in so many frames.
MOMENTS = 8
# Wrong presses that are named.
NAMED = 24


def curves(axes: Any, path: pathlib.Path) -> None:
    """Losses of each stage over its steps, and accuracies on the right axis."""
    stages: Dict[str, List[Dict[str, str]]] = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            stages.setdefault(row["stage"], []).append(row)
    right = axes.twinx()
    before = 0
    for stage, rows in stages.items():
        steps = [before + int(row["step"]) for row in rows]
        for column, line in (("loss", "-"), ("validation_loss", "--"), ("generator_loss", ":")):
            found = [(step, float(row[column])) for step, row in zip(steps, rows) if row[column]]
            if found:
                axes.plot(*zip(*found), line, label=f"{stage}: {column.replace('_', ' ')}")
        for column in ("accuracy", "validation_accuracy"):
            found = [(step, 100 * float(row[column])) for step, row in zip(steps, rows) if row[column]]
            if found:
                right.plot(*zip(*found), ":", alpha=0.6, label=f"{stage}: {column.replace('_', ' ')}")
        before = steps[-1]
    axes.set(title="learning", xlabel="steps", ylabel="loss")
    right.set_ylabel("accuracy, %")
    lines = [line for side in (axes, right) for line in side.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], fontsize=7)


def confusion(axes: Any, confused: List[List[int]], levels: List[str], title: str) -> None:
    """Counts of truth and verdict; the colour is the share of the true level."""
    counts = np.array(confused, float)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, vmin=0, vmax=1, cmap="Blues")
    for truth, said in np.ndindex(*counts.shape):
        colour = "white" if shares[truth, said] > 0.6 else "black"
        axes.text(said, truth, f"{counts[truth, said]:.0f}", ha="center", va="center", color=colour)
    axes.set_xticks(range(len(levels)), levels)
    axes.set_yticks(range(len(levels)), levels)
    axes.set(title=title, xlabel="level of the verdict", ylabel="true level")


def reliability(axes: Any, figures: Dict[str, Any]) -> None:
    """The share of right verdicts against the stated confidence; a dot's area is the number of presses."""
    bins = [one for one in figures["calibration"] if one["samples"]]
    samples = np.array([one["samples"] for one in bins], float)
    confidence = np.array([one["confidence"] for one in bins]) / samples
    right = np.array([one["right"] for one in bins]) / samples
    axes.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axes.plot(confidence, right, color="C0", linewidth=1)
    axes.scatter(confidence, right, s=10 + 300 * samples / samples.sum())
    title = f"reliability, off by {figures['ece']:.2f}"
    axes.set(title=title, xlabel="stated confidence", ylabel="share of right verdicts", xlim=(0, 1), ylim=(0, 1))


def of_figures(figures: Dict[str, Any], more: int = 0) -> Tuple[Any, List[Any]]:
    """A figure with confusion and reliability, and room for more on their left."""
    count = more + 1 + bool(figures.get("calibration"))
    figure, axes = plt.subplots(1, count, figsize=(5 * count, 4.5), layout="constrained", squeeze=False)
    title = f"accuracy {100 * figures['accuracy']:.1f} %"
    if figures.get("balanced_accuracy") is not None:
        title += f", balanced {100 * figures['balanced_accuracy']:.1f} %"
    levels = [str(level) for level in range(1, len(figures["confusion"]) + 1)]
    confusion(axes[0][more], figures["confusion"], levels, title)
    if figures.get("calibration"):
        reliability(axes[0][more + 1], figures)
    return figure, list(axes[0])


def of_fit(report: Dict[str, Any]) -> Any:
    """The candidates with their intervals, the confusion of the best one, and its wrong presses."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    rows = [row for row in report["candidates"] + report["controls"] if not row["left_out"]][::-1]
    for offset, (key, name) in enumerate((("later_presses", "later presses"), ("new_objects", "new objects"))):
        found = [(place, row[key]) for place, row in enumerate(rows) if row[key]]
        shares = [100 * one["balanced_accuracy"] for _, one in found]
        left.barh([place + 0.4 * offset - 0.2 for place, _ in found], shares, 0.38, label=name)
        for (place, one), share in zip(found, shares):
            if one["interval"]:
                low, high = (100 * end for end in one["interval"])
                ends = [[share - low], [high - share]]
                left.errorbar(share, place + 0.4 * offset - 0.2, xerr=ends, color="black", capsize=2)
    left.set_yticks(range(len(rows)), [row["name"] for row in rows])
    left.set(title=f"{report['presses']} presses", xlabel="balanced accuracy, %", xlim=(0, 100))
    left.legend(fontsize=8)
    best = f"{report['best']}, {(report['chosen_by'] or '').replace('_', ' ')}" if report["best"] else "none is best"
    confusion(middle, report["confusion"], [level["label"] for level in report["levels"]], best)
    wrong = [f"{one['press']}: {one['level']}, said {one['said']}" for one in report["wrong"]]
    more = [f"and {len(wrong) - NAMED} more"] if len(wrong) > NAMED else []
    right.axis("off")
    right.set_title(f"{len(wrong)} wrong presses")
    right.text(0, 1, "\n".join(wrong[:NAMED] + more), va="top", fontsize=7, wrap=True, transform=right.transAxes)
    return figure


def json_of(path: pathlib.Path) -> Any:
    with reading(path, "not JSON"):
        return json.loads(path.read_text(encoding="utf-8"))


def of_json(path: pathlib.Path) -> Any:
    report = json_of(path)
    keys = set(report) if isinstance(report, dict) else set()
    if not keys & {"candidates", "confusion"}:
        found = f"the keys {', '.join(sorted(keys)[:4])}" if keys else f"a {type(report).__name__}"
        raise ValueError(f"found {found}, expected `hrn-train fit --json`, `evaluate --json` of one model, or a run directory")
    return of_fit(report) if "candidates" in keys else of_figures(report)[0]


def of_run(path: pathlib.Path) -> Any:
    """Learning curves, and the figures of the evaluation if the run has ended."""
    evaluation = path / "evaluation.json"
    if evaluation.exists():
        figure, axes = of_figures(json_of(evaluation), 1)
        curves(axes[0], path / "metrics.csv")
        return figure
    figure, one = plt.subplots(figsize=(7, 4.5), layout="constrained")
    curves(one, path / "metrics.csv")
    return figure


def of_data(path: pathlib.Path) -> Any:
    """Presses of each level. Of presses over time, one press of each level from its beginning to its end, too."""
    data, _ = best_frames(path)
    frames, level = data["frames"], data["level"]
    rows: List[Tuple[str, Any]] = []
    for one in np.unique(level):
        places = np.flatnonzero(level == one)
        chosen = places[np.linspace(0, len(places) - 1, min(SHOWN, len(places))).astype(int)]
        name = f"level {one}" if one else "no level"
        rows.append((f"{name}\n{len(places)} presses", frames[chosen]))
        if "frames_mn" in data:
            of_press = np.flatnonzero((data["press"] == chosen[0]) & (data["time_s"] >= 0))
            moments = of_press[np.linspace(0, len(of_press) - 1, min(MOMENTS, len(of_press))).astype(int)]
            rows.append((f"{name}\none press", data["frames_mn"][moments] / 1000))
    figure, axes = plt.subplots(
        len(rows), SHOWN, figsize=(1.3 * SHOWN + 1, 1.5 * len(rows)), layout="constrained", squeeze=False
    )
    for of_row, (name, shown) in zip(axes, rows):
        for place, axis in enumerate(of_row):
            axis.set(xticks=[], yticks=[])
            if place >= len(shown):
                axis.axis("off")
                continue
            # The root of the force for the colour, because most taxels have little of it.
            axis.imshow(np.sqrt(np.maximum(shown[place], 0)), vmin=0)
            axis.set_title(f"{shown[place].sum():.1f} N", fontsize=7)
        of_row[0].axis("on")
        of_row[0].set_ylabel(name, fontsize=8)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(prog="python3 -m hardnessd.plot", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("path", type=pathlib.Path, help="a run directory, a file of `evaluate --json` or `fit --json`, or a data set")
    parser.add_argument(
        "--out", type=pathlib.Path, metavar="P.png",
        help="the picture; an old one is replaced [default: beside the input, where none may be]",
    )
    given = parser.parse_args()
    path = given.path
    draw = of_run if path.is_dir() else of_data if path.suffix == ".npz" else of_json
    out = given.out or (path / "run.png" if path.is_dir() else path.with_suffix(".png"))
    picture = io.BytesIO()
    with ending(out):
        with reading(path, "cannot be drawn"):
            figure = draw(path)
        with reading(out, "cannot be drawn"):
            figure.savefig(picture, dpi=110, format=out.suffix[1:] or "png")
        save(out, picture.getvalue(), "wb" if given.out else "xb")
    print(out)


if __name__ == "__main__":
    main()
