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

MODEL = HERE.parent.parent / "models/course.onnx"
COMMON = "--sequences --objects 0 --test-objects 100 --test-covers 25 --electronics 4 --presses 4"
ELECTRONICS = 4
SETS = {
    "Unseen sensors, `matched` shapes": "--sensors broad --materials broad --shapes matched --seed 3101",
    "Unseen sensors, `wide` shapes": "--sensors broad --materials broad --shapes wide --seed 3102",
    "The simulated JX255N, `matched`": "--sensors jx255n --materials broad --shapes matched --seed 3103",
    "The simulated JX255N, `wide`": "--sensors jx255n --materials broad --shapes wide --seed 3104",
    "Unseen sensors, the eight named materials, `matched`": "--sensors broad --all-test --shapes matched --seed 3105",
    "Unseen sensors, the eight named materials, `wide`": "--sensors broad --all-test --shapes wide --seed 3106",
}
TOLD = {
    "nothing known": (),
    "2 + 2": ("--rigid", "2"),
    "5 + 5": ("--rigid", "5"),
    "4 labelled": ("--labelled", "1"),
    "2 + 2 and 4 labelled": ("--rigid", "2", "--labelled", "1"),
}
# The factors of the wrong newtons are spread evenly over their logarithm.
WRONG_NEWTONS = (0.5, 2.0)
BOOTSTRAPS = 1000


def verdicts_of(path):
    """Object, level, named level and the probabilities of the levels, a row each."""
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            shares = [float(row[f"probability_{level}"]) for level in (1, 2, 3, 4)]
            yield int(row["object"]), int(row["level"]), int(row["judged"]), shares


def sensors_of(rows, data):
    """The sensor of each verdict."""
    import numpy

    # Objects that serve as references have no verdict.
    has_verdict = (data["level"] > 0) & numpy.isin(data["object"], [row[0] for row in rows])
    assert data["object"][has_verdict].tolist() == [row[0] for row in rows]
    return data["sensor"][has_verdict].tolist()


def balanced(counts):
    """The mean over the levels of the share of right presses. `counts` is [..., level, (right, presses)]."""
    return (counts[..., 0] / counts[..., 1]).mean(axis=-1)


def interval(of_cover):
    """The 95 % interval of the balanced accuracy. `of_cover` is [cover, level, (right, presses)]."""
    import numpy

    drawn = numpy.random.default_rng(1).integers(len(of_cover), size=(BOOTSTRAPS, len(of_cover)))
    return numpy.percentile(balanced(of_cover[drawn].sum(axis=1)), [2.5, 97.5]).tolist()


def figures(evaluated, verdicts, data):
    """What the tables show of one set and one way to be told."""
    import numpy

    rows = list(verdicts_of(verdicts))
    sensors = sensors_of(rows, data)
    covers = sorted({sensor // ELECTRONICS for sensor in sensors})
    single, together = (numpy.zeros((len(covers), 4, 2)) for _ in range(2))
    of_object = {}
    for sensor, (key, level, named, shares) in zip(sensors, rows):
        single[covers.index(sensor // ELECTRONICS), level - 1] += [named == level, 1]
        of_object.setdefault((key, sensor, level), []).append(shares)
    for (_, sensor, level), presses in of_object.items():
        # As the daemon judges an object by several presses.
        likeliest = numpy.log(numpy.maximum(presses, 1e-4)).sum(axis=0).argmax() + 1
        together[covers.index(sensor // ELECTRONICS), level - 1] += [likeliest == level, 1]
    own = {"balanced": float(balanced(single.sum(axis=0))), "interval": interval(single)}
    own["object_of_4"] = float(balanced(together.sum(axis=0)))
    share = single.sum(axis=1)
    own["worst_cover"] = float((share[:, 0] / share[:, 1]).min())
    return own | {"evaluation": evaluated}


def with_wrong_newtons(path, out):
    """The same presses with the newtons of each sensor times a factor of its own."""
    import numpy

    data = dict(numpy.load(path))
    least, most = numpy.log(WRONG_NEWTONS)
    factors = numpy.exp(numpy.random.default_rng(2).uniform(least, most, data["sensor"].max() + 1))
    frames = data["frames_mn"] * factors[data["sensor"][data["press"]]][:, None, None]
    data["frames_mn"] = numpy.minimum(numpy.round(frames), 65535).astype(numpy.uint16)
    numpy.savez(out, **data)
    return out


def measure(trainer, work):
    import numpy

    found = {"common": COMMON, "model": MODEL.name, "sets": {}}
    verdicts = work / "verdicts.csv"

    def judged(path, told):
        evaluated = trainer.judged(MODEL, path, verdicts, *told)
        return figures(evaluated, verdicts, numpy.load(path))

    for number, (name, options) in enumerate(SETS.items()):
        path = trainer.simulated(work / f"set-{number}.npz", f"{COMMON} {options}")
        ways = {told: judged(path, arguments) for told, arguments in TOLD.items()}
        # The same presses of a robot that does not say where its arm is.
        unknown = trainer.simulated(work / f"unknown-{number}.npz", f"{COMMON} {options} --unknown 1")
        for told in ("nothing known", "2 + 2"):
            ways[f"{told}, no positions"] = judged(unknown, TOLD[told])
        if number < 2:
            wrong = with_wrong_newtons(path, work / "wrong.npz")
            for told in ("nothing known", "2 + 2"):
                ways[f"{told}, wrong newtons"] = judged(wrong, TOLD[told])
        found["sets"][name] = {"simulate": options, "ways": ways}
    training.write(HERE / "evaluations.json", trainer, found)


def table():
    found = json.loads((HERE / "evaluations.json").read_text())["sets"]

    def shown(own):
        low, high = own["interval"]
        return f"{100 * own['balanced']:.1f} % ({100 * low:.1f} to {100 * high:.1f})"

    print("| Test presses |", " | ".join(TOLD), "|")
    for name, of_set in found.items():
        print("|", " | ".join([name, *(shown(of_set["ways"][told]) for told in TOLD)]), "|")
    print("\nWith 2 + 2\n\n| Test presses | 4 presses of an object | Worst cover | Shore RMSE | Interval holds |", end=" ")
    print("Set holds | Ambiguous | Right if named | Calibration error |")
    for name, of_set in found.items():
        own = of_set["ways"]["2 + 2"]
        all_of = own["evaluation"]
        shore, sets = all_of["shore"], all_of["sets"]
        cells = [f"{100 * own['object_of_4']:.1f} %", f"{100 * own['worst_cover']:.0f} %", f"{shore['rmse']:.1f}"]
        shares = [shore["coverage"], sets["coverage"], sets["ambiguous"], sets["accuracy_of_others"]]
        cells += [f"{100 * share:.1f} %" for share in shares]
        print("|", " | ".join([name, *cells, f"{all_of['ece']:.3f}"]), "|")
    for title, way in (("Newtons that are wrong by 0.5 to 2", "wrong newtons"), ("No positions of the arm", "no positions")):
        print(f"\n{title}\n\n| Test presses | nothing known | 2 + 2 |")
        for name, of_set in found.items():
            ways = of_set["ways"]
            if f"2 + 2, {way}" in ways:
                print("|", name, "|", shown(ways[f"nothing known, {way}"]), "|", shown(ways[f"2 + 2, {way}"]), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table)
