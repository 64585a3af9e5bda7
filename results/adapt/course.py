#!/usr/bin/env python3
"""What `hrn-train adapt` is worth to the course model on a sensor that it has not seen.

    pip install numpy
    cargo build --release --workspace
    python3 results/adapt/course.py target/release/hrn-train --work WORK
    python3 results/adapt/course.py --table         # prints the table from the committed file

A draw has 12 objects of random materials, three of each level, with 20 presses each, and 160 other objects, 40 of each
level, with 6 presses each for the test, all on one sensor. Random materials are seldom of the middle levels, so more
are simulated, and the first ones of each level are kept.

WORK keeps data sets and runs, so an interrupted call goes on. course.json, beside this file, has what
`evaluate --json` prints for every draw and model.
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
# The arrays that have a row for each frame. The others have one for each press.
OF_FRAMES = ("frames_mn", "press", "time_s", "approach_mm", "known")
COMMON = "--sequences --materials broad --gaps --shapes wide --cover 0.8 --sensor-profile raw --fps 20"


def first(path, objects, factor):
    """The presses of the first `objects` objects of each level with their newtons times `factor`, beside the whole set."""
    import numpy

    data = dict(numpy.load(path))
    kept = numpy.zeros(len(data["level"]), bool)
    for level in (1, 2, 3, 4):
        names = numpy.unique(data["object"][data["level"] == level])
        assert len(names) >= objects, f"level {level} has {len(names)} objects, not {objects}"
        kept |= numpy.isin(data["object"], names[:objects]) & (data["level"] == level)
    rows = kept[data["press"]]
    # The numbers of the kept presses and rows, counted anew.
    press, row = numpy.cumsum(kept) - 1, numpy.cumsum(rows) - 1
    data["press"], data["best"] = press[data["press"]], row[data["best"]]
    for name, values in data.items():
        if name != "meta":
            data[name] = values[rows if name in OF_FRAMES else kept]
    for name in ("press", "best"):
        data[name] = data[name].astype(numpy.uint32)
    data["frames_mn"] = numpy.round(data["frames_mn"] * factor).astype(numpy.uint16)
    meta = json.loads(bytes(data["meta"]))
    meta["settings"] = None
    data["meta"] = numpy.frombuffer(json.dumps(meta).encode(), numpy.uint8)
    out = path.with_name(f"{path.stem}-{factor}.npz")
    numpy.savez(out, **data)
    return out


def measure(trainer, work):
    found = {str(factor): {"course model": [], "adapt": []} for factor in FACTORS}
    for draw in DRAWS:
        sensor = f"{COMMON} --one-sensor {draw}"
        own = f"{sensor} --seed {90 + draw} --objects 40 --test-objects 0 --presses 20"
        own = trainer.simulated(work / f"own-{draw}.npz", own)
        test = f"{sensor} --seed {80 + draw} --objects 0 --test-objects 160 --presses 6"
        test = trainer.simulated(work / f"test-{draw}.npz", test)
        for factor in FACTORS:
            data = first(own, 3, factor), first(test, 40, factor)
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
