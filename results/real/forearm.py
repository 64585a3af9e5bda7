"""An iCub lowers its forearm on flat materials, of which six are surely stiff and five surely soft.

https://github.com/clear-nus/TactileLearning has lists of the taxels in contact with their mean pressure, and no Shore
values: the names tell. The place of the taxels is not stated. They are shown in the order of their numbers.
"""

import re
import sys

import numpy as np
from recorded import Recorded, by_object, by_time

URL = "https://github.com/clear-nus/TactileLearning"
COMMIT = "e41c31af7f5b"

SOFT = ["cuisionFoam", "softMaterial1", "softMaterial2", "spongeWhiteSmall", "bathTowel"]
STIFF = ["metal", "polypropileno", "polypropilenoSmooth", "fiberBoard", "paper1", "paper2"]
FIRST, ROWS, COLS = 36, 7, 12
# A touch ends when nothing is in contact for this long. Some logs begin with a few samples of another touch.
PAUSE_S, FEWEST_SAMPLES = 0.5, 10
# A line is a number, the time, then each contact. A contact ends with its taxels and their mean pressure.
CONTACT = re.compile(r"\(([\d ]+)\) ([\d.e+-]+)\)")
SENSOR = """
[[sensor]]
name = "forearm"
port = "/dev/null"
frame_rate_hz = 50
[sensor.frame]
sync = "AA 55 C3 3C"
length = "none"
checksum = "none"
cell = "u16le"
rows = 7
cols = 12
[press]
begin_area_taxels = 1
"""


def touches(path):
    """[rows, taxels] each."""
    found, last = [], -np.inf
    for line in path.read_text().splitlines():
        contacts = CONTACT.findall(line)
        if not contacts:
            continue
        time_s = float(line.split()[1])
        if time_s - last > PAUSE_S:
            found.append([np.zeros(ROWS * COLS, int)])
        row = np.zeros(ROWS * COLS, int)
        for numbers, mean in contacts:
            row[[int(number) - FIRST for number in numbers.split()]] = round(float(mean))
        found[-1].append(row)
        last = time_s
    return [np.array(rows) for rows in found if len(rows) > FEWEST_SAMPLES]


def read(path):
    counts, level, objects, trial = [], [], [], []
    for soft, names in enumerate([STIFF, SOFT]):
        for name in names:
            of_name = touches(path / "data" / name / "touch_raw/skin_events/data.log")
            counts += of_name
            level += [soft] * len(of_name)
            objects += [len(set(objects))] * len(of_name)
            trial += range(1, len(of_name) + 1)
    if not counts:
        sys.exit(f"{path}: no touches")
    return Recorded(counts, np.array(level), np.array(objects), np.array(trial), SENSOR)


def splits(recorded, share):
    return [by_object(recorded), by_time(recorded, share)]
