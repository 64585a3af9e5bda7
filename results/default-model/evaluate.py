#!/usr/bin/env python3
"""The evaluations behind models/README.md: simulates the test sets, judges the models, writes what they reached.

    cargo build --release --workspace
    git show c57c8aa:models/hrn.onnx > before.onnx
    python3 results/default-model/evaluate.py target/release/hrn-train before.onnx --work WORK
    pip install numpy scipy
    python3 results/default-model/evaluate.py --table          # prints the tables from the committed files

Five other models are trained first: `features` on the presses of the default model, `features` and the default
model's method on its random materials alone, and the other two candidates for the default model. Those of random
materials alone know none of the eight named materials. WORK keeps data sets and these runs, 1 GB, so an interrupted
call goes on. Written beside this file:

- evaluations.json: the command of every set, what `evaluate --json` prints for every set and model, and how many
  verdicts have at least a confidence, with the right ones among them;
- objects.csv: for every set, model and object its level, its presses, the right ones, those whose true Shore hardness
  lies in the model's interval, and the sum of squared Shore errors (the last two empty where one is unknown).
"""

import csv
import json
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import intervals  # noqa: E402
import trainer as training  # noqa: E402

BROAD = "--materials broad --gaps --objects 300 --test-objects 0 --presses 10"
NAMED = "--objects 25 --test-objects 0"
TRAINING = {
    "n_paper": f"--seed 101 --shapes paper {NAMED}",
    "n_matched": f"--seed 102 --shapes matched {NAMED}",
    "fw": f"--seed 601 --shapes wide {BROAD}",
    "fm": f"--seed 602 --shapes matched {BROAD}",
    "fw2": f"--seed 603 --shapes wide {BROAD}",
    "fm2": f"--seed 604 --shapes matched {BROAD}",
}
RANDOM = ["fw", "fm", "fw2", "fm2"]
# Name -> the method, what it learns from, and its settings.
TRAINED = {
    "features": ("features", list(TRAINING), ""),
    "features, random alone": ("features", RANDOM, ""),
    "frame, random alone": ("frame", RANDOM, ""),
    "frame, half balanced": ("frame", list(TRAINING), "training.level_balance = 0.5"),
    "frame, random alone, not balanced, other sensors": (
        "frame",
        RANDOM,
        "training.level_balance = 0.0\ntraining.augmentation.other_sensors = true",
    ),
}
MODELS = ["default", "before", *TRAINED]


def sets():
    """Name -> the options of `simulate`, and the split to judge."""
    found = {}
    raw = {"": "", ", raw": " --sensor-profile raw"}
    others = "--sequences --materials broad --seed 51 --objects 0 --test-objects 60 --presses 6 --fps 20..20"
    for profile, option in raw.items():
        for shapes in ("matched", "wide"):
            found[f"other materials, {shapes}{profile}"] = f"{others} --gaps --shapes {shapes}{option}", "test"
    for shapes in ("matched", "wide"):
        found[f"other materials, {shapes}, no gaps"] = f"{others} --shapes {shapes}", "test"
    for profile, option in raw.items():
        for seed, shapes in ((201, "paper"), (202, "matched"), (203, "wide")):
            own = f"--seed {seed} --objects 0 --test-objects 20 --shapes {shapes}{option}"
            found[f"the four test materials, {shapes}{profile}"] = own, "test"
    for profile, option in raw.items():
        for seed, shapes in ((202, "matched"), (203, "wide")):
            # With all roles swapped, the materials that others train on are the test.
            own = f"--seed {seed} --objects 0 --test-objects 20 --shapes {shapes} --swapped-levels 1234{option}"
            found[f"the four training materials, {shapes}{profile}"] = own, "test"
    for shapes in ("matched", "wide"):
        own = f"--materials broad --gaps --seed 701 --objects 60 --test-objects 0 --presses 10 --shapes {shapes}"
        found[f"candidates: other materials, {shapes}"] = own, "train"
    own = "--seed 703 --objects 10 --test-objects 10 --presses 12 --shapes matched"
    found["candidates: training materials, matched"] = own, "train"
    return found


def measure(trainer, before, work):
    data = {name: trainer.simulated(work / f"{name}.npz", options) for name, options in TRAINING.items()}
    models = {"default": HERE.parent.parent / "models/hrn.onnx", "before": before}
    for name, (method, sources, settings) in TRAINED.items():
        run = work / name.replace(",", "").replace(" ", "-")
        config = run.with_suffix(".toml")
        config.write_text(settings)
        command = ["train", "--method", method, "--profile", "quick", "--config", config]
        command += [word for source in sources for word in ("--data", data[source])]
        models[name] = trainer.learnt(run, *command)
    found = {"sets": {}, "evaluations": {}, "confident": {}}
    rows = []
    for number, (name, (options, split)) in enumerate(sets().items()):
        test = trainer.simulated(work / f"set-{number}.npz", options)
        found["sets"][name] = {"simulate": options, "split": split}
        found["evaluations"][name] = {}
        found["confident"][name] = {}
        for model, path in models.items():
            verdicts = work / "verdicts.csv"
            evaluated = trainer.judged(path, test, verdicts, "--split", split)
            found["evaluations"][name][model] = evaluated
            found["confident"][name][model] = training.by_confidence(verdicts)
            for key, (level, n, right, held, squares) in training.by_object(verdicts).items():
                squares = squares if squares == "" else f"{squares:.1f}"
                rows.append([name, model, key, level, n, right, held, squares])
    training.write(HERE / "evaluations.json", trainer, found)
    with open(HERE / "objects.csv", "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["set", "model", "object", "level", "presses", "right", "in_interval", "squared_errors"])
        table.writerows(rows)


def clusters(objects, name):
    """[right, samples] by cluster: the four test objects that have a shape in common, otherwise each object. Objects of
    paper shapes have no shape in common, and neither have the training objects that the candidates are judged on."""
    if "paper" in name or name.startswith("candidates"):
        return {(level, number): [right, presses] for number, level, presses, right in objects}
    return intervals.of_objects([(n, right, presses) for n, _, presses, right in objects], len(objects) // 4)


def of_all_eight(evaluations, presses):
    """Model -> its accuracy on the eight named materials: the mean of two sets of the same size."""
    halves = [evaluations[f"the four {role} materials, {presses}"] for role in ("test", "training")]
    return {model: sum(half[model]["accuracy"] for half in halves) / 2 for model in MODELS}


def of_the_default_on_all_eight(evaluations, rows, presses):
    """The default model's accuracy with its interval, its Shore error, and two shares, on the eight named materials. Each
    shape has eight objects, because both sets have the same seed: the interval draws these eight together."""
    names = [f"the four {role} materials, {presses}" for role in ("test", "training")]
    shapes = {}
    for name in names:
        for shape, (right, samples) in clusters(of_set(rows, name), name).items():
            before = shapes.get(shape, [0, 0])
            shapes[shape] = [before[0] + right, before[1] + samples]
    mean, low, high = (100 * value for value in intervals.interval([shapes], 0))
    found = [evaluations[name]["default"] for name in names]
    rmse = (sum(one["shore"]["rmse"] ** 2 for one in found) / 2) ** 0.5
    holds = 50 * sum(one["shore"]["coverage"] for one in found)
    beyond = 50 * sum(one["beyond_neighbour"] for one in found)
    return f"{mean:.1f} % ({low:.1f} to {high:.1f}) | {rmse:.1f} | {holds:.1f} % | {beyond:.1f} %"


def of_set(rows, name):
    """Object, level, presses and right ones of every object of a set."""
    keys = ("object", "level", "presses", "right")
    return [tuple(int(row[key]) for key in keys) for row in rows if row["set"] == name]


def table():
    with open(HERE / "objects.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["model"] == "default"]
    written = json.loads((HERE / "evaluations.json").read_text())
    print("| Presses | Default model | Shore RMSE | Its interval holds | Beyond the neighbour |", end=" ")
    print(" | ".join(MODELS[1:]), "|")
    for name, found in written["evaluations"].items():
        own, shore = found["default"], found["default"]["shore"]
        _, low, high = (100 * value for value in intervals.interval([clusters(of_set(rows, name), name)], 0))
        cells = [name, f"{100 * own['accuracy']:.1f} % ({low:.1f} to {high:.1f})"]
        cells.append(f"{shore['rmse']:.1f}" if shore else "-")
        cells.append(f"{100 * shore['coverage']:.1f} %" if shore else "-")
        cells.append(f"{100 * own['beyond_neighbour']:.1f} %")
        cells += [f"{100 * found[model]['accuracy']:.1f} %" for model in MODELS[1:]]
        print("|", " | ".join(cells), "|")
    print("\n| Presses | Default model | Shore RMSE | Its interval holds | Beyond the neighbour |", end=" ")
    print(" | ".join(MODELS[1:]), "|")
    for presses in ("matched", "wide", "matched, raw", "wide, raw"):
        default = of_the_default_on_all_eight(written["evaluations"], rows, presses)
        shares = of_all_eight(written["evaluations"], presses)
        others = " | ".join(f"{100 * shares[model]:.1f} %" for model in MODELS[1:])
        print(f"| All eight named materials, {presses} | {default} | {others} |")
    print("\n| Presses | Level 1 | Level 2 | Level 3 | Level 4 | Near a border |")
    for name, found in written["evaluations"].items():
        if shore := found["default"]["shore"]:
            errors = [*shore["rmse_by_level"], shore["rmse_near_borders"]]
            print("|", name, "|", " | ".join("-" if e is None else f"{e:.1f}" for e in errors), "|")
    training.print_by_level_and_confidence(written, "default")


if __name__ == "__main__":
    training.main(__doc__, measure, table, "before")
