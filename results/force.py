#!/usr/bin/env python3
"""How far the sum of a frame is from the force of a press, and what `newtons_per_count` does to the verdicts.

    cargo build --release
    python3 results/force.py target/release/hardnessd

Prints the figures of results/simulator.md. It simulates 240 presses of 15 N: ten seeds, the eight materials in turn.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

SEEDS, PRESSES = range(1, 11), 24
# Levels of the materials in the order in which `simulate` presses them.
LEVELS = {"wood": 1, "rubber": 2, "plasticine": 3, "sponge": 4, "hard-plastic": 1, "foam": 2, "soft-candy": 3, "yoga-mat": 4}
NEWTONS_PER_COUNT = 0.04
# Bytes of a frame of `jx255n`: 4 before the cells, 784 cells, 2 after them.
BYTES, CELLS = 790, slice(4, 788)
# A press is over when the sum of a frame is below this.
RELEASED_N = 2.0


def greatest_sums(data):
    """The greatest sum of a frame of each press, in newtons."""
    found, greatest = [], 0.0
    for at in range(0, len(data), BYTES):
        newtons = NEWTONS_PER_COUNT * sum(data[at : at + BYTES][CELLS])
        if newtons >= RELEASED_N:
            greatest = max(greatest, newtons)
        elif greatest:
            found.append(greatest)
            greatest = 0.0
    return found


def verdicts(program, recording, newtons_per_count):
    """The final verdicts of a recording."""
    config = recording.with_suffix(".toml")
    calibration = f"[sensor.calibration]\nnewtons_per_count = {newtons_per_count}\n"
    config.write_text(f'[[sensor]]\nport = "none"\nframe_rate_hz = 20.0\n{calibration}')
    command = [program, "replay", recording, "--config", config]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [event for event in map(json.loads, lines) if event.get("phase") == "final"]


def show(name, newtons):
    mean = sum(newtons) / len(newtons)
    print(f"{name}, {len(newtons)} presses: {min(newtons):.1f} to {max(newtons):.1f} N, mean {mean:.1f} N")


def main(program):
    sums, forces, right = [], [], {NEWTONS_PER_COUNT: 0, 0.036: 0}
    with tempfile.TemporaryDirectory() as directory:
        for seed in SEEDS:
            recording = pathlib.Path(directory) / f"{seed}.bin"
            materials = [word for name in LEVELS for word in ("--material", name)]
            options = ["--fps", "20", "--force", "15", "--presses", str(PRESSES), "--seed", str(seed)]
            subprocess.run([program, "simulate", "--to", recording, *options, *materials], check=True)
            sums += greatest_sums(recording.read_bytes())
            for newtons_per_count in right:
                found = verdicts(program, recording, newtons_per_count)
                levels = list(LEVELS.values()) * (PRESSES // len(LEVELS))
                right[newtons_per_count] += sum(e["level"] == level for e, level in zip(found, levels, strict=True))
                if newtons_per_count == NEWTONS_PER_COUNT:
                    forces += [event["force_n"] for event in found]
    show("greatest sum", sums)
    show("force_n", forces)
    for newtons_per_count, count in right.items():
        print(f"newtons_per_count {newtons_per_count}: {count} of {len(forces)} verdicts are right")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]).resolve())
