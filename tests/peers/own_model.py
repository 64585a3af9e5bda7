#!/usr/bin/env python3
"""examples/own_model.py with real PyTorch, from a data set to verdicts.

    PYTHON tests/peers/own_model.py target/debug

PYTHON has torch and the Python client with its reader of data sets. Claims: the example runs to its end on one
thread, the daemon's inference library recognises as many presses as PyTorch (the example asserts that), and a
replay judges with the model that the example made.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

EXAMPLE = pathlib.Path(__file__).parents[2] / "examples/own_model.py"


def main(binaries):
    environment = {**os.environ, "PATH": f"{os.path.abspath(binaries)}:{os.environ['PATH']}"}
    with tempfile.TemporaryDirectory() as directory:
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, EXAMPLE, directory],
            env=environment, stdout=subprocess.PIPE, text=True, timeout=300,
        )
        print(done.stdout)
        assert done.returncode == 0, done.returncode
        took_s = time.monotonic() - start
        inspected = subprocess.run(
            ["hrn-train", "inspect", "own.onnx"],
            cwd=directory, env=environment, stdout=subprocess.PIPE, text=True, check=True,
        ).stdout
    model = re.search(r"sha256 +([0-9a-f]{12})", inspected)[1]
    verdicts = re.findall(r"^press \d+: level (\d), .*, by (\w+)$", done.stdout, re.M)
    assert len(verdicts) >= 5 and {by for _, by in verdicts} == {model}, (verdicts, model)
    # Wood is of level 1, and a model that learnt nothing says so once in four times.
    right = sum(level == "1" for level, _ in verdicts)
    assert right > len(verdicts) / 2, verdicts
    recognised = float(re.search(r"([\d.]+)% of \d+ presses of the test materials", done.stdout)[1])
    assert recognised > 50, recognised
    print(json.dumps({"seconds": round(took_s), "recognised": recognised, "wood as level 1": f"{right}/{len(verdicts)}"}))


if __name__ == "__main__":
    main(sys.argv[1])
