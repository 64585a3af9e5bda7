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

import argparse
import json
import pathlib
import statistics
import subprocess

HERE = pathlib.Path(__file__).resolve().parent
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
TRAINED = {
    "features": ["--method", "features"],
    "hrn100": ["--method", "hrn100", "--profile", "quick"],
    "frame": ["--method", "frame", "--profile", "quick"],
}
MODELS = ("built-in", "adapt", "adapt, unlabelled too", *TRAINED)


def run(*command):
    print("$", *command, flush=True)
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


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
    found = {}
    for sensor, (options, factor) in SENSORS.items():
        for draw in DRAWS:
            place = work / f"{sensor}-{draw}".replace(" ", "-").replace(",", "")
            place.mkdir(parents=True, exist_ok=True)
            if not (place / "test.npz").exists():
                seeds = ["--seed", str(900 + draw), "--one-sensor", str(90 + draw)]
                run(trainer, "simulate", *COMMON.split(), *options.split(), *seeds, "--out", str(place / "all.npz"))
                split(place / "all.npz", factor, place)
            labelled, both = str(place / "labelled.npz"), str(place / "both.npz")
            commands = {"adapt": ["adapt", "--data", labelled], "adapt, unlabelled too": ["adapt", "--data", both]}
            commands |= {name: ["train", *own, "--data", labelled] for name, own in TRAINED.items()}
            for name in MODELS:
                model = BUILT_IN
                if name in commands:
                    directory = place / name.split(",")[0] if name != MODELS[2] else place / "adapt-both"
                    model = directory / "hrn.onnx"
                    if not model.exists():
                        run(trainer, *commands[name], "--out", str(directory), "--resume")
                text = run(trainer, "evaluate", "--model", str(model), "--data", str(place / "test.npz"), "--json")
                found.setdefault(sensor, {}).setdefault(name, []).append(json.loads(text))
    written = {"revision": run(trainer, "--version").strip(), "common": COMMON, "sensors": SENSORS}
    written["evaluations"] = found
    (HERE / "adapt.json").write_text(json.dumps(written, indent=1) + "\n")


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trainer", nargs="?")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("adapt-work"))
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if not given.table:
        measure(given.trainer, given.work)
    table()
