#!/usr/bin/env python3
"""The wheel of a release, as `.ci/wheel` builds it. It needs nothing but Python 3 with venv.

    python3 tests/peers/wheel.py FOLDER/hardnessd-0.2.0-py3-none-manylinux2014_x86_64.whl

Claims: without a compiler and without the network it is installed; the demonstration gives a verdict within 3 s;
the program has all features; the client beside it reads the program's events; nothing is in it twice.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
import zipfile

from bench import run


def first_verdict(program, environment):
    """How long the demonstration takes to its first verdict, in s."""
    start = time.monotonic()
    demo = subprocess.Popen([program, "demo", "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)
    for line in demo.stdout:
        if json.loads(line)["type"] == "hardness":
            seconds = time.monotonic() - start
            break
    return demo, seconds


def main(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names)), names
    size = os.path.getsize(wheel) / 1e6
    with tempfile.TemporaryDirectory() as place:
        venv = pathlib.Path(place, "venv")
        run(sys.executable, "-m", "venv", venv)
        start = time.monotonic()
        run(venv / "bin/pip", "install", "--quiet", "--no-index", wheel)
        installed_s = time.monotonic() - start
        program = venv / "bin/hardnessd"
        # Neither the sources nor another installation is in reach.
        environment = {"PATH": "/nowhere", "XDG_RUNTIME_DIR": place, "HOME": place}
        demo, verdict_s = first_verdict(program, environment)
        try:
            read = [venv / "bin/python", "-m", "hardnessd", "--types", "frame", "--count", "1", "--timeout", "10"]
            assert "demo" in run(*read, env=environment, cwd=place).stdout
        finally:
            demo.terminate()
            demo.wait(10)
        tables = "[publish.zenoh]\n[publish.ros2]\n[publish.foxglove]\n"
        config = pathlib.Path(place, "hardnessd.toml")
        config.write_text(f'[[sensor]]\nname = "palm"\nport = "palm"\n{tables}')
        run(program, "check", "--config", config, env=environment)
        start = time.monotonic()
        run(program, "--version", env=environment)
        started_s = time.monotonic() - start
    assert verdict_s < 3, f"the first verdict came after {verdict_s:.1f} s"
    print(
        f"{os.path.basename(wheel)}: {size:.1f} MB, installed in {installed_s:.1f} s, first verdict after {verdict_s:.1f} s, "
        f"`--version` in {1000 * started_s:.0f} ms"
    )


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
