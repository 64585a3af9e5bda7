#!/usr/bin/env python3
"""The Python client against servers that are not hardnessd.

    python3 -m venv venv && venv/bin/pip install ./clients/python
    venv/bin/python tests/peers/hostile.py

Claims, for Client and AsyncClient alike: whatever a server sends, the client says in one `disconnected`
event what is wrong with it, and tries again. It never holds much more than the longest line, and a time limit
holds for a whole answer. Control and Connection raise an exception with the same words.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time

import hardnessd

HELLO = {"type": "hello", "protocol": 1, "server": "hardnessd", "run": "ab", "seq": 7}
STATUS = {
    **{"type": "status", "sensor": "a", "time": "2026-11-21T10:00:00.000000Z", "state": "live"},
    **dict.fromkeys(("reason", "detail", "frame_rate_hz")),
    **dict.fromkeys(("frames", "frames_damaged", "frames_dropped", "bytes_skipped"), 5),
}


def line(message):
    return json.dumps(message).encode() + b"\n"


class Server:
    """Sends the same to each connection, and then `endless`, a byte each `slowly` seconds or all that the other end
    takes. Counts the bytes that one took, and the connections. With `stays` none is closed."""

    def __init__(self, sent, endless=b"", stays=False, slowly=0.0):
        self.directory = tempfile.TemporaryDirectory()
        self.path = os.path.join(self.directory.name, "events.sock")
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(self.path)
        self.listener.listen()
        self.sent, self.stays, self.slowly = sent, stays, slowly
        self.parts = [endless[at : at + 1] for at in range(len(endless))] if slowly else [endless]
        self.connections, self.most_bytes, self.open = 0, 0, []
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            self.connections += 1
            self.open = [*self.open, connection] if self.stays else [connection]
            taken = 0
            try:
                connection.sendall(self.sent)
                while self.parts[0] and taken < (1000 if self.slowly else 50_000_000):
                    for part in self.parts:
                        taken += connection.send(part)
                        time.sleep(self.slowly)
                if not self.stays:
                    connection.shutdown(socket.SHUT_WR)
                    connection.recv(4096)
            except OSError:
                pass
            self.most_bytes = max(self.most_bytes, taken)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.listener.close()
        self.directory.cleanup()


def by_client(path, count):
    client = hardnessd.Client(path)
    found = []
    for event in client:
        found.append(event)
        if len(found) == count:
            client.close()
    return found


def by_async_client(path, count):
    async def follow():
        async with hardnessd.AsyncClient(path) as client:
            return [await client.__anext__() for _ in range(count)]

    return asyncio.run(follow())


def check(sent, said, before=0, **more):
    """After `before` events, the client says why it gave up, and does so twice."""
    with Server(sent, **more) as server:
        for follow in (by_client, by_async_client):
            server.connections = server.most_bytes = 0
            found = follow(server.path, 2 * (before + 1))
            gone = [event for event in found if event["type"] == "disconnected"]
            assert len(gone) == 2 and len(found) == 2 * before + 2, found
            assert all(said in event["reason"] for event in gone), (said, gone)
            assert server.connections >= 2, server.connections
            # What lies in the buffers of the system and of asyncio comes on top.
            assert server.most_bytes < 4 * hardnessd.LONGEST_LINE_BYTES, server.most_bytes


def by_control(sent, raised, said, timeout_s=0.5, **more):
    with Server(sent, **more) as server:
        try:
            hardnessd.Control(server.path, timeout_s)
        except raised as error:
            assert said in str(error), error
        else:
            raise AssertionError(f"{said!r} is not raised")


def main():
    hello = line(HELLO)
    endless = b"x" * (1 << 16)
    check(b"", "a line is longer than 1048576 bytes: this is not hardnessd", endless=endless)
    check(hello + line(STATUS), "a line is longer than 1048576 bytes", before=1, endless=endless)
    check(hello, "a line is not JSON: HTTP/1.1 400 Bad Request\\r", endless=b"HTTP/1.1 400 Bad Request\r\n")
    check(b"\xff\xfe\x00\n", "a line is not JSON: \\xff\\xfe\\x00")
    check(hello + b"[" * 500_000 + b"\n", "a line is not JSON: [[[")
    check(hello + b'{"type":"status","x":NaN}\n', "a line is not JSON")
    check(hello + b"5\n", "a line is not an object with a type: 5")
    check(hello + b'{"type":["status"]}\n', "a line is not an object with a type")
    check(hello + b'{"type":"press","seq":"8"}\n', "seq is not a whole number")
    bare = {key: value for key, value in STATUS.items() if key != "reason"}
    check(hello + line(bare), "reason of a status is missing or of another type")
    check(hello + line({**STATUS, "frames": "5"}), "frames of a status is missing or of another type")
    check(hello + line(STATUS).replace(b'"frame_rate_hz": null', b'"frame_rate_hz": 1e999'), "a line is not JSON")
    frame = {"type": "frame", "sensor": "a", "time": STATUS["time"], "frame": 1, "rows": 2, "cols": 2, "tared": True}
    frame.update(newtons=[0, 0.5, 1], contact_area_taxels=0, force_n=None, approach_mm=None)
    check(hello + line(frame), "a frame has more or fewer newtons than taxels")
    check(hello + line({**frame, "newtons": [0, None, 1, 2]}), "newtons of a frame is missing or of another type")
    check(line(STATUS), "the first line is 'status', expected 'hello'")
    check(line({**HELLO, "protocol": 2}), "protocol 2, expected 1")
    check(line({"type": "hello", "protocol": 1}), "hello has no run or no seq")
    check(line({"type": "error", "message": "full"}), "full")
    check(hello[:-5], "the daemon closed the connection")
    check(hello + line({"type": "hail"}) + line(STATUS)[:-1], "the daemon closed the connection")
    # Events without end in place of an answer to the subscription.
    early = b"".join(line({**STATUS, "seq": seq}) for seq in range(5000))
    with Server(hello + early, stays=True) as server:
        for follow in (by_client, by_async_client):
            last = follow(server.path, hardnessd.MOST_EARLY_LINES + 1)[-1]
            assert "too many events before the answer" in last.get("reason", ""), last
    hardnessd.HELLO_S = 0.3
    check(b"", "no ", stays=True)
    check(hello[:-5], "no ", stays=True)
    # A byte, or a line of no use, comes before each wait is over.
    check(b"", "no ", endless=b"x", slowly=0.05)
    check(hello, "no ", endless=line({"type": "hail"}), slowly=0.005)

    by_control(b"", hardnessd.LineTooLong, "longer than", timeout_s=30, endless=endless)
    by_control(hello, TimeoutError, "in time", endless=b"x", slowly=0.05)
    by_control(hello, hardnessd.ProtocolError, "too many lines", timeout_s=30, endless=line({"type": "hail"}))
    # Fewer lines than the daemon may send, but more bytes.
    long = line({"type": "hail", "of": "z" * 1_000_000})
    by_control(hello, hardnessd.ProtocolError, "too many lines", timeout_s=30, endless=long)
    by_control(hello + b"5\n", hardnessd.ProtocolError, "not an object with a type")
    by_control(b"", ConnectionError, "the daemon closed the connection")
    by_control(hello, TimeoutError, "in time", stays=True)
    by_control(line({"type": "error", "message": "full"}), ConnectionError, "full")
    for address in [("127.0.0.1", 1), "127.0.0.1:1", "[::1]:1", "/nowhere/events.sock", "x" * 200]:
        for follow in (by_client, by_async_client):
            assert [event["type"] for event in follow(address, 2)] == ["disconnected"] * 2, address
    with Server(hello + line(STATUS), stays=True) as server:
        command = [sys.executable, "-m", "hardnessd", server.path, "--json", "--count", "1"]
        shown = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert shown.returncode == 0 and json.loads(shown.stdout) == STATUS, shown
    print("servers that are not hardnessd: each is named, none harms")


if __name__ == "__main__":
    main()
