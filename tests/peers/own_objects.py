#!/usr/bin/env python3
"""The commands of docs/own-objects.md, as they are there, but those of three sections.

    python tests/peers/own_objects.py target/debug

Claims: they run to their end, in a directory of their own, the model that they train judges, and the way back to
the built-in one leaves its references. The commands on simulated data run on few samples and in the profile `smoke`: the page's own take minutes.
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
    run(commands(text), directory, path)
    inspected = run("hrn-train inspect own.onnx", directory, path)
    own = re.search(r"sha256 +([0-9a-f]{12})", inspected)[1]
    trained = verdicts(directory, path)
    assert all(event["model"] == own for event in trained), trained
    # The page's way back to the built-in model, which has the references.
    run(re.search(r"`(sed -i '/\^.*?)`", text)[1], directory, path)
    told = verdicts(directory, path)
    assert all(event["model"] != own and event["references"] == "labelled" for event in told), told
    for way, of_wood in [("told", told), ("trained", trained)]:
        right = sum(event["level"] == 1 for event in of_wood)
        print(f"{way}: {right} of {len(of_wood)} presses of unknown wood said to be of level 1")
        assert len(of_wood) >= 2 and right > len(of_wood) / 2, of_wood


def verdicts(directory, path):
    """The final verdicts on wood that is neither learnt nor a reference."""
    printed = run("hardnessd replay wood-12.mcap --config own.toml --json", directory, path)
    events = map(json.loads, printed.splitlines())
    return [event for event in events if event.get("phase") == "final"]


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
