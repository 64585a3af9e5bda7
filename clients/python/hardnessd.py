"""Events of hardnessd, the daemon that tells hard from soft.

This module is one file, needs only the standard library, and runs on Python 3.9 or later. Copy it
beside your program, or install it with `pip install ./clients/python`.

    import hardnessd

    client = hardnessd.Client()
    for event in client:
        if event["type"] == "hardness" and event["phase"] == "final":
            print(event["sensor"], hardnessd.answer(event, client.hello), event["confidence"])

`Client` connects when you iterate over it. When the connection breaks, it connects again and
continues where it stopped. It gives each numbered event once, as long as the daemon still holds the
event (the last 4,096). A `gap` event says how many events were lost. While there is no connection,
nothing is known of the sensor. The client then gives an event of its own:
{"type": "disconnected", "reason": ...}.

`AsyncClient` does the same for asyncio:

    async with hardnessd.AsyncClient() as client:
        async for event in client:
            ...

`Control` sends commands to the control socket:

    control = hardnessd.Control()
    control.tare("forearm")
    control.context("forearm", tag="pick-17")

An address is the path of a Unix socket, "HOST:PORT", or a pair (host, port). Without an address,
the module looks where the daemon puts its sockets by default.

As a program, the module prints events: python3 hardnessd.py --help
"""

from __future__ import annotations

import argparse
import asyncio
import datetime
import errno
import functools
import glob
import io
import json
import math
import os
import re
import socket
import sys
import tempfile
import threading
import time
from typing import (
    Any,
    AsyncIterator,
    Dict,
    Iterator,
    List,
    Literal,
    Optional,
    Sequence,
    Set,
    Tuple,
    TypedDict,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

__all__ = [
    "Address",
    "AsyncClient",
    "Client",
    "Connection",
    "Control",
    "Disconnected",
    "Event",
    "Frame",
    "Gap",
    "Hardness",
    "LineTooLong",
    "Offsets",
    "PROTOCOL",
    "Press",
    "ProtocolError",
    "Refused",
    "Shore",
    "Status",
    "TYPES",
    "Tare",
    "answer",
    "default_address",
]

PROTOCOL = 1
"""Version of the protocol that this module speaks."""

TYPES = ("hardness", "press", "status", "frame")
"""Types of events that you can subscribe to."""

LONGEST_LINE_BYTES = 1 << 20
"""No line of the daemon comes near this. What is longer does not come from hardnessd."""

CONFIDENT = 0.7
"""[`answer`][hardnessd.answer] marks a level with less confidence as weak."""

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0

HELLO_S = 5.0
"""How long connecting may take, and how long the first line and the answer to the subscription may
take together. The daemon answers within 50 ms, but a service manager may have to start it first."""

MOST_EARLY_LINES = 4096
"""As many events as the daemon holds. It never sends more lines before it answers a request."""

MOST_EARLY_BYTES = 16 << 20
"""Nor does it send more bytes: the last verdicts of 1,000 sensors are 2 MB."""

Address = Union[str, "os.PathLike[str]", Tuple[str, int]]
"""Path of a Unix socket, "HOST:PORT", or (host, port)."""

Message = Dict[str, Any]


class _Numbered(TypedDict, total=False):
    seq: int
    """Place in the daemon's run. Absent in the status that comes right after connecting."""


class Shore(TypedDict):
    """Shore hardness with its 90 % interval."""

    value: float
    low: float
    high: float


class ObjectVerdict(TypedDict):
    """The verdict over all presses so far of the object that the context names."""

    name: str
    presses: int
    level: int
    probabilities: List[float]
    shore: Optional[Shore]


class Hardness(_Numbered):
    """A verdict on a press."""

    type: Literal["hardness"]
    sensor: str
    time: str
    press: int
    phase: Literal["early", "final"]
    level: Optional[int]
    label: Optional[str]
    rejected: Optional[str]
    notes: List[str]
    probabilities: List[float]
    confidence: float
    frame: int
    contact_area_taxels: int
    contact_area_mm2: float
    force_n: float
    model: str
    state: Literal["connecting", "live", "stale", "lost"]
    context: Optional[Message]
    mono_ns: Optional[int]
    age_at_publish_ms: Optional[float]
    latency_us: Optional[int]
    shore: Optional[Shore]
    levels: Optional[List[int]]
    course: Optional[Literal["positions", "speed", "none"]]
    stiffness_n_per_mm: Optional[float]
    references: str
    advice: Optional[Literal["press_harder", "press_again"]]
    object: Optional[ObjectVerdict]


class Press(_Numbered):
    """A press began, ended or was aborted."""

    type: Literal["press"]
    sensor: str
    time: str
    press: int
    state: Literal["begin", "end", "aborted"]
    frame: int
    reason: Optional[str]
    frames: int
    context: Optional[Message]


class Status(_Numbered):
    """A sensor's link."""

    type: Literal["status"]
    sensor: str
    time: str
    state: Literal["connecting", "live", "stale", "lost"]
    reason: Optional[str]
    detail: Optional[str]
    frames: int
    frames_damaged: int
    frames_dropped: int
    bytes_skipped: int
    frame_rate_hz: Optional[float]


class Frame(TypedDict):
    """One frame: `rows` x `cols` newtons, row by row. Until the first tare is taken, `tared` is false and `force_n`
    None."""

    type: Literal["frame"]
    sensor: str
    time: str
    frame: int
    rows: int
    cols: int
    newtons: List[float]
    contact_area_taxels: int
    force_n: Optional[float]
    tared: bool
    approach_mm: Optional[float]


class Gap(TypedDict):
    """Events that you will not get. `lost` is None when their number is not known."""

    type: Literal["gap"]
    lost: Optional[int]


class Disconnected(TypedDict):
    """The client has no connection. It tries again, and gives this event for each failed try."""

    type: Literal["disconnected"]
    reason: str


Event = Union[Hardness, Press, Status, Frame, Gap, Disconnected]


_EVENTS = {"hardness": Hardness, "press": Press, "status": Status, "frame": Frame}
"""The events whose fields are checked."""


class Offsets(TypedDict):
    """The baseline of a sensor, over its live taxels."""

    mean_counts: float
    least_counts: float
    most_counts: float


class Tare(TypedDict):
    """What a tare changed."""

    sensor: str
    old: Offsets
    new: Offsets


class Refused(Exception):
    """The daemon answered a request with an `error`. The message is the daemon's."""


class ProtocolError(ConnectionError):
    """What answers there does not speak the protocol of hardnessd."""


class LineTooLong(ProtocolError):
    """A line is longer than any that hardnessd sends."""

    def __init__(self) -> None:
        super().__init__(
            f"a line is longer than {LONGEST_LINE_BYTES} bytes: this is not hardnessd"
        )


def default_address(name: str = "events.sock") -> str:
    """Finds a daemon's socket, in the places where `hardnessd tail` looks.

    These are $RUNTIME_DIRECTORY, $XDG_RUNTIME_DIR/hardnessd, /run/hardnessd, and a `hardnessd demo` of
    this user. Returns the first socket that answers. When none does, it returns the first that exists,
    and otherwise the first place.
    """
    service, user = os.environ.get("RUNTIME_DIRECTORY"), os.environ.get("XDG_RUNTIME_DIR")
    directories = [service.split(":")[0]] if service else []
    directories += [os.path.join(user, "hardnessd")] if user else []
    directories += ["/run/hardnessd"]
    # Anyone may make a directory among the temporary files: only the user's own are trusted.
    demos = [
        directory
        for parent in [user, tempfile.gettempdir()]
        for directory in glob.glob(os.path.join(glob.escape(parent or "/nowhere"), "hardnessd-demo-*"))
        if os.lstat(directory).st_uid == os.geteuid()
    ]
    paths = [os.path.join(directory, name) for directory in directories + demos]
    there = [path for path in paths if os.path.exists(path)]
    if len(there) > 1:
        there.sort(key=lambda path: not _answers(path))
    return (there or paths)[0]


def _answers(path: str) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except BlockingIOError:
            # Many are waiting to be served.
            return True
        except OSError:
            return False
    return True


def _destination(address: Address) -> Union[str, Tuple[str, int]]:
    """A path, or host and port."""
    if isinstance(address, tuple):
        return address
    text = os.fspath(address)
    host, _, port = text.rpartition(":")
    if isinstance(address, str) and host and "/" not in text and re.fullmatch("[0-9]+", port):
        if int(port) > 0xFFFF:
            raise ValueError(f"found port {port}, expected at most 65535")
        return host.strip("[]"), int(port)
    return text


def _parse(line: bytes) -> Message:
    try:
        message = json.loads(line.decode(), parse_constant=_no_number, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"a line is not JSON: {_short(line)}") from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ProtocolError(f"a line is not an object with a type: {_short(line)}")
    if not isinstance(message.get("seq", 0), int):
        raise ProtocolError(f"seq is not a whole number: {_short(line)}")
    kind = message["type"]
    for key, field in _fields(_EVENTS[kind]).items() if kind in _EVENTS else ():
        if key != "seq" and not (key in message and _fits(message[key], field)):
            raise ProtocolError(f"{key} of a {kind} is missing or of another type: {_short(line)}")
    if kind == "frame" and len(message["newtons"]) != message["rows"] * message["cols"]:
        raise ProtocolError(f"a frame has more or fewer newtons than taxels: {_short(line)}")
    return message


def _fits(value: object, field: Any) -> bool:
    """Whether a value of JSON is one of this field's type. A text may be one that a later version adds."""
    origin, parts = get_origin(field), get_args(field)
    if origin is Union:
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str)
    if origin is list:
        # Frames have many numbers.
        wanted = {int, float} if parts[0] is float else {parts[0]}
        return isinstance(value, list) and set(map(type, value)) <= wanted
    if origin is dict:
        return isinstance(value, dict)
    if isinstance(field, type) and issubclass(field, dict):
        fields = _fields(field)
        return isinstance(value, dict) and all(key in value and _fits(value[key], fields[key]) for key in fields)
    return type(value) in ((int, float) if field is float else (field,))


@functools.lru_cache(maxsize=None)
def _fields(event: Any) -> Dict[str, Any]:
    return get_type_hints(event)


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _no_number(text)


def _no_number(text: str) -> Any:
    raise ValueError(f"{text} is not a number of JSON")


def _short(line: bytes) -> str:
    text = repr(line[:60])[2:-1]
    return text + "..." if len(line) > 60 else text


def _shown(address: Address) -> str:
    return "{}:{}".format(*address) if isinstance(address, tuple) else os.fspath(address)


def _explained(error: OSError, address: Address) -> OSError:
    """The error of a failed connection, which the system says without the address."""
    if error.errno is not None:
        error.filename = _shown(address)
    if error.errno in (errno.ENOENT, errno.ECONNREFUSED):
        error.strerror = f"{os.strerror(error.errno)}: start `hardnessd run`, or name its socket"
    return error


def _silence(address: Address, seconds: float) -> str:
    """What to say where a connection is open, but no line came."""
    if isinstance(_destination(address), str):
        return f"no line within {seconds:g} s"
    return (
        f"no event within {seconds:g} s: events are at `listen` of [publish.tcp], port 8255 by default. "
        "Port 8256 is the web page"
    )


def _keep_alive(peer: Any) -> None:
    """Lets the system notice within a minute that the robot is gone: as the daemon does for its clients."""
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has these. Without them it takes two hours.
    for name, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            peer.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class Connection:
    """Lines to and from the daemon, as they are. `timeout_s` is the limit for each whole line."""

    def __init__(self, address: Address, timeout_s: Optional[float] = None) -> None:
        destination = _destination(address)
        patience_s = HELLO_S if timeout_s is None else timeout_s
        try:
            if isinstance(destination, str):
                self.socket = socket.socket(socket.AF_UNIX)
                self.socket.settimeout(patience_s)
                try:
                    self._connect(destination, time.monotonic() + patience_s)
                except OSError:
                    self.socket.close()
                    raise
            else:
                self.socket = socket.create_connection(destination, patience_s)
                _keep_alive(self.socket)
        except socket.timeout as error:
            why = f"no answer within {patience_s:g} s"
            raise TimeoutError(errno.ETIMEDOUT, why, _shown(address)) from error
        except OSError as error:
            raise _explained(error, address)
        self.socket.settimeout(timeout_s)
        self._timeout_s = timeout_s
        self._bytes = bytearray()

    def _connect(self, path: str, deadline: float) -> None:
        while True:
            try:
                return self.socket.connect(path)
            except BlockingIOError:
                # So many wait to be served that there is no room to wait.
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.01)

    def send(self, request: Message) -> None:
        """Sends one request."""
        self.socket.sendall(json.dumps(request).encode() + b"\n")

    def _until(self) -> Optional[float]:
        """When a wait that begins now ends."""
        return None if self._timeout_s is None else time.monotonic() + self._timeout_s

    def receive(self) -> Message:
        """Returns the next line's object.

        Raises ConnectionError when the connection is closed, ProtocolError (a ConnectionError) when
        the line is none of hardnessd, and TimeoutError when no whole line came in time.
        """
        return self._receive(self._until())

    def _receive(self, deadline: Optional[float]) -> Message:
        return _parse(self._line(deadline))

    def _line(self, deadline: Optional[float]) -> bytes:
        searched = 0
        while (end := self._bytes.find(b"\n", searched)) < 0:
            searched = len(self._bytes)
            if searched > LONGEST_LINE_BYTES:
                raise LineTooLong
            # A server that sends a byte now and then must not prolong the wait.
            left_s = None if deadline is None else deadline - time.monotonic()
            if left_s is not None and left_s <= 0:
                raise TimeoutError("no whole line in time")
            self.socket.settimeout(left_s)
            try:
                received = self.socket.recv(1 << 16)
            except socket.timeout as error:
                # Before Python 3.10, socket.timeout is not a TimeoutError.
                raise TimeoutError("no whole line in time") from error
            if not received:
                raise ConnectionError("the daemon closed the connection")
            self._bytes += received
        line = bytes(self._bytes[:end])
        del self._bytes[: end + 1]
        return line

    def close(self) -> None:
        """Closes the connection. A thread that waits in `receive` wakes with ConnectionError."""
        # `shutdown` wakes a reader on another thread. `close` alone does not.
        try:
            self.socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self.socket.close()


class _Follower:
    """What a subscriber remembers over its connections. It does no I/O."""

    def __init__(self, types: Union[str, Sequence[str]], policy: str, since: Optional[str]) -> None:
        self.types = [types] if isinstance(types, str) else list(types)
        self.policy = policy
        self.place = since
        self.hello: Optional[Message] = None
        # Numbers that came before the daemon took the subscription. The daemon does not send them
        # again on this connection, but it would on the next.
        self._early: Set[int] = set()
        self.subscribed = False

    def subscription(self, hello: Message) -> Message:
        """The answer to the first line of a connection."""
        if hello["type"] == "error":
            raise ConnectionError(hello.get("message", "the daemon refused the connection"))
        if hello["type"] != "hello":
            raise ProtocolError(f"the first line is {hello['type']!r}, expected 'hello'")
        if hello.get("protocol") != PROTOCOL:
            raise ProtocolError(f"protocol {hello.get('protocol')}, expected {PROTOCOL}")
        run, seq = hello.get("run"), hello.get("seq")
        if not isinstance(run, str) or not isinstance(seq, int):
            raise ProtocolError("hello has no run or no seq")
        self.hello, self._run, self.subscribed = hello, run, False
        request = {"subscribe": self.types, "policy": self.policy}
        if self.place is None:
            self.place = f"{run}:{seq}"
        else:
            request["since"] = self.place
            if not self.place.startswith(run + ":"):
                self._early.clear()
        return request

    def take(self, message: Message) -> Optional[Event]:
        """The event in a later line, if it has one that was asked for and is new."""
        kind, seq = message["type"], message.get("seq")
        if kind == "ok":
            self.subscribed = True
        elif kind == "error":
            raise Refused(message.get("message", "the daemon refused the subscription"))
        elif kind == "gap" or (kind in self.types and seq not in self._early):
            if seq is not None and self.subscribed:
                self.place = f"{self._run}:{seq}"
                self._early = {number for number in self._early if number > seq}
            elif seq is not None:
                self._early.add(seq)
                if len(self._early) > MOST_EARLY_LINES:
                    raise ProtocolError("too many events before the answer to the subscription")
            return cast(Event, _Line(message, self.hello))
        return None


class _Line(Message):
    """An event of a daemon, whose text is the line of `hardnessd tail`."""

    def __init__(self, event: Message, hello: Optional[Message]) -> None:
        super().__init__(event)
        self._hello = hello

    def __str__(self) -> str:
        return _readable(cast(Event, self), self._hello)


def _disconnected(address: Address, error: BaseException) -> Disconnected:
    why = getattr(error, "strerror", None) or str(error) or f"no answer within {HELLO_S:g} s"
    return {"type": "disconnected", "reason": f"{_shown(address)}: {why}"}


class _Subscriber:
    """What both clients are told, and say."""

    def __init__(
        self,
        address: Optional[Address] = None,
        types: Union[str, Sequence[str]] = ("hardness", "press", "status"),
        policy: str = "queue",
        since: Optional[str] = None,
    ) -> None:
        self.address = address
        self._follower = _Follower(types, policy, since)
        self._found: Address = ""

    def _find(self) -> Address:
        """Where to connect now: a daemon that was not there may be."""
        self._found = self.address or default_address()
        return self._found

    @property
    def place(self) -> Optional[str]:
        """RUN:SEQ of the last event, to continue from with `since`."""
        return self._follower.place

    @property
    def hello(self) -> Optional[Message]:
        """The first line of the latest connection: robot, sensors, model."""
        return self._follower.hello


class Client(_Subscriber):
    """An endless iterator over events.

    `types` is any of TYPES. With `policy` "queue" the daemon keeps up to 1,024 events for a slow
    client, with "latest" the newest of each type and sensor. `since` is a place RUN:SEQ to continue
    from, such as `place` of an earlier client. Raises Refused if the daemon refuses these.
    """

    def __init__(
        self,
        address: Optional[Address] = None,
        types: Union[str, Sequence[str]] = ("hardness", "press", "status"),
        policy: str = "queue",
        since: Optional[str] = None,
    ) -> None:
        super().__init__(address, types, policy, since)
        self.connection: Optional[Connection] = None
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Event]:
        pause_s = FIRST_PAUSE_S
        while not self._closed.is_set():
            try:
                for event in self._connected():
                    pause_s = FIRST_PAUSE_S
                    yield event
            except OSError as error:
                if self._closed.is_set():
                    return
                yield _disconnected(self._found, error)
            self._closed.wait(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def close(self) -> None:
        """Ends the iteration, also from another thread."""
        self._closed.set()
        if self.connection:
            self.connection.close()

    def _connected(self) -> Iterator[Event]:
        """Events of one connection. It ends with an exception, or when the client is closed."""
        connection = Connection(self._find(), HELLO_S)
        self.connection = connection
        try:
            # Another thread may have closed the client while there was no connection to close.
            if self._closed.is_set():
                return
            deadline = time.monotonic() + HELLO_S
            try:
                hello = connection._receive(deadline)
            except TimeoutError as error:
                raise TimeoutError(_silence(self._found, HELLO_S)) from error
            connection.send(self._follower.subscription(hello))
            while not self._closed.is_set():
                line = connection._receive(None if self._follower.subscribed else deadline)
                event = self._follower.take(line)
                if event is not None:
                    yield event
        finally:
            connection.close()


class AsyncClient(_Subscriber):
    """The same as `Client`, for asyncio: an endless asynchronous iterator over events.

    Cancelling a wait loses nothing: `asyncio.wait_for(client.__anext__(), 0.1)` may time out as often
    as you like. Use the client in one task at a time. Close it with `async with` or with `close`.
    """

    def __init__(
        self,
        address: Optional[Address] = None,
        types: Union[str, Sequence[str]] = ("hardness", "press", "status"),
        policy: str = "queue",
        since: Optional[str] = None,
    ) -> None:
        super().__init__(address, types, policy, since)
        self._streams: Optional[Tuple[asyncio.StreamReader, asyncio.StreamWriter]] = None
        self._opening: Optional[asyncio.Task[None]] = None
        self._deadline = 0.0
        self._pause_s = 0.0
        self._try_at = 0.0
        self._closed = False

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def __aiter__(self) -> AsyncIterator[Event]:
        return self

    async def __anext__(self) -> Event:
        while not self._closed:
            try:
                event = await self._step()
            except Refused:
                self._disconnect()
                raise
            except (OSError, asyncio.TimeoutError) as error:
                self._disconnect()
                if not self._closed:
                    return _disconnected(self._found, error)
            else:
                if event is not None:
                    self._pause_s = 0.0
                    return event
        raise StopAsyncIteration

    def close(self) -> None:
        """Ends the iteration, also that of another task."""
        self._closed = True
        if self._opening:
            self._opening.cancel()
        self._disconnect()

    async def _step(self) -> Optional[Event]:
        """Connects, or reads a line. When it is cancelled, the next call continues where it was."""
        if self._streams:
            receiving = self._receive(self._streams[0])
            if not self._follower.subscribed:
                receiving = asyncio.wait_for(receiving, self._deadline - time.monotonic())
            return self._follower.take(await receiving)
        if self._opening is None:
            self._opening = asyncio.ensure_future(self._open())
            # A failure that nobody waits for is no news.
            self._opening.add_done_callback(lambda task: task.cancelled() or task.exception())
        opening = self._opening
        # Cancelling `wait` does not cancel what it waits for.
        await asyncio.wait([opening])
        self._opening = None
        if not opening.cancelled():
            opening.result()
        return None

    async def _open(self) -> None:
        """Connects and subscribes, once the pause since the last connection is over."""
        await asyncio.sleep(max(0.0, self._try_at - time.monotonic()))
        destination = _destination(self._find())
        connecting = (
            asyncio.open_unix_connection(destination, limit=LONGEST_LINE_BYTES)
            if isinstance(destination, str)
            else asyncio.open_connection(*destination, limit=LONGEST_LINE_BYTES)
        )
        try:
            reader, writer = await asyncio.wait_for(connecting, HELLO_S)
        except OSError as error:
            raise _explained(error, self._found)
        self._deadline = time.monotonic() + HELLO_S
        try:
            if not isinstance(destination, str):
                _keep_alive(writer.get_extra_info("socket"))
            try:
                hello = await asyncio.wait_for(self._receive(reader), HELLO_S)
            except asyncio.TimeoutError as error:
                raise TimeoutError(_silence(self._found, HELLO_S)) from error
            writer.write(json.dumps(self._follower.subscription(hello)).encode() + b"\n")
        except BaseException:
            writer.close()
            raise
        self._streams = reader, writer
        if self._closed:
            self._disconnect()

    async def _receive(self, reader: asyncio.StreamReader) -> Message:
        try:
            return _parse((await reader.readuntil(b"\n"))[:-1])
        except asyncio.LimitOverrunError:
            raise LineTooLong from None
        except asyncio.IncompleteReadError:
            raise ConnectionError("the daemon closed the connection") from None

    def _disconnect(self) -> None:
        if self._streams:
            self._streams[1].close()
            self._streams = None
        self._pause_s = min(max(2 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
        self._try_at = time.monotonic() + self._pause_s


class Control:
    """Commands to the daemon's control socket, one at a time.

    Each raises Refused with the daemon's message if the daemon refuses it, and OSError when there is
    no connection or no answer within `timeout_s`.
    """

    def __init__(self, address: Optional[Address] = None, timeout_s: float = 30.0) -> None:
        self._requests = 0
        self.connection = Connection(address or default_address("control.sock"), timeout_s)
        try:
            self.request({"subscribe": []})
        except BaseException:
            self.connection.close()
            raise

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def tare(self, sensor: str) -> Tare:
        """Takes another tare. Returns the offsets before and after."""
        return cast(Tare, self._answer({"tare": sensor}, "tare"))

    def context(self, sensor: str, **fields: Any) -> None:
        """Says what is being done with the sensor. Its presses and verdicts then carry it.

        Without fields, they carry nothing any more.
        """
        self.request({"context": {"sensor": sensor, **fields}})

    def motion(self, sensor: str, at: Sequence[Tuple[Union[int, str], float]]) -> None:
        """Says where the arm is: pairs of a moment and a position in mm, growing towards the object.

        A moment is `time.monotonic_ns()` on the daemon's machine, or an RFC 3339 time. At most 256
        pairs, in order.
        """
        self.request({"motion": {"sensor": sensor, "at": [list(point) for point in at]}})

    def blackbox(self, sensor: str) -> str:
        """Has the daemon write the sensor's last minute to a recording. Returns the file's path."""
        return cast(str, self._answer({"blackbox": sensor}, "blackbox"))

    def last(self) -> List[Hardness]:
        """Returns each sensor's last final verdict."""
        return cast("List[Hardness]", self.request({"get": "last"})[1])

    def status(self) -> List[Status]:
        """Returns each sensor's status now."""
        return cast("List[Status]", self.request({"get": "status"})[1])

    def _answer(self, request: Message, field: str) -> Any:
        answer = self.request(request)[0]
        if field not in answer:
            raise ProtocolError(f"the answer lacks {field!r}")
        return answer[field]

    def request(self, request: Message) -> Tuple[Message, List[Message]]:
        """Sends any request of the protocol. Returns its `ok`, and the lines sent before it."""
        self._requests += 1
        deadline = self.connection._until()
        self.connection.send({**request, "id": self._requests})
        lines: List[Message] = []
        early_bytes = 0
        while True:
            text = self.connection._line(deadline)
            line = _parse(text)
            if line["type"] not in ("ok", "error"):
                lines.append(line)
                early_bytes += len(text)
                if len(lines) > MOST_EARLY_LINES or early_bytes > MOST_EARLY_BYTES:
                    raise ProtocolError("too many lines before the answer to a request")
            elif "id" not in line:
                # The daemon has no room for this connection.
                raise ConnectionError(line.get("message", "the daemon refused the connection"))
            elif line["id"] != self._requests:
                # The late answer to a request that was given up.
                lines.clear()
                early_bytes = 0
            elif line["type"] == "error":
                raise Refused(line.get("message", "no reason given"))
            else:
                return line, lines

    def close(self) -> None:
        """Closes the connection."""
        self.connection.close()


def answer(event: Hardness, hello: Optional[Message] = None) -> str:
    """What a verdict says: its level, such as "firm", or "firm?" if its confidence is below 0.7 or it has
    the note `outside_training`. For a rejected verdict: the levels that it lies between, such as
    "firm or soft". Their labels are in the client's `hello`."""
    levels = hello["model"]["levels"] if hello else []

    def named(level: int) -> str:
        return levels[level - 1]["label"] if level <= len(levels) else f"level {level}"

    if event["level"] is not None:
        weak = event["confidence"] < CONFIDENT or "outside_training" in event["notes"]
        return (event["label"] or named(event["level"])) + ("?" if weak else "")
    if event["rejected"] == "low_force":
        return "low force"
    between = event["levels"] or []
    if len(between) < 2:
        shares = event["probabilities"]
        likely = sorted(range(len(shares)), key=lambda index: -shares[index])
        between = sorted(index + 1 for index in likely[:2])
    if len(between) < 2:
        return "".join(f"{named(level)}?" for level in between) or "no level"
    return f"{named(between[0])} {'or' if len(between) == 2 else 'to'} {named(between[-1])}"


def _readable(event: Event, hello: Optional[Message]) -> str:
    """An event as one line of text, the same as that of `hardnessd tail`."""
    if event["type"] == "disconnected":
        return f"-- disconnected: {event['reason']} --"
    if event["type"] == "gap":
        lost = "an unknown number of" if event["lost"] is None else event["lost"]
        return f"-- gap: {lost} events lost --"
    if event["type"] == "hardness":
        clock, text = _published(event), _verdict(event, hello)
    elif event["type"] == "press":
        clock = event["time"][11:23]
        text = f"#{event['press']:<4} {event['state']:<8}  frame {event['frame']}"
        text += "" if event["state"] == "begin" else f", {event['frames']} in contact"
        text += _reason(event["reason"]) + _context(event["context"])
    elif event["type"] == "status":
        clock = event["time"][11:23]
        text = f"{event['state']:<10}  {event['frames']} frames, {event['frames_damaged']} damaged"
        text += f", {event['frames_dropped']} dropped" if event["frames_dropped"] else ""
        text += "" if event["frame_rate_hz"] is None else f", {event['frame_rate_hz']:.1f} frames/s"
        reason, detail = event["reason"], event["detail"]
        text += _reason(f"{reason}: {detail}" if detail else reason)
    else:
        clock, force_n = event["time"][11:23], event["force_n"]
        text = f"#{event['frame']:<13}  "
        text += "no zero yet" if force_n is None else f"{force_n:>6.2f} N, highest taxel {max(0, *event['newtons']):.2f} N"
    return f"{clock}  {event['sensor']:<12}  {event['type']:<8}  {text}".rstrip()


def _published(event: Hardness) -> str:
    """The time of day of publication. `time` is that of the chosen frame, and lines are in the order
    in which events are published."""
    if event["age_at_publish_ms"] is None:
        return event["time"][11:23]
    published = datetime.datetime.fromisoformat(event["time"].replace("Z", "+00:00"))
    published += datetime.timedelta(milliseconds=event["age_at_publish_ms"])
    return f"{published:%H:%M:%S.%f}"[:12]


def _verdict(event: Hardness, hello: Optional[Message]) -> str:
    probabilities = " ".join(f"{100 * p:.0f}" for p in event["probabilities"])
    text = f"#{event['press']:<4} {event['phase']:<8}  {_with_shore(event, hello):<32} {100 * event['confidence']:>3.0f} %"
    text += f" [{probabilities}]  {event['contact_area_taxels']:>3} taxels  {event['force_n']:>6.2f} N"
    # An older daemon sends no advice.
    advice = event.get("advice")
    if advice is not None:
        text += f"  {advice.replace('_', ' ')}"
    of_object = event.get("object")
    if of_object is not None and of_object["presses"] > 1:
        most = max(of_object["probabilities"])
        text += f"  {of_object['name']}: {of_object['level']} by {of_object['presses']} presses, {100 * most:.0f} %"
    if event["age_at_publish_ms"] is not None:
        text += f"  frame {event['frame']} at {event['time'][11:23]}"
    return text + _reason(", ".join(event["notes"])) + _context(event["context"])


def _with_shore(event: Hardness, hello: Optional[Message]) -> str:
    """The answer with the Shore hardness first, and the limits or the bounds of its interval of 90 %."""
    # An older daemon sends no Shore hardness.
    shore = event.get("shore")
    if shore is None:
        return answer(event, hello)
    value, low, high = shore["value"], shore["low"], shore["high"]
    below, above = value - low, high - value
    most = max(below, above)
    # Outside the middle half of the interval, one number for both sides would hide that one side is short. The scale
    # ends at 0 and 100.
    if most <= min(value, 100 - value) and min(below, above) >= (high - low) / 4:
        return f"{value:.0f} +- {most:.0f} OO, {answer(event, hello)}"
    return f"{value:.0f} OO ({low:.0f} to {high:.0f}), {answer(event, hello)}"


def _reason(text: Optional[str]) -> str:
    return f"  ({text})" if text else ""


def _context(context: Optional[Message]) -> str:
    if context is None:
        return ""
    return "  " + json.dumps(context, ensure_ascii=False, separators=(",", ":"))


def _types(text: str) -> List[str]:
    types = text.split(",")
    for found in types:
        if found not in TYPES:
            raise argparse.ArgumentTypeError(f"found {found!r}, expected {', '.join(TYPES)}")
    return types


def _count(text: str) -> int:
    if not re.fullmatch("[0-9]+", text) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number above 0")
    return int(text)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= threading.TIMEOUT_MAX:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of seconds above 0")
    return seconds


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python3 -m hardnessd",
        description="Print events of a running hardnessd, one a line. It connects again when the "
        "connection breaks, and continues where it stopped.",
        epilog="Exit codes: 0 done, 1 timeout or refused by the daemon, 2 wrong usage, 74 stdout fails, "
        "130 Ctrl-C.",
    )
    parser.add_argument(
        "address", nargs="?", help="path of a Unix socket, or HOST:PORT [default: the daemon's socket]"
    )
    parser.add_argument("--json", action="store_true", help="print the events as JSON")
    parser.add_argument(
        "--types",
        type=_types,
        default=["hardness", "press", "status"],
        metavar="T,...",
        help="types of events: hardness, press, status, frame [default: hardness,press,status]",
    )
    parser.add_argument("--since", metavar="RUN:SEQ", help="continue after this event")
    parser.add_argument("--count", type=_count, metavar="N", help="end after N events")
    parser.add_argument(
        "--timeout", type=_seconds, metavar="S", help="give up after S seconds, with exit code 1"
    )
    return parser


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The program. Returns its exit code."""
    args = _arguments().parse_args(arguments)
    client = Client(args.address, args.types, since=args.since)
    over = threading.Timer(args.timeout or 0, client.close)
    over.daemon = True
    count = 0
    reason: Optional[str] = None
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A label may have letters that this terminal lacks.
        sys.stdout.reconfigure(errors="replace")
    try:
        if args.timeout:
            over.start()
        for event in client:
            if event["type"] != "disconnected":
                reason = None
            elif event["reason"] == reason:
                # The client gives this event for each failed try. One line says it.
                continue
            else:
                reason = event["reason"]
            try:
                text = json.dumps(event) if args.json else _readable(event, client.hello)
            except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
                # No event of hardnessd.
                text = json.dumps(event)
            # A reason comes from the system, a label from a model file. Neither may move the cursor.
            print("".join(c for c in text if c.isprintable()), flush=True)
            count += event["type"] in args.types
            if count == args.count:
                return 0
        wanted = f" of {args.count}" if args.count else ""
        said = f"timed out after {args.timeout:g} s ({count}{wanted} events)"
        if client.hello is None and client.connection and reason is None:
            said = f"{_shown(client._found)}: {_silence(client._found, args.timeout)}\n{said}"
        print(said, file=sys.stderr)
        return 1
    except Refused as error:
        print("the daemon refused: " + "".join(c for c in str(error) if c.isprintable()), file=sys.stderr)
        return 1
    except (ValueError, OverflowError) as error:
        print(f"{args.address}: no address: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Nobody reads any more, as with `head`. Nothing is left to be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except OSError as error:
        # Connections that fail are events, so this is about stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        print(f"stdout: {error.strerror}", file=sys.stderr)
        return 74


if __name__ == "__main__":
    sys.exit(main())
