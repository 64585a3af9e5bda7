#!/usr/bin/env python3
"""The choice of the image's scale: `hrn15` and `hrn15-strong` under several scales, judged on held-out training objects.

    cargo build --release --features train
    python3 results/start/start.py target/release/hrn-train paper101.npz --work WORK
    python3 results/start/start.py --table          # prints the table from the committed file

paper101.npz is of `hrn-train simulate --seed 101 --shapes paper`. The held-out objects are ten others of each material
that it trains on. No test material is looked at. WORK keeps the runs, so an interrupted call goes on. start.json,
beside this file, has what `evaluate --json` prints.
"""

import argparse
import json
import pathlib
import statistics
import subprocess

HERE = pathlib.Path(__file__).resolve().parent
SEEDS = (1, 2, 3)
# full_scale_n, log_above_n.
SCALES = [(10.2, 0.0), (1.0, 0.0), (0.3, 0.0), (10.2, 1.0), (10.2, 0.1), (10.2, 0.01)]
METHODS = ("hrn15", "hrn15-strong")
HELD_OUT = "--seed 703 --objects 10 --test-objects 0 --presses 12 --shapes paper"


def run(*command):
    print("$", *command, flush=True)
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def measure(trainer, data, work):
    work.mkdir(exist_ok=True)
    held_out = work / "held-out.npz"
    if not held_out.exists():
        run(trainer, "simulate", *HELD_OUT.split(), "--out", str(held_out))
    rows = []
    for method in METHODS:
        for full_scale_n, log_above_n in SCALES:
            config = work / f"{full_scale_n}-{log_above_n}.toml"
            config.write_text(f"full_scale_n = {full_scale_n}\n[network]\nlog_above_n = {log_above_n}\n")
            for seed in SEEDS:
                out = work / f"{method}-{full_scale_n}-{log_above_n}-{seed}"
                if not (out / "hrn.onnx").exists():
                    own = ["--method", method, "--profile", "quick", "--seed", str(seed), "--config", str(config)]
                    run(trainer, "train", *own, "--data", data, "--out", str(out), "--resume")
                judge = ["--model", str(out / "hrn.onnx"), "--data", str(held_out), "--split", "train", "--json"]
                evaluation = json.loads(run(trainer, "evaluate", *judge))
                row = {"method": method, "full_scale_n": full_scale_n, "log_above_n": log_above_n, "seed": seed}
                rows.append(row | {"evaluation": evaluation})
    written = {"revision": run(trainer, "--version").strip(), "held_out": HELD_OUT, "runs": rows}
    (HERE / "start.json").write_text(json.dumps(written, indent=1) + "\n")


def table():
    runs = json.loads((HERE / "start.json").read_text())["runs"]
    print("| `full_scale_n` | `log_above_n` |", " | ".join(f"`{method}`" for method in METHODS), "|")
    for scale in SCALES:
        cells = []
        for method in METHODS:
            own = [r for r in runs if (r["full_scale_n"], r["log_above_n"]) == scale and r["method"] == method]
            percents = [100 * run["evaluation"]["accuracy"] for run in own]
            seeds = ", ".join(f"{percent:.1f}" for percent in percents)
            cells.append(f"{statistics.mean(percents):.1f} % ({seeds})")
        print("|", " | ".join(map(str, scale)), "|", " | ".join(cells), "|")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trainer", nargs="?")
    parser.add_argument("data", nargs="?")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("start-work"))
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if not given.table:
        measure(given.trainer, given.data, given.work)
    table()
