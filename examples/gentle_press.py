#!/usr/bin/env python3
"""Presses an object no harder than its level needs: the arm withdraws when the level is known, or at a force. It
presses harder, or again, where the verdict's `advice` asks for it.

Replace the class `Arm` by your robot's. docs/motion.md shows how to try it beside a simulated sensor. `hardnessd.py`
must be beside this file or installed.
"""

import argparse
import time

import hardnessd

FAR_MM, SPEED_MM_S, LONGEST_S = 20.0, 5.0, 20.0
MOST_PRESSES, MOST_N = 4, 30.0


class Arm:
    """The arm of a robot. This one only says where it would go."""

    def move(self, to_mm, speed_mm_s):
        print(f"arm: to {to_mm:.0f} mm at {speed_mm_s:.0f} mm/s")

    def wait(self):
        """Returns when the arm is where it was sent. This one is there at once."""


def press(arm, events, sensor, limit_n=15.0, sure=0.0):
    """Presses once. Returns the early verdict that ended the loading, or None; the final verdict; and the greatest
    force that the sensor read, in N. Early verdicts of a confidence below `sure` do not count."""
    early, greatest_n, loading, goal_mm = None, 0.0, True, 0.0
    start, live = time.monotonic(), False
    try:
        for event in events:
            seconds, ours = time.monotonic() - start, event.get("sensor", sensor) == sensor
            if seconds > 2 * LONGEST_S or ours and event["type"] == "press" and event["state"] == "aborted":
                raise RuntimeError(f"no verdict: {sensor} is no sensor, was lost, or the arm touched nothing or too lightly")
            if not ours:
                continue
            if event["type"] in ("status", "disconnected"):
                live = event.get("state") == "live"
            elif event["type"] == "frame":
                live, greatest_n = True, max(greatest_n, event["force_n"] or 0.0)
            elif event["type"] == "hardness" and event["phase"] == "final":
                return early, event, greatest_n
            elif event["type"] == "hardness" and loading and event["confidence"] >= sure:
                # A press unlike those of the training has a confidence that says little.
                early = None if "outside_training" in event["notes"] else event
            loading = loading and not early and greatest_n < limit_n and seconds < LONGEST_S
            # While nothing is known of the sensor, the arm goes back.
            wanted_mm = FAR_MM if loading and live else 0.0
            if wanted_mm != goal_mm:
                goal_mm = wanted_mm
                arm.move(goal_mm, SPEED_MM_S)
    finally:
        # Whatever ended the press, the arm goes back first.
        arm.move(0.0, SPEED_MM_S)
        arm.wait()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sensor", nargs="?", default="forearm")
    parser.add_argument("--limit", type=float, default=15.0, help="greatest force in newtons [default: 15]")
    args = parser.parse_args()
    events = hardnessd.Client(types=["frame", "hardness", "press", "status"])
    try:
        arm = Arm()
        limit_n = args.limit
        for _ in range(MOST_PRESSES):
            early, final, greatest_n = press(arm, events, args.sensor, limit_n)
            why = f"an early verdict ({early['confidence']:.0%})" if early else "no early verdict"
            print(f"{final}\n{why}, greatest force {greatest_n:.1f} N, advice: {final['advice']}")
            if final["advice"] is None:
                break
            if final["advice"] == "press_harder":
                limit_n = min(2 * limit_n, MOST_N)
    except (OSError, RuntimeError) as error:
        raise SystemExit(error)


if __name__ == "__main__":
    main()
