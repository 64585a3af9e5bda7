"""A two-finger gripper with 16 taxels closes on printed cubes and cylinders of several hardness levels.

https://github.com/YoussifAmin/Object_Hardness_Classification has volts and no newtons, no positions and no place of
the taxels. Within one session the unloaded first row tells the level, so only later trials and another shape are judged.
"""

import sys

import numpy as np
from recorded import Recorded

URL = "https://github.com/YoussifAmin/Object_Hardness_Classification"
COMMIT = "d34beb3b"

SHAPES = ["Cubes", "Cylinders"]
ROWS = 80
LEVELS = 4
# One step of the converter.
VOLTS_A_COUNT = 6.25e-5
LABELLED = (5, 10)
# The default contact threshold, 0.07 N for taxels 3.5 mm apart, is two counts with this scale: just above the noise. The
# unloaded volts of the taxels differ by more than the zero allows by default.
SENSOR = """
[[sensor]]
name = "gripper"
port = "/dev/null"
frame_rate_hz = 20
[sensor.frame]
sync = "AA 55 C3 3C"
length = "none"
checksum = "none"
cell = "u16le"
rows = 4
cols = 4
[sensor.calibration]
newtons_per_count = 0.035
tare_max_n = 50
"""


def read(path):
    """Reads a clone, or an `.npz` file with `volts`, `level`, `shape` and `trial`."""
    if path.suffix == ".npz":
        arrays = np.load(path)
        volts, level, shape, trial = (arrays[name] for name in ("volts", "level", "shape", "trial"))
    else:
        rows = []
        for shape, name in enumerate(SHAPES):
            for file in (path / "Dataset" / name / f"{ROWS}_Samples").glob("*/*.csv"):
                rows.append((int(file.parent.name), shape, int(file.stem.split("_")[-1]), file))
        if not rows:
            sys.exit(f"{path}: no grasps")
        rows.sort()
        level, shape, trial = (np.array(column) for column in list(zip(*rows))[:3])
        volts = np.array([np.loadtxt(row[3], delimiter=",") for row in rows])
    counts = np.round(volts / VOLTS_A_COUNT).astype(int)
    # The set counts from the softest one; cylinders have the softest three.
    level = LEVELS - 1 - level.astype(int)
    return Recorded(list(counts), level, shape.astype(int), trial.astype(int), SENSOR)


def splits(recorded, share):
    """Later trials of both shapes, and another shape with and without a few of its presses."""
    level, shape, trial = recorded.level, recorded.object, recorded.trial
    last = round(share * trial.max())
    for title, of in [
        ("cubes and cylinders, 3 levels, later trials", level > 0),
        ("cubes, 4 levels, later trials", (shape == 0) & (level >= 0)),
    ]:
        yield title, [(np.flatnonzero(of & (trial <= last)), np.flatnonzero(of & (trial > last)))]
    cubes = (shape == 0) & (level > 0)
    cylinders = (shape == 1) & (level > 0)
    yield "cylinders by cubes, another shape", [(np.flatnonzero(cubes), np.flatnonzero(cylinders))]
    for labelled in LABELLED:
        title = f"cylinders by cubes and the first {labelled} cylinders of each level"
        learn, judge = cubes | (cylinders & (trial <= labelled)), cylinders & (trial > last)
        yield title, [(np.flatnonzero(learn), np.flatnonzero(judge))]
