#!/usr/bin/env python3
"""examples/gentle_press.py beside the real daemon, on a simulated sensor that presses by itself.

    PYTHON tests/peers/gentle_press.py target/debug/hardnessd

Claims: the arm loads, goes back at an early verdict or at the limit of the force, and goes back whatever ends a press: a
final verdict while it loads, a lost sensor, Ctrl-C.
"""

import importlib.util
import itertools
import json
import pathlib
import sys

import hardnessd
from bench import Bench

ROOT = pathlib.Path(__file__).parents[2]
LIVE = {"type": "status", "sensor": "forearm", "state": "live"}
FRAME = {"type": "frame", "sensor": "forearm", "force_n": 3.0}
EARLY = {"type": "hardness", "sensor": "forearm", "phase": "early", "confidence": 0.9, "notes": []}
UNLIKE = {**EARLY, "notes": ["outside_training"]}
FINAL = {"type": "hardness", "sensor": "forearm", "phase": "final", "confidence": 0.9, "advice": None}
LOST = {"type": "press", "sensor": "forearm", "state": "aborted", "reason": "lost"}


def example():
    spec = importlib.util.spec_from_file_location("gentle_press", ROOT / "examples/gentle_press.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Arm:
    """Remembers where it was sent, and that somebody waited for it."""

    def __init__(self):
        self.orders = []

    def move(self, to_mm, _speed_mm_s):
        self.orders.append(to_mm)

    def wait(self):
        self.orders.append("there")


def interrupted():
    yield from [LIVE, FRAME]
    raise KeyboardInterrupt


def goes_back_whatever_ends_a_press(gentle_press):
    for events, raised in [
        ([LIVE, FRAME, EARLY, FRAME, FINAL], None),
        ([LIVE, FRAME, FINAL], None),
        ([LIVE, FRAME, UNLIKE, FRAME, FINAL], None),
        ([LIVE, FRAME, {**FRAME, "force_n": 16.0}, FINAL], None),
        ([LIVE, FRAME, LOST], RuntimeError),
        (interrupted(), KeyboardInterrupt),
    ]:
        arm, ended = Arm(), None
        try:
            early, _, _ = gentle_press.press(arm, iter(events), "forearm")
            # A press unlike those of the training ends none early.
            assert (early == EARLY) == (EARLY in events), early
        except (RuntimeError, KeyboardInterrupt) as error:
            ended = type(error)
        assert ended == raised, (ended, raised)
        assert arm.orders[0] == gentle_press.FAR_MM and arm.orders[-2:] == [0.0, "there"], arm.orders


def withdraws_beside_a_daemon(gentle_press, binary, presses=6):
    more = f'[press]\nearly_min_force_n = 3.0\n[model]\npath = "{ROOT}/models/course.onnx"\nearly_confidence = 0.6\n'
    with Bench(binary, frame_rate_hz=20, more=more) as bench:
        bench.sensor("forearm", "--force", "20", "--material", "hard-plastic", "--material", "yoga-mat")
        bench.daemon()
        events = iter(hardnessd.Client(bench.path("events.sock"), ["frame", "hardness", "press", "status"]))
        found = []
        for _ in range(presses):
            arm = Arm()
            early, final, greatest_n = gentle_press.press(arm, events, "forearm")
            assert final["phase"] == "final" and greatest_n > 0.0, (final, greatest_n)
            orders = [order for order, _ in itertools.groupby(arm.orders)]
            assert orders[:1] == [gentle_press.FAR_MM] and orders[-2:] == [0.0, "there"], arm.orders
            found.append(early is not None)
    print(json.dumps({"presses": presses, "early": sum(found)}))
    assert any(found), "no early verdict"


if __name__ == "__main__":
    module = example()
    goes_back_whatever_ends_a_press(module)
    withdraws_beside_a_daemon(module, sys.argv[1])
