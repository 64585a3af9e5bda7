#!/usr/bin/env python3
"""What `hrn-train adapt` is worth on sensors that the built-in model has not seen, beside other ways.

    pip install numpy
    cargo build --release --features train
    python3 results/adapt/adapt.py target/release/hrn-train --work WORK
    python3 results/adapt/adapt.py --table          # prints the table from the committed file

A draw has 20 random objects of each level with 20 presses each, all on one sensor. Of each level, three objects are
labelled, five are unlabelled, and the last twelve are the test. WORK keeps data sets and runs, so an interrupted call
goes on. adapt.json, beside this file, has what `evaluate --json` prints for every sensor, draw and model.
"""

import json
import pathlib
import statistics
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402

BUILT_IN = HERE.parent.parent / "models/hrn.onnx"
DRAWS = (1, 2, 3)
LABELLED, UNLABELLED = 3, 5
# Name -> options of `simulate`, and what the newtons are multiplied by.
SENSORS = {
    "A": ("--shapes matched --cover 1.5", 1.0),
    "B": ("--shapes matched --cover 8", 1.0),
    "A, newtons 1.5 times as large": ("--shapes matched --cover 1.5", 1.5),
    "A, wide shapes": ("--shapes wide --cover 1.5", 1.0),
}
COMMON = "--materials broad --gaps --objects 20 --test-objects 0 --presses 20 --sensor-profile raw"
# Name -> the directory of the run, its command, and which of the draw's sets it learns from.
LEARNT = {
    "adapt": ("adapt", ["adapt"], "labelled"),
    "adapt, unlabelled too": ("adapt-both", ["adapt"], "both"),
    "features": ("features", ["train", "--method", "features"], "labelled"),
    "hrn100": ("hrn100", ["train", "--method", "hrn100", "--profile", "quick"], "labelled"),
    "frame": ("frame", ["train", "--method", "frame", "--profile", "quick"], "labelled"),
}
MODELS = ("built-in", *LEARNT)


def split(path, factor, out):
    """Writes the draw as three data sets: labelled, with unlabelled presses too, and the test."""
    import numpy

    data = dict(numpy.load(path))
    data["frames"] = (data["frames"] * factor).astype(numpy.float32)
    place = numpy.zeros(len(data["level"]), int)
    for level in (1, 2, 3, 4):
        own = data["level"] == level
        _, place[own] = numpy.unique(data["object"][own], return_inverse=True)
    labelled, test = place < LABELLED, place >= LABELLED + UNLABELLED
    meta = json.loads(bytes(data["meta"]))
    meta["settings"] = None
    data["meta"] = numpy.frombuffer(json.dumps(meta).encode(), numpy.uint8)

    def write(name, kept, level=data["level"], split=0):
        rows = {key: values[kept] for key, values in data.items() if key != "meta"}
        rows |= {"level": level[kept], "split": numpy.full(kept.sum(), split, numpy.uint8), "meta": data["meta"]}
        numpy.savez(out / f"{name}.npz", **rows)

    write("labelled", labelled)
    write("both", ~test, level=numpy.where(labelled, data["level"], 0).astype(numpy.uint8))
    write("test", test, split=1)


def measure(trainer, work):
    found = {sensor: {model: [] for model in MODELS} for sensor in SENSORS}
    for sensor, (options, factor) in SENSORS.items():
        for draw in DRAWS:
            place = work / f"{sensor}-{draw}".replace(" ", "-").replace(",", "")
            place.mkdir(exist_ok=True)
            seeds = f"--seed {900 + draw} --one-sensor {90 + draw}"
            split(trainer.simulated(place / "all.npz", f"{COMMON} {options} {seeds}"), factor, place)
            models = {"built-in": BUILT_IN}
            for name, (run, command, data) in LEARNT.items():
                models[name] = trainer.learnt(place / run, *command, "--data", place / f"{data}.npz")
            for name, model in models.items():
                found[sensor][name].append(trainer.evaluated(model, place / "test.npz"))
    written = {"common": COMMON, "sensors": SENSORS, "evaluations": found}
    training.write(HERE / "adapt.json", trainer, written)


def table():
    found = json.loads((HERE / "adapt.json").read_text())["evaluations"]
    print("| Sensor |", " | ".join(MODELS), "|")
    for sensor, of_models in found.items():
        cells = [sensor]
        for name in MODELS:
            percents = [100 * evaluation["accuracy"] for evaluation in of_models[name]]
            cells.append(f"{statistics.mean(percents):.1f} ({min(percents):.1f} to {max(percents):.1f})")
        print("|", " | ".join(cells), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table)
