#!/usr/bin/env python3
"""Presses an object no harder than its level needs: the arm withdraws when the level is known, or at a force.

    gentle_press.py ARM [SENSOR] [--limit N]

ARM is the socket of `hardnessd simulate --arm`. For a robot of yours, replace the class `Arm`.
`hardnessd.py` must be beside this file or installed. docs/motion.md shows how to start the daemon and the arm.
"""

import argparse
import json
import socket
import time

import hardnessd

FAR_MM, SPEED_MM_S = 20.0, 5.0
LONGEST_S = 20.0


class Arm:
    """The simulated arm. It stops when this program ends."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(path)
        self.lines = self.socket.makefile("rw")

    def order(self, **order):
        print(json.dumps(order), file=self.lines, flush=True)
        answer = json.loads(self.lines.readline())
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer


def press(arm, events, sensor, limit_n=15.0, sure=0.0):
    """Presses once. Returns the early verdict that ended the loading, or None; the final verdict; and the greatest
    force that the sensor read, in N. Early verdicts of a confidence below `sure` do not count."""
    early, greatest_n, loading = None, 0.0, True
    start = time.monotonic()
    arm.order(to_mm=FAR_MM, speed_mm_s=SPEED_MM_S)
    for event in events:
        is_blind = event["type"] == "disconnected" or event.get("state") in ("stale", "lost")
        if event.get("sensor", sensor) != sensor:
            continue
        if event["type"] == "frame":
            greatest_n = max(greatest_n, sum(event["newtons"]))
        elif event["type"] == "hardness" and event["phase"] == "final":
            return early, event, greatest_n
        elif event["type"] == "hardness" and loading and event["confidence"] >= sure:
            early = event
        seconds = time.monotonic() - start
        if loading and (early or greatest_n >= limit_n or is_blind or seconds > LONGEST_S):
            loading = False
            arm.order(to_mm=0.0)
        if event["type"] == "press" and event["state"] == "aborted" or seconds > 2 * LONGEST_S:
            raise RuntimeError("no verdict: the arm did not touch the object, or too lightly, or the sensor was lost")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("arm")
    parser.add_argument("sensor", nargs="?", default="forearm")
    parser.add_argument("--limit", type=float, default=15.0, help="greatest force in newtons [default: 15]")
    args = parser.parse_args()
    events = iter(hardnessd.Client(types=["frame", "hardness", "press", "status"]))
    arm = Arm(args.arm)
    early, final, greatest_n = press(arm, events, args.sensor, args.limit)
    level = f"{final['level']} {final['label']}" if final["level"] else f"rejected: {final['rejected']}"
    why = f"an early verdict ({early['confidence']:.0%})" if early else "no early verdict"
    print(f"{level} ({final['confidence']:.0%}), {why}, greatest force {greatest_n:.1f} N")
    while arm.order(to_mm=0.0)["at_mm"] > 0:
        time.sleep(0.05)


if __name__ == "__main__":
    main()
