"""What contact area and force tell of hardness on a real robot's forearm.

An iCub lowered its forearm on 19 flat materials, 11 touches each. For each touch this takes area and
force at the moment of the greatest area, which is the moment that hardnessd judges.

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


def columns(moments, names):
    """Logarithms: by Hertz, area and force of one material on one shape lie on a line."""
    area, force = np.log(np.array(moments, float)).T
    return np.stack([{"area": area, "force": force}[name] for name in names], 1)


def left_out(materials, names):
    """Share of touches that are told stiff or soft rightly by a model that never met their material."""
    right = {}
    for material in STIFF + SOFT:
        others = [other for other in STIFF + SOFT if other != material]
        x = columns([moment for other in others for moment in materials[other]], names)
        y = [other in STIFF for other in others for _ in materials[other]]
        model = make_pipeline(StandardScaler(), LogisticRegression()).fit(x, y)
        told = model.predict(columns(materials[material], names))
        right[material] = int(np.sum(told == (material in STIFF)))
    return right


def main(path):
    touches = read(path)
    missing = sorted(set(STIFF + SOFT) - set(touches))
    if missing:
        sys.exit(f"{path}: no touches of {', '.join(missing)}")
    materials = {name: [chosen(touch) for touch in of] for name, of in touches.items()}
    print(f"{len(materials)} materials, {sum(map(len, materials.values()))} touches")
    for names in (["area", "force"], ["area"], ["force"]):
        right = left_out(materials, names)
        count = sum(len(materials[name]) for name in right)
        missed = [f"{len(materials[name]) - right[name]} of {name}" for name in right if right[name] < len(materials[name])]
        share = 100 * sum(right.values()) / count
        print(f"{' and '.join(names)}: {share:.1f} % of {count} touches; missed: {', '.join(missed)}")
    print("from stiff to soft, by a model of all these touches:")
    x = columns([moment for name in STIFF + SOFT for moment in materials[name]], ["area", "force"])
    y = [name in STIFF for name in STIFF + SOFT for _ in materials[name]]
    model = make_pipeline(StandardScaler(), LogisticRegression()).fit(x, y)
    order = {name: np.median(model.decision_function(columns(of, ["area", "force"]))) for name, of in materials.items()}
    for name in sorted(order, key=order.get, reverse=True):
        area, force = np.median(materials[name], axis=0)
        kind = "stiff" if name in STIFF else "soft" if name in SOFT else "not said"
        print(f"{order[name]:6.1f}  {area:3.0f} taxels, pressure {force:4.0f}  {name}, {kind}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(pathlib.Path(sys.argv[1]))
