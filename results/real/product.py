"""The product on recorded presses: `collect`, `fit`, and the daemon's replay of the presses that are judged."""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

SYNC = bytes.fromhex("AA55C33C")
# Unloaded frames before a press, for the daemon's zero, and after it.
BEFORE, AFTER = 6, 4
JOBS = 4


class Product:
    """The programs in `binaries`, with their files in a directory."""

    def __init__(self, binaries, directory, recorded):
        self.binaries, self.directory = binaries.resolve(), directory
        self.files, self.fits, self.account = [], 0, ""
        self.configure("sensor", recorded.sensor)
        for number, counts in enumerate(recorded.counts):
            rest = counts[:1].astype("<u2")
            rows = np.concatenate([np.repeat(rest, BEFORE, 0), counts.astype("<u2"), np.repeat(rest, AFTER, 0)])
            self.files.append(f"{number:04}.bin")
            (directory / self.files[-1]).write_bytes(b"".join(SYNC + row.tobytes() for row in rows))

    def configure(self, name, sensor, model=""):
        self.sensor = sensor
        (self.directory / f"{name}.toml").write_text(sensor + model)

    def call(self, program, *arguments, may_fail=False):
        command = [self.binaries / program, *map(str, arguments)]
        done = subprocess.run(command, cwd=self.directory, capture_output=True, text=True)
        if done.returncode != 0 and not may_fail:
            sys.exit(f"{program} {arguments[0]}: {done.stderr}")
        return done.stdout

    def collected(self, recorded, learn):
        """Data sets of the presses, one for each object."""
        parts = []
        for key in sorted(set(zip(recorded.level[learn], recorded.object[learn]))):
            of_object = [n for n in learn if (recorded.level[n], recorded.object[n]) == key]
            parts.append(f"fit{self.fits}-{key[0]}-{key[1]}.npz")
            # A press may be too light for the contact threshold.
            options = ["--sequences", "--skip-unusable", "--config", "sensor.toml"]
            options += ["--level", key[0] + 1, "--object", key[1]]
            self.call("hrn-train", "collect", "--out", parts[-1], *options, *(self.files[n] for n in of_object))
        return parts

    def judge(self, recorded, learn, judged):
        """The level of each press by the daemon, with what `fit` made."""
        self.fits += 1
        parts, model = self.collected(recorded, learn), f"fit{self.fits}.onnx"
        report = json.loads(self.call("hrn-train", "fit", *parts, "--out", model, "--json", may_fail=True))
        self.account = f"  fit wrote {report['writes'] or 'nothing'} ({report['best']}); what it expected:\n"
        self.account += "\n".join(map(of_row, report["candidates"] + report["controls"]))
        name = f"fit{self.fits}"
        if report["writes"] == "model":
            self.configure(name, self.sensor, f'[model]\npath = "{model}"\n')
        elif report["writes"] is None:
            # The built-in model is as good.
            self.configure(name, self.sensor)
        else:
            references = f'references = "{name}.npz"\n'
            sensor = self.sensor.replace("[sensor.frame]", references + "[sensor.frame]")
            (self.directory / f"{name}.toml").write_text(sensor)
        with ThreadPoolExecutor(JOBS) as pool:
            return np.array(list(pool.map(lambda n: self.replayed(self.files[n], f"{name}.toml"), judged)))

    def replayed(self, file, config):
        """The level of the longest press in a recording, from 0. -1 if there is none."""
        events = map(json.loads, self.call("hardnessd", "replay", file, "--config", config, "--json").splitlines())
        longest, level = 0, -1
        frames = 0
        for event in events:
            if event["type"] == "press" and event["state"] == "end":
                frames = event["frames"]
            if event["type"] == "hardness" and event["phase"] == "final" and frames > longest:
                longest, level = frames, int(np.argmax(event["probabilities"]))
        return level


def of_row(row):
    def of(estimate):
        return "-" if estimate is None else f"{100 * estimate['balanced_accuracy']:.1f} %"

    expected = f"new objects {of(row['new_objects'])}, later presses {of(row['later_presses'])}"
    return f"    {row['name']:40} {row['left_out'] or expected}"
