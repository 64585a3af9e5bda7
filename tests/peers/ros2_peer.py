#!/usr/bin/env python3
"""Events as ROS 2 topics, read by Cyclone DDS, the middleware under a ROS 2 installation.

    python -m venv venv && venv/bin/pip install cyclonedds
    cargo build --features ros2 && venv/bin/python tests/peers/ros2_peer.py target/debug/hardnessd

Claims: every field of every event, as the message files of clients/ros2 have it, is what the Unix socket
says; whoever comes late gets the last verdict and status; frames come best effort; the node and its
topics are in ROS's own discovery; a frozen reader costs no other subscriber an event, nor the stop its
second.
"""

import json
import os
import pathlib
import struct
import subprocess
import sys
import time

# On loopback alone, where there is no multicast.
os.environ["CYCLONEDDS_URI"] = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

from bench import Bench, same, wait_for  # noqa: E402
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication  # noqa: E402
from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl import make_idl_struct, types  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402

DOMAIN = 87
MESSAGES = pathlib.Path(__file__).resolve().parents[2] / "clients/ros2/tactile_interfaces/msg"
TYPES = {
    "uint8": types.uint8,
    "uint32": types.uint32,
    "int32": types.int32,
    "uint64": types.uint64,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}


def message(package, name, text):
    """A message of ROS, from its definition, as a type of DDS."""
    fields = {}
    for line in text.splitlines():
        kind, field = line.split()
        base = TYPES[kind.removesuffix("[]")]
        fields[field] = types.sequence[base] if kind.endswith("[]") else base
    made = make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)
    TYPES[f"{package}/{name}"] = made
    return made


message("builtin_interfaces", "Time", "int32 sec\nuint32 nanosec")
message("std_msgs", "Header", "builtin_interfaces/Time stamp\nstring frame_id")
IMAGE = message(
    "sensor_msgs",
    "Image",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
)
OURS = {
    kind: message("tactile_interfaces", kind.title(), (MESSAGES / f"{kind.title()}.msg").read_text())
    for kind in ("hardness", "press", "status")
}

RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(100))
VOLATILE = Qos(RELIABLE, Policy.History.KeepLast(100))
BEST_EFFORT = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(10))


class Reader:
    """All that comes on a topic, in order."""

    def __init__(self, participant, name, kind, qos):
        topic = Topic(participant, f"rt{name}", kind)
        self.reader = DataReader(participant, topic, qos=qos)
        self.samples = []

    def take(self):
        self.samples += [sample for sample in self.reader.take(N=1000) if hasattr(sample, "header")]
        return self.samples

    def until(self, there):
        wait_for("a sample", lambda: any(there(sample) for sample in self.take()))
        return self.samples


def readers(participant, space):
    qos = {"hardness": LATCHED, "press": VOLATILE, "status": LATCHED}
    made = {kind: Reader(participant, f"{space}/{kind}", OURS[kind], qos[kind]) for kind in OURS}
    return made | {"frame": Reader(participant, f"{space}/frame", IMAGE, BEST_EFFORT)}


def table(namespace="/"):
    return f'[publish.ros2]\ndomain_id = {DOMAIN}\nnamespace = "{namespace}"\nnetworks = ["127.0.0.1"]\n'


def same_as_the_socket(binary):
    with Bench(binary, more=table("/arm_7")) as bench:
        bench.daemon()
        lines = bench.tail("--timeout", "90", "--count", "1000")
        participant = DomainParticipant(DOMAIN)
        topics = readers(participant, "/arm_7/tactile/forearm")
        topics["status"].until(lambda status: status.state == "connecting")
        time.sleep(1)
        sensor = bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3")
        sensor.wait(timeout=60)
        topics["hardness"].until(lambda verdict: verdict.phase == "final" and verdict.press == 2)
        topics["press"].until(lambda press: press.press == 2 and press.state == "end")
        topics["status"].until(lambda status: status.state == "lost")
        image = topics["frame"].take()[-1]
        late = readers(DomainParticipant(DOMAIN), "/arm_7/tactile/forearm")
        (verdict,) = late["hardness"].until(lambda verdict: verdict.phase == "final")[-1:]
        (status,) = late["status"].until(lambda status: status.state == "lost")[-1:]
        assert (verdict.press, status.state) == (2, "lost"), (verdict, status)
        found = discovered(participant)
        lines.kill()
        events = [json.loads(line) for line in lines.communicate()[0].splitlines()]
        compared = 0
        for kind in OURS:
            told = {event["seq"]: event for event in events if event["type"] == kind and "seq" in event}
            got = {sample.seq: sample for sample in topics[kind].samples}
            missing = set(told) - set(got)
            # Of statuses only the last is kept for a reader that has yet to be found.
            assert kind == "status" or not missing, (kind, missing)
            for seq, sample in got.items():
                if seq not in told:
                    continue
                for key, value in told[seq].items():
                    if key != "type":
                        assert same(getattr(sample, key), value, key), (kind, key, sample, value)
                assert sample.header.frame_id == "forearm"
                compared += 1
        assert compared >= 7, compared
        assert (image.height, image.width, image.encoding, image.step) == (28, 28, "32FC1", 112)
        newtons = struct.unpack("<784f", bytes(image.data))
        assert 0 <= min(newtons) and max(newtons) < 100
        return compared, found


def discovered(participant):
    """What a tool such as `ros2 topic list` goes by."""
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    wanted = {f"rt/arm_7/tactile/forearm/{kind}" for kind in ("hardness", "press", "status", "frame")}
    found = {}

    def all_there():
        for sample in reader.take(N=100):
            found[sample.topic_name] = sample.type_name
        return wanted <= set(found)

    wait_for("the topics", all_there)
    assert found["rt/arm_7/tactile/forearm/hardness"] == "tactile_interfaces::msg::dds_::Hardness_", found
    assert found["rt/arm_7/tactile/forearm/frame"] == "sensor_msgs::msg::dds_::Image_", found
    assert "ros_discovery_info" in found, found
    return sorted(found)


FROZEN = """
import sys, time
sys.path.insert(0, sys.argv[1])
from ros2_peer import DOMAIN, readers
from cyclonedds.domain import DomainParticipant
topics = readers(DomainParticipant(DOMAIN), "/tactile/forearm")
topics["hardness"].until(lambda verdict: True)
print("there", flush=True)
time.sleep(600)
"""


def a_frozen_reader(binary):
    with Bench(binary, frame_rate_hz=100, more=table()) as bench:
        daemon = bench.daemon()
        bench.sensor("forearm", "--force", "15", "--baud", "921600")
        here = os.path.dirname(os.path.abspath(__file__))
        peer = subprocess.Popen([sys.executable, "-c", FROZEN, here], stdout=subprocess.PIPE, text=True)
        bench.processes.append(peer)
        assert peer.stdout.readline() == "there\n"
        return bench.freeze(peer, daemon)


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    compared, found = same_as_the_socket(binary)
    print(f"{compared} messages, as on the socket; discovered: {' '.join(found)}")
    print("a frozen reader: %d frames, none missed; verdicts after %d us at most; stop in %.2f s" % a_frozen_reader(binary))
