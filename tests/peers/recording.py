#!/usr/bin/env python3
"""Recordings in other people's readers: mcap, mcap-ros2-support and rosbags.

    python -m venv venv && venv/bin/pip install mcap mcap-ros2-support rosbags
    venv/bin/python tests/peers/recording.py target/debug/hardnessd

Claims: a recording of the daemon, and what `recover` saves of one that was killed, open in all three;
they count the same messages; a bag that `clients/ros2/bag.py` makes of it opens in rosbags by its metadata.yaml; and every field of the daemon's hardness events is in them, with its
value.
"""

import json
import os
import pathlib
import struct
import sys
import tempfile
import time

from bench import Bench, run, same_messages, taken, wait_for
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

TOPICS = ["input", "frame", "hardness", "press", "status", "motion", "contact"]
BAG = pathlib.Path(__file__).resolve().parents[2] / "clients/ros2/bag.py"


def by_mcap(path):
    """Messages a topic, and the metadata, by the plain reader with its index."""
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        counts = dict.fromkeys(TOPICS, 0)
        for schema, channel, message in reader.iter_messages():
            assert channel.message_encoding == "cdr" and schema.encoding == "ros2msg"
            counts[channel.topic.rsplit("/", 1)[1]] += 1
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    return counts, metadata


def by_mcap_ros2(path):
    """All messages, decoded, a topic."""
    messages = {topic: [] for topic in TOPICS}
    for found in read_ros2_messages(path):
        messages[found.channel.topic.rsplit("/", 1)[1]].append(found.ros_msg)
    return messages


def by_rosbags(path):
    """The same, by a third reader."""
    messages = {topic: [] for topic in TOPICS}
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([pathlib.Path(path)], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages[connection.topic.rsplit("/", 1)[1]].append(message)
    return messages


def check(path, live):
    """All readers agree with each other and with what subscribers read."""
    counts, metadata = by_mcap(path)
    ros2, bags = by_mcap_ros2(path), by_rosbags(path)
    for topic in TOPICS:
        assert counts[topic] == len(ros2[topic]) == len(bags[topic]), (topic, counts)
    for messages in (ros2, bags):
        for kind in ("hardness", "press", "status"):
            assert same_messages(kind, messages[kind], live) or not live, f"no {kind} to compare"
        image = messages["frame"][-1]
        assert (image.height, image.width, image.encoding) == (28, 28, "32FC1")
        newtons = struct.unpack("<784f", bytes(image.data))
        assert min(newtons) >= 0 and max(newtons) < 100
        raw = b"".join(bytes(message.data) for message in messages["input"] if message.kind == 0)
        # All but the frames under way at both ends, if frames were not damaged.
        assert 0 <= len(raw) - 790 * counts["frame"] < 2 * 790, (len(raw), counts)
    return counts, metadata


def bag(out, recordings, counts):
    """A bag of these recordings in the new directory `out` says what is in them, and opens by its metadata."""
    run(sys.executable, BAG, "--out", out, *recordings)
    with Reader(out) as reader:
        assert "storage_identifier: mcap" in (out / "metadata.yaml").read_text()
        assert reader.message_count == sum(counts.values())
        told = {topic.rsplit("/", 1)[1]: info.msgcount for topic, info in reader.topics.items()}
        assert told == counts, (told, counts)
        types = {connection.topic.rsplit("/", 1)[1]: connection.msgtype for connection in reader.connections}
        assert (types["frame"], types["contact"]) == ("sensor_msgs/msg/Image", "tactile_interfaces/msg/Contact"), types
        read = dict.fromkeys(TOPICS, 0)
        for connection, time_ns, _ in reader.messages():
            assert reader.start_time <= time_ns <= reader.end_time
            read[connection.topic.rsplit("/", 1)[1]] += 1
        assert read == counts, (read, counts)
    assert "bag.py: " in run(sys.executable, BAG, "--out", out, *recordings, code=1).stderr


def recorded(binary):
    """The daemon's own recording beside what a subscriber read."""
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        recording = directory / "take.mcap"
        live = taken(binary, recording)
        counts, metadata = check(recording, live)
        bag(directory / "one", [recording], counts)
        # Two files become one bag.
        second = directory / "second.mcap"
        second.write_bytes(recording.read_bytes())
        bag(directory / "both", [recording, second], {kind: 2 * n for kind, n in counts.items()})
    assert metadata["hardnessd.recording"]["robot"] == "arm-7"
    assert json.loads(metadata["hardnessd.sensor"]["settings"])["name"] == "forearm"
    finals = [event for event in live if event.get("phase") == "final"]
    assert counts["hardness"] >= len(finals) >= 2, counts
    return counts


def killed(binary):
    """What is saved of a recording that was killed."""
    with Bench(binary) as bench:
        sensor = bench.sensor("forearm", "--force", "15")
        out, good = bench.path("out.mcap"), bench.path("good.mcap")
        config = bench.path("hardnessd.toml")
        recorder = bench._start(
            ["record", "--config", config, "--out", out, "--label", "level=2"], "recorder"
        )
        wait_for("the recording", lambda: os.path.exists(out) and os.path.getsize(out) > 20_000)
        time.sleep(1.3)
        recorder.kill()
        recorder.wait()
        sensor.kill()
        saved = run(binary, "recover", out, "--out", good)
        assert "the end was missing" in saved.stderr, saved.stderr
        counts, metadata = check(good, [])
        assert metadata["hardnessd.labels"] == {"level": "2", "simulated": "true"}
        return counts


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    print("recorded:", recorded(binary))
    print("recovered:", killed(binary))
