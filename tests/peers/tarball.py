#!/usr/bin/env python3
"""The tarball of a release.

    venv/bin/python tests/peers/tarball.py target/debug/hardnessd

Claims: `.ci/tarball` gives the same bytes twice; the table for `cargo binstall` in Cargo.toml names the tarball and
the binary in it; what is unpacked runs a demonstration from there, without anything else of the repository.
"""

import os
import pathlib
import sys
import tarfile
import tempfile
import tomllib

from bench import run

ROOT = pathlib.Path(__file__).parents[2]
TARGET = "x86_64-unknown-linux-gnu"


def packed(binary, directory):
    os.makedirs(directory)
    return pathlib.Path(run(ROOT / ".ci/tarball", binary, TARGET, directory).stdout.strip())


def main(binary):
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text())
    table = manifest["package"]["metadata"]["binstall"]
    words = {
        "repo": "https://example.org/hardnessd", "name": "hardnessd", "bin": "hardnessd", "target": TARGET,
        "version": manifest["workspace"]["package"]["version"],
    }

    def filled(template):
        for word, value in words.items():
            template = template.replace(f"{{ {word} }}", value)
        assert "{" not in template, template
        return template

    with tempfile.TemporaryDirectory() as place:
        first, second = (packed(binary, os.path.join(place, name)) for name in ("first", "second"))
        assert first.read_bytes() == second.read_bytes(), "two tarballs differ"
        assert filled(table["pkg-url"]).rsplit("/", 1)[1] == first.name, first.name
        with tarfile.open(first) as tar:
            tar.extractall(place, filter="data")
        unpacked = os.path.join(place, filled(table["bin-dir"]))
        alone = {"PATH": "/nowhere", "XDG_RUNTIME_DIR": place}
        demo = run(unpacked, "demo", "--presses", "1", "--speed", "10", cwd=place, env=alone)
        assert '"phase":"final"' in demo.stdout, demo
        print(f"{first.name}: twice the same, {first.stat().st_size >> 20} MiB, and it runs")


if __name__ == "__main__":
    main(sys.argv[1])
