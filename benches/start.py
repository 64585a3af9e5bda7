#!/usr/bin/env python3
"""From the start of the daemon to its first line, the banner `hello`, as a subscriber sees it.

    cargo build --release
    python3 benches/start.py target/release/hardnessd

The floor is a process that does nothing, /bin/true.
"""

import argparse
import os
import resource
import socket
import statistics
import subprocess
import tempfile
import time

PATIENCE_S = 30


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("--model", help="a model file in place of the built-in one")
    parser.add_argument("--runs", type=int, default=50)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        config, path = (os.path.join(directory, name) for name in ("hardnessd.toml", "events.sock"))
        with open(config, "w") as file:
            file.write('[[sensor]]\nname = "a"\nport = "absent"\n[publish.unix]\npath = "events.sock"\n')
            if arguments.model:
                file.write(f'[model]\npath = "{os.path.abspath(arguments.model)}"\n')
        banners, processors, floors = [], [], []
        for _ in range(arguments.runs):
            begun = time.monotonic()
            subprocess.run(["/bin/true"])
            floors.append(1e3 * (time.monotonic() - begun))
            banner, processor = start([arguments.binary, "run", "--config", config], path)
            banners.append(banner)
            processors.append(processor)
    banner, floor = statistics.median(banners), statistics.median(floors)
    print(
        f"start to banner: median {banner:.1f} ms, least {min(banners):.1f}; processor time with the end"
        f" {statistics.median(processors):.1f} ms; /bin/true {floor:.1f} ms, the median over it {banner / floor:.1f}"
    )


def start(command, path):
    """Milliseconds to the banner, and processor time of the whole run."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begun = time.monotonic()
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while True:
        with socket.socket(socket.AF_UNIX) as subscriber:
            try:
                subscriber.connect(path)
            except (FileNotFoundError, ConnectionRefusedError):
                assert process.poll() is None and time.monotonic() - begun < PATIENCE_S, "no daemon"
                time.sleep(0.0002)
                continue
            assert subscriber.recv(16).startswith(b'{"type":"hello"')
            taken = 1e3 * (time.monotonic() - begun)
            break
    process.terminate()
    process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return taken, 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


if __name__ == "__main__":
    main()
