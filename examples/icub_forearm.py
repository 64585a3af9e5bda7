"""What contact area and force tell of hardness on a real robot's forearm.

An iCub lowered its forearm on 19 flat materials, 11 touches each. For each touch this takes area and
force at the moment of the greatest area, which is the moment that a model of one frame judges. It also takes
the course of the touch: areas while the force grew, and times.

    git clone https://github.com/clear-nus/TactileLearning
    pip install numpy scikit-learn
    python3 examples/icub_forearm.py TactileLearning/data

The data have no Shore values and no frames. The names say what is stiff and what is soft. It also reads
a table with the columns material, touch, time_s, taxels and pressure (a CSV file).
"""

import csv
import itertools
import pathlib
import re
import sys

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

# The materials whose names leave no doubt. Paper lay on a table.
STIFF = ["metal", "polypropileno", "polypropilenoSmooth", "fiberBoard", "paper1", "paper2"]
SOFT = ["cuisionFoam", "softMaterial1", "softMaterial2", "spongeWhiteSmall", "bathTowel"]

# A touch ends when nothing is in contact for this long, in seconds.
PAUSE_S = 0.5

# A line of skin_events/data.log: a number, the time, then each contact. A contact ends with the list of
# its taxels and their mean pressure (0 to 255).
CONTACT = re.compile(r"\(([\d ]+)\) ([\d.e+-]+)\)")


def touches_of_log(path):
    """Lists of (time_s, taxels, pressure), one for each touch."""
    touches, last = [], -np.inf
    for line in path.read_text().splitlines():
        contacts = CONTACT.findall(line)
        if not contacts:
            continue
        time_s = float(line.split()[1])
        taxels = [len(of.split()) for of, _ in contacts]
        pressure = sum(count * float(mean) for count, (_, mean) in zip(taxels, contacts))
        if time_s - last > PAUSE_S:
            touches.append([])
        touches[-1].append((time_s, sum(taxels), pressure))
        last = time_s
    return touches


def read(path):
    """{material: [touch]}."""
    if path.is_dir():
        logs = sorted(path.glob("*/touch_raw/skin_events/data.log"))
        return {log.parts[-4]: touches_of_log(log) for log in logs}
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    materials = {}
    for (material, _), of in itertools.groupby(rows, lambda row: (row["material"], int(row["touch"]))):
        touch = [(float(row["time_s"]), int(row["taxels"]), float(row["pressure"])) for row in of]
        materials.setdefault(material, []).append(touch)
    return materials


def chosen(touch):
    """Area and force at the moment of the greatest area; of equal ones, that of the greatest force."""
    _, taxels, pressure = max(touch, key=lambda moment: moment[1:])
    return taxels, pressure


# Shares of the greatest force at which the course of a touch is read off.
SHARES = (0.25, 0.5, 0.75)
# Added to times before their logarithm: two and a half readings of the skin.
SHORTEST_S = 0.05


def course(touch):
    """Areas at shares of the greatest force, then seconds from these shares to it, and seconds of the hold."""
    time_s, taxels, pressure = np.array(touch, float).T
    top = pressure.argmax()
    at = [int(np.argmax(pressure >= share * pressure[top])) for share in SHARES]
    held = np.flatnonzero(pressure >= SHARES[-1] * pressure[top])[-1]
    return [*taxels[at], *(time_s[top] - time_s[at]), time_s[held] - time_s[top]]


def columns(touches, names):
    """Logarithms: by Hertz, area and force of one material on one shape lie on a line."""
    area, force = np.log(np.array([chosen(touch) for touch in touches], float)).T
    of_course = np.array([course(touch) for touch in touches])
    areas, times = of_course[:, : len(SHARES)], of_course[:, len(SHARES) :]
    found = {"area": area, "force": force, "areas before": np.log(areas), "times": np.log(times + SHORTEST_S)}
    return np.column_stack([found[name] for name in names])


def left_out(materials, names):
    """Of each material, how many touches are told stiff or soft rightly by a model that never met it."""
    right = {}
    for material in STIFF + SOFT:
        others = [other for other in STIFF + SOFT if other != material]
        x = columns([touch for other in others for touch in materials[other]], names)
        y = [other in STIFF for other in others for _ in materials[other]]
        model = make_pipeline(StandardScaler(), LogisticRegression()).fit(x, y)
        told = model.predict(columns(materials[material], names))
        right[material] = int(np.sum(told == (material in STIFF)))
    return right


def main(path):
    materials = read(path)
    missing = sorted(set(STIFF + SOFT) - set(materials))
    if missing:
        sys.exit(f"{path}: no touches of {', '.join(missing)}")
    print(f"{len(materials)} materials, {sum(map(len, materials.values()))} touches")
    one_moment, course_too = ["area", "force"], ["area", "force", "areas before"]
    for names in (one_moment, ["area"], ["force"], course_too, [*course_too, "times"]):
        right = left_out(materials, names)
        count = sum(len(materials[name]) for name in right)
        missed = [f"{len(materials[name]) - right[name]} of {name}" for name in right if right[name] < len(materials[name])]
        share = 100 * sum(right.values()) / count
        print(f"{', '.join(names)}: {share:.1f} % of {count} touches; missed: {', '.join(missed)}")
    print("from stiff to soft, by a model of all these touches:")
    x = columns([touch for name in STIFF + SOFT for touch in materials[name]], one_moment)
    y = [name in STIFF for name in STIFF + SOFT for _ in materials[name]]
    model = make_pipeline(StandardScaler(), LogisticRegression()).fit(x, y)
    order = {name: np.median(model.decision_function(columns(of, one_moment))) for name, of in materials.items()}
    for name in sorted(order, key=order.get, reverse=True):
        area, force = np.median([chosen(touch) for touch in materials[name]], axis=0)
        kind = "stiff" if name in STIFF else "soft" if name in SOFT else "not said"
        print(f"{order[name]:6.1f}  {area:3.0f} taxels, pressure {force:4.0f}  {name}, {kind}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(pathlib.Path(sys.argv[1]))
