#!/usr/bin/env python3
"""docs/formats.md as it stands: a data set made by numpy, a model made by onnx, and our programs on both.

    python tests/peers/formats.py target/debug

Claims: every Python block runs, and every command prints what the page shows (`...`: anything).
"""

import os
import pathlib
import re
import subprocess
import sys
import tempfile

PAGE = pathlib.Path(__file__).parents[2] / "docs/formats.md"


def run(command, directory, path):
    done = subprocess.run(
        command, cwd=directory, env={**os.environ, "PATH": path}, capture_output=True, text=True,
        timeout=300,
    )
    assert done.returncode == 0, (command, done)
    return done.stdout


def console(block, directory, path):
    for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
        command, _, shown = part.partition("\n")
        came = run(["bash", "-c", command], directory, path)
        print(f"$ {command}\n{came}")
        wanted = ".*".join(re.escape(text.strip()) for text in shown.split("..."))
        assert re.search(wanted, came, re.S), (command, shown, came)


def main(binaries):
    path = f"{os.path.abspath(binaries)}:{os.environ['PATH']}"
    blocks = re.findall(r"```(\w+)\n(.*?)```", PAGE.read_text(), re.S)
    assert [kind for kind, _ in blocks].count("python") == 3, blocks
    with tempfile.TemporaryDirectory() as directory:
        for kind, block in blocks:
            if kind == "console":
                console(block, directory, path)
                continue
            name = block.split("\n", 1)[0].removeprefix("# ")
            pathlib.Path(directory, name).write_text(block)
            if kind == "python":
                run([sys.executable, name], directory, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
