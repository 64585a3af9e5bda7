#!/usr/bin/env python3
"""Every command of docs/where-your-data-goes.md.

    python3 -m venv venv && venv/bin/pip install './clients/python[export,rerun]' duckdb rosbags
    venv/bin/python tests/peers/destinations.py target/debug/hardnessd

Claims: each row of the page's table has a command that does what the row says, and each `sh` and `sql` block of the page
runs. The rows that need a feature are left to foxglove_peer.py and zenoh_peer.py.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import time

import duckdb
import pyarrow.parquet as pq
from bench import Bench, run
from rerun.chunk import RrdReader
from rosbags.rosbag2 import Reader

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/where-your-data-goes.md").read_text()


def rows():
    """The first word of each tool, and its command."""
    table = PAGE.split("\n## ")[0]
    found = re.findall(r"^\| \[(\w+)[^|]*\|[^|]*\| `([^|]*)` \|", table, re.M)
    assert len(found) == len(re.findall(r"^\| \[", table, re.M)) == 8, found
    return dict(found)


def shell(bench, command, **replaced):
    """Runs a command of the page in the bench's directory."""
    ours = {"python3 ": f"{sys.executable} ", "clients/": f"{ROOT}/clients/", "examples/": f"{ROOT}/examples/"}
    for found, put in {**replaced, **ours}.items():
        command = command.replace(found, put)
    # This program's `hardnessd`, and the bench's daemon.
    environment = {**os.environ, "RUNTIME_DIRECTORY": bench.directory.name}
    path = os.path.dirname(bench.binary)
    return run("bash", "-euc", command, cwd=bench.directory.name, env=environment, path=path).stdout


def recorded(bench, commands):
    """The rows about `take.mcap`."""
    place = pathlib.Path(bench.directory.name)
    for tool in ("ROS", "Rerun", "LeRobot", "Parquet"):
        shell(bench, commands[tool])
    with Reader(place / "bag") as bag:
        assert bag.message_count > 100, bag.message_count
    entities = {chunk.entity_path for chunk in RrdReader(str(place / "take.rrd")).stream()}
    assert {"/forearm/frame", "/forearm/force_n", "/forearm/probability"} <= entities, entities
    info = json.loads((place / "set/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] > 90, info
    assert pq.read_table(place / "tables/hardness.parquet").num_rows >= 2


def blocks(bench):
    """The blocks below the table, in the order of the page, but the one that opens a window."""
    place = pathlib.Path(bench.directory.name)
    count = 0
    for kind, block in re.findall(r"^```(\w+)\n(.*?)^```", PAGE.split("\n## ", 1)[1], re.M | re.S):
        if kind == "sql":
            os.chdir(place)
            answer = duckdb.sql(block).fetchall()
            assert answer and all(force > 5 for *_, force in answer), answer
        elif "rerun" not in block:
            # Each block writes its own output.
            for old in ("set", "tables", "presses"):
                if f"--out {old}" in block:
                    subprocess.run(["rm", "-rf", place / old], check=True)
            shell(bench, block)
        count += 1
    features = json.loads((place / "set/meta/info.json").read_text())["features"]
    assert features["observation.tactile.left"]["shape"] == [28, 28] and features["observation.state"]["shape"] == [1]
    return count


def live(bench, commands, http):
    metrics = shell(bench, commands["Prometheus"], **{"127.0.0.1:8256": http})
    assert 'hardnessd_frames_total{robot="arm-7",sensor="forearm"}' in metrics, metrics[:500]
    line = shell(bench, commands["Your"])
    assert "hardness" in line and "forearm" in line, line


def main(binary):
    commands = rows()
    more = '[record]\ndir = "rec"\nkeep_free_mb = 0\n[http]\nlisten = "127.0.0.1:0"\n'
    with Bench(binary, more=more) as bench:
        daemon = bench.daemon()
        http = bench.address("http")
        bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3").wait(timeout=60)
        time.sleep(0.5)
        bench.sensor("forearm", "--force", "15")
        live(bench, commands, http)
        daemon.terminate()
        daemon.wait(timeout=10)
        place = pathlib.Path(bench.directory.name)
        (first, *_) = sorted((place / "rec").glob("hardnessd-*.mcap"))
        (place / "takes").mkdir()
        os.link(first, place / "take.mcap")
        os.link(first, place / "takes/take.mcap")
        recorded(bench, commands)
        print("blocks:", blocks(bench))
    print("commands:", ", ".join(tool for tool in commands if tool not in ("Foxglove", "zenoh")))


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
