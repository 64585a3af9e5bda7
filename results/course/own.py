#!/usr/bin/env python3
"""What a few presses of one's own are worth to the built-in model: as references of the sensor, or to train it further.

    pip install numpy
    cargo build --release --workspace
    python3 results/course/own.py target/release/hrn-train --work WORK
    python3 results/course/own.py --table         # prints the table from the committed file

A draw has 12 objects of random materials, three of each level, with 20 presses each, and 160 other objects, 40 of each
level, with 6 presses each for the test, all on one sensor. Random materials are seldom of the middle levels, so more
are simulated, and the first ones of each level are kept. The references are one press of each of the 12 objects.

Revision 5703f13 is the last one whose trainer has `adapt`. With that trainer, which made the committed file, the model
is also trained on the 240 presses.

WORK keeps data sets and runs, so an interrupted call goes on. own.json, beside this file, has what `evaluate --json`
prints for every draw and way.
"""

import json
import pathlib
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402

MODEL = HERE.parent.parent / "models/course.onnx"
DRAWS = (1, 2, 3)
FACTORS = (1.0, 1.5)
COMMON = "--sequences --materials broad --gaps --shapes wide --cover 0.8 --sensor-profile raw --fps 20"


def first(path, objects, factor):
    """The arrays of the first `objects` objects of each level, with their newtons times `factor`."""
    import numpy

    data = dict(numpy.load(path))
    kept = numpy.zeros(len(data["level"]), bool)
    for level in (1, 2, 3, 4):
        names = numpy.unique(data["object"][data["level"] == level])
        assert len(names) >= objects, f"level {level} has {len(names)} objects, not {objects}"
        kept |= numpy.isin(data["object"], names[:objects]) & (data["level"] == level)
    data = training.presses(data, kept)
    data["frames_mn"] = numpy.round(data["frames_mn"] * factor).astype(numpy.uint16)
    meta = json.loads(bytes(data["meta"]))
    meta["settings"] = None
    data["meta"] = numpy.frombuffer(json.dumps(meta).encode(), numpy.uint8)
    return data


def joined(own, test):
    """The presses of both, all of the test split. The model takes its references from the first objects of a level."""
    import numpy

    test = dict(test)
    for name, before in (("press", "level"), ("best", "press")):
        test[name] = test[name] + numpy.uint32(len(own[before]))
    test["object"] = test["object"] + own["object"].max() + numpy.uint32(1)
    both = {name: own[name] if name == "meta" else numpy.concatenate([own[name], test[name]]) for name in own}
    both["split"] = numpy.ones_like(both["split"])
    return both


def has_adapt(trainer):
    return subprocess.run([trainer.program, "adapt", "--help"], capture_output=True).returncode == 0


def measure(trainer, work):
    import numpy

    def saved(name, arrays):
        numpy.savez(work / name, **arrays)
        return work / name

    found = {str(factor): {} for factor in FACTORS}
    for draw in DRAWS:
        sensor = f"{COMMON} --one-sensor {draw}"
        own = f"{sensor} --seed {90 + draw} --objects 40 --test-objects 0 --presses 20"
        own = trainer.simulated(work / f"own-{draw}.npz", own)
        test = f"{sensor} --seed {80 + draw} --objects 0 --test-objects 160 --presses 6"
        test = trainer.simulated(work / f"test-{draw}.npz", test)
        for factor in FACTORS:
            of_own, of_test = first(own, 3, factor), first(test, 40, factor)
            alone = saved("alone.npz", of_test)
            both = saved("both.npz", joined(of_own, of_test))
            ways = {
                "nothing known": trainer.evaluated(MODEL, alone),
                "12 references": trainer.evaluated(MODEL, both, "--labelled", "3"),
            }
            if has_adapt(trainer):
                data = saved(f"adapt-{draw}-{factor}.npz", of_own)
                run = work / f"adapt-{draw}-{factor}"
                adapted = trainer.learnt(run, "adapt", "--data", data, "--start", MODEL)
                ways["240 presses of training"] = trainer.evaluated(adapted, alone)
            for way, evaluated in ways.items():
                found[str(factor)].setdefault(way, []).append(evaluated)
    training.write(HERE / "own.json", trainer, {"common": COMMON, "evaluations": found})


def table():
    found = json.loads((HERE / "own.json").read_text())["evaluations"]
    print("| Newtons times |", " | ".join(found["1.0"]), "|")
    for factor, of_ways in found.items():
        cells = [factor]
        for evaluations in of_ways.values():
            balanced = [100 * sum(one["category_accuracy"]) / 4 for one in evaluations]
            rmse = [one["shore"]["rmse"] for one in evaluations]
            shown = ", ".join(f"{percent:.1f}" for percent in balanced)
            cells.append(f"{shown} %; {min(rmse):.1f} to {max(rmse):.1f} OO")
        print("|", " | ".join(cells), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table)
