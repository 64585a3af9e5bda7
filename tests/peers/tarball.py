#!/usr/bin/env python3
"""The tarball of a release.

    venv/bin/python tests/peers/tarball.py target/debug/hardnessd

Claims: `.ci/tarball` gives the same bytes twice; the table for `cargo binstall` in Cargo.toml names the tarball and
the binary in it; what is unpacked runs a demonstration from there, without anything else of the repository.
"""

import os
import pathlib
import subprocess
import sys
import tarfile
import tempfile
import tomllib

ROOT = pathlib.Path(__file__).parents[2]
TARGET = "x86_64-unknown-linux-gnu"


def packed(binary, directory):
    os.makedirs(directory)
    run = subprocess.run([ROOT / ".ci/tarball", binary, TARGET, directory], capture_output=True, text=True, check=True)
    return pathlib.Path(run.stdout.strip())


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
        demo = subprocess.run(
            [unpacked, "demo", "--presses", "1", "--speed", "10"],
            capture_output=True, text=True, timeout=60, cwd=place, env={"PATH": "/nowhere", "XDG_RUNTIME_DIR": place},
        )
        assert demo.returncode == 0 and '"phase":"final"' in demo.stdout, demo
        print(f"{first.name}: twice the same, {first.stat().st_size >> 20} MiB, and it runs")


if __name__ == "__main__":
    main(sys.argv[1])
