"""A gripper with two BioTac fingertips holds six objects, of which two are hard by name.

https://github.com/joshsia/haptics-classification has the hold alone: no onset, no release, no Shore values. For the zero,
the mean of all holds stands for the unloaded electrodes, which are not in the files.
"""

import sys

import numpy as np
from recorded import Recorded, by_object, by_time
from scipy.io import loadmat

URL = "https://github.com/joshsia/haptics-classification"
COMMIT = "e0c50647ce84"

SOFT = ["black_foam", "car_sponge", "flour_sack", "kitchen_sponge"]
HARD = ["acrylic", "steel_vase"]
# The rate of the files is 100 Hz.
EVERY = 10
SENSOR = """
[[sensor]]
name = "fingers"
port = "/dev/null"
frame_rate_hz = 10
[sensor.frame]
sync = "AA 55 C3 3C"
length = "none"
checksum = "none"
cell = "u16le"
rows = 2
cols = 19
[sensor.calibration]
newtons_per_count = 0.035
tare_max_n = 500
"""


def read(path):
    files, level = [], []
    for soft, names in enumerate([HARD, SOFT]):
        for name in names:
            of_name = sorted((path / "data").glob(f"{name}_*_HOLD.mat"))
            files += of_name
            level += [soft] * len(of_name)
    if not files:
        sys.exit(f"{path}: no holds")
    held = []
    for file in files:
        fingers = loadmat(file)
        held.append(np.concatenate([fingers["F0Electrodes"], fingers["F1Electrodes"]]).T[::EVERY].astype(int))
    rest = np.mean([rows.mean(axis=0) for rows in held], axis=0).round().astype(int)
    counts = [np.concatenate([rest[None], rows]) for rows in held]
    name = np.array([file.name.rsplit("_", 3)[0] for file in files])
    trial = np.array([int(file.name.split("_")[-2]) for file in files])
    return Recorded(counts, np.array(level), np.unique(name, return_inverse=True)[1], trial, SENSOR)


def splits(recorded, share):
    return [by_object(recorded), by_time(recorded, share)]
