"""Seven capacitive taxels are pressed on 16 places of a silicone body. Under some of them lies something hard.

https://github.com/lucascimeca/palpation_analysis has three presses of each place, in steps of 0.5 mm and without times.
An object is a place.
"""

import sys

import numpy as np
from recorded import Recorded, by_object
from scipy.io import loadmat

URL = "https://github.com/lucascimeca/palpation_analysis"
COMMIT = "baaf84169983"

FILE = "data/presence_exp.mat"
SIDE, REPEATS = 4, 3
SENSOR = """
[[sensor]]
name = "finger"
port = "/dev/null"
frame_rate_hz = 20
[sensor.frame]
sync = "AA 55 C3 3C"
length = "none"
checksum = "none"
cell = "u16le"
rows = 1
cols = 7
[sensor.calibration]
newtons_per_count = 0.001
tare_max_n = 50
"""


def read(path):
    file = path / FILE
    if not file.exists():
        sys.exit(f"{path}: no {FILE}")
    arrays = loadmat(file)
    counts, level, place = [], [], []
    for row in range(SIDE):
        for col in range(SIDE):
            # [steps, travel and taxels, repeats]
            pressed = arrays[f"Vertical_{row + 1}_{col + 1}"]
            counts += [pressed[:, 1:, repeat].astype(int) for repeat in range(REPEATS)]
            level += [int(arrays["nodules"][row, col, 0] == 0)] * REPEATS
            place += [row * SIDE + col] * REPEATS
    trial = np.tile(np.arange(1, REPEATS + 1), SIDE * SIDE)
    return Recorded(counts, np.array(level), np.array(place), trial, SENSOR)


def splits(recorded, share):
    return [by_object(recorded)]
