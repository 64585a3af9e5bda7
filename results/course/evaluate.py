#!/usr/bin/env python3
"""The figures of models/course.md: simulates the test sets, judges them, writes what the model reached.

    cargo build --release --workspace
    pip install numpy
    python3 results/course/evaluate.py target/release/hrn-train --work WORK     # 40 minutes of one core
    python3 results/course/evaluate.py --table          # prints the tables from the committed file

WORK keeps the data sets, so an interrupted call goes on. evaluations.json, beside this file, has the figures of every
set and of everything that the model was told. Intervals are 95 %, by a bootstrap over the covers: the sensors under one
cover press the same objects, and covers, objects and shapes are drawn anew for each.
"""

import csv
import json
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402
from wrong_newtons import wrong_newtons  # noqa: E402

MODEL = HERE.parent.parent / "models/course.onnx"
COMMON = "--sequences --objects 0 --test-objects 100 --presses 4"
SETTINGS = "[sensors]\ntest_covers = 25\nelectronics = 4\n"
# Of named materials.
ALL_TEST = "[objects]\nall_test = true\n"
ELECTRONICS = 4
SETS = {
    "Unseen sensors, `matched` shapes": "--sensors broad --materials broad --shapes matched --seed 6101",
    "Unseen sensors, `wide` shapes": "--sensors broad --materials broad --shapes wide --seed 6102",
    "Unseen sensors, `flat` shapes": "--sensors broad --materials broad --shapes flat --seed 6103",
    "The simulated JX255N, `matched`": "--sensors jx255n --materials broad --shapes matched --seed 6104",
    "The simulated JX255N, `wide`": "--sensors jx255n --materials broad --shapes wide --seed 6105",
    "The simulated JX255N, `flat`": "--sensors jx255n --materials broad --shapes flat --seed 6106",
    "Unseen sensors, the eight named materials, `matched`": "--sensors broad --shapes matched --seed 6107",
    "Unseen sensors, the eight named materials, `wide`": "--sensors broad --shapes wide --seed 6108",
}
TOLD = {
    "nothing known": (),
    "16 own presses": ("--own", "16"),
    "2 + 2": ("--rigid", "2"),
    "2 + 2 and 16 own": ("--rigid", "2", "--own", "16"),
    "4 labelled": ("--labelled", "1"),
}
# What the second and third table are about.
USUAL = "16 own presses"
# The ways in which the positions of the arm, or the newtons of an unseen sensor, are left out or wrong.
WITHOUT = ("nothing known", USUAL, "2 + 2 and 16 own")
UNSEEN = 3
BOOTSTRAPS = 1000
# What is kept of what `evaluate --json` prints.
KEPT = ("n", "accuracy", "category_accuracy", "confusion", "ece", "nll", "beyond_neighbour", "shore", "sets")
SURE = 0.7
# The levels above 70, of 50 to 70 and up to 50 OO.
THREE = {1: 1, 2: 2, 3: 2, 4: 3}


def verdicts_of(path):
    """Object, level, named level, the probabilities of the levels, and the error of the Shore hardness, a row each."""
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            shares = [float(row[f"probability_{level}"]) for level in (1, 2, 3, 4)]
            error = abs(float(row["shore"]) - float(row["true_shore"]))
            yield int(row["object"]), int(row["level"]), int(row["judged"]), shares, error


def judged_presses(rows, data):
    """The places in the data set of the presses that the verdicts are of."""
    import numpy

    # Objects that serve as references have no verdict.
    has_verdict = (data["level"] > 0) & numpy.isin(data["object"], [row[0] for row in rows])
    assert data["object"][has_verdict].tolist() == [row[0] for row in rows]
    return numpy.flatnonzero(has_verdict)


def balanced(counts):
    """The mean over the levels of the share of right presses. `counts` is [..., level, (right, presses)]."""
    import numpy

    with numpy.errstate(invalid="ignore"):
        return numpy.nanmean(counts[..., 0] / counts[..., 1], axis=-1)


def interval(of_cover):
    """The 95 % interval of the balanced accuracy. `of_cover` is [cover, level, (right, presses)]."""
    import numpy

    drawn = numpy.random.default_rng(1).integers(len(of_cover), size=(BOOTSTRAPS, len(of_cover)))
    return numpy.percentile(balanced(of_cover[drawn].sum(axis=1)), [2.5, 97.5]).tolist()


def counted(pairs, levels=4):
    """Balanced accuracy of pairs of true and named level."""
    import numpy

    counts = numpy.zeros((levels, 2))
    for level, named in pairs:
        counts[level - 1] += [named == level, 1]
    return float(balanced(counts))


def of_objects(rows, sensors, presses):
    """True and named level of each object by its first `presses` presses, as the daemon judges an object by several."""
    import numpy

    of_object = {}
    for sensor, (key, level, _, shares, _) in zip(sensors, rows):
        of_object.setdefault((key, sensor, level), []).append(shares)
    for (_, _, level), shares in of_object.items():
        yield level, numpy.log(numpy.maximum(shares[:presses], 1e-4)).sum(axis=0).argmax() + 1


def figures(evaluated, verdicts, data):
    """What the tables show of one set and one way to be told."""
    import numpy

    rows = list(verdicts_of(verdicts))
    places = judged_presses(rows, data)
    sensors = data["sensor"][places].tolist()
    covers = sorted({sensor // ELECTRONICS for sensor in sensors})
    counts = numpy.zeros((len(covers), 4, 2))
    for sensor, (_, level, named, _, _) in zip(sensors, rows):
        counts[covers.index(sensor // ELECTRONICS), level - 1] += [named == level, 1]
    share = counts.sum(axis=1)
    materials = json.loads(data["meta"].tobytes())["materials"]
    # The named materials have none that is layered.
    is_layered = numpy.array(materials)[data["material"][places]] == "broad-layered"
    pairs = [(level, named) for _, level, named, _, _ in rows]
    sure = [level == named for _, level, named, shares, _ in rows if max(shares) > SURE]
    return {
        "balanced": float(balanced(counts.sum(axis=0))),
        "interval": interval(counts),
        "worst_cover": float((share[:, 0] / share[:, 1]).min()),
        "object_of_3": counted(of_objects(rows, sensors, 3)),
        "three_levels": counted(((THREE[level], THREE[named]) for level, named in pairs), levels=3),
        "sure": len(sure) / len(rows),
        "sure_and_wrong": 1 - sum(sure) / max(len(sure), 1),
        "layered": {"share": float(is_layered.mean())}
        | {
            name: counted(pair for pair, of_kind in zip(pairs, kind) if of_kind)
            for name, kind in (("balanced", is_layered), ("others_balanced", ~is_layered))
            if kind.any()
        },
        "median_shore_error": float(numpy.median([row[-1] for row in rows])),
        "evaluation": {key: evaluated[key] for key in KEPT},
    }


def without_positions(path, out):
    """Writes the presses at `path` as of a robot that does not say where its arm is, and returns where they are."""
    import numpy

    data = dict(numpy.load(path))
    for name in ("approach_mm", "known", "arm_n_per_mm"):
        data[name] = numpy.zeros_like(data[name])
    numpy.savez(out, **data)
    return out


def measure(trainer, work):
    import numpy

    found = {"common": COMMON, "settings": SETTINGS, "model": MODEL.name, "sets": {}}
    verdicts = work / "verdicts.csv"

    def judged(path, told):
        evaluated = trainer.judged(MODEL, path, verdicts, *TOLD[told])
        return figures(evaluated, verdicts, numpy.load(path))

    for number, (name, options) in enumerate(SETS.items()):
        settings = SETTINGS if "--materials" in options else SETTINGS + ALL_TEST
        path = trainer.simulated(work / f"set-{number}.npz", f"{COMMON} {options}", settings)
        ways = {told: judged(path, told) for told in TOLD}
        if number < UNSEEN:
            # The same presses of a robot that does not say where its arm is.
            unknown = without_positions(path, work / "unknown.npz")
            ways |= {f"{told}, no positions": judged(unknown, told) for told in WITHOUT}
            wrong = wrong_newtons(path, work / "wrong.npz")
            ways |= {f"{told}, wrong newtons": judged(wrong, told) for told in WITHOUT}
        found["sets"][name] = {"simulate": options, "ways": ways}
    training.write(HERE / "evaluations.json", trainer, found)


def row(*cells):
    print("|", " | ".join(cells), "|")


def head(*cells):
    print()
    row(*cells)
    print("|" + "---|" * len(cells))


def table():
    found = json.loads((HERE / "evaluations.json").read_text())["sets"]

    def percent(share, places=0):
        return f"{100 * share:.{places}f} %"

    def shown(of_way):
        low, high = of_way["interval"]
        return f"{percent(of_way['balanced'], 1)} ({100 * low:.1f} to {100 * high:.1f})"

    head("Test presses", *TOLD)
    for name, of_set in found.items():
        row(name, *(shown(of_set["ways"][told]) for told in TOLD))
    print(f"\nWith {USUAL}")
    head("Test presses", "Three presses", "Three levels", "Layered", "Others", "Worst cover", "Sure", "Sure and wrong")
    for name, of_set in found.items():
        of_way = of_set["ways"][USUAL]
        layered = of_way["layered"]
        shares = [of_way["object_of_3"], of_way["three_levels"], layered.get("balanced"), layered["others_balanced"]]
        shares += [of_way["worst_cover"], of_way["sure"], of_way["sure_and_wrong"]]
        row(name, *("-" if share is None else percent(share) for share in shares))
    head("Test presses", "Shore error", "Interval holds", "Set holds", "Ambiguous", "Right if named", "Confidence off by")
    for name, of_set in found.items():
        of_way = of_set["ways"][USUAL]
        all_of = of_way["evaluation"]
        shore, sets = all_of["shore"], all_of["sets"]
        shares = [shore["coverage"], sets["coverage"], sets["ambiguous"], sets["accuracy_of_others"]]
        row(name, f"{of_way['median_shore_error']:.1f}", *(percent(share) for share in shares), f"{all_of['ece']:.2f}")
    print(f"\nOver {SURE} and wrong, and the share of presses whose set holds the level")
    head("Test presses", *TOLD)
    for name, of_set in found.items():
        ways = [of_set["ways"][told] for told in TOLD]
        row(name, *(f"{percent(way['sure_and_wrong'])}, {percent(way['evaluation']['sets']['coverage'])}" for way in ways))
    for title, way in (("Newtons that are wrong by 0.5 to 2", "wrong newtons"), ("No positions of the arm", "no positions")):
        print(f"\n{title}")
        head("Test presses", *WITHOUT)
        for name, of_set in list(found.items())[:UNSEEN]:
            row(name, *(shown(of_set["ways"][f"{told}, {way}"]) for told in WITHOUT))


if __name__ == "__main__":
    training.main(__doc__, measure, table)
