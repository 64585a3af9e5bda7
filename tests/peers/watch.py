#!/usr/bin/env python3
"""`hardnessd watch` on a real pty, read by a terminal emulator that is not ours (pyte).

    python -m venv venv && venv/bin/pip install pyte pillow
    venv/bin/python tests/peers/watch.py target/debug/hardnessd [--pictures DIRECTORY]

Claims: live, stale, lost and a daemon that has gone are told apart, in colours and without, wide and
narrow; a lost sensor shows within 1 s; SIGTERM ends it. With --pictures it leaves one of each.
"""

import argparse
import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import termios
import time

import pyte
from bench import Bench, PATIENCE_S

SHOWS_WITHIN_S = 1.0


class Terminal:
    """A `watch` on a pty of `columns` x `rows`."""

    def __init__(self, bench, columns, rows, **variables):
        self.screen = pyte.Screen(columns, rows)
        self.stream = pyte.ByteStream(self.screen)
        self.master, device = pty.openpty()
        fcntl.ioctl(device, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        environment = {
            **os.environ, "TERM": "xterm-256color", "LC_ALL": "C.UTF-8", "NO_COLOR": "", "COLORTERM": "", **variables,
        }
        self.process = subprocess.Popen(
            [bench.binary, "watch", "--socket", bench.path("events.sock")],
            stdin=device, stdout=device, stderr=device, env=environment,
        )
        os.close(device)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGTERM)
        end = time.monotonic() + PATIENCE_S
        while self.process.poll() is None and time.monotonic() < end:
            self.read(0.1)
        assert self.process.wait(1) == 0
        os.close(self.master)

    def read(self, patience_s):
        if select.select([self.master], [], [], patience_s)[0]:
            try:
                self.stream.feed(os.read(self.master, 65536))
            except OSError:  # It has ended.
                time.sleep(patience_s)

    def text(self):
        return "\n".join(self.screen.display)

    def shows(self, *parts):
        """Waits until all parts stand there; how long it took."""
        start = time.monotonic()
        while not all(part in self.text() for part in parts):
            assert time.monotonic() - start < PATIENCE_S, f"{parts} not in\n{self.text()}"
            self.read(0.05)
        return time.monotonic() - start

    def for_seconds(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.read(0.05)


class Pictures:
    """Screens as PNG files."""

    CELL = (9, 18)
    NAMED = {
        "default": None, "black": "000000", "red": "cd0000", "green": "00cd00", "brown": "cdcd00",
        "blue": "0000ee", "magenta": "cd00cd", "cyan": "00cdcd", "white": "e5e5e5",
    }

    def __init__(self, directory):
        self.directory = directory
        if directory:
            os.makedirs(directory, exist_ok=True)

    def take(self, terminal, name):
        if not self.directory:
            return
        from PIL import Image, ImageDraw, ImageFont

        fonts = "/usr/share/fonts/truetype/dejavu/DejaVuSansMono%s.ttf"
        plain, bold = (ImageFont.truetype(fonts % which, 14) for which in ("", "-Bold"))
        width, height = self.CELL
        screen = terminal.screen
        image = Image.new("RGB", (screen.columns * width, screen.lines * height), "#101014")
        draw = ImageDraw.Draw(image)

        def colour(name, other):
            return "#" + (self.NAMED.get(name, name) or other)

        for row in range(screen.lines):
            for column in range(screen.columns):
                cell = screen.buffer[row][column]
                ink, paper = colour(cell.fg, "d8d8d8"), colour(cell.bg, "101014")
                if cell.reverse:
                    ink, paper = paper, ink
                left, top = column * width, row * height
                draw.rectangle((left, top, left + width - 1, top + height - 1), paper)
                blocks = "\u2581\u2582\u2583\u2584\u2585\u2586\u2587\u2588"
                if cell.data == "\u2580":
                    draw.rectangle((left, top, left + width - 1, top + height // 2 - 1), ink)
                elif cell.data in blocks:
                    filled = height * (blocks.index(cell.data) + 1) // 8
                    bottom = top + height - 1
                    draw.rectangle((left, bottom - filled + 1, left + width - 1, bottom), ink)
                elif cell.data.strip():
                    draw.text((left, top), cell.data, ink, bold if cell.bold else plain)
        image.save(os.path.join(self.directory, f"watch-{name}.png"))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("--pictures")
    arguments = parser.parse_args()
    pictures = Pictures(arguments.pictures)
    with Bench(os.path.abspath(arguments.binary), sensors=("forearm", "wrist")) as bench:
        with Terminal(bench, 80, 24) as terminal:
            terminal.shows("NO DAEMON")
            pictures.take(terminal, "no-daemon")
        daemon = bench.daemon()
        forearm = bench.sensor("forearm", "--seed", "3")
        bench.sensor("wrist", "--seed", "4")
        looks = [
            ("80x24", (80, 24), {"COLORTERM": "truecolor"}),
            ("wide", (120, 48), {}),
            ("large", (220, 64), {}),
            ("narrow", (44, 40), {}),
            ("no-colour", (80, 24), {"NO_COLOR": "1"}),
            ("vt100", (80, 24), {"TERM": "vt100"}),
            ("dumb", (80, 24), {"TERM": "dumb"}),
        ]
        terminals = [(name, Terminal(bench, *size, **more)) for name, size, more in looks]
        try:
            observe(terminals, forearm, daemon, pictures)
        finally:
            for _, terminal in terminals:
                terminal.__exit__()


def observe(terminals, forearm, daemon, pictures):
    for _, terminal in terminals:
        terminal.shows("1 forearm LIVE", "2 wrist LIVE", "in contact for")
    # The fourth material is a soft one; a second into its press it is shown by many taxels.
    while "press 4 in contact for 1." not in terminals[0][1].text():
        for _, terminal in terminals:
            terminal.read(0.01)
    for name, terminal in terminals:
        terminal.shows("in contact for")
        pictures.take(terminal, f"live-{name}")
    forearm.send_signal(signal.SIGSTOP)
    for name, terminal in terminals:
        terminal.shows("1 forearm STALE", "force not known", "2 wrist LIVE")
        pictures.take(terminal, f"stale-{name}")
    forearm.send_signal(signal.SIGCONT)
    for _, terminal in terminals:
        terminal.shows("1 forearm LIVE")
    forearm.kill()
    start = time.monotonic()
    for _, terminal in terminals:
        terminal.shows("1 forearm LOST", "LOST  unplugged", "force not known")
    delay_s = time.monotonic() - start
    assert delay_s < SHOWS_WITHIN_S, f"all show the loss after {delay_s} s"
    for name, terminal in terminals:
        terminal.for_seconds(0.3)
        pictures.take(terminal, f"lost-{name}")
    daemon.kill()
    for name, terminal in terminals:
        terminal.shows("NO DAEMON", "last frame")
        pictures.take(terminal, f"no-daemon-{name}")
    print(f"watch: {len(terminals)} terminals, all show a loss after {delay_s:.2f} s")


if __name__ == "__main__":
    main()
