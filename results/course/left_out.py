#!/usr/bin/env python3
"""What the built-in model owes to the variety of its sensors: trains it on sensors that are alike in one respect.

    pip install numpy
    cargo build --release --workspace && cargo build --release --workspace --example sensors
    python3 results/course/left_out.py target/release/hrn-train target/release/examples/sensors --work WORK
    python3 results/course/left_out.py --table         # prints the table from the committed file

Each run learns from a fifth of the broad sensors of models/course.md, and from a fifth of the simulated JX255Ns. In a
run that leaves one property out, the broad sensors are those that are most like the JX255N in it; the others are drawn
by chance for the run to compare with. All judge the test sets of evaluate.py, told 2 + 2 rigid presses.

WORK keeps data sets and runs, so an interrupted call goes on. left_out.json, beside this file, has the counts of every
run and cover: presses, and right ones, of each level.
"""

import json
import math
import pathlib
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402
from evaluate import BOOTSTRAPS, COMMON, ELECTRONICS, SETS, TOLD, balanced, sensors_of, verdicts_of  # noqa: E402

TEST_SETS = dict(list(SETS.items())[:2])
OF_TRAINING = "--sequences --materials broad --test-objects 0 --presses 2 --electronics 4"
BROAD = f"{OF_TRAINING} --sensors broad --objects 3000 --covers 190"
JX255N = f"{OF_TRAINING} --sensors jx255n --objects 1500 --covers 95"
TRAINING_SETS = {
    "m1": f"{BROAD} --shapes matched --seed 3001",
    "m2": f"{BROAD} --shapes matched --seed 3003",
    "w1": f"{BROAD} --shapes wide --seed 3002",
    "w2": f"{BROAD} --shapes wide --seed 3004",
    "j1": f"{JX255N} --shapes matched --seed 3005",
    "j2": f"{JX255N} --shapes wide --seed 3006",
}
SHARE = 0.2
# The JX255N's pitch and cover, and the ranges of the covers as factors.
PITCH_MM, COVER_MPA, COVER_MM = 3.5, 3.0, 1.0
COVERS_MPA, COVERS_MM = 20 / 0.3, 4 / 0.5
CONFIG = """[reports]
unknown = 0.1
unknown_arm = 0.05
exact = 0.7
position = 0.05
arm = 0.1
early = 0.1
slower = 0.1
"""


def cover_distance(sensor):
    stiffer = math.log(sensor["cover_mpa"] / COVER_MPA) / math.log(COVERS_MPA)
    return math.hypot(stiffer, math.log(sensor["cover_mm"] / COVER_MM) / math.log(COVERS_MM))


# What is left out -> how far a sensor is from the JX255N in it.
DISTANCES = {
    "pitch": lambda sensor: abs(math.log(sensor["pitch_mm"] / PITCH_MM)),
    "response law": lambda sensor: float(not sensor["linear"]),
    "cover": cover_distance,
    "hysteresis": lambda sensor: sensor["hysteresis"],
}
NOTHING = "nothing"


def described(program, data):
    """The sensors of a simulated data set, by number."""
    settings = json.dumps(json.loads(bytes(data["meta"]))["settings"])
    printed = subprocess.run([program], input=settings, check=True, capture_output=True, text=True).stdout
    return {sensor["sensor"]: sensor for sensor in json.loads(printed)}


def chosen(sensors, left_out, draws):
    """The numbers of the sensors to learn from."""
    count = round(SHARE * len(sensors))
    mixed = [sensors[number] for number in draws.permutation(sorted(sensors))]
    if left_out in DISTANCES:
        mixed.sort(key=DISTANCES[left_out])
    return [sensor["sensor"] for sensor in mixed[:count]]


def subset(sensors_program, path, out, left_out):
    """The presses of `path` on the chosen sensors."""
    import numpy

    if not out.exists():
        data = dict(numpy.load(path))
        draws = numpy.random.default_rng(1)
        of_set = described(sensors_program, data)
        # The sensors of JX255N sets are alike in everything, so these are chosen by chance.
        numbers = chosen(of_set, None if path.stem.startswith("j") else left_out, draws)
        unfinished = out.with_suffix(".part.npz")
        numpy.savez_compressed(unfinished, **training.presses(data, numpy.isin(data["sensor"], numbers)))
        unfinished.rename(out)
    return out


def counts(verdicts, data):
    """[cover, level, (right, presses)] of one run on one test set."""
    import numpy

    rows = list(verdicts_of(verdicts))
    covers = [sensor // ELECTRONICS for sensor in sensors_of(rows, data)]
    names = sorted(set(covers))
    table = numpy.zeros((len(names), 4, 2), int)
    for cover, (_, level, named, _) in zip(covers, rows):
        table[names.index(cover), level - 1] += [named == level, 1]
    return table.tolist()


def measure(trainer, sensors_program, work):
    import numpy

    config = work / "left_out.toml"
    config.write_text(CONFIG)
    verdicts = work / "verdicts.csv"
    tests = {name: trainer.simulated(work / f"test-{k}.npz", f"{COMMON} {options}") for k, (name, options) in enumerate(TEST_SETS.items())}
    found = {}
    for left_out in (NOTHING, *DISTANCES):
        run = work / left_out.replace(" ", "-")
        run.mkdir(exist_ok=True)
        data = []
        for name, options in TRAINING_SETS.items():
            path = trainer.simulated(work / f"{name}.npz", options)
            data.append(subset(sensors_program.resolve(), path, run / f"{name}.npz", left_out))
        command = ["train", "--method", "course", "--profile", "quick", "--config", config, "--data", *data]
        model = trainer.learnt(run / "run", *command)
        found[left_out] = {}
        for name, path in tests.items():
            trainer.judged(model, path, verdicts, *TOLD["2 + 2"])
            found[left_out][name] = counts(verdicts, numpy.load(path))
    training.write(HERE / "left_out.json", trainer, {"counts": found})


def table():
    import numpy

    found = json.loads((HERE / "left_out.json").read_text())["counts"]
    print("| Left out |", " | ".join(f"{name} | Cost |" for name in TEST_SETS))
    for left_out, of_sets in found.items():
        cells = []
        for name, of_cover in of_sets.items():
            own, whole = numpy.array(of_cover, float), numpy.array(found[NOTHING][name], float)
            drawn = numpy.random.default_rng(1).integers(len(own), size=(BOOTSTRAPS, len(own)))
            less = balanced(whole[drawn].sum(axis=1)) - balanced(own[drawn].sum(axis=1))
            low, high = 100 * numpy.percentile(less, [2.5, 97.5])
            cost = 100 * (balanced(whole.sum(axis=0)) - balanced(own.sum(axis=0)))
            cells.append(f"{100 * balanced(own.sum(axis=0)):.1f} %")
            cells.append("" if left_out == NOTHING else f"{cost:.1f} points ({low:.1f} to {high:.1f})")
        print("|", " | ".join([left_out, *cells]), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table, "sensors")
