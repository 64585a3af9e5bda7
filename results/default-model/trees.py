#!/usr/bin/env python3
"""How much of the level does one frame hold? Boosted trees on many hand-made features of it, beside the default model.

    pip install numpy scikit-learn
    python3 results/default-model/trees.py --data TRAIN.npz ... --test TEST.npz ...
    python3 results/default-model/trees.py --table         # prints the table from the committed file

The files are of `hrn-train simulate`. Of a press over time its frame of the greatest contact area counts. The weight of a
level grows with its number of samples to the power 1 (all samples alike), 0.5, or 0 (all levels alike). trees.json,
beside this file, has the shares of correct levels. Fitting 170,312 frames three times takes 10 minutes of one core.
"""

import argparse
import json
import pathlib

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier

FOUND = pathlib.Path(__file__).resolve().parent / "trees.json"
CONTACT_N = 0.02
AREAS_N = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2)
GREATEST = (0, 1, 2, 3, 5, 7, 10, 14, 19, 25, 32, 40, 50, 65, 80, 100, 130)
RINGS, STRIPS = 10, 9
POWERS = (1.0, 0.5, 0.0)
ROWS, COLUMNS = (axis.ravel().astype(np.float32) for axis in np.meshgrid(np.arange(28), np.arange(28), indexing="ij"))


def moments(weights):
    """Centre (row, column), and second moments (row row, column column, row column)."""
    total = weights.sum(1) + 1e-6
    row, column = weights @ ROWS / total, weights @ COLUMNS / total
    second = (ROWS**2, COLUMNS**2, ROWS * COLUMNS)
    own = (row * row, column * column, row * column)
    return row, column, [weights @ square / total - mean for square, mean in zip(second, own)]


def features(newtons):
    """Features `[frames, 72]` of frames in newtons, `[frames, 784]`."""
    pressed = np.where(newtons >= CONTACT_N, newtons, 0).astype(np.float32)
    contact = (pressed > 0).astype(np.float32)
    force = pressed.sum(1)
    found = [force, contact.sum(1), pressed.max(1), force**2 / ((pressed**2).sum(1) + 1e-6), force / (contact.sum(1) + 1)]
    for weights in (pressed, contact, pressed**2):
        _, _, (rr, cc, rc) = moments(weights)
        spread, longer = np.maximum(rr + cc, 0), np.sqrt((rr - cc) ** 2 + 4 * rc**2)
        found += [spread, (spread + longer) / 2, (spread - longer) / 2]
    found += [(newtons >= threshold).sum(1) for threshold in AREAS_N]
    found += list(-np.sort(-pressed, axis=1)[:, GREATEST].T)
    image = pressed.reshape(-1, 28, 28)
    steps = sum(np.abs(np.diff(image, axis=axis)).sum((1, 2)) for axis in (1, 2))
    middle, around = image[:, 1:-1, 1:-1], (image[:, :-2, 1:-1], image[:, 2:, 1:-1], image[:, 1:-1, :-2], image[:, 1:-1, 2:])
    bends = np.abs(4 * middle - sum(around)).sum((1, 2))
    found += [steps / (force + 0.05), bends / (force + 0.05)]
    row, column, (rr, cc, rc) = moments(pressed)
    down, right = ROWS - row[:, None], COLUMNS - column[:, None]
    distance = np.hypot(down, right)
    for ring in range(RINGS):
        inside = (distance >= ring) & (distance < ring + 1)
        found.append((pressed * inside).sum(1) / (inside.sum(1) + 1e-6))
    angle = 0.5 * np.arctan2(2 * rc, rr - cc)[:, None]
    along = np.abs(down * np.cos(angle) + right * np.sin(angle))
    across = np.abs(right * np.cos(angle) - down * np.sin(angle))
    for axis in (along, across):
        strips = [(axis >= strip) & (axis < strip + 1) for strip in range(STRIPS)]
        found += [(pressed * strip).sum(1) / (force + 1e-6) for strip in strips]
        square, fourth = ((pressed * axis**power).sum(1) / (force + 1e-6) for power in (2, 4))
        found.append(fourth / (square + 1e-3) ** 2)
    return np.stack(found, 1).astype(np.float32)


def best_frames(data):
    """The frame of the greatest contact area, then force, of each press, in newtons."""
    if "frames" in data:
        return data["frames"].reshape(-1, 784)
    millinewtons = data["frames_mn"].reshape(-1, 784)
    contact, force = (millinewtons >= 1000 * CONTACT_N).sum(1), millinewtons.sum(1)
    order = np.lexsort((-np.arange(len(force)), force, contact, data["press"]))
    last = np.searchsorted(data["press"], np.arange(len(data["level"])), side="right") - 1
    return millinewtons[order[last]] * np.float32(1e-3)


def read(path, split):
    """Features, level and material of a split's presses (0 train, 1 test)."""
    with np.load(path) as file:
        data = {name: file[name] for name in file}
    own = data["split"] == split
    frames = best_frames(data)[own]
    parts = [features(frames[first : first + 5000]) for first in range(0, len(frames), 5000)]
    material = np.array(json.loads(bytes(data["meta"]))["materials"])[data["material"]][own]
    return np.concatenate(parts), data["level"][own].astype(int), material


def measure(training, tests):
    parts = [read(path, 0) for path in training]
    x, level = (np.concatenate([part[column] for part in parts]) for column in (0, 1))
    tests = {path.stem: read(path, 1) for path in tests}
    found = {"frames": len(level), "features": x.shape[1], "accuracy": {}}
    for power in POWERS:
        weights = np.bincount(level)[level] ** (power - 1)
        trees = HistGradientBoostingClassifier(max_iter=300, l2_regularization=1.0, early_stopping=False)
        trees.fit(x, level, sample_weight=weights / weights.mean())
        of_power = found["accuracy"][str(power)] = {}
        for name, (test, truth, material) in tests.items():
            right = trees.predict(test) == truth
            of_power[name] = {"all": right.mean()} | {str(kind): right[material == kind].mean() for kind in np.unique(material)}
        print(power, of_power, flush=True)
    FOUND.write_text(json.dumps(found, indent=1) + "\n")


def table():
    found = json.loads(FOUND.read_text())
    powers = found["accuracy"]
    print("| Presses |", " | ".join(powers), "|")
    for name, kinds in next(iter(powers.values())).items():
        for kind in kinds:
            shares = [f"{100 * of_power[name][kind]:.1f} %" for of_power in powers.values()]
            print(f"| {name}, {kind} |", " | ".join(shares), "|")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", nargs="+", type=pathlib.Path, default=[])
    parser.add_argument("--test", nargs="+", type=pathlib.Path, default=[])
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if not given.table:
        measure(given.data, given.test)
    table()
