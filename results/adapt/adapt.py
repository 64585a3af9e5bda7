#!/usr/bin/env python3
"""What `hrn-train adapt` is worth on sensors that the built-in model has not seen, beside other ways.

    pip install numpy
    cargo build --release --workspace
    python3 results/adapt/adapt.py target/release/hrn-train --work WORK
    python3 results/adapt/adapt.py --table          # prints the table from the committed file

A draw has 20 objects of each level with 20 presses each, all on one sensor. Of each level, three objects are labelled,
five are unlabelled, and the last twelve are the test. The objects are of random materials, or of the eight named ones.
Random materials are seldom of the middle levels, so more are simulated, and the first ones of each level are kept. The
two named materials of a level take turns, so all three parts have both. One more model learns from 640 other objects of
these materials on the same sensor, 160 of each level: it shows how much the few objects leave to be learnt.

WORK keeps data sets and runs, so an interrupted call goes on. adapt.json, beside this file, has what `evaluate --json`
prints for every sensor, draw and model.
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
# Objects of each level: of a draw, its labelled and its unlabelled ones, and of the last model.
OBJECTS, LABELLED, UNLABELLED, MANY = 20, 3, 5, 160
PRESSES = "--presses 20 --sensor-profile raw"
# Materials -> options of `simulate` that give at least a number of objects of each level.
MATERIALS = {
    "random": lambda objects: f"--materials broad --gaps --objects {4 * objects + 80} --test-objects 0",
    "named": lambda objects: f"--materials named --objects {objects // 2} --test-objects {objects // 2}",
}
# Name -> the materials, more options, and what the newtons are multiplied by.
SENSORS = {
    "A": ("random", "--shapes matched --cover 1.5", 1.0),
    "B": ("random", "--shapes matched --cover 8", 1.0),
    "A, newtons 1.5 times as large": ("random", "--shapes matched --cover 1.5", 1.5),
    "A, wide shapes": ("random", "--shapes wide --cover 1.5", 1.0),
    "A, named materials": ("named", "--shapes matched --cover 1.5", 1.0),
    "B, named materials": ("named", "--shapes matched --cover 8", 1.0),
    "A, named materials, newtons 1.5 times as large": ("named", "--shapes matched --cover 1.5", 1.5),
    "A, named materials, wide shapes": ("named", "--shapes wide --cover 1.5", 1.0),
}
# Name -> the directory of the run, its command, and which of the draw's sets it learns from.
LEARNT = {
    "adapt": ("adapt", ["adapt"], "labelled"),
    "adapt, unlabelled too": ("adapt-both", ["adapt"], "both"),
    "features": ("features", ["train", "--method", "features"], "labelled"),
    "hrn15-strong": ("strong", ["train", "--method", "hrn15-strong", "--labels", "240"], "labelled"),
    "frame": ("frame", ["train", "--method", "frame"], "labelled"),
    "frame, 640 objects": ("frame-many", ["train", "--method", "frame", "--profile", "quick"], "many"),
}
MODELS = ("built-in", *LEARNT)


def read(path, factor):
    """A data set with scaled newtons, without the settings that no longer describe it."""
    import numpy

    data = dict(numpy.load(path))
    data["frames"] = (data["frames"] * factor).astype(numpy.float32)
    meta = json.loads(bytes(data["meta"]))
    meta["settings"] = None
    data["meta"] = numpy.frombuffer(json.dumps(meta).encode(), numpy.uint8)
    return data


def write(path, data, kept, test=False, **changed):
    """Writes the samples where `kept` is true."""
    import numpy

    changed["split"] = numpy.full(len(kept), test, numpy.uint8)
    rows = {key: values[kept] for key, values in (data | changed).items() if key != "meta"}
    numpy.savez(path, **rows, meta=data["meta"])


def places(data, taking_turns):
    """The place of every sample's object among those of its level. Materials take turns, or objects keep their order."""
    import numpy

    place = numpy.zeros(len(data["level"]), int)
    for level in (1, 2, 3, 4):
        own = numpy.flatnonzero(data["level"] == level)
        materials = data["material"][own] if taking_turns else numpy.zeros(len(own), int)
        order = []
        for material in numpy.unique(materials):
            of_material = numpy.unique(data["object"][own[materials == material]])
            order += [(turn, material, name) for turn, name in enumerate(of_material)]
        place_of = {name: at for at, (_, _, name) in enumerate(sorted(order))}
        place[own] = [place_of[name] for name in data["object"][own]]
    return place


def first(data, taking_turns, objects):
    """The places, and which samples are of the first `objects` objects of their level. No level may have fewer."""
    place = places(data, taking_turns)
    for level in (1, 2, 3, 4):
        there = place[data["level"] == level].max(initial=-1) + 1
        assert there >= objects, f"level {level} has {there} objects, not {objects}"
    return place, place < objects


def split(data, taking_turns, out):
    """Writes the draw as three data sets: labelled, with unlabelled presses too, and the test."""
    import numpy

    place, kept = first(data, taking_turns, OBJECTS)
    labelled, learnt = place < LABELLED, place < LABELLED + UNLABELLED
    write(out / "labelled.npz", data, labelled)
    write(out / "both.npz", data, learnt, level=numpy.where(labelled, data["level"], 0).astype(numpy.uint8))
    write(out / "test.npz", data, kept & ~learnt, test=True)


def measure(trainer, work):
    found = {sensor: {model: [] for model in MODELS} for sensor in SENSORS}
    for sensor, (materials, more, factor) in SENSORS.items():
        for draw in DRAWS:
            place = work / f"{sensor}-{draw}".replace(" ", "-").replace(",", "")
            place.mkdir(exist_ok=True)
            options = f"{PRESSES} {more} --one-sensor {90 + draw}"
            taking_turns = materials == "named"
            path = trainer.simulated(place / "all.npz", f"{MATERIALS[materials](OBJECTS)} {options} --seed {900 + draw}")
            split(read(path, factor), taking_turns, place)
            path = trainer.simulated(place / "many-all.npz", f"{MATERIALS[materials](MANY)} {options} --seed {950 + draw}")
            many = read(path, factor)
            write(place / "many.npz", many, first(many, taking_turns, MANY)[1])
            models = {"built-in": BUILT_IN}
            for name, (run, command, data) in LEARNT.items():
                models[name] = trainer.learnt(place / run, *command, "--data", place / f"{data}.npz")
            for name, model in models.items():
                found[sensor][name].append(trainer.evaluated(model, place / "test.npz"))
    sensors = {name: (MATERIALS[materials](OBJECTS), *rest) for name, (materials, *rest) in SENSORS.items()}
    written = {"common": PRESSES, "sensors": sensors, "evaluations": found}
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
