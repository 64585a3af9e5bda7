#!/usr/bin/env python3
"""The window of the LeRobot camera, with stand-ins for the few classes of LeRobot that the plugin is made of.
`lerobot_peer.py` has the real ones.

    venv/bin/python tests/peers/camera.py target/debug/hardnessd

Claims: with `window`, an observation has that many frames, the oldest first; pictures at 30 a second miss no frame of
100; features say the shapes.
"""

import dataclasses
import os
import pathlib
import sys
import time
import types

import numpy as np
from bench import Bench

PLUGIN = pathlib.Path(__file__).parents[2] / "clients/lerobot"
WINDOW = 16


@dataclasses.dataclass(kw_only=True)
class CameraConfig:
    fps: int | None = None
    width: int | None = None
    height: int | None = None

    @classmethod
    def register_subclass(cls, name):
        return lambda subclass: subclass


class Camera:
    def __init__(self, config):
        self.width, self.height = config.width, config.height

    def __enter__(self):
        self.connect()
        return self

    def __exit__(self, *_):
        self.disconnect()


def stand_in(name, **content):
    sys.modules[name] = types.ModuleType(name)
    vars(sys.modules[name]).update(content)


def main(binary):
    for name in ("cv2", "lerobot", "lerobot.cameras", "lerobot.utils"):
        stand_in(name)
    stand_in("lerobot.cameras.camera", Camera=Camera)
    stand_in("lerobot.cameras.configs", CameraConfig=CameraConfig)
    errors = {name: type(name, (Exception,), {}) for name in ("DeviceAlreadyConnectedError", "DeviceNotConnectedError")}
    stand_in("lerobot.utils.errors", **errors)
    sys.path.insert(0, str(PLUGIN))
    from lerobot_camera_hardnessd import HardnessdCamera, HardnessdCameraConfig

    with Bench(binary, frame_rate_hz=100) as bench:
        bench.daemon()
        bench.sensor("forearm", "--baud", "1000000", "--presses", "3")
        config = HardnessdCameraConfig(address=bench.path("events.sock"), window=WINDOW)
        newtons, fresh = "observation.tactile.forearm.newtons", "observation.tactile.forearm.fresh"
        with HardnessdCamera(config) as camera:
            features = camera.features()
            assert features[newtons]["shape"] == (WINDOW, 28, 28), features
            time.sleep(0.3)
            before, missed, seen = camera.observation()[newtons], 0, 0
            for _ in range(90):
                time.sleep(1 / 30)
                found = camera.observation()
                assert {key: found[key].shape for key in features} == {key: feature["shape"] for key, feature in features.items()}
                count = int(found[fresh][0])
                missed += max(0, count - WINDOW)
                if count < WINDOW:
                    # What was there before moves on by as many places as are fresh.
                    assert np.array_equal(found[newtons][: WINDOW - count], before[count:])
                before, seen = found[newtons], seen + count
    assert seen > 200 and missed < 0.05 * seen, (seen, missed)
    print(f"90 observations had {seen} frames, {missed} of them older than the window")


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
