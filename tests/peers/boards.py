#!/usr/bin/env python3
"""Every board of docs/boards.md, emulated over a network, with the configuration that the page gives.

    venv/bin/python tests/peers/boards.py target/debug/hardnessd

Claims: the daemon reads the counts that each emulator sends, at their places; it sends what the board waits for; and the
areas of a hand are all read at one port.
"""

import contextlib
import os
import pty
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import tomllib
import tty

from bench import Bench, free_port, wait_for

PAGE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../docs/boards.md")


def crc16_modbus(data):
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


def with_crc(data):
    return data + crc16_modbus(data)


def with_lrc(data):
    return data + bytes([-sum(data) & 0xFF])


def counts(cells):
    return [(7 * place + 3) % 97 for place in range(cells)]


def three_axes(cells):
    """Fx and Fy with a sign, and Fz."""
    return b"".join(struct.pack("bbB", -5, 9, count) for count in counts(cells))


def slip(data):
    return b"\xc0" + data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def xhand():
    planes = struct.pack("<240H", *[999] * 240) + struct.pack("<120H", *counts(120))
    rest = b"\x01\x02\x03" + planes + b"\x11\x22"
    return b"\x55\xaa" + rest + bytes([sum(rest) & 0xFF])


def linkerhand():
    registers = [4242] * 10 + counts(72) + [17] * 14
    return with_crc(bytes.fromhex("2704C0") + struct.pack(">96H", *registers))


def anyskin():
    chips = b"".join(struct.pack("<4f", 23.5, -1.0, 2.0, count - 1.25) for count in counts(5))
    return chips + b"\r\n"


def text(title, cells):
    rows = [" ".join(map(str, cells[at : at + 6])) for at in range(0, len(cells), 6)]
    return "\n".join([title, *rows]) + "\n"


TWO = text("Sensor 1", counts(24)) + text("Sensor 2", [count + 1 for count in counts(24)]) + "END\n"
SLIPPED = [*range(256)]
PAXINI = b"\xaa\x55\xd7\x02\x01\x00\xfb\x0e\x04\x00\x00\xcd\x02"

# The bytes of a frame, what the board waits for before each (or once, before the first), and the counts of each sensor.
BOARDS = {
    "dfrobot": (
        with_crc(b"\x01\x04\x40" + struct.pack(">32H", *counts(32))),
        bytes.fromhex("0104000700204013"),
        [counts(32)],
    ),
    "xhand": (xhand(), None, [counts(120)]),
    "paxini": (
        with_lrc(PAXINI + b"\x00" + three_axes(239)),
        with_lrc(bytes.fromhex("55AA09000100FB0E040000CD02")),
        [counts(238)],
    ),
    "paxini_push": (
        with_lrc(b"\xaa\x56\x00\xd4\x02\x00" + b"\xe2\xff\x0c\x00\x6e\x00" + three_axes(239)),
        "once 55AA00101700010001D8",
        [counts(238)],
    ),
    "anyskin": (anyskin(), None, [[count - 1.25 for count in counts(5)]]),
    "linkerhand": (linkerhand(), with_crc(bytes.fromhex("270400480060")), [counts(72)]),
    "fulai": (struct.pack("<415f", *[1.0] * 10, *counts(40), *[2.0] * 365) + b"\x00\x00\x80\x7f", None, [counts(40)]),
    "synria": (
        with_crc(b"\x01\x42\x78\x00" + struct.pack("<60H", *counts(60))),
        with_crc(b"\x01\x42"),
        [counts(60)],
    ),
    "etextile": (slip(b"/r\0\0,b\0\0\0\0\1\0" + bytes(SLIPPED)), slip(b"/r\0\0,\0\0\0"), [SLIPPED]),
    "fsr_array": (struct.pack("<2I256H", 7, 9, *counts(256)), b"\x10", [counts(256)]),
    "twelve": (b"\xa5\x5a" + struct.pack("<64H", *[0xF000 | count for count in counts(64)]), None, [counts(64)]),
    "left": (TWO.encode(), None, [counts(24), [count + 1 for count in counts(24)]]),
    "round": (b"\xaa\x55" + bytes(counts(16)), None, [None]),
    "flexitac": (b"\xaa\x55" + bytes(counts(512)), None, [counts(512)]),
    "m1616": (b"\xaa\xab\xac" + struct.pack(">256H", *counts(256)) + b"\1\2\3\4", None, [counts(256)]),
    "jq_glove": (
        b"\xaa\x55\x03\x99\x01\x07" + bytes(counts(256)[:128]) + b"\xaa\x55\x03\x99\x02\x07" + bytes(counts(256)[128:])
        + bytes(16),
        None,
        [counts(256)],
    ),
}


def serve(board):
    """A board at an address of this machine. What waits for bytes sends its frame whenever it has read them, or from
    then on if it waits once. The others send at their rate."""
    frame, asked, rate = board
    is_once = isinstance(asked, str)
    wanted = bytes.fromhex(asked.split()[1]) if is_once else asked

    def talk(connection):
        heard = b""
        while True:
            while wanted and wanted not in heard:
                if not (more := connection.recv(4096)):
                    return
                heard += more
            heard = b"" if not is_once else heard
            connection.sendall(frame)
            if is_once or not wanted:
                time.sleep(1 / rate)

    return listening(talk)


def listening(talk):
    """A server that talks to each connection until it ends, and its address as a port of the daemon."""

    def accept():
        while True:
            connection, _ = listener.accept()
            threading.Thread(target=talk_until_its_end, args=(connection,), daemon=True).start()

    def talk_until_its_end(connection):
        with contextlib.suppress(ConnectionError):
            talk(connection)

    listener = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=accept, daemon=True).start()
    return f"tcp://127.0.0.1:{listener.getsockname()[1]}"


def hand(connection):
    """Answers Modbus TCP. A register holds its own number, modulo 97, and a high bit that is no count."""
    stream = connection.makefile("rb")
    while len(request := stream.read(12)) == 12:
        number, first, cells = struct.unpack(">H6xHH", request)
        head = struct.pack(">HHHBBB", number, 0, 3 + 2 * cells, 1, 3, 2 * cells)
        connection.sendall(head + struct.pack(">H", 0x8000 | first % 97) * cells)


def modules(connection):
    """Three Paxini modules on one line, of which the third says nothing. An answer takes as long as the line."""
    stream = connection.makefile("rb")
    while len(request := stream.read(14)) == 14:
        module = request[4]
        if module < 3:
            time.sleep(732 * 10 / 921_600)
            head = PAXINI[:4] + bytes([module]) + PAXINI[5:]
            connection.sendall(with_lrc(head + bytes([0]) + three_axes(239)))


def modules_of(board, port):
    """The tables of three modules at one port, by the table of one."""
    for module in (1, 2, 3):
        request = with_lrc(bytes.fromhex(f"55AA0900{module:02X}00FB0E040000CD02")).hex(" ").upper()
        table = board.replace('"paxini"', f'"module{module}"').replace("D7 02 01", f"D7 02 {module:02X}")
        table = re.sub(r'(?m)^port = ".*"', f'port = "{port}"', table)
        yield re.sub(r'(?m)^request = ".*"', f'request = "{request}"', table)


def robotiq():
    """A TSF-85 at a pty, whose path this returns. Not every packet has the static tactile field, and lengths vary."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    port = os.ttyname(theirs)

    def send():
        assert os.read(ours, 5) == bytes.fromhex("9A00580114")
        for packet in range(1 << 30):
            fields = b"".join(bytes([0x20 | finger << 2]) + struct.pack(">h", packet % 50) for finger in (0, 1))
            if packet % 3 == 0:
                fields += b"".join(
                    bytes([0x10 | finger << 2]) + struct.pack(">28H", *[count + finger for count in counts(28)])
                    for finger in (0, 1)
                )
            if packet % 5 == 0:
                fields += b"\x70" + struct.pack(">Q", packet)
            os.write(ours, bytes([0x9A, 0, 0x58, len(fields)]) + fields)
            time.sleep(0.01)

    threading.Thread(target=send, daemon=True).start()
    return port


def bridged(binary, program, config, expected):
    """The daemon reads what this bridge sends."""
    port = str(free_port())
    process = subprocess.Popen([sys.executable, "-c", program, port])
    try:
        check(binary, config.replace("8300", port), {"bridge": expected})
    finally:
        process.kill()
        process.wait()


def presets():
    """The boards that have a preset."""
    for name, preset, rate in [("flexitac", "flexitac", 50), ("m1616", "m1616", 20), ("jq_glove", "jq-glove", 50)]:
        yield f'[[sensor]]\nname = "{name}"\nport = "p"\nframe_rate_hz = {rate}.0\nbaud = 921600\n[sensor.frame]\npreset = "{preset}"\n'


def newtons_are_counts(config):
    """The same tables with a force of 1 N a count, and without a tare."""
    tables = []
    for table in re.split(r"(?m)^(?=\[\[sensor\]\])", config):
        if table.strip():
            if "[sensor.calibration]" not in table:
                table += "[sensor.calibration]\n"
            tables.append(table + "newtons_per_count = 1.0\ntare_frames = 0\n")
    return "".join(tables)


def check(binary, config, wanted, seconds=0):
    """The daemon reads `wanted`, the counts by the sensors' names. None of these is stale for so long."""
    with Bench(binary, sensors=()) as bench:
        with open(bench.path("hardnessd.toml"), "w") as out:
            out.write('[publish.unix]\npath = "events.sock"\n' + newtons_are_counts(config))
        bench.daemon()
        tail = bench.events("--types", "frame,status")
        frames = lambda name: [event for event in tail.events if event["type"] == "frame" and event["sensor"] == name]
        for name, expected in wanted.items():
            found = wait_for(f"a frame of {name}", lambda name=name: frames(name)[3:])
            assert expected is None or all(frame["newtons"] == expected for frame in found), (name, found[0])
        time.sleep(seconds)
        for event in tail.events:
            assert event["sensor"] not in wanted or event.get("state") != "stale" or not seconds, event
        tail.kill()
        tail.thread.join()


def main(binary):
    with open(PAGE) as page:
        page = page.read()
    blocks = re.findall(r"(?ms)^```toml\n(.*?)^```", page)
    programs = dict(re.findall(r"(?ms)^```python\n# (\S+)\n(.*?)^```", page))
    programs["robotiq"] = re.search(r"(?ms)^```python\n(from pyrobotiqtactile.*?)^```", page)[1]
    boards = {tomllib.loads(block)["sensor"][0]["name"]: block for block in [*blocks, *presets()]}
    bridge = boards.pop("bridge")
    assert boards.keys() == BOARDS.keys(), boards.keys() ^ BOARDS.keys()
    for name, block in boards.items():
        sensors = tomllib.loads(block)["sensor"]
        frame, asked, expected = BOARDS[name]
        port = serve((frame, asked, sensors[0]["frame_rate_hz"]))
        config = re.sub(r'(?m)^port = ".*"', f'port = "{port}"', block)
        wanted = dict(zip([sensor["name"] for sensor in sensors], expected, strict=True))
        check(binary, config, wanted)
        print(f"{name}: {', '.join(wanted)}")

    write = [sys.executable, "-c", programs["inspire.py"], listening(hand)]
    config = subprocess.run(write, capture_output=True, text=True, check=True).stdout
    areas = tomllib.loads(config)["sensor"]
    assert len(areas) == 17
    wanted = {}
    for area in areas:
        cells = area["frame"]["rows"] * area["frame"]["cols"]
        wanted[area["name"]] = [int(area["name"][5:]) % 97] * cells
    check(binary, config, wanted)
    print(f"inspire: {len(areas)} areas at one port")

    config = "".join(modules_of(boards["paxini"], listening(modules)))
    check(binary, config, {"module1": counts(238), "module2": counts(238)}, seconds=10)
    print("paxini: two modules live at one port, and a silent one")

    bridged(binary, programs["bridge.py"], bridge, [row + col / 10 for row in range(4) for col in range(4)])
    print("bridge: UDP")

    begin, end = programs["bridge.py"].split("def read_taxels")
    program = begin + programs["robotiq"].replace("/dev/ttyACM0", robotiq()) + end[end.index("\n\n\ndaemon") :]
    bridged(binary, program, bridge.replace("rows = 4", "rows = 7"), counts(28))
    print("robotiq: by its package and the bridge")


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
