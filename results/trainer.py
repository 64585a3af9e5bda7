"""Calls `hrn-train` for the scripts in the directories beside this file.

What a command made before is not made again, so an interrupted script goes on.
"""

import argparse
import csv
import json
import pathlib
import subprocess


class Trainer:
    def __init__(self, program):
        self.program = program
        # The revisions of the program that made the runs.
        self.revisions = set()

    def run(self, *arguments):
        """Runs a command, which is shown, and returns what it prints."""
        command = [self.program, *map(str, arguments)]
        print("$", *command, flush=True)
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def simulated(self, path, options, settings):
        """The data set at `path`, simulated with `options` and settings in TOML unless it is there."""
        if not path.exists():
            path.with_suffix(".toml").write_text(settings)
            self.run("simulate", *options.split(), "--config", path.with_suffix(".toml"), "--out", path)
        return path

    def learnt(self, out, *command):
        """The model of the run in `out`, which `command` makes or continues unless it is finished."""
        model = out / "hrn.onnx"
        if not model.exists():
            self.run(*command, "--out", out, "--resume")
        self.revisions.update((out / "revision").read_text().split("\n"))
        return model

    def evaluated(self, model, data, *more):
        """What `evaluate --json` prints."""
        return json.loads(self.run("evaluate", "--model", model, "--data", data, *more, "--json"))

    def judged(self, model, data, verdicts, *more):
        """The same. The file `verdicts` has the verdicts of this call, and not those of an earlier one."""
        verdicts.unlink(missing_ok=True)
        return self.evaluated(model, data, *more, "--verdicts", verdicts)


def by_object(verdicts):
    """Object -> level, presses, right ones, those in the interval, and the sum of squared Shore errors."""
    counts = {}
    with open(verdicts, newline="") as file:
        for row in csv.DictReader(file):
            own = counts.setdefault(int(row["object"]), [row["level"], 0, 0, 0, 0.0])
            own[1] += 1
            own[2] += row["level"] == row["judged"]
            if row["shore"] and row["true_shore"]:
                truth = float(row["true_shore"])
                own[3] += float(row["shore_low"]) <= truth <= float(row["shore_high"])
                own[4] += (float(row["shore"]) - truth) ** 2
            else:
                own[3:] = ["", ""]
    return counts


# The arrays of a data set of courses that have a row for each frame. The others have one for each press.
OF_FRAMES = ("frames_mn", "press", "time_s", "approach_mm", "known")


def presses(data, kept):
    """The arrays of a data set of courses with only the presses where `kept` is true."""
    import numpy

    data = dict(data)
    rows = kept[data["press"]]
    # The numbers of the kept presses and rows, counted anew.
    press, row = numpy.cumsum(kept) - 1, numpy.cumsum(rows) - 1
    data["press"], data["best"] = press[data["press"]], row[data["best"]]
    for name, values in data.items():
        if name != "meta":
            data[name] = values[rows if name in OF_FRAMES else kept]
    for name in ("press", "best"):
        data[name] = data[name].astype(numpy.uint32)
    return data


CONFIDENCES = (0.5, 0.7, 0.9, 0.95)


def by_confidence(verdicts):
    """Confidence -> the presses whose verdict has at least this confidence, and the right ones among them."""
    counts = {confidence: [0, 0] for confidence in CONFIDENCES}
    with open(verdicts, newline="") as file:
        for row in csv.DictReader(file):
            sure = max(float(value) for key, value in row.items() if key.startswith("probability_"))
            for confidence, own in counts.items():
                if sure >= confidence:
                    own[0] += 1
                    own[1] += row["level"] == row["judged"]
    return counts


def print_by_level_and_confidence(written, model):
    """Prints how often each level is right, and what share of the presses has a confidence and how often it is right."""
    print("\n| Presses | Level 1 right | Level 2 | Level 3 | Level 4 | Calibration error |")
    for name, found in written["evaluations"].items():
        levels = " | ".join(f"{100 * share:.0f} %" for share in found[model]["category_accuracy"])
        print(f"| {name} | {levels} | {found[model]['ece']:.2f} |")
    print("\n| Presses |", " | ".join(f"{confidence} or more" for confidence in CONFIDENCES), "|")
    for name, found in written["confident"].items():
        presses = written["evaluations"][name][model]["n"]
        cells = [f"{100 * n / presses:.0f} %, {100 * right / n:.0f} %" if n else "-" for n, right in found[model].values()]
        print("|", name, "|", " | ".join(cells), "|")


def on_lines(value, indent=""):
    """A value as JSON. What fits on a line is on one."""
    line = json.dumps(value)
    if len(line) <= 100 or not isinstance(value, (dict, list)):
        return line
    deeper = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {on_lines(part, deeper)}" for key, part in value.items()]
        return "{\n" + ",\n".join(deeper + part for part in parts) + f"\n{indent}}}"
    return "[\n" + ",\n".join(deeper + on_lines(part, deeper) for part in value) + f"\n{indent}]"


def write(path, trainer, found):
    """Writes what was found, with the program's version, and the revisions that made the runs."""
    program = {"program": trainer.run("--version").strip(), "revisions": sorted(trainer.revisions - {""})}
    path.write_text(on_lines(program | found) + "\n")


def main(description, measure, table, *inputs):
    """Measures with the trainer, the `inputs` and the directory of --work, then prints the table. --table prints it only."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("trainer", *inputs):
        parser.add_argument(name, nargs="?", type=pathlib.Path)
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("work"))
    parser.add_argument("--table", action="store_true")
    given = vars(parser.parse_args())
    if not given["table"]:
        given["work"].mkdir(parents=True, exist_ok=True)
        measure(Trainer(given["trainer"].resolve()), *(given[name] for name in inputs), given["work"])
    table()
