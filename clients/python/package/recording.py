"""Recordings: the MCAP files that `hardnessd record` and the daemon's [record] table write.

    from hardnessd import recording

    with recording.open("take.mcap") as take:
        print(take.labels, take.sensors)
        for event in take.events():
            if event["type"] == "hardness":
                print(event["press"], event["label"])
        for frame in take.frames():
            ...

It needs mcap and mcap-ros2-support: pip install './clients/python[recording]'

Events are those of the daemon, as it published them. `hardnessd replay` computes them again.
"""

from __future__ import annotations

import array
import builtins
import contextlib
import itertools
import json
import math
import os
import sys
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union, cast

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hardnessd import Event, Hardness, Press, Status

_EVENTS = {"hardness": Hardness, "press": Press, "status": Status}

# What a ROS message has where the event has null, because ROS knows no null. Numbers that are not
# listed are NaN there.
_NULL: Dict[str, Union[int, str, bytes]] = {
    "level": 0,
    "label": "",
    "rejected": "",
    "reason": "",
    "detail": "",
    "context": "",
    "mono_ns": 0,
    "levels": b"",
    "course": "",
    "advice": "",
    "object": "",
}


# The first bytes of an MCAP file.
_MAGIC = b"\x89MCAP0\r\n"

# Constants of tactile_interfaces/msg/Input.
_BYTES = 0
_STATE = 9


class Frame(NamedTuple):
    """What the network saw at one moment."""

    sensor: str
    time_ns: int
    """Nanoseconds since 1970, UTC."""
    newtons: "array.array[float]"
    """rows x cols newtons, row by row. numpy.asarray(newtons).reshape(rows, cols) makes an image of it."""
    rows: int
    cols: int
    number: Optional[int]
    """The frame's number, as in events. None if the recording lacks its contact."""


class Chunk(NamedTuple):
    """Bytes that the sensor sent."""

    sensor: str
    time_ns: int
    """When they were read, in nanoseconds since 1970, UTC."""
    mono_ns: int
    """The same by CLOCK_MONOTONIC."""
    data: bytes


class _Found(NamedTuple):
    """A message."""

    sensor: str
    topic: str
    time_ns: int
    sequence: int
    message: Any


class Touch(NamedTuple):
    """A frame and its contact, joined by sensor and time. One of them may be missing, but not both."""

    frame: Any
    contact: Any


class Damaged(ValueError):
    """The file is no recording, or not a whole one."""


class Recording:
    """An open recording. Use it with `with`, or call `close`."""

    def __init__(self, path: Union[str, "os.PathLike[str]"]) -> None:
        self.path = os.fspath(path)
        self._file = builtins.open(path, "rb")
        try:
            if self._file.read(len(_MAGIC)) != _MAGIC:
                raise Damaged(f"{self.path}: no MCAP recording, as `hardnessd record` writes it")
            self._file.seek(0)
            with self._reading():
                self._reader = make_reader(
                    self._file, validate_crcs=True, decoder_factories=[DecoderFactory()]
                )
                metadata = [(found.name, dict(found.metadata)) for found in self._reader.iter_metadata()]
                summary = self._reader.get_summary()
                topics = [channel.topic.split("/") for channel in summary.channels.values()] if summary else []
            named = dict(metadata)
            names = {topic[2]: None for topic in topics if len(topic) == 4 and topic[1] == "tactile"}
            if "hardnessd.recording" not in named and not names:
                raise ValueError(f"{self.path}: a recording, but none of hardnessd")
            sensors = [found for name, found in metadata if name == "hardnessd.sensor"]
            settings = {found["name"]: json.loads(found["settings"]) for found in sensors}
            self.sensors: Dict[str, Dict[str, Any]] = settings
            """Settings of each sensor. Empty for a sensor whose settings the recording lacks."""
            self.about: Dict[str, str] = named.get("hardnessd.recording", {})
            """robot, run, boot_id, version. Empty if the recording lacks them."""
            self.labels: Dict[str, str] = named.get("hardnessd.labels", {})
            """What was given with `record --label`."""
            self.lacks: List[str] = []
            """What another program has taken from the recording, in words."""
            if not self.about:
                self._restore([*names, *(name for name in settings if name not in names)])
            written = {topic[3] for topic in topics if len(topic) == 4}
            if ("frame" in written) != ("contact" in written):
                self.lacks.append("contacts, so its frames have no numbers" if "frame" in written else "frames")
        except BaseException:
            self._file.close()
            raise

    def _restore(self, names: List[str]) -> None:
        """What the metadata said, as far as the states of the sensors say it too."""
        self.lacks.append("metadata: robot, run and version")
        for name in names:
            with self._reading():
                inputs = self._reader.iter_decoded_messages([f"/tactile/{name}/input"])
                state = next((bytes(found[3].data) for found in inputs if found[3].kind == _STATE), None)
            if state is None:
                self.sensors.setdefault(name, {})
                self.lacks.append(f"the settings and labels of {name}")
            else:
                known = json.loads(state)
                self.sensors[name] = known["sensor"]
                self.labels = self.labels or known["labels"]

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def events(self, types: Sequence[str] = ("hardness", "press", "status")) -> Iterator[Event]:
        """Events in the order of their publication, with the fields that a subscriber gets."""
        with self._reading():
            events = [
                {"type": topic, **{key: _value(key, message) for key in _fields(topic)}}
                for _, topic, _, message in self._messages(types)
            ]
        return iter(cast("List[Event]", sorted(events, key=lambda event: event["seq"])))

    def frames(self) -> Iterator[Frame]:
        """Frames after tare, in the order of time."""
        for sensor, _, time_ns, (frame, contact) in self.joined([]):
            if frame is not None:
                newtons = array.array("f", bytes(frame.data))
                if sys.byteorder == "big":
                    newtons.byteswap()
                number = None if contact is None else contact.frame
                yield Frame(sensor, time_ns, newtons, frame.height, frame.width, number)

    def joined(self, topics: Sequence[str]) -> Iterator[Tuple[str, str, int, Any]]:
        """Sensor, topic, nanoseconds since 1970, and message, in the order of time. A frame and its contact come as
        one Touch, with the topic `touch`, before the other topics of their moment.

        A frame has no number of its own, and its contact has one. Both have the same time, and where frames of one
        moment are several, their order in the recording is that of their numbers.
        """
        found = self._records(["frame", "contact", *topics])
        for time_ns, same in itertools.groupby(found, key=lambda one: one.time_ns):
            moment = list(same)
            for sensor in dict.fromkeys(one.sensor for one in moment):
                of = {topic: [one for one in moment if (one.sensor, one.topic) == (sensor, topic)] for topic in ("frame", "contact")}
                frames = sorted(of["frame"], key=lambda one: one.sequence)
                contacts = sorted(of["contact"], key=lambda one: one.message.frame)
                if frames and contacts and len(frames) != len(contacts):
                    counts = f"{len(frames)} frames and {len(contacts)} contacts of {sensor} at one moment"
                    raise Damaged(f"{self.path}: {counts}: another program has changed this recording")
                for frame, contact in itertools.zip_longest(frames, contacts):
                    yield sensor, "touch", time_ns, Touch(frame and frame.message, contact and contact.message)
            for one in moment:
                if one.topic not in ("frame", "contact"):
                    yield one.sensor, one.topic, time_ns, one.message

    def chunks(self) -> Iterator[Chunk]:
        """The bytes that came from the sensors, as they were read, in the order of time."""
        for sensor, _, time_ns, message in self._messages(["input"]):
            if message.kind == _BYTES:
                yield Chunk(sensor, time_ns, message.mono_ns, bytes(message.data))

    def check(self) -> None:
        """Reads the whole recording. Raises Damaged if it is not whole."""
        with self._reading():
            for _ in self._reader.iter_messages():
                pass
        for _ in self._records(["status"]):
            pass

    def _messages(self, topics: Sequence[str]) -> Iterator[Tuple[str, str, int, Any]]:
        """Sensor, topic, nanoseconds since 1970, and message."""
        for found in self._records(topics):
            yield found.sensor, found.topic, found.time_ns, found.message

    def _records(self, topics: Sequence[str]) -> Iterator[_Found]:
        names = [f"/tactile/{sensor}/{topic}" for sensor in self.sensors for topic in topics]
        count = 0
        with self._reading():
            for _, channel, record, message in self._reader.iter_decoded_messages(names):
                _, _, sensor, topic = channel.topic.split("/")
                count += 1
                # MCAP's own time goes on after 2038, where a ROS header ends, but does not know the time before 1970.
                yield _Found(sensor, topic, record.log_time or _time_ns(message), record.sequence, message)
            # The library takes a chunk of zeros, as a power failure leaves it, for an empty one.
            summary = self._reader.get_summary()
            if summary is not None and summary.statistics is not None:
                counts = summary.statistics.channel_message_counts
                expected = sum(counts.get(id, 0) for id, channel in summary.channels.items() if channel.topic in names)
                if count != expected:
                    raise ValueError(f"{count} messages, expected {expected}")

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        """What damage leads to, in one exception: the libraries have many."""
        try:
            yield
        except Damaged:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> Damaged:
        name = type(error).__name__
        why = " ".join(f"{name}: {error}".split()) if str(error) else name
        if len(why) > 80:
            why = why[:77] + "..."
        return Damaged(
            f"{self.path}: a damaged recording, or one that is still being written: "
            f"`hardnessd recover {self.path} --out GOOD.mcap` saves what is whole. Found: {why}"
        )


def open(path: Union[str, "os.PathLike[str]"]) -> Recording:  # as gzip.open and others
    """Opens a recording. Raises Damaged (a ValueError) if it is not whole, and OSError or ValueError if
    the file cannot be opened or is none of hardnessd."""
    return Recording(path)


def _fields(topic: str) -> List[str]:
    return [key for key in {**_EVENTS[topic].__annotations__, "seq": int} if key != "type"]


def _value(key: str, message: Any) -> Any:
    """A field of the event, from the ROS message."""
    value = getattr(message, key)
    if isinstance(value, float) and math.isnan(value):
        return None
    if key in _NULL and value == _NULL[key]:
        return None
    if key == "context":
        return json.loads(value)
    if key == "object":
        low, high = message.object_shore_low, message.object_shore_high
        shore = {"value": message.object_shore, "low": low, "high": high}
        return {
            "name": value,
            "presses": message.object_presses,
            "level": message.object_level,
            "probabilities": list(message.object_probabilities),
            "shore": None if math.isnan(message.object_shore) else shore,
        }
    if key == "shore":
        return {"value": value, "low": message.shore_low, "high": message.shore_high}
    return list(value) if key in ("notes", "probabilities", "levels") else value


def _time_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
