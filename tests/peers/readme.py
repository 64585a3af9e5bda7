#!/usr/bin/env python3
"""The commands of the README's "Train on your own objects", as they stand there.

    python tests/peers/readme.py target/debug

Claims: they run to their end, in a directory of their own, and the model that comes of them judges.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
SECTION = "## Train on your own objects"


def commands():
    text = (ROOT / "README.md").read_text()
    section = text.split(SECTION, 1)[1].split("\n## ", 1)[0]
    return "\n".join(re.findall(r"```sh\n(.*?)```", section, re.S))


def main(binaries):
    path = f"{os.path.abspath(binaries)}:{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as directory:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", commands()],
            cwd=directory,
            env={**os.environ, "PATH": path},
            stdout=subprocess.PIPE,
            text=True,
            timeout=900,
        )
        assert done.returncode == 0, done
        print(done.stdout)
        # The last command is the replay: its verdicts are of the new model.
        inspected = subprocess.run(
            ["hrn-train", "inspect", "own.onnx"],
            cwd=directory,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        model = re.search(r"sha256 +([0-9a-f]{12})", inspected)[1]
        events = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        verdicts = [event for event in events if event.get("phase") == "final"]
        assert len(verdicts) >= 5, verdicts
        assert all(event["model"] == model for event in verdicts), (model, verdicts[0])
        right = sum(event["level"] == 1 for event in verdicts)
        print(f"{right} of {len(verdicts)} presses of unknown wood said to be of level 1")
        assert right > len(verdicts) / 2


if __name__ == "__main__":
    main(sys.argv[1])
