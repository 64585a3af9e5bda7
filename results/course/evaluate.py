#!/usr/bin/env python3
"""The evaluations behind models/course.md: simulates the test sets, judges both models, writes what they reached.

    cargo build --release --workspace
    pip install numpy scipy
    python3 results/course/evaluate.py target/release/hrn-train --work WORK     # a quarter of an hour
    python3 results/course/evaluate.py --table          # prints the tables from the committed files

WORK keeps the data sets, so an interrupted call goes on. Written beside this file:

- evaluations.json: the command of every set, what `evaluate --json` prints for every set and model, and how many
  verdicts have at least a confidence, with the right ones among them;
- objects.csv: for every set, model and object its material (for a random one its law), its level, its presses, the
  right ones, those whose true Shore hardness lies in the model's interval, and the sum of squared Shore errors.
"""

import csv
import json
import pathlib
import sys

import numpy

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import intervals  # noqa: E402
import trainer as training  # noqa: E402

MODELS = {"course": "course.onnx", "default": "hrn.onnx"}
PRESSES = "--sequences --presses 6"
OTHERS = "--materials broad --seed 51 --objects 0 --test-objects 60"
FOUR = "--seed 52 --objects 0 --test-objects 20"
KNOWN = "--seed 54 --objects 20 --test-objects 0"
UNKNOWN = "--unknown 1"
POSITIONS = "--position-error 0.1"
CLOCK = "--clock-error 1"
# What the robot tells and how the sensor is -> options of `simulate`.
CASES = {
    "": "--fps 20..20",
    ", nothing known": f"--fps 20..20 {UNKNOWN}",
    ", the robot errs": f"--fps 20..20 {POSITIONS} --arm-error 0.3 {CLOCK}",
    ", 5 frames/s": "--fps 5..5",
    ", 100 frames/s": "--fps 100..100",
    ", raw": "--fps 20..20 --sensor-profile raw",
    ", raw, nothing known": f"--fps 20..20 --sensor-profile raw {UNKNOWN}",
    ", positions off": f"--fps 20..20 {POSITIONS}",
    ", clock off": f"--fps 20..20 {CLOCK}",
    ", 5 frames/s, clock off": f"--fps 5..5 {CLOCK}",
}
# Errors of the robot -> the presses without them.
ERRORS = {", positions off": "", ", clock off": "", ", the robot errs": "", ", 5 frames/s, clock off": ", 5 frames/s"}
SHAPES = ("matched", "wide")


def sets():
    """Name -> the options of `simulate`, and the split to judge."""
    found = {}
    for case, options in CASES.items():
        for who, own in (("others", f"{OTHERS} --gaps"), ("the four", FOUR)):
            for shapes in SHAPES:
                found[f"{who}, {shapes}{case}"] = f"{PRESSES} {own} --shapes {shapes} {options}", "test"
    for shapes in SHAPES:
        found[f"others, {shapes}, no gaps"] = f"{PRESSES} {OTHERS} --shapes {shapes} --fps 20..20", "test"
    for shapes in SHAPES:
        found[f"training materials, {shapes}"] = f"{PRESSES} {KNOWN} --shapes {shapes} --fps 20..20", "train"
    return found


def materials(path):
    """The name of every object's material."""
    with numpy.load(path) as data:
        names = json.loads(bytes(data["meta"]))["materials"]
        return {int(number): names[place] for number, place in zip(data["object"], data["material"])}


def measure(trainer, work):
    found = {"sets": {}, "evaluations": {}, "confident": {}}
    rows = []
    for number, (name, (options, split)) in enumerate(sets().items()):
        test = trainer.simulated(work / f"course-set-{number}.npz", options)
        named = materials(test)
        found["sets"][name] = {"simulate": options, "split": split}
        found["evaluations"][name] = {}
        found["confident"][name] = {}
        for model, file in MODELS.items():
            verdicts = work / "verdicts.csv"
            path = HERE.parent.parent / "models" / file
            evaluated = trainer.evaluated(path, test, "--split", split, "--verdicts", verdicts)
            found["evaluations"][name][model] = evaluated
            found["confident"][name][model] = training.by_confidence(verdicts)
            for key, (level, n, right, held, squares) in training.by_object(verdicts).items():
                rows.append([name, model, key, named[key], level, n, right, held, f"{squares:.1f}"])
    training.write(HERE / "evaluations.json", trainer, found)
    with open(HERE / "objects.csv", "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ["set", "model", "object", "material", "level", "presses", "right", "in_interval", "squared_errors"]
        )
        table.writerows(rows)


def clusters(objects, name):
    """[right, presses] by cluster: the four objects that have a shape in common, or else each object. Objects of the
    training split have no shape in common."""
    counts = [(int(one["object"]), int(one["right"]), int(one["presses"])) for one in objects]
    if name.startswith("training"):
        return {(one["level"], count[0]): list(count[1:]) for one, count in zip(objects, counts)}
    return intervals.of_objects(counts, len(counts) // 4)


def percent(share, sign=""):
    return f"{100 * share:{sign}.1f}"


def shown(share, low, high, sign=""):
    mean, low, high = (percent(value, sign) for value in (share, low, high))
    return mean, f"{low} to {high}"


def table():
    with open(HERE / "objects.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    written = json.loads((HERE / "evaluations.json").read_text())
    evaluations = written["evaluations"]

    def objects(name):
        return [row for row in rows if (row["set"], row["model"]) == (name, "course")]

    print("| Presses | Level right | Beyond the neighbour | Shore RMSE | Interval holds | Set holds |", end=" ")
    print("Ambiguous | Right if named | Default model |")
    for name, found in evaluations.items():
        own, sets_of = found["course"], found["course"]["sets"]
        mean, ends = shown(*intervals.interval([clusters(objects(name), name)], 0))
        cells = [name, f"{mean} % ({ends})", percent(own["beyond_neighbour"]) + " %"]
        cells.append(f"{own['shore']['rmse']:.1f}")
        shares = [own["shore"]["coverage"], sets_of["coverage"], sets_of["ambiguous"], sets_of["accuracy_of_others"]]
        cells += [percent(share) + " %" for share in [*shares, found["default"]["accuracy"]]]
        print("|", " | ".join(cells), "|")

    print("\nThe Shore error by level\n\n| Presses | Level 1 | Level 2 | Level 3 | Level 4 | Near a border |")
    for name in ("others, matched", "others, wide"):
        shore = evaluations[name]["course"]["shore"]
        print("|", name, "|", " | ".join(f"{e:.1f}" for e in [*shore["rmse_by_level"], shore["rmse_near_borders"]]), "|")

    training.print_by_level_and_confidence(written, "course")

    columns = [f"{who}, {shapes}" for who in ("others", "the four") for shapes in SHAPES]
    print("\nErrors of the robot\n\n| The robot errs |", " | ".join(columns), "|")
    for case, exact in ERRORS.items():
        cells = []
        for column in columns:
            own, before = (clusters(objects(column + which), column) for which in (case, exact))
            pairs = {key: [right - before[key][0] * n / before[key][1], n] for key, (right, n) in own.items()}
            mean, ends = shown(*intervals.interval([pairs], -1), "+")
            accuracy = percent(evaluations[column + case]["course"]["accuracy"])
            cells.append(f"{accuracy} % ({mean}: {ends})")
        print("|", case.removeprefix(", "), "|", " | ".join(cells), "|")

    print("\nLayered materials\n\n| Presses | Layered | Not layered |")
    for name in columns[:2]:
        cells = []
        for is_layered in (True, False):
            own = [one for one in objects(name) if (one["material"] == "broad-layered") == is_layered]
            right, presses = (sum(int(one[key]) for one in own) for key in ("right", "presses"))
            cells.append(f"{percent(right / presses)} % of {presses}")
        print("|", name, "|", " | ".join(cells), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table)
