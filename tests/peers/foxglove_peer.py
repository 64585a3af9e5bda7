#!/usr/bin/env python3
"""Events as Foxglove and Lichtblick read them, by a websocket client that is not Foxglove's.

    python -m venv venv && venv/bin/pip install websockets mcap mcap-ros2-support
    cargo build --features foxglove && venv/bin/python tests/peers/foxglove_peer.py target/debug/hardnessd

Claims: every field of every event, decoded by the definitions that the server announces, is what the Unix socket
says; a late viewer gets the last verdict and status; a recording has the same topics with the same
definitions and, of the positions of the arm, the same bytes; and the layout in clients/foxglove fits both; a viewer
that never reads costs no other subscriber an event.
"""

import json
import math
import os
import pathlib
import queue
import struct
import sys
import threading
import time

from bench import Bench, same, same_messages
from mcap.reader import make_reader
from mcap_ros2._dynamic import generate_dynamic
from websockets.sync.client import connect

LAYOUT = pathlib.Path(__file__).resolve().parents[2] / "clients/foxglove/hardnessd.json"
TABLE = '[publish.foxglove]\nlisten = "127.0.0.1:0"\n'
TOPICS = ["contact", "frame", "hardness", "press", "status"]
PROTOCOL = "foxglove.sdk.v1"


def opened(address, **more):
    """A connection that stays open until the process ends, or it is closed."""
    return connect(f"ws://{address}", subprotocols=[PROTOCOL], **more).__enter__()


class Viewer:
    """Subscribes to every topic, and decodes what comes by what was announced."""

    def __init__(self, address):
        self.socket = opened(address, max_size=None)
        assert self.socket.subprotocol == PROTOCOL
        self.info = json.loads(self.socket.recv(timeout=10))
        assert self.info["op"] == "serverInfo", self.info
        self.channels = {}
        while len(self.channels) < len(TOPICS):
            said = json.loads(self.socket.recv(timeout=10))
            assert said["op"] == "advertise", said
            for channel in said["channels"]:
                assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg"), channel
                self.channels[channel["id"]] = channel
        self.topics = {channel["topic"]: channel for channel in self.channels.values()}
        self.decoders = {number: decoder(channel) for number, channel in self.channels.items()}
        self.messages = queue.Queue()
        # The number of a subscription is not that of its channel.
        wanted = [{"id": 1000 + number, "channelId": number} for number in self.channels]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        for data in self.socket:
            if isinstance(data, str):
                self.messages.put((json.loads(data)["op"], None, data))
                continue
            operation, subscription, time_ns = struct.unpack_from("<BIQ", data)
            assert operation == 1, operation
            channel = self.channels[subscription - 1000]
            message = self.decoders[channel["id"]](data[13:])
            topic = channel["topic"].rsplit("/", 1)[1]
            self.messages.put((topic, time_ns, message))

    def until(self, there):
        """All that came, with the first for which `there(topic, message)` last."""
        got = []
        while not got or not there(got[-1][0], got[-1][2]):
            got.append(self.messages.get(timeout=60))
        return got


def decoder(channel):
    """How a viewer reads the messages of a channel."""
    made = generate_dynamic(channel["schemaName"], channel["schema"])
    return made[channel["schemaName"]]


def same_as_the_socket(binary):
    more = TABLE + '[record]\ndir = "rec"\nkeep_free_mb = 0\n'
    with Bench(binary, more=more) as bench:
        daemon = bench.daemon()
        address = bench.address("foxglove")
        lines = bench.events("--types", "frame,hardness,press,status")
        viewer = Viewer(address)
        # Both subscriptions are made before the first frame.
        time.sleep(2)
        assert viewer.info["name"] == "hardnessd of arm-7" and viewer.info["capabilities"] == [], viewer.info
        assert sorted(viewer.topics) == [f"/tactile/forearm/{topic}" for topic in TOPICS], viewer.topics
        sensor = bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3", "--motion", bench.path("control.sock"))
        sensor.wait(timeout=60)
        # The last status says why the sensor stays lost.
        got = viewer.until(lambda topic, message: topic == "status" and (message.state, message.reason) == ("lost", "no such device"))
        late = Viewer(address)
        greeted = {}
        while set(greeted) < {"hardness", "status"}:
            topic, _, message = late.messages.get(timeout=10)
            greeted[topic] = message
        assert (greeted["hardness"].phase, greeted["hardness"].press) == ("final", 2), greeted
        assert greeted["status"].state == "lost", greeted
        daemon.terminate()
        assert daemon.wait(timeout=10) == 0
        lines.kill()
        lines.thread.join()
        events = lines.events
        compared = compare(got, events)
        (recording,) = pathlib.Path(bench.path("rec")).glob("hardnessd-*.mcap")
        check_recording(recording, viewer, got)
        check_layout(viewer, got)
        return compared


def compare(got, events):
    """How many messages of each topic are as the socket has them, field by field."""
    compared = dict.fromkeys(TOPICS, 0)
    for kind in ("hardness", "press", "status"):
        messages = [message for topic, _, message in got if topic == kind]
        compared[kind] = same_messages(kind, messages, events)
        assert compared[kind] == len([event for event in events if event["type"] == kind and "seq" in event]), kind
    frames = {event["frame"]: event for event in events if event["type"] == "frame"}
    by_time = {event["time"]: event for event in frames.values()}
    for topic, time_ns, message in got:
        if topic == "contact":
            event = frames[message.frame]
            assert same(message.force_n, event["force_n"], "force_n"), message
            for key in ("contact_area_taxels", "tared"):
                assert getattr(message, key) == event[key], (key, message)
            assert same(message.approach_mm, event["approach_mm"], "approach_mm"), (message, event["approach_mm"])
        elif topic == "frame":
            event = by_time[rfc3339(time_ns)]
            newtons = struct.unpack("<784f", bytes(message.data))
            assert (message.height, message.width, message.encoding, message.step) == (28, 28, "32FC1", 112)
            assert all(abs(a - b) <= 0.0005 + 1e-6 for a, b in zip(newtons, event["newtons"], strict=True))
        else:
            continue
        compared[topic] += 1
    assert compared["frame"] == compared["contact"] >= 0.9 * len(frames) > 50, (compared, len(frames))
    assert min(compared.values()) >= 2, compared
    assert any(not math.isnan(message.approach_mm) for topic, _, message in got if topic == "contact")
    return compared


def rfc3339(time_ns):
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds)) + f".{rest // 1000:06}Z"


def check_recording(path, viewer, got):
    """A recording has the same topics, definitions and bytes."""
    # The daemon has closed the connection.
    viewer.reader.join(timeout=10)
    with open(path, "rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        recorded = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            recorded[channel.topic] = (schema.name, schema.data.decode(), channel.message_encoding)
        for topic, channel in viewer.topics.items():
            assert recorded[topic] == (channel["schemaName"], channel["schema"], "cdr"), topic
        contacts = [
            decoder(viewer.topics[channel.topic])(message.data)
            for _, channel, message in reader.iter_messages(topics=["/tactile/forearm/contact"])
        ]
    # Without a zero there is no force.
    recorded = {message.frame: message.force_n for message in contacts if message.tared}
    live = {message.frame: message.force_n for topic, _, message in got if topic == "contact" and message.tared}
    assert live.items() <= recorded.items() and len(live) > 50


def check_layout(viewer, got):
    """Every path of the layout leads to a topic, and to a field of its messages."""
    examples = {topic: message for topic, _, message in got}

    def paths(value):
        if isinstance(value, dict):
            for key, below in value.items():
                yield from paths(key)
                yield from paths(below)
        elif isinstance(value, list):
            for below in value:
                yield from paths(below)
        elif isinstance(value, str) and value.startswith("/"):
            yield value

    found = set(paths(json.loads(LAYOUT.read_text())))
    assert len(found) >= 10, found
    for path in found:
        topic, _, field = path.partition(".")
        assert topic in viewer.topics, path
        assert not field or hasattr(examples[topic.rsplit("/", 1)[1]], field), path


FROZEN = """
import sys, time
from foxglove_peer import Viewer
viewer = Viewer(sys.argv[1])
viewer.until(lambda topic, message: topic == "frame")
print("there", flush=True)
time.sleep(600)
"""


def a_frozen_viewer(binary):
    with Bench(binary, frame_rate_hz=100, more=TABLE) as bench:
        daemon = bench.daemon()
        bench.sensor("forearm", "--force", "15", "--baud", "921600")
        return bench.freeze(daemon, FROZEN, bench.address("foxglove"))


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    print("messages as on the socket:", same_as_the_socket(binary))
    print("a frozen viewer: %d frames, none missed; verdicts after %d us at most; stop in %.2f s" % a_frozen_viewer(binary))
