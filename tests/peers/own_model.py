#!/usr/bin/env python3
"""examples/own_model.py as a reader runs it, from the first press to verdicts of models of one's own.

    PYTHON tests/peers/own_model.py target/debug [--pictures DIRECTORY]

PYTHON has what the example says, best of all with torch. Claims: the example runs to its end; its recordings have
their labels; the daemon's inference library recognises as many presses as scikit-learn and PyTorch (the example
asserts that); and the daemon judged with the models that the example made, and is mostly right on presses that they
did not learn from.
"""

import importlib.util
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

from hardnessd import recording

EXAMPLE = pathlib.Path(__file__).parents[2] / "examples/own_model.py"


def main(binaries, pictures):
    environment = {**os.environ, "PATH": f"{os.path.abspath(binaries)}:{os.environ['PATH']}"}
    expected = ["scikit-learn", *(["PyTorch"] if importlib.util.find_spec("torch") else [])]
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name, "own")
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, EXAMPLE, directory],
            env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, timeout=400,
        )
        took_s = time.monotonic() - start
        print(done.stdout)
        assert done.returncode == 0, done.returncode
        picture(directory / "presses.png", pictures)
        labels = set()
        for path in directory.glob("*.mcap"):
            with recording.open(path) as take:
                labels.add((take.labels["level"], take.labels["object"]))
        assert labels == {(str(level), str(10 * level + n)) for level in (1, 2, 3, 4) for n in (1, 2, 3)}, labels
        models = {}
        for library in expected:
            inspected = subprocess.run(
                ["hrn-train", "inspect", f"own-{library}.onnx"],
                cwd=directory, env=environment, stdout=subprocess.PIPE, text=True, check=True,
            ).stdout
            models[library] = re.search(r"sha256 +([0-9a-f]{12})", inspected)[1]
    found = re.findall(r"^(\S+): (\d+) of (\d+) presses right, judged by model (\w+)$", done.stdout, re.M)
    assert {library: by for library, _, _, by in found} == models and len(found) == len(models), (found, models)
    for library, right, judged, _ in found:
        # A model that learnt nothing is right once in four times.
        assert int(judged) == 48 and int(right) > 0.6 * int(judged), (library, right, judged)
    shares = {library: f"{right}/{judged}" for library, right, judged, _ in found}
    print(json.dumps({"seconds": round(took_s), **shares}))


def picture(path, folder):
    """The example draws if it can."""
    if importlib.util.find_spec("matplotlib"):
        assert path.stat().st_size > 20_000, path.stat()
        if folder:
            os.makedirs(folder, exist_ok=True)
            shutil.copy(path, folder)


if __name__ == "__main__":
    binaries, *pictures = sys.argv[1:]
    main(binaries, pictures[-1] if pictures else None)
