#!/usr/bin/env python3
"""The command `fit` of docs/own-objects.md on recordings of simulated objects, with a sensor that nobody calibrated.

    python tests/peers/own_objects.py target/debug

The newtons are a third of what they should be, so that the built-in model is wrong about every second press, and `fit`
has a reason to write a model. Claims: it runs to its end, the lines that it prints for the configuration are ones that
`check` takes, and the daemon judges an object that was not recorded with the model.
"""

import json
import pathlib
import re
import sys
import tempfile

import bench

PAGE = pathlib.Path(__file__).parents[2] / "docs/own-objects.md"
RECORD = """
cat > own.toml <<END
[[sensor]]
name = "forearm"
port = "forearm"
baud = 230400
frame_rate_hz = 20
[sensor.calibration]
newtons_per_count = 0.013
[publish.unix]
path = "events.sock"
END
mkdir own
record() {  # DIRECTORY MATERIAL LEVEL OBJECT
    sed "s/^port.*/port = \\"$2-$4\\"/" own.toml > "$2-$4.toml"
    hardnessd simulate --link "$2-$4" --fps 20 --baud 230400 --material "$2" --seed "$4" > /dev/null &
    until [ -e "$2-$4" ]; do sleep 0.1; done
    hardnessd record --config "$2-$4.toml" --out "$1/$2-$4.mcap" --label level="$3" --label object="$4" \\
        --seconds 60 2> "$2-$4.log"
    kill $!
}
for n in 0 1; do
    record own wood 1 1$n & record own rubber 2 2$n & record own plasticine 3 3$n & record own sponge 4 4$n &
done
record . wood 1 12 &
wait
"""


def run(script, directory, path):
    printed = bench.run("bash", "-euo", "pipefail", "-c", script, cwd=directory, path=path).stdout
    print(printed)
    return printed


def main(binaries):
    fit = re.search(r"^hrn-train fit .*$", PAGE.read_text(), re.M)[0]
    with tempfile.TemporaryDirectory() as directory:
        run(RECORD, directory, binaries)
        lines = run(fit, directory, binaries).split("configuration:\n\n")[1]
        config = pathlib.Path(directory, "own.toml")
        config.write_text(config.read_text() + lines)
        run("hardnessd check --config own.toml", directory, binaries)
        printed = run("hardnessd replay wood-12.mcap --config own.toml --json", directory, binaries)
    events = [event for event in map(json.loads, printed.splitlines()) if event.get("phase") == "final"]
    right = sum(event["level"] == 1 for event in events)
    print(f"{right} of {len(events)} presses of unknown wood said to be of level 1")
    assert len(events) >= 2 and right > len(events) / 2, events


if __name__ == "__main__":
    main(sys.argv[1])
