"""Boosted trees on hand-made features of a press, beside the course model (models/course.md).

    pip install numpy scikit-learn
    python trees.py --data TRAIN.npz ... --test TEST.npz ...

The files are of `hrn-train simulate --sequences`. It prints the share of correct levels and the root mean square error
of the Shore hardness, all and by kind of material. Fitting 112,712 presses took a quarter of an hour on a busy core.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor

CONTACT_N = 0.02
# Newtons at which loading is read off, and shares of the greatest force at which loading and unloading are.
FORCES_N = np.array([0.2, 0.4, 0.7, 1, 1.5, 2, 3, 4, 5.5, 7, 9])
SHARES = (0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9)
# Seconds after the greatest force at which relaxation is read off.
AFTER_S = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)


def of_frames(millinewtons: np.ndarray) -> np.ndarray:
    """Features of each frame: `[frames, 13]`, force and contact area first."""
    newtons = millinewtons.astype(np.float32).reshape(len(millinewtons), -1) * 1e-3
    pressed = np.where(newtons >= CONTACT_N, newtons, 0)
    rows, columns = (axis.ravel() for axis in np.meshgrid(np.arange(28), np.arange(28), indexing="ij"))
    features = [pressed.sum(1), (pressed > 0).sum(1)]
    for weights in (pressed, (pressed > 0).astype(np.float32)):
        total = weights.sum(1) + 1e-6
        r, c = weights @ rows / total, weights @ columns / total
        rr = weights @ rows**2 / total - r * r
        cc = weights @ columns**2 / total - c * c
        rc = weights @ (rows * columns) / total - r * c
        spread = np.maximum(rr + cc, 0)
        features += [spread, np.sqrt((rr - cc) ** 2 + 4 * rc**2) / (spread + 1e-3)]
    features += [pressed.max(1), features[0] ** 2 / ((pressed**2).sum(1) + 1e-6)]
    features += [(newtons >= threshold).sum(1) for threshold in (0.05, 0.1, 0.2, 0.4)]
    image = pressed.reshape(-1, 28, 28)
    steps = sum(np.abs(np.diff(image, axis=axis)).sum((1, 2)) for axis in (1, 2))
    return np.stack([*features, steps / (features[0] + 0.05)], 1).astype(np.float32)


def slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and intercept of a line by least squares; NaN where there is none."""
    if not (np.isfinite(x).all() and np.isfinite(y).all()) or len(x) < 2:
        return np.nan, np.nan
    spread = ((x - x.mean()) ** 2).sum()
    if spread < 1e-9:
        return np.nan, np.nan
    steep = ((x - x.mean()) * (y - y.mean())).sum() / spread
    return steep, y.mean() - steep * x.mean()


def of_press(frames: np.ndarray, time: np.ndarray, approach: np.ndarray, known: np.ndarray, arm: float) -> list[float]:
    """Features of a press; NaN where something is unknown or was not reached."""
    force = frames[:, 0]
    approach = np.where(known > 0.5, approach, np.nan)
    arm = arm if arm > 0 else np.nan
    depth = approach - force / arm
    top = int(force.argmax())
    furthest = int(np.nanargmax(approach)) if np.isfinite(approach).any() else top
    step = np.median(np.diff(time)) if len(time) > 1 else 0
    row = [force.max(), time[top], time[-1], step, len(time), arm, approach[top], depth[top], known.min() > 0.5]
    row += list(frames[top, 1:])

    def between(before: int, after: int, level: float, of: np.ndarray, *columns: np.ndarray) -> list[float]:
        part = (level - of[before]) / (of[after] - of[before] + 1e-9)
        return [column[before] + part * (column[after] - column[before]) for column in columns]

    rising = np.maximum.accumulate(force[: top + 1])
    columns = (approach, depth, frames[:, 1], frames[:, 2], frames[:, 7])
    for level in FORCES_N:
        if level > force[top] or level < force[0]:
            row += [np.nan] * 5
            continue
        after = min(max(int(np.searchsorted(rising, level)), 1), top)
        row += between(after - 1, after, level, rising, *columns)
    columns = (depth, frames[:, 2], time - time[top], frames[:, 7])
    for share in SHARES:
        level = share * force[top]
        after = int(np.searchsorted(rising, level))
        row += between(after - 1, after, level, rising, *columns) if after >= 1 else [np.nan] * 4
        falling = np.nonzero(force[top:] <= level)[0]
        after = top + falling[0] if len(falling) else 0
        row += between(after - 1, after, level, force, *columns) if after >= 1 else [np.nan] * 4
    for after_s in AFTER_S:
        moment = time[top] + after_s
        if moment > time[-1]:
            row += [np.nan] * 3
            continue
        row += [np.interp(moment, time, force) / force[top], np.interp(moment, time, depth)]
        row += [np.interp(moment, time, approach)]
    row += [force[furthest] / force[top], time[furthest] - time[top], approach[furthest], depth[furthest]]
    row += [approach[-1], force[-1]]
    loading = slice(0, top + 1)
    bent = (depth[loading] > 0.03) & (force[loading] > 0.1)
    row += slope(np.log(depth[loading][bent]), np.log(force[loading][bent]))
    steep = force[loading] > 0.4 * force[top]
    row += [slope(approach[loading][steep], force[loading][steep])[0]]
    row += [np.trapezoid(force, depth), np.trapezoid(force[loading], depth[loading])]
    return row


def read(path: Path, split: int) -> dict[str, np.ndarray]:
    """The features of every press of a split (0 train, 1 test), with level, Shore hardness and kind of material."""
    with np.load(path) as file:
        data = {name: file[name] for name in file}
    meta = json.loads(bytes(data["meta"]))
    features = of_frames(data["frames_mn"])
    firsts = np.searchsorted(data["press"], np.arange(len(data["level"]) + 1))
    presses = []
    for press, (first, end) in enumerate(zip(firsts[:-1], firsts[1:])):
        rows = np.arange(first, end)
        rows = rows[data["time_s"][rows] >= 0]
        told = (data[name][rows] for name in ("time_s", "approach_mm", "known"))
        presses.append(of_press(features[rows], *told, data["arm_n_per_mm"][press]))
    x = np.array(presses, np.float32)
    x[~np.isfinite(x)] = np.nan
    kind = np.array(meta["materials"])[data["material"]]
    found = {"x": x, "level": data["level"].astype(int), "shore": data["shore"], "kind": kind}
    return {name: values[data["split"] == split] for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", nargs="+", type=Path, required=True)
    parser.add_argument("--test", nargs="+", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=300)
    arguments = parser.parse_args()
    files = [read(path, 0) for path in arguments.data]
    x, level, shore = (np.concatenate([file[name] for file in files]) for name in ("x", "level", "shore"))
    # Some features are never known, such as the approach before the first frame.
    used = [column for column in range(x.shape[1]) if len(np.unique(x[np.isfinite(x[:, column]), column])) > 2]
    x = x[:, used]
    # Levels with few presses weigh more, halfway to equal weights of all levels, as the course model does.
    weights = np.bincount(level)[level] ** -0.5
    settings = {"max_iter": arguments.rounds, "learning_rate": 0.1, "max_leaf_nodes": 31, "early_stopping": False}
    classifier = HistGradientBoostingClassifier(l2_regularization=1.0, **settings)
    classifier.fit(x, level, sample_weight=weights / weights.mean())
    regressor = HistGradientBoostingRegressor(**settings).fit(x, shore)
    for path in arguments.test:
        test = read(path, 1)
        test["x"] = test["x"][:, used]
        right = classifier.predict(test["x"]) == test["level"]
        errors = regressor.predict(test["x"]) - test["shore"]
        for kind in ["all", *np.unique(test["kind"])]:
            of = np.full(len(right), True) if kind == "all" else test["kind"] == kind
            rmse = np.sqrt((errors[of] ** 2).mean())
            print(f"{path.stem:28} {kind:16} {100 * right[of].mean():5.1f} % right, Shore RMSE {rmse:.1f}")


if __name__ == "__main__":
    main()
