#!/usr/bin/env python3
"""Exports of recordings, read by pandas, DuckDB and pyarrow.

    python3 -m venv venv && venv/bin/pip install './clients/python[export]' pandas duckdb
    venv/bin/python tests/peers/export_peer.py target/debug/hardnessd

Claims: the tables have every event that a subscriber read, every field of it, every frame and every position of the
arm; a data set for LeRobot has the files and columns of v3.0, whose episodes are recordings or presses, with the
verdicts that were known at each frame; a bad file is one line, and nothing of the output stays. `lerobot_peer.py` reads the data sets with LeRobot itself.
"""

import datetime
import json
import os
import pathlib
import sys
import tempfile

import bench
import duckdb
import hardnessd
import numpy as np
import pandas
import pyarrow.parquet as pq
from bench import Bench, taken
from hardnessd import export, observation, recording
from mcap.reader import make_reader
from mcap.writer import Writer

UTC = datetime.timezone.utc


def run(*arguments, code=0, lines=1):
    said = bench.run(sys.executable, "-m", "hardnessd.export", *arguments, code=code).stderr.strip()
    assert len(said.splitlines()) == lines or code == 2, said
    return said


def moment(text):
    return datetime.datetime.fromisoformat(text.replace("Z", "+00:00")).astimezone(UTC)


def tables(path, live, directory):
    out = directory / "tables"
    run(path, "--to", "parquet", "--out", out)
    assert sorted(file.stem for file in out.iterdir()) == sorted(export.TABLES)
    read = {name: pq.read_table(out / f"{name}.parquet").to_pylist() for name in export.TABLES}
    for kind, fields in (("press", hardnessd.Press), ("hardness", hardnessd.Hardness)):
        columns = {"recording", *fields.__annotations__, "seq"} - {"type"}
        assert set(export.TABLES[kind].names) == columns, columns ^ set(export.TABLES[kind].names)
        expected = {event["seq"]: event for event in live if event["type"] == kind}
        found = {row["seq"]: row for row in read[kind]}
        assert list(found) == list(expected) and len(found) >= 3, (kind, list(found), list(expected))
        for seq, event in expected.items():
            for key, value in event.items():
                same(key, found[seq].get(key), value)
    frames = {event["frame"]: event for event in live if event["type"] == "frame"}
    contact = {row["frame"]: row for row in read["contact"]}
    recorded = {row["frame"]: row for row in read["frames"]}
    assert set(contact) == set(recorded) and set(frames) <= set(recorded) and len(frames) > 100, len(frames)
    for number, event in frames.items():
        row, touched = recorded[number], contact[number]
        assert (row["rows"], row["cols"]) == (28, 28) and row["time"] == touched["time"] == moment(event["time"])
        assert np.allclose(row["newtons"], event["newtons"], atol=0.0006), number
        for key in ("force_n", "contact_area_taxels", "tared", "approach_mm"):
            same(key, touched[key], event[key])
    assert any(event["approach_mm"] is not None for event in frames.values())
    with recording.open(path) as opened:
        points = [point for _, _, _, line in opened._messages(["motion"]) for point in zip(line.at_ns, line.approach_mm)]
        labels = opened.labels
    assert [(row["mono_ns"], row["approach_mm"]) for row in read["motion"]] == points and len(points) > 100
    (about,) = read["recording"]
    assert about["robot"] == "arm-7" and dict(about["labels"]) == labels and "forearm" in json.loads(about["sensors"])
    # An arm's position and a frame of the same time lie near each other in the tables too.
    times = [row["time"] for row in read["motion"]]
    assert read["frames"][0]["time"] - datetime.timedelta(seconds=5) < times[0] < times[-1]
    hardness = pandas.read_parquet(out / "hardness.parquet")
    # A rejected verdict names no level.
    named = [None if pandas.isna(level) else level for level in hardness["level"]]
    assert named == [row["level"] for row in read["hardness"]]
    assert str(hardness["time"].dtype) == "datetime64[us, UTC]", hardness.dtypes
    return {name: len(rows) for name, rows in read.items()}


def same(key, found, expected):
    if key == "type":
        return
    if key == "time":
        expected = moment(expected)
    elif key == "context" and expected is not None:
        found = json.loads(found)
    elif key == "shore" and expected:
        found, expected = list(found.values()), [expected[end] for end in ("value", "low", "high")]
    if isinstance(expected, (float, list)) and key != "notes":
        # JSON rounds, ROS has float32.
        assert np.allclose(found, expected, rtol=1e-5, atol=0.0006), (key, found, expected)
    else:
        assert found == expected, (key, found, expected)


def data_set(path, live, directory, episodes):
    out = directory / episodes
    run(path, "--to", "lerobot", "--episodes", episodes, "--out", out)
    files = sorted(str(file.relative_to(out)) for file in out.rglob("*") if file.is_file())
    assert files == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ], files
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_tasks"]) == ("v3.0", 20, 1), info
    assert info["data_path"].format(chunk_index=0, file_index=0) == files[0]
    newtons, state = "observation.tactile.forearm.newtons", "observation.tactile.forearm.state"
    assert info["features"][newtons] == {"dtype": "float32", "shape": [28, 28], "names": ["rows", "cols"]}
    names = info["features"][state]["names"]
    assert [newtons.rsplit(".", 1)[1], *names] == list(observation.KEYS), names
    # The task is the index of this table, as pandas writes one.
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    assert list(tasks.index) == ["press an object"] and list(tasks["task_index"]) == [0]
    rows = pq.read_table(out / files[0]).to_pylist()
    assert list(rows[0]) == list(info["features"]) and len(rows) == info["total_frames"] > 90
    described = pq.read_table(out / files[1]).to_pylist()
    assert len(described) == info["total_episodes"] and info["splits"] == {"train": f"0:{len(described)}"}
    frames = {event["frame"]: event for event in live if event["type"] == "frame" and event["tared"]}
    verdicts = [event for event in live if event["type"] == "hardness"]
    at = 0
    for number, episode in enumerate(described):
        assert (episode["episode_index"], episode["dataset_from_index"], episode["tasks"]) == (number, at, ["press an object"])
        at += episode["length"]
        assert (episode["dataset_to_index"], episode["data/chunk_index"], episode["data/file_index"]) == (at, 0, 0)
        part = rows[at - episode["length"] : at]
        begin = moment(frames[part[0]["hardnessd.frame"]]["time"])
        assert episode["hardnessd/recording"] == "take.mcap" and episode["hardnessd/time"] == begin
        for index, row in enumerate(part):
            event = frames[row["hardnessd.frame"]]
            assert (row["frame_index"], row["episode_index"], row["task_index"]) == (index, number, 0)
            assert row["index"] == at - episode["length"] + index and np.isclose(row["timestamp"], index / 20)
            since_begin = (moment(event["time"]) - begin).total_seconds()
            assert np.isclose(row["hardnessd.time_s"], since_begin, atol=1e-5)
            assert np.allclose(row[newtons], np.reshape(event["newtons"], (28, 28)), atol=0.0006)
            known(dict(zip(names, row[state])), event, verdicts)
    if episodes == "presses":
        of_presses(described, rows, live)
    elif not any(event["type"] == "status" and event["state"] == "stale" for event in live):
        assert len(described) == 1 and len(rows) == len(frames), (len(described), len(rows), len(frames))
    return len(described), len(rows)


def known(found, event, verdicts):
    """What a policy could know at a frame."""
    now = moment(event["time"])
    assert np.isclose(found["force_n"], event["force_n"], atol=1e-3)
    assert found["contact_area_taxels"] == event["contact_area_taxels"]
    assert found["approach_known"] == (event["approach_mm"] is not None)
    assert np.isclose(found["approach_mm"], event["approach_mm"] or 0, atol=1e-3)
    published = [(moment(v["time"]) + datetime.timedelta(milliseconds=v["age_at_publish_ms"]), v) for v in verdicts]
    # JSON rounds the age to a microsecond or so: at that very moment both answers are right.
    before = [(when, v) for when, v in published if when <= now + datetime.timedelta(milliseconds=0.1)]
    if not before:
        assert (found["level"], found["confidence"], found["verdict_age_s"]) == (0, 0, 60), found
        return
    when, verdict = max(before, key=lambda pair: pair[0])
    assert found["level"] == (verdict["level"] or 0), (found, verdict)
    assert np.isclose(found["confidence"], verdict["confidence"], atol=1e-5)
    assert np.isclose(found["verdict_age_s"], (now - when).total_seconds(), atol=0.01)


def of_presses(described, rows, live):
    """Each episode is the frames of a press, with its final verdict."""
    for state, edge in (("begin", 0), ("end", -1)):
        events = [event for event in live if event["type"] == "press" and event["state"] == state]
        parts = [rows[episode["dataset_from_index"] : episode["dataset_to_index"]] for episode in described]
        told = [(event["press"], event["frame"]) for event in events]
        found = [(episode["hardnessd/press"], part[edge]["hardnessd.frame"]) for episode, part in zip(described, parts)]
        assert told == found, (told, found)
    finals = [event for event in live if event["type"] == "hardness" and event["phase"] == "final"]
    told = [(event["level"], event["label"]) for event in finals]
    assert [(episode["hardnessd/level"], episode["hardnessd/label"]) for episode in described] == told


def keys(path, directory):
    """Quantities go to the features that are named, or to none."""
    out = directory / "keys"
    chosen = ["newtons=touch.array", "force_n=touch.force", "level=", "approach_mm=", "approach_known="]
    options = [word for key in chosen for word in ("--key", key)]
    run(path, "--to", "lerobot", "--out", out, "--task", "press it", *options)
    features = json.loads((out / "meta/info.json").read_text())["features"]
    assert features["touch.array"]["shape"] == [28, 28] and features["touch.force"]["shape"] == [1]
    state = features["observation.tactile.forearm.state"]
    assert state["names"] == ["contact_area_taxels", "confidence", "verdict_age_s"] and state["shape"] == [3]
    rows = pq.read_table(out / "data/chunk-000/file-000.parquet").to_pylist()
    assert np.isclose(rows[50]["touch.force"], np.sum(rows[50]["touch.array"]), atol=1)


def two_sensors(binary, directory):
    """A recording of two sensors has both in its tables. A data set is of one."""
    with Bench(binary, sensors=("forearm", "palm")) as two:
        for seed, name in enumerate(("forearm", "palm")):
            two.sensor(name, "--force", "15", "--seed", str(seed))
        path = directory / "two.mcap"
        command = [binary, "record", "--config", two.path("hardnessd.toml"), "--out", path, "--seconds", "8"]
        bench.run(*command)
    run(path, "--to", "parquet", "--out", directory / "two")
    frames = pq.read_table(directory / "two/frames.parquet").to_pandas()
    contact = pq.read_table(directory / "two/contact.parquet").to_pandas()
    for name in ("forearm", "palm"):
        ours, touched = frames[frames.sensor == name], contact[contact.sensor == name]
        assert list(ours.frame) == list(touched.frame) == list(range(len(ours))) and len(ours) > 100, name
        assert touched.force_n.isna().eq(~touched.tared).all() and touched.force_n.max() > 10, name
    assert "--sensor" in run(path, "--to", "lerobot", "--out", directory / "one", code=2)
    run(path, "--to", "lerobot", "--sensor", "palm", "--out", directory / "one")
    rows = pq.read_table(directory / "one/data/chunk-000/file-000.parquet").to_pandas()
    untared = contact[(contact.sensor == "palm") & ~contact.tared]
    assert len(rows) == len(ours) - len(untared), (len(rows), len(ours), len(untared))
    forces = [state[0] for state in rows["observation.tactile.palm.state"]]
    assert np.allclose(forces, touched[touched.tared].force_n, atol=1e-3)
    return len(frames)


def rewritten(path, out, change=lambda message, topic: message, topics=None, metadata=True):
    """The recording as another program may write it anew. `change` gives the time and the sequence of a message."""
    with open(path, "rb") as file, open(out, "wb") as new:
        reader, writer = make_reader(file), Writer(new)
        writer.start("ros2")
        messages = [
            (*change((message.log_time, message.sequence), channel.topic), schema, channel, message.data)
            for schema, channel, message in reader.iter_messages()
            if topics is None or channel.topic.rsplit("/", 1)[1] in topics
        ]
        ids = {}
        # By time, and within a moment by topic, the other way round.
        for time, sequence, schema, channel, data in sorted(messages, key=lambda found: (found[0], found[3].topic)):
            if channel.topic not in ids:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(ids[channel.topic], time, data, time, sequence)
        for found in reader.iter_metadata() if metadata else ():
            writer.add_metadata(found.name, found.metadata)
        writer.finish()


def changed_by_others(path, directory):
    """Frame and contact are joined by what they are. What a recording lacks is said, by every reader alike."""
    run(path, "--to", "parquet", "--out", directory / "as-made")
    expected = pq.read_table(directory / "as-made/frames.parquet").to_pandas().set_index("frame").newtons
    burst, bare, alone = (directory / f"{name}.mcap" for name in ("burst", "bare", "alone"))
    # Frames of 0.3 s at one moment, as after a stall, and each topic of a moment behind the others.
    rewritten(path, burst, lambda message, _: (message[0] // 300_000_000 * 300_000_000, message[1]))
    rewritten(path, bare, metadata=False)
    rewritten(path, alone, topics=("frame", "input", "status"))
    for number, other in enumerate((burst, bare)):
        out = directory / f"other-{number}"
        said = run(other, "--to", "parquet", "--out", out, lines=1 + number)
        assert ("lacks metadata" in said) == (number == 1), said
        found = pq.read_table(out / "frames.parquet").to_pandas().set_index("frame").newtons
        assert list(found.index) == list(expected.index)
        for frame, newtons in expected.items():
            assert np.array_equal(newtons, found[frame]), (other, frame)
    labels = dict(pq.read_table(out / "recording.parquet").to_pylist()[0]["labels"])
    with recording.open(path) as whole, recording.open(bare) as opened:
        assert labels == whole.labels == opened.labels and opened.sensors.keys() == whole.sensors.keys()
    run(bare, "--to", "lerobot", "--out", directory / "bare-set", lines=2)
    assert json.loads((directory / "bare-set/meta/info.json").read_text())["fps"] == 20
    said = run(alone, "--to", "parquet", "--out", directory / "alone", lines=2)
    assert "lacks contacts, so its frames have no numbers" in said, said
    return len(expected)


def parted(path, directory):
    """Partitions grow by recordings, and a damaged one is left out and named."""
    takes, out = directory / "takes", directory / "parted"
    takes.mkdir()
    (takes / "a.mcap").write_bytes(path.read_bytes())
    (takes / "b.mcap").write_bytes(path.read_bytes()[:60_000])
    options = ("--to", "parquet", "--partition", "--append", "--skip-damaged", "--out", out)
    said = run(*takes.iterdir(), *options, lines=2)
    assert "1 recordings left out" in said and "b.mcap" in (out / export.LEFT_OUT).read_text(), said
    (takes / "b.mcap").write_bytes(path.read_bytes())
    said = run(takes / "a.mcap", takes / "b.mcap", *options, lines=2)
    assert "a.mcap: it is there already" in said, said
    counts = duckdb.sql(
        f"select recording, robot, count(*) from read_parquet('{out}/contact/**/*.parquet', hive_partitioning = true) "
        "group by all order by all"
    ).fetchall()
    assert [(row[0][:2], row[1]) for row in counts] == [("a-", "arm-7"), ("b-", "arm-7")], counts
    assert counts[0][2] == counts[1][2], counts
    assert not list(out.rglob("*.part"))
    assert "--partition" in run(path, "--to", "parquet", "--append", "--out", out, code=2)


def refusals(path, directory):
    """One line, the exit code, and no output."""
    out = directory / "refused"
    broken, other = directory / "broken.mcap", directory / "other.mcap"
    whole = path.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    other.write_text("something else")
    for to in ("parquet", "lerobot"):
        assert "hardnessd recover" in run(path, broken, "--to", to, "--out", out, code=1)
        assert "no MCAP recording" in run(other, "--to", to, "--out", out, code=1)
        assert "missing.mcap" in run(directory / "missing.mcap", "--to", to, "--out", out, code=66)
        assert not out.exists()
    assert "press" in run(path, "--to", "lerobot", "--key", "wrong=x", "--out", out, code=2)
    assert "'palm'" in run(path, "--to", "lerobot", "--sensor", "palm", "--out", out, code=1)
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    assert "not an empty folder" in run(path, "--to", "parquet", "--out", out, code=74)
    assert [file.name for file in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    run(path, "--to", "parquet", "--out", out)


def main(binary):
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        path = directory / "take.mcap"
        live = taken(binary, path, "--motion", "{control}")
        print("tables:", tables(path, live, directory))
        for episodes in ("recordings", "presses"):
            print("a data set of %d episodes and %d frames" % data_set(path, live, directory, episodes))
        keys(path, directory)
        print("two sensors: %d frames" % two_sensors(binary, directory))
        print("changed by other programs: %d frames" % changed_by_others(path, directory))
        parted(path, directory)
        refusals(path, directory)


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
