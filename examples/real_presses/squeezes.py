"""Whether the stiffness that a gripper's force and opening show orders objects as their Shore hardness does.

In: forces and widths of squeezes, and a table of hardness. Out: printed Spearman correlations of three definitions of
stiffness, with 95 % intervals by object.
"""

import csv
import pickle
import re
import sys

import numpy as np
from scipy.stats import spearmanr

SEED = 1
RESAMPLES = 2000
# What the objects of the squeezes are called in the table of hardness.
NAMES = {
    "orange_ball_softest": "orange_elastic_ball",
    "green_ball_softer": "green_elastic_ball",
    "purple_ball_hardest": "purple_elastic_ball",
    "yellow_foam_brick_softest": "yellow_foam_brick",
    "red_foam_brick_softer": "red_foam_brick",
    "blue_foam_brick_harder": "blue_foam_brick",
    "rigid_strawberry": "plastic_strawberry",
    "bolt": "bolt_gray",
}
# The end of the Shore OO scale. Harder objects have no reading.
SCALE_ENDS = 90
# Loading begins at this force (that of the data's authors), and its law is taken from these shares of the
# greatest force on, as in crates/core/src/verdict/features.rs.
TOUCH_N = 0.75
FITTED, END = 0.08, 0.5
AT_N = 8.0
# What is nearly rigid, and so shows how far the gripper itself gives way.
RIGID = "golf_ball"


class ArraysOnly(pickle.Unpickler):
    """Reads a numpy array from a stranger's pickle, and refuses anything else."""

    ALLOWED = {"_reconstruct": np.empty(0).__reduce__()[0], "ndarray": np.ndarray, "dtype": np.dtype}

    def find_class(self, module, name):
        if module.split(".")[0] != "numpy" or name not in self.ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return self.ALLOWED[name]


def array_of(path):
    with open(path, "rb") as file:
        return np.asarray(ArraysOnly(file).load(), float)


def read_squeezes(directory):
    """{object: [(force_n, width_mm)]}, over time."""
    squeezes = {}
    for forces in sorted((directory / "example_data").glob("*/*_forces.pkl")):
        name = re.sub(r"(_|__t=)\d+_forces$", "", forces.stem)
        widths = forces.with_name(forces.name.replace("_forces", "_widths"))
        squeezes.setdefault(name, []).append((array_of(forces), 1000 * array_of(widths)))
    return squeezes


def hardness_of(directory, names):
    """{object: Shore OO}. Above the scale there is no reading: there the table's modulus gives the order."""
    with open(directory / "data/dataset_objects_and_compliance.csv", newline="", encoding="utf-8-sig") as file:
        rows = {row["Label"]: row for row in csv.DictReader(file)}
    rows = {name: rows[NAMES.get(name, name)] for name in names}
    above = {name: SCALE_ENDS + np.log10(float(row["Modulus [Pa]"])) for name, row in rows.items()}
    return {name: float(row["Shore 00 [/]"] or above[name]) for name, row in rows.items()}


def loading(force_n, width_mm):
    """Force and approach from touch to the greatest force while the gripper closes."""
    top = np.argmax(force_n[: np.argmin(width_mm) + 1])
    light = np.flatnonzero(force_n[:top] < TOUCH_N)
    first = light[-1] if len(light) else 0
    return force_n[first : top + 1], width_mm[first] - width_mm[first : top + 1]


def slope(x, y):
    """Of the line through points by least squares, near 0 if they hardly differ in x, as in the daemon."""
    from_mean = x - x.mean()
    return np.sum(from_mean * (y - y.mean())) / (np.sum(from_mean**2) + 0.02 * len(x))


def compliance(force_n, approach_mm):
    end = force_n >= END * force_n.max()
    return slope(force_n[end], approach_mm[end])


def stiffnesses(force_n, approach_mm, gripper_mm_per_n):
    """{definition: stiffness} of a squeeze, each the greater the stiffer; NaN where it cannot be taken."""
    indentation = approach_mm - gripper_mm_per_n * force_n
    law = force_n >= FITTED * force_n.max()
    at = np.argmax(force_n >= AT_N) if force_n.max() >= AT_N else None
    return {
        "slope of the force at the end": 1 / max(compliance(force_n, indentation), 3e-3),
        "slope of F^(2/3), Hertz": slope(indentation[law], force_n[law] ** (2 / 3)),
        f"force by indentation at {AT_N:.0f} N": np.nan if at is None else force_n[at] / max(indentation[at], 0.1),
    }


def spearman(values, hardness, names):
    """Of all squeezes of the named objects, and of the objects' medians."""
    points = [(value, hardness[name]) for name in names for value in values[name] if np.isfinite(value)]
    medians = [(np.nanmedian(values[name]), hardness[name]) for name in names]
    return [spearmanr(*zip(*of)).statistic for of in (points, medians)]


def print_spearman(title, values, hardness):
    """Prints how {object: [stiffness]} goes with hardness. For the intervals objects are drawn anew."""
    names, rng = sorted(values), np.random.default_rng(SEED)
    draws = [rng.choice(names, len(names)) for _ in range(RESAMPLES)]
    draws = [spearman(values, hardness, drawn) for drawn in draws if len(set(drawn)) > 2]
    of_squeezes, of_medians = zip(spearman(values, hardness, names), *np.nanpercentile(draws, [2.5, 97.5], axis=0))
    count = sum(np.isfinite(of).sum() for of in values.values())
    print(f"    {title}:")
    print("      {:.2f} ({:.2f} to {:.2f}) over {} squeezes".format(*of_squeezes, count))
    print("      {:.2f} ({:.2f} to {:.2f}) over {} medians of objects".format(*of_medians, len(names)))


def print_stiffnesses(title, presses, gripper_mm_per_n, hardness):
    print(f"  {title}:")
    found = {name: [stiffnesses(*press, gripper_mm_per_n) for press in of] for name, of in presses.items()}
    definitions = next(iter(found.values()))[0]
    for definition in definitions:
        values = {name: [each[definition] for each in of] for name, of in found.items()}
        print_spearman(definition, values, hardness)


def report(directory, table_directory):
    squeezes = read_squeezes(directory)
    if RIGID not in squeezes:
        sys.exit(f"{directory}: no squeezes of {RIGID}")
    hardness = hardness_of(table_directory, squeezes)
    presses = {name: [loading(*squeeze) for squeeze in of] for name, of in squeezes.items()}
    with_reading = {name: of for name, of in presses.items() if hardness[name] < SCALE_ENDS}
    not_rigid = {name: of for name, of in presses.items() if name != RIGID}
    gripper_mm_per_n = np.median([compliance(*press) for press in presses[RIGID]])
    print(f"{sum(map(len, presses.values()))} squeezes of {len(presses)} objects; Spearman with Shore OO")
    print_stiffnesses("all objects", presses, 0.0, hardness)
    print_stiffnesses("objects with a reading of Shore OO", with_reading, 0.0, hardness)
    title = f"less the gripper's own {gripper_mm_per_n:.3f} mm/N, which the {RIGID} shows"
    print_stiffnesses(title, not_rigid, gripper_mm_per_n, hardness)
