#!/usr/bin/env python3
"""examples/gentle_press.py on a simulated arm, with the real daemon, the course model and real time.

    PYTHON tests/peers/gentle_press.py target/debug/hardnessd [PRESSES]

Claims: after eight presses, which serve the sensor as references, most presses have the right level, and those of hard
and of very soft materials end at an early verdict, below half of the 15 N at which the others end.
"""

import importlib.util
import json
import pathlib
import statistics
import sys
import time

import hardnessd
from bench import Bench

ROOT = pathlib.Path(__file__).parents[2]
OWN = 8
MATERIALS = ["hard-plastic", "foam", "soft-candy", "yoga-mat"]


def example():
    spec = importlib.util.spec_from_file_location("gentle_press", ROOT / "examples/gentle_press.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(binary, presses=12, seed="63"):
    gentle_press = example()
    # 790 bytes take 8.6 ms at 921,600 baud, the scan 10 ms.
    more = (
        f'[press]\nearly_min_force_n = 3.0\n[model]\npath = "{ROOT}/models/course.onnx"\nearly_confidence = 0.9\n'
    )
    with Bench(binary, frame_rate_hz=100, more=more) as bench:
        config = pathlib.Path(bench.path("hardnessd.toml"))
        arm = "baud = 921600\narm = { stiffness_n_per_mm = 10.0, delay_ms = 18.6 }\n[publish.unix]"
        config.write_text(config.read_text().replace("[publish.unix]", arm, 1))
        materials = [word for material in MATERIALS for word in ("--material", material)]
        bench.sensor(
            "forearm", "--baud", "921600", "--arm", bench.path("arm.sock"), "--motion", bench.path("control.sock"),
            "--seed", seed, *materials,
        )
        bench.daemon()
        events = iter(hardnessd.Client(bench.path("events.sock"), ["frame", "hardness", "press", "status"]))
        arm = gentle_press.Arm(bench.path("arm.sock"))
        right, forces_n, early = 0, {material: [] for material in MATERIALS}, dict.fromkeys(MATERIALS, 0)
        for number in range(1, OWN + presses + 1):
            while arm.order(to_mm=0.0)["at_mm"] > 0:
                time.sleep(0.02)
            arm.order(object=number)
            first, final, _ = gentle_press.press(arm, events, "forearm")
            truth = arm.order()["truth"]
            if number <= OWN:
                continue
            right += 1 + final["probabilities"].index(max(final["probabilities"])) == truth["level"]
            forces_n[truth["material"]].append(truth["greatest_n"])
            early[truth["material"]] += first is not None
    median_n = statistics.median(sum(forces_n.values(), []))
    found = {"presses": presses, "right": right, "median_n": median_n, "early": early}
    print(json.dumps(found))
    assert right >= 0.8 * presses, found
    for material in ("hard-plastic", "yoga-mat"):
        assert early[material] >= 0.9 * len(forces_n[material]), found
        assert statistics.median(forces_n[material]) < 7.5, (found, forces_n)


if __name__ == "__main__":
    binary, *presses = sys.argv[1:]
    main(binary, *map(int, presses))
