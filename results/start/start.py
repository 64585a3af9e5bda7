#!/usr/bin/env python3
"""The choice of the image's scale: `hrn15`, `hrn15-strong` and `frame` under several scales, judged on held-out training objects.

    cargo build --release --workspace
    python3 results/start/start.py target/release/hrn-train paper101.npz --work WORK
    python3 results/start/start.py --table          # prints the table from the committed file

paper101.npz is of `hrn-train simulate --seed 101 --shapes paper`. The held-out objects are ten others of each material
that it trains on. No test material is looked at. WORK keeps the runs, so an interrupted call goes on. start.json,
beside this file, has what `evaluate --json` prints.

`frame` takes its scale from the code: SCALE in crates/train/src/net/frame.rs. So each of its rows needs a build of its own.
Name them hrn-train-10.2-0.1 and so on, by the two numbers of SCALE, and put them beside the trainer. A row whose build
is missing is left out.
"""

import json
import pathlib
import statistics
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import trainer as training  # noqa: E402

SEEDS = (1, 2, 3)
# full_scale_n, log_above_n.
SCALES = [(10.2, 0.0), (1.0, 0.0), (0.3, 0.0), (10.2, 1.0), (10.2, 0.1), (10.2, 0.01)]
METHODS = ("hrn15", "hrn15-strong", "frame")
HELD_OUT = "--seed 703 --objects 10 --test-objects 0 --presses 12 --shapes paper"


def measure(trainer, data, work):
    held_out = trainer.simulated(work / "held-out.npz", HELD_OUT)
    runs = []
    for method in METHODS:
        for full_scale_n, log_above_n in SCALES:
            own_trainer = trainer
            if method == "frame":
                own_trainer = training.Trainer(trainer.program.with_name(f"hrn-train-{full_scale_n}-{log_above_n}"))
                if not own_trainer.program.exists():
                    continue
            config = work / f"{full_scale_n}-{log_above_n}.toml"
            config.write_text(f"full_scale_n = {full_scale_n}\n[network]\nlog_above_n = {log_above_n}\n")
            for seed in SEEDS:
                own = ["--method", method, "--profile", "quick", "--seed", seed, "--config", config]
                out = work / f"{method}-{full_scale_n}-{log_above_n}-{seed}"
                model = own_trainer.learnt(out, "train", *own, "--data", data)
                evaluation = trainer.evaluated(model, held_out, "--split", "train")
                row = {"method": method, "full_scale_n": full_scale_n, "log_above_n": log_above_n, "seed": seed}
                runs.append(row | {"evaluation": evaluation})
            trainer.revisions |= own_trainer.revisions
    training.write(HERE / "start.json", trainer, {"held_out": HELD_OUT, "runs": runs})


def table():
    runs = json.loads((HERE / "start.json").read_text())["runs"]
    print("| `full_scale_n` | `log_above_n` |", " | ".join(f"`{method}`" for method in METHODS), "|")
    for scale in SCALES:
        cells = []
        for method in METHODS:
            own = [r for r in runs if (r["full_scale_n"], r["log_above_n"]) == scale and r["method"] == method]
            if not own:
                cells.append("-")
                continue
            percents = [100 * run["evaluation"]["accuracy"] for run in own]
            seeds = ", ".join(f"{percent:.1f}" for percent in percents)
            cells.append(f"{statistics.mean(percents):.1f} % ({seeds})")
        print("|", " | ".join(map(str, scale)), "|", " | ".join(cells), "|")


if __name__ == "__main__":
    training.main(__doc__, measure, table, "data")
