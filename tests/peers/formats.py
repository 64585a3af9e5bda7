#!/usr/bin/env python3
"""docs/formats.md and models/README.md: a data set made by numpy, a model made by onnx, our programs on
both, and the default model in onnxruntime.

    python tests/peers/formats.py target/debug

Claims: the programs of examples/numpy_model run, every command prints what the page shows (`...`: anything), a data set of
`hrn-train simulate` has the arrays that the page lists, and the card's example judges a press.
"""

import json
import os
import pathlib
import re
import shutil
import sys
import tempfile

import bench
import numpy as np

ROOT = pathlib.Path(__file__).parents[2]
PAGE = ROOT / "docs/formats.md"
CARD = ROOT / "models/README.md"


def run(command, directory, path):
    return bench.run(*command, cwd=directory, env={**os.environ, "PATH": path}).stdout


def console(block, directory, path):
    for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
        command, _, shown = part.partition("\n")
        came = run(["bash", "-c", command], directory, path)
        print(f"$ {command}\n{came}")
        wanted = ".*".join(re.escape(text.strip()) for text in shown.split("..."))
        assert re.search(wanted, came, re.S), (command, shown, came)


def main(binaries):
    # `python3` of the page's commands is this one, which has numpy.
    path = f"{os.path.abspath(binaries)}:{os.path.dirname(sys.executable)}:{os.environ['PATH']}"
    blocks = re.findall(r"```(\w+)\n(.*?)```", PAGE.read_text(), re.S)
    assert [kind for kind, _ in blocks].count("console") == 2, blocks
    with tempfile.TemporaryDirectory() as directory:
        for program in (ROOT / "examples/numpy_model").iterdir():
            shutil.copy(program, directory)
        for kind, block in blocks:
            if kind == "console":
                console(block, directory, path)
                continue
            if kind == "text":
                continue
            name = block.split("\n", 1)[0].removeprefix("# ").split(":")[0]
            pathlib.Path(directory, name).write_text(block)
            if kind == "python":
                run([sys.executable, name], directory, path)
        simulated(directory, path)
    card()


def simulated(directory, path):
    """What the page says of a data set, against one that `simulate` has written."""
    few = "--objects 1 --test-objects 1 --presses 2".split()
    run(["hrn-train", "simulate", "--out", "simulated.npz", *few], directory, path)
    data = np.load(pathlib.Path(directory, "simulated.npz"))
    section = PAGE.read_text().split("## A data set")[1].split("```")[0]
    listed = dict(re.findall(r"^\| `(\w+)` \| (\w+) \| \[", section, re.M))
    kinds = {"f32": np.float32, "u8": np.uint8, "u32": np.uint32}
    assert {name: data[name].dtype for name in data} == {name: kinds[kind] for name, kind in listed.items()}
    meta = json.loads(data["meta"].tobytes())
    rows = re.findall(r"^\| `(\w+)` \| (both|`simulate`|`collect`) \|", PAGE.read_text(), re.M)
    assert set(meta) == {key for key, by in rows if by != "`collect`"}, (sorted(meta), rows)


def card():
    """The example of the model's card."""
    (example,) = re.findall(r"```python\n(.*?)```", CARD.read_text(), re.S)
    printed = bench.run(sys.executable, "-c", example, cwd=ROOT).stdout
    print(printed)
    shore, *levels = printed.splitlines()
    low, value, high = (float(re.fullmatch(r"Shore (\d+) \((\d+) to (\d+)\)", shore)[n]) for n in (2, 1, 3))
    assert 0 <= low <= value <= high <= 100, shore
    shares = [float(line.split()[1]) for line in levels]
    assert len(shares) == 4 and abs(sum(shares) - 1) < 0.01, shares


if __name__ == "__main__":
    main(*sys.argv[1:])
