#!/usr/bin/env python3
"""What `hrn-train adapt` is worth to the course model on a sensor that it has not seen.

    pip install numpy
    cargo build --release --features train
    python3 results/adapt/course.py target/release/hrn-train --work WORK
    python3 results/adapt/course.py --table         # prints the table from the committed file

A draw has 12 objects of random materials, three of each level, with 20 presses each, and 160 other objects with 6 presses
each for the test, all on one sensor. WORK keeps data sets and runs, so an interrupted call goes on. course.json, beside
this file, has what `evaluate --json` prints for every draw and model.
"""

import json
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402

COURSE = HERE.parent.parent / "models/course.onnx"
DRAWS = (1, 2, 3)
FACTORS = (1.0, 1.5)
COMMON = "--sequences --materials broad --gaps --shapes wide --cover 0.8 --sensor-profile raw --fps 20"


def scaled(path, factor):
    """The data set with its newtons times `factor`, beside it."""
    import numpy

    if factor == 1.0:
        return path
    data = dict(numpy.load(path))
    data["frames_mn"] = numpy.round(data["frames_mn"] * factor).astype(numpy.uint16)
    out = path.with_name(f"{path.stem}-{factor}.npz")
    numpy.savez(out, **data)
    return out


def measure(trainer, work):
    found = {str(factor): {"course model": [], "adapt": []} for factor in FACTORS}
    for draw in DRAWS:
        sensor = f"{COMMON} --one-sensor {draw}"
        own = f"{sensor} --seed {90 + draw} --objects 3 --test-objects 0 --presses 20"
        own = trainer.simulated(work / f"own-{draw}.npz", own)
        test = f"{sensor} --seed {80 + draw} --objects 0 --test-objects 40 --presses 6"
        test = trainer.simulated(work / f"test-{draw}.npz", test)
        for factor in FACTORS:
            data = scaled(own, factor), scaled(test, factor)
            adapted = trainer.learnt(work / f"adapt-{draw}-{factor}", "adapt", "--data", data[0], "--start", COURSE)
            for name, model in (("course model", COURSE), ("adapt", adapted)):
                found[str(factor)][name].append(trainer.evaluated(model, data[1]))
    training.write(HERE / "course.json", trainer, {"common": COMMON, "evaluations": found})


def table():
    found = json.loads((HERE / "course.json").read_text())["evaluations"]
    print("| Newtons times | Model |", " | ".join(f"Draw {draw}" for draw in DRAWS), "|")
    for factor, of_models in found.items():
        for name, evaluations in of_models.items():
            percents = [f"{100 * evaluation['accuracy']:.1f} %" for evaluation in evaluations]
            print(f"| {factor} | {name} |", " | ".join(percents), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table)
