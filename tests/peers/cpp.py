#!/usr/bin/env python3
"""The example in C++: it compiles without a warning, and prints the verdicts that a subscriber receives.

    python3 tests/peers/cpp.py target/debug/hardnessd
"""

import json
import os
import subprocess
import sys

from bench import Bench, run

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


def main(binary):
    with Bench(binary) as bench:
        program = bench.path("subscribe")
        source = os.path.join(ROOT, "examples/cpp/subscribe.cpp")
        run("g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", source, "-o", program)
        bench.daemon()
        reader = subprocess.Popen([program, bench.path("events.sock")], stdout=subprocess.PIPE, text=True)
        ours = bench.tail("--types", "hardness", "--timeout", "60")
        bench.sensor("forearm", "--presses", "2")
        events = (json.loads(line) for line in ours.stdout)
        for _ in range(2):
            event = next(event for event in events if event["phase"] == "final")
            label = "null" if event["label"] is None else f'"{event["label"]}"'
            printed = reader.stdout.readline().split()
            assert printed[0] == label and float(printed[1]) == event["confidence"], (printed, event)
            assert float(printed[2]) == event["force_n"], (printed, event)
        for process in (reader, ours):
            process.kill()
    print("C++ printed two verdicts, as they were published")


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
