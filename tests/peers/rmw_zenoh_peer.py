#!/usr/bin/env python3
"""Events as ROS 2 topics over zenoh, read as nodes with `rmw_zenoh` read them.

    python -m venv venv && venv/bin/pip install eclipse-zenoh rosbags zenoh-ros2-sdk
    cargo build --features zenoh && venv/bin/python tests/peers/rmw_zenoh_peer.py target/debug/hardnessd

Robotis's zenoh-ros2-sdk reads, which shares no code with the daemon: it takes keys and tokens from the definitions of
the messages, whose hashes rosbags computes. Between them stands a router with the settings of ROS's `rmw_zenohd`.
Claims: every field of every event, as the message files of clients/ros2 have it, is what the Unix socket says;
frames come as pictures; who comes late gets the last verdict and status; the node and its topics are in the graph with
types and quality of service, and leave it when the daemon is killed; the router may come after the daemon; keys without
hashes are those of Humble; a frozen reader costs no other subscriber an event, nor the stop its second.
"""

import os
import pathlib
import struct
import sys
import time

import zenoh
import zenoh.ext
from bench import Bench, free_port, same_messages, wait_for
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber, discovery
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability

DOMAIN = 87
MESSAGES = pathlib.Path(__file__).resolve().parents[2] / "clients/ros2/tactile_interfaces/msg"
OURS = ("hardness", "press", "status", "contact")
STORE = get_typestore(Stores.ROS2_JAZZY)
for own in map(str.title, OURS):
    STORE.register(get_types_from_msg((MESSAGES / f"{own}.msg").read_text(), f"tactile_interfaces/msg/{own}"))


def router(port):
    config = zenoh.Config()
    for key, value in [
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/127.0.0.1:{port}"]'),
        ("scouting/multicast/enabled", "false"),
        ("routing/router/peers_failover_brokering", "false"),
        ("timestamping/enabled", "true"),
    ]:
        config.insert_json5(key, value)
    return zenoh.open(config)


class Reader:
    """All that comes on a topic, in order. Of a latched one it gets the last message before too, as Eclipse's own
    subscriber asks for it: the kit's does so only for names of one part."""

    def __init__(self, port, topic, kind):
        self.samples = []
        text, type_hash = STORE.generate_msgdef(kind)[0].split("=" * 80)[0], STORE.hash_rihs01(kind)
        is_latched = kind.endswith(("Hardness", "Status"))
        take = (lambda _: None) if is_latched else self.samples.append
        self.node = ROS2Subscriber(topic, kind, take, text, domain_id=DOMAIN, router_port=port, type_hash=type_hash)
        # Its own would fetch the definition of a header from the network.
        self.node.session_mgr.store = STORE
        if is_latched:
            self.subscriber = zenoh.ext.declare_advanced_subscriber(
                self.node.session_mgr.session,
                self.node.keyexpr,
                lambda sample: self.samples.append(STORE.deserialize_cdr(sample.payload.to_bytes(), kind)),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            )

    def until(self, there):
        wait_for("a sample", lambda: any(there(sample) for sample in self.samples))
        return self.samples


def reader(port, space, kind):
    message = "sensor_msgs/msg/Image" if kind == "frame" else f"tactile_interfaces/msg/{kind.title()}"
    return Reader(port, f"{space}/{kind}", message)


def table(port, more=""):
    return f'[publish.rmw_zenoh]\ndomain_id = {DOMAIN}\nconnect = ["tcp/127.0.0.1:{port}"]\n{more}'


def same_as_the_socket(binary):
    port = free_port()
    with Bench(binary, more=table(port, 'namespace = "/arm_7"\n')) as bench:
        daemon = bench.daemon()
        lines = bench.events("--types", "frame,hardness,press,status")
        time.sleep(1)
        between = router(port)
        space = "/arm_7/tactile/forearm"
        wait_for("the topics", lambda: len(topics(port, space)) == 5)
        readers = {kind: reader(port, space, kind) for kind in (*OURS, "frame")}
        readers["status"].until(lambda status: status.state == "connecting")
        time.sleep(1)
        bench.sensor("forearm", "--presses", "2", "--force", "15", "--seed", "3").wait(timeout=60)
        readers["hardness"].until(lambda verdict: verdict.phase == "final" and verdict.press == 2)
        readers["press"].until(lambda press: press.press == 2 and press.state == "end")
        readers["status"].until(lambda status: status.state == "lost")
        late = {kind: reader(port, space, kind) for kind in ("hardness", "status")}
        assert late["hardness"].until(lambda verdict: verdict.phase == "final")[0].press == 2
        assert late["status"].until(lambda status: True)[0].state == "lost"
        found = graph(port, space)
        daemon.kill()
        wait_for("an empty graph", lambda: not topics(port, space))
        lines.kill()
        lines.thread.join()
        events = lines.events
        compared = 0
        for kind in ("hardness", "press", "status"):
            count = same_messages(kind, readers[kind].samples, events)
            assert kind == "status" or count == len([event for event in events if event["type"] == kind]), kind
            compared += count
        assert compared >= 7, compared
        frames = {event["frame"] for event in events if event["type"] == "frame"}
        contacts = [sample.frame for sample in readers["contact"].samples]
        assert set(contacts) <= frames and len(contacts) > 0.9 * len(frames) > 50, (len(contacts), len(frames))
        image = readers["frame"].samples[-1]
        assert (image.height, image.width, image.encoding, image.step) == (28, 28, "32FC1", 112)
        assert max(struct.unpack("<784f", bytes(image.data))) < 100
        between.close()
        return compared, len(contacts), found


def topics(port, space):
    """The types of the topics that the daemon publishes."""
    named = discovery.get_topic_names_and_types(DOMAIN, router_port=port, timeout=2.0)
    infos = {name: discovery.get_topic_info(name, DOMAIN, router_port=port, verbose=True) for name, _ in named}
    return {name: info.publishers[0] for name, info in infos.items() if name.startswith(space) and info and info.publishers}


def graph(port, space):
    """What `ros2 topic list -t` and `ros2 topic info -v` go by."""
    found = topics(port, space)
    assert set(found) == {f"{space}/{kind}" for kind in (*OURS, "frame")}, found
    for name, publisher in found.items():
        kind = name.rsplit("/", 1)[1]
        message = "sensor_msgs/msg/Image" if kind == "frame" else f"tactile_interfaces/msg/{kind.title()}"
        assert publisher.topic_type == message, publisher
        assert (publisher.node_namespace, publisher.node_name) == ("/arm_7", "hardnessd"), publisher
        qos = QosProfile.decode(publisher.qos)
        is_latched = qos.durability == QosDurability.TRANSIENT_LOCAL
        is_reliable = qos.reliability == QosReliability.RELIABLE
        assert (is_latched, is_reliable) == (kind in ("hardness", "status"), kind != "frame"), publisher
    return sorted(found)


def of_humble(binary):
    port = free_port()
    with router(port) as between, Bench(binary, more=table(port, "type_hashes = false\n")) as bench:
        seen = []
        between.declare_subscriber(f"{DOMAIN}/tactile/forearm/*/*/TypeHashNotSupported", seen.append)
        bench.daemon()
        bench.sensor("forearm", "--presses", "1")
        wait_for("a sample", lambda: seen)
        number, _, length = struct.unpack("<qqB", seen[0].attachment.to_bytes()[:17])
        assert (number, length, len(seen[0].attachment.to_bytes())) == (1, 16, 33), seen[0].attachment


FROZEN = """
import sys
from rmw_zenoh_peer import reader
port = int(sys.argv[1])
readers = {kind: reader(port, "/tactile/forearm", kind) for kind in ("hardness", "contact", "frame")}
readers["hardness"].until(lambda verdict: True)
readers["frame"].until(lambda frame: True)
print("there", flush=True)
import time
time.sleep(600)
"""


def a_frozen_reader(binary):
    port = free_port()
    with router(port), Bench(binary, frame_rate_hz=100, more=table(port)) as bench:
        daemon = bench.daemon()
        bench.sensor("forearm", "--force", "15", "--baud", "921600")
        return bench.freeze(daemon, FROZEN, str(port))


if __name__ == "__main__":
    binary = os.path.abspath(sys.argv[1])
    compared, seen, found = same_as_the_socket(binary)
    print(f"{compared} messages, as on the socket; of frames {seen}; in the graph: {' '.join(found)}")
    of_humble(binary)
    print("a frozen reader: %d frames, none missed; verdicts after %d us at most; stop in %.2f s" % a_frozen_reader(binary), flush=True)
    # Threads of the SDK would go on for ever.
    os._exit(0)
