#!/usr/bin/env python3
"""What Rerun gets, read by Rerun's own reader.

    python3 -m venv venv && venv/bin/pip install './clients/python[export,rerun]' pandas duckdb
    venv/bin/python tests/peers/rerun_peer.py target/debug/hardnessd --pictures pictures

Claims: a recording as `.rrd` has every frame, with force, contact area, approach and probabilities as numbers that
Rerun plots; so has what the live bridge writes; every view of the layout shows something; and after a sensor is lost,
or the daemon is gone, nothing is shown any more. With `--pictures` and a display (xvfb-run) the viewer itself shows it.
"""

import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

import numpy as np
import rerun
from bench import Bench, run, taken, wait_for
from export_peer import moment
from rerun.chunk import RrdReader

VIEWER = [sys.executable, "-m", "hardnessd.rerun_viewer"]


def read(path):
    """What each entity has: (time in us, component -> value), in the order of time. Static values have no time."""
    found = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        times_ns = None if chunk.is_static else batch.column("time").cast("int64").to_pylist()
        for number, row in enumerate(batch.to_pylist()):
            at = times_ns[number] // 1000 if times_ns else None
            values = {key: value for key, value in row.items() if ":" in key and value is not None}
            found.setdefault(chunk.entity_path, []).append((at, values))
    return {entity: sorted(rows, key=lambda row: row[0] or 0) for entity, rows in found.items()}


def blueprint(path):
    """Where the views of the layout look."""
    reader = RrdReader(str(path))
    origins = []
    for store in reader.blueprints():
        for chunk in reader.stream(store=store):
            for row in chunk.to_record_batch().to_pylist():
                origins += [value for key, value in row.items() if key.endswith("space_origin") and value]
    return {f"/{origin.lstrip('/')}" for value in origins for origin in value}


def us(event):
    return round(moment(event["time"]).timestamp() * 1e6)


def compare(entities, live):
    """Every frame and verdict of the socket is there, at its time."""
    frames = {us(event): event for event in live if event["type"] == "frame"}
    pictures = {time: values for time, values in entities["/forearm/frame"] if "DepthImage:buffer" in values}
    numbers = {
        name: {time: values["Scalars:scalars"] for time, values in entities[f"/forearm/{name}"] if "Scalars:scalars" in values}
        for name in ("force_n", "contact_area_taxels", "approach_mm", "probability")
    }
    assert set(frames) <= set(pictures) and len(frames) > 100, (len(frames), len(pictures))
    for time, event in frames.items():
        newtons = np.frombuffer(bytes(pictures[time]["DepthImage:buffer"][0]), "<f4")
        assert np.allclose(newtons, event["newtons"], atol=0.0006), time
        if event["tared"]:
            assert np.isclose(numbers["force_n"][time][0], event["force_n"], atol=1e-3)
        assert numbers["contact_area_taxels"][time] == [event["contact_area_taxels"]]
        approach = numbers["approach_mm"].get(time)
        expected = event["approach_mm"]
        assert approach is None if expected is None else np.isclose(approach[0], expected, atol=0.0006)
    verdicts = [event for event in live if event["type"] == "hardness"]
    told = sorted(event["probabilities"] for event in verdicts)
    published = sorted(us(event) + event["age_at_publish_ms"] * 1e3 for event in verdicts)
    assert np.allclose(sorted(numbers["probability"]), published, atol=2e3), (sorted(numbers["probability"]), published)
    shown = sorted(numbers["probability"].values())
    # JSON rounds.
    assert np.allclose(shown, told, atol=0.0001) and len(told) >= 3, (shown, told)
    lines = [row["TextLog:text"][0] for _, row in entities["/forearm/press"] + entities["/forearm/verdict"]]
    assert len(lines) == len([event for event in live if event["type"] in ("press", "hardness")]), lines
    return len(frames), len(verdicts)


def nothing_after(entities, kind):
    """The last thing that each of these entities has is that it is cleared."""
    for name in ("frame", "force_n", "contact_area_taxels", "approach_mm"):
        _, last = entities[f"/forearm/{name}"][-1]
        assert "Clear:is_recursive" in last, (kind, name, last)


def a_recording(path, live, directory):
    out = directory / "take.rrd"
    run(*VIEWER, path, "--save", out)
    entities = read(out)
    origins = blueprint(out)
    assert {f"/forearm/{name}" for name in ("frame", "force_n", "probability")} <= origins, origins
    assert all(any(entity.startswith(origin) for entity in entities) for origin in origins), (origins, list(entities))
    nothing_after(entities, "the end of a recording")
    broken, nothing = directory / "broken.mcap", directory / "no.rrd"
    broken.write_bytes(path.read_bytes()[:-100])
    for source, to, code in ((path, out, 74), (broken, nothing, 1), (directory / "missing.mcap", nothing, 66)):
        assert len(run(*VIEWER, source, "--save", to, code=code).stderr.splitlines()) == 1, source
    assert not nothing.exists()
    return compare(entities, live)


def the_bridge(binary, directory):
    """Live, while the sensor is lost and comes back, until the daemon is gone."""
    out = directory / "live.rrd"
    with Bench(binary) as bench:
        daemon = bench.daemon()
        lines = bench.events("--types", "frame,hardness,press,status")
        bridge = subprocess.Popen([*VIEWER, bench.path("events.sock"), "--save", out])
        bench.processes.append(bridge)
        # The bridge follows before the first frame.
        wait_for("the bridge", out.exists)
        time.sleep(2)
        sensor = bench.sensor("forearm", "--presses", "3", "--force", "15", "--motion", bench.path("control.sock"))
        sensor.wait(timeout=60)
        lost = lambda: [e for e in lines.events if e.get("state") == "lost" and "seq" in e]  # noqa: E731
        wait_for("the loss", lost)
        first = lost()[0]
        bench.sensor("forearm", "--force", "15", "--motion", bench.path("control.sock"))
        wait_for("frames", lambda: len(lines.events) > 20 + lines.events.index(first))
        daemon.terminate()
        daemon.wait(timeout=10)
        lines.kill()
        lines.thread.join()
        # The bridge notices by the connection.
        time.sleep(1)
        bridge.terminate()
        assert bridge.wait(timeout=10) == 143
    entities = read(out)
    live = [event for event in lines.events if event["type"] != "hello"]
    pictures = entities["/forearm/frame"]
    cleared = [time for time, values in pictures if "Clear:is_recursive" in values]
    came = [time for time, values in pictures if "DepthImage:buffer" in values]
    at = us(first)
    assert any(abs(time - at) < 1e6 for time in cleared) and any(time > at for time in came), (at, cleared)
    nothing_after(entities, "the end of the daemon")
    return compare(entities, live)


def a_picture(rrd, out):
    """What the viewer draws. The pointer is in the middle of the screen, which is beside the window."""
    out.unlink(missing_ok=True)
    command = [shutil.which("rerun", path=os.path.dirname(sys.executable)), str(rrd), "--renderer", "vulkan"]
    shown = ["xvfb-run", "-a", "-s", "-screen 0 5800x1900x24", *command, "--window-size", "1400x900", "--screenshot-to", str(out)]
    done = subprocess.run(shown, capture_output=True, text=True, timeout=240)
    assert out.exists(), re.sub(r"\x1b\[[0-9;]*m", "", done.stderr)[-600:]


def main(binary, pictures):
    print("Rerun", rerun.__version__)
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        path = directory / "take.mcap"
        live = taken(binary, path, "--motion", "{control}")
        print("a recording: %d frames and %d verdicts" % a_recording(path, live, directory))
        print("the live bridge: %d frames and %d verdicts" % the_bridge(binary, directory))
        if pictures:
            os.makedirs(pictures, exist_ok=True)
            a_picture(directory / "take.rrd", pathlib.Path(pictures, "rerun.png"))


if __name__ == "__main__":
    binary, *pictures = sys.argv[1:]
    main(os.path.abspath(binary), pictures[-1] if pictures else None)
