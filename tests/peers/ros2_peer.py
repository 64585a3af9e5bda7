#!/usr/bin/env python3
"""Events as ROS 2 topics, read by Cyclone DDS, the middleware under a ROS 2 installation.

    python -m venv venv && venv/bin/pip install cyclonedds
    cargo build --features ros2 && venv/bin/python tests/peers/ros2_peer.py target/debug/hardnessd

Claims: every field of every event, as the message files of clients/ros2 have it, is what the Unix socket
says; contacts are what frames say, for reliable readers too;
whoever comes late gets the last verdict and status; frames come best effort; the node and its topics are in ROS's own
discovery; a frozen reader costs no other subscriber an event, nor the stop its second.
"""

import math
import os
import pathlib
import struct
import sys
import time

# On loopback alone, where there is no multicast.
os.environ["CYCLONEDDS_URI"] = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

from bench import Bench, same_messages, wait_for  # noqa: E402
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
    "bool": bool,
}


def message(package, name, text):
    """A message of ROS, from its definition, as a type of DDS."""
    fields = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
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
CONTACT = message("tactile_interfaces", "Contact", (MESSAGES / "Contact.msg").read_text())

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
    made["contact"] = Reader(participant, f"{space}/contact", CONTACT, VOLATILE)
    return made | {"frame": Reader(participant, f"{space}/frame", IMAGE, BEST_EFFORT)}


def table(namespace="/"):
    return f'[publish.ros2]\ndomain_id = {DOMAIN}\nnamespace = "{namespace}"\nnetworks = ["127.0.0.1"]\n'


def same_as_the_socket(binary):
    with Bench(binary, more=table("/arm_7")) as bench:
        bench.daemon()
        lines = bench.events("--types", "frame,hardness,press,status")
        participant = DomainParticipant(DOMAIN)
        topics = readers(participant, "/arm_7/tactile/forearm")
        topics["status"].until(lambda status: status.state == "connecting")
        time.sleep(1)
        sensor = bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3")
        # A reader keeps 100 samples.
        while sensor.poll() is None:
            for reader in topics.values():
                reader.take()
            time.sleep(0.2)
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
        lines.thread.join()
        events = lines.events
        compared = 0
        for kind in OURS:
            count = same_messages(kind, topics[kind].samples, events)
            # Of statuses only the last is kept for a reader that has yet to be found.
            assert kind == "status" or count == len([event for event in events if event["type"] == kind]), kind
            compared += count
        assert compared >= 7, compared
        assert (image.height, image.width, image.encoding, image.step) == (28, 28, "32FC1", 112)
        newtons = struct.unpack("<784f", bytes(image.data))
        assert 0 <= min(newtons) and max(newtons) < 100
        frames = [event for event in events if event["type"] == "frame"]
        return compared, check_contacts(topics["contact"].samples, frames), found


def at(header):
    """As a frame event writes its time."""
    stamp = header.stamp
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(stamp.sec)) + f".{stamp.nanosec // 1000:06}Z"


def check_contacts(contacts, frames):
    """Contacts are what the frame events say."""
    by_time = {frame["time"]: frame for frame in frames}
    for sample in contacts:
        frame = by_time[at(sample.header)]
        assert sample.header.frame_id == "forearm"
        # Without a zero there is no force.
        is_same = math.isclose(sample.force_n, sum(frame["newtons"]), abs_tol=784 * 0.0005)
        assert is_same if frame["tared"] else math.isnan(sample.force_n), sample
        for key in ("frame", "contact_area_taxels", "tared"):
            assert getattr(sample, key) == frame[key], (key, sample)
    assert len(contacts) > 0.9 * len(frames) > 50, (len(contacts), len(frames))
    return len(contacts)


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
import time
from ros2_peer import DOMAIN, readers
from cyclonedds.domain import DomainParticipant
topics = readers(DomainParticipant(DOMAIN), "/tactile/forearm")
topics["hardness"].until(lambda verdict: True)
topics["contact"].until(lambda contact: True)
print("there", flush=True)
time.sleep(600)
"""


def a_frozen_reader(binary):
    with Bench(binary, frame_rate_hz=100, more=table()) as bench:
        daemon = bench.daemon()
        bench.sensor("forearm", "--force", "15", "--baud", "921600")
        return bench.freeze(daemon, FROZEN)


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    compared, seen, found = same_as_the_socket(binary)
    print(f"{compared} messages, as on the socket; of frames {seen}; discovered: {' '.join(found)}")
    print("a frozen reader: %d frames, none missed; verdicts after %d us at most; stop in %.2f s" % a_frozen_reader(binary))
