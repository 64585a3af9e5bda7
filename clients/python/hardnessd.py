"""Events of hardnessd, the daemon that tells hard from soft.

One file, standard library only, Python 3.9 or later: copy it beside your program.

    import hardnessd

    for event in hardnessd.Client("/run/hardnessd/events.sock"):
        if event["type"] == "hardness" and event["phase"] == "final":
            print(event["sensor"], event["label"], event["confidence"])

The client connects when it is iterated, and again when the connection breaks, where it stopped: no
numbered event is missed or given twice as long as the daemon holds it (the last 4,096). What was
missed is said by a `gap`. While the connection is down nothing is known of the sensor; the client
says so with an event of its own, {"type": "disconnected", "reason": ...}.

    control = hardnessd.Control("/run/hardnessd/control.sock")
    control.tare("forearm")
    control.context("forearm", tag="pick-17")

As a program it prints events as JSON lines: python3 hardnessd.py [ADDRESS] [TYPE ...]
"""

import json
import os
import socket
import sys
import time

PROTOCOL = 1
FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0


class Refused(Exception):
    """The daemon answered a request with an `error`."""


def default_address(name="events.sock"):
    """Where the daemon's sockets are by default."""
    directory = os.environ.get("XDG_RUNTIME_DIR") or "/run"
    candidates = [os.path.join("/run/hardnessd", name), os.path.join(directory, "hardnessd", name)]
    return next((path for path in candidates if os.path.exists(path)), candidates[0])


class Connection:
    """Lines to and from the daemon. `address`: a socket's path, or (host, port)."""

    def __init__(self, address, timeout_s=None):
        if isinstance(address, (str, os.PathLike)):
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.settimeout(timeout_s)
            try:
                self.socket.connect(os.fspath(address))
            except OSError:
                self.socket.close()
                raise
        else:
            self.socket = socket.create_connection(address, timeout_s)
            self.socket.settimeout(timeout_s)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.lines = self.socket.makefile("rb")

    def send(self, request):
        self.socket.sendall(json.dumps(request).encode() + b"\n")

    def receive(self):
        """The next line's object.

        Raises ConnectionError when the connection is at its end, TimeoutError when none came.
        """
        line = self.lines.readline()
        if not line.endswith(b"\n"):
            raise ConnectionError("the daemon closed the connection")
        return json.loads(line)

    def close(self):
        # `shutdown` wakes a reader on another thread, which `close` alone does not.
        try:
            self.socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self.lines.close()
        self.socket.close()


class Client:
    """An endless iterator over events.

    `types`: any of "hardness", "press", "status", "frame". `policy`: "queue" keeps every event up to
    1,024, "latest" the newest of each type and sensor. `since`: a RUN:SEQ to go on from, such as
    `place` of an earlier client.
    """

    def __init__(
        self,
        address=None,
        types=("hardness", "press", "status"),
        policy="queue",
        since=None,
    ):
        self.address = address or default_address()
        self.types = list(types)
        self.policy = policy
        self.place = since
        self.hello = None
        self.connection = None
        # Numbers given before the daemon took the subscription: it does not send them again on the
        # same connection, but would on the next.
        self.early = set()
        self.closed = False

    def __iter__(self):
        pause_s = FIRST_PAUSE_S
        while not self.closed:
            try:
                for event in self._connected():
                    pause_s = FIRST_PAUSE_S
                    yield event
            except (OSError, ValueError) as error:
                if self.closed:
                    return
                yield {"type": "disconnected", "reason": str(error)}
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def close(self):
        """Ends the iteration, also from another thread."""
        self.closed = True
        if self.connection:
            self.connection.close()

    def _connected(self):
        """Events of one connection; it ends by an exception, or because the client is closed."""
        self.connection = Connection(self.address)
        try:
            if self.closed:
                # By another thread, which had no connection to close yet.
                return
            self.hello = self.connection.receive()
            if self.hello.get("type") != "hello":
                raise ConnectionError(self.hello.get("message", "no hardnessd answers there"))
            if self.hello["protocol"] != PROTOCOL:
                raise ConnectionError(f"protocol {self.hello['protocol']}, expected {PROTOCOL}")
            run = self.hello["run"]
            subscription = {"subscribe": self.types, "policy": self.policy}
            if self.place is not None:
                subscription["since"] = self.place
                if not self.place.startswith(run + ":"):
                    self.early.clear()
            else:
                self.place = f"{run}:{self.hello['seq']}"
            self.connection.send(subscription)
            subscribed = False
            while not self.closed:
                event = self.connection.receive()
                kind, seq = event.get("type"), event.get("seq")
                if kind == "ok":
                    subscribed = True
                elif kind == "error":
                    raise Refused(event["message"])
                elif kind == "gap":
                    yield event
                elif kind not in self.types or seq in self.early:
                    # Unwanted, unknown, or had before.
                    continue
                else:
                    if seq is not None and subscribed:
                        self.place = f"{run}:{seq}"
                        self.early = {number for number in self.early if number > seq}
                    elif seq is not None:
                        self.early.add(seq)
                    yield event
        finally:
            self.connection.close()


class Control:
    """Commands, one at a time. Raises Refused with the daemon's message, OSError without one."""

    def __init__(self, address=None, timeout_s=30.0):
        self.connection = Connection(address or default_address("control.sock"), timeout_s)
        self.connection.send({"subscribe": []})
        self._answer()

    def tare(self, sensor):
        """Takes another tare; returns the offsets before and after."""
        return self._ask({"tare": sensor})[0]["tare"]

    def context(self, sensor, **fields):
        """What is being done with the sensor: echoed in its presses and verdicts. Without fields:
        nothing any more."""
        self._ask({"context": {"sensor": sensor, **fields}})

    def last(self):
        """Every sensor's last final verdict."""
        return self._ask({"get": "last"})[1]

    def status(self):
        """Every sensor's status now."""
        return self._ask({"get": "status"})[1]

    def close(self):
        """Closes the connection."""
        self.connection.close()

    def _ask(self, request):
        self.connection.send(request)
        return self._answer()

    def _answer(self):
        events = []
        while True:
            line = self.connection.receive()
            if line["type"] == "ok":
                return line, events
            if line["type"] == "error":
                raise Refused(line["message"])
            if line["type"] != "hello":
                events.append(line)


def main(arguments):
    address = arguments[0] if arguments else None
    for event in Client(address, **({"types": arguments[1:]} if arguments[1:] else {})):
        print(json.dumps(event), flush=True)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (BrokenPipeError, KeyboardInterrupt):
        # Nobody reads any more; nothing is left to be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
