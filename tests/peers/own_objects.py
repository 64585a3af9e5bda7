#!/usr/bin/env python3
"""The commands of docs/own-objects.md, as they are there, but those of three sections.

    python tests/peers/own_objects.py target/debug

Claims: they run to their end, in a directory of their own, and the model that they train judges. The
commands on simulated data run on few samples and in the profile `smoke`: the page's own take minutes.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

PAGE = pathlib.Path(__file__).parents[2] / "docs/own-objects.md"
SIMULATED = "## Train on simulated data"
# Their commands build, ask a person at a terminal, or need GNU parallel.
LEFT_OUT = ("## Before you start", "### With your sensor", "### Thousands of recordings")


def commands(text):
    sections = [section for section in re.split(r"^(?=##)", text, flags=re.M) if not section.startswith(LEFT_OUT)]
    found = "\n".join(re.findall(r"```sh\n(.*?)```", "".join(sections), re.S))
    assert found, text
    return found


def run(script, directory, path):
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=directory,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done
    print(done.stdout)
    return done.stdout


def own_objects(text, directory, path):
    printed = run(commands(text), directory, path)
    inspected = run("hrn-train inspect own.onnx", directory, path)
    own = re.search(r"sha256 +([0-9a-f]{12})", inspected)[1]
    events = [json.loads(line) for line in printed.splitlines() if line.startswith("{")]
    verdicts = [event for event in events if event.get("phase") == "final"]
    told = [event for event in verdicts if event["model"] != own]
    assert told and all(event["references"] == "labelled" for event in told), verdicts
    # The last command is the replay: its verdicts are of the new model.
    for way, of_wood in [("told", told), ("trained", [event for event in verdicts if event["model"] == own])]:
        right = sum(event["level"] == 1 for event in of_wood)
        print(f"{way}: {right} of {len(of_wood)} presses of unknown wood said to be of level 1")
        assert len(of_wood) >= 2 and right > len(of_wood) / 2, verdicts


def simulated(text, directory, path):
    script = commands(text)
    for asked, cheaper in [
        ("--out data.npz", "--out data.npz --objects 3 --test-objects 2 --presses 6"),
        ("--profile quick", "--profile smoke"),
    ]:
        assert asked in script, script
        script = script.replace(asked, cheaper)
    run(script, directory, path)
    for file in ("sheet.png", "runs/hrn100/hrn.onnx", "comparison/tables.md"):
        assert pathlib.Path(directory, file).stat().st_size > 0, file


def main(binaries):
    path = f"{os.path.abspath(binaries)}:{os.environ['PATH']}"
    own, of_simulated = PAGE.read_text().split(SIMULATED)
    with tempfile.TemporaryDirectory() as directory:
        own_objects(own, directory, path)
        simulated(of_simulated, directory, path)


if __name__ == "__main__":
    main(sys.argv[1])
