#!/usr/bin/env python3
"""LeRobot itself: it reads our exports, and records an episode with our camera.

    python3.12 -m venv venv
    venv/bin/pip install './clients/python[export]' ./clients/lerobot 'lerobot[core-scripts]'    # 5 GB
    venv/bin/python tests/peers/lerobot_peer.py target/debug/hardnessd --pictures pictures

Claims: LeRobotDataset reads an export; LeRobot finds
the camera by the name of its package, and `lerobot-record` records an episode of a simulated robot with it; what
LeRobotDataset then reads is what the socket said; and a sensor that is stale or lost, or a daemon that is gone, gives
no frame.
"""

import contextlib
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field

os.environ["HF_HUB_OFFLINE"] = "1"
# LeRobot keeps calibrations there, and asks nobody.
os.environ.setdefault("HF_HOME", tempfile.mkdtemp())

import lerobot
import numpy as np
from bench import Bench, taken
from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.datasets import LeRobotDataset
from lerobot.robots import Robot, RobotConfig
from lerobot.scripts import lerobot_record
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_camera_hardnessd import HardnessdCamera, HardnessdCameraConfig
from PIL import Image

FPS = 20
ARRAY, STATE = "observation.tactile.forearm.newtons", "observation.tactile.forearm.state"


@RobotConfig.register_subclass("simulated_arm")
@dataclass(kw_only=True)
class SimulatedArmConfig(RobotConfig):
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class SimulatedArm(Robot):
    """A robot of one joint. As LeRobot's own robots, it gives its cameras' images; as a robot with touch would, it adds
    the force and the level to its state."""

    config_class, name = SimulatedArmConfig, "simulated_arm"
    made = []

    def __init__(self, config):
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self.at, self.seen = 0.0, []
        SimulatedArm.made.append(self)

    @property
    def observation_features(self):
        images = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {"joint.pos": float, "force_n": float, "level": float, **images}

    @property
    def action_features(self):
        return {"joint.pos": float}

    is_connected = property(lambda self: all(camera.is_connected for camera in self.cameras.values()))
    is_calibrated = True

    def connect(self, calibrate=True):
        for camera in self.cameras.values():
            camera.connect()

    def calibrate(self):
        pass

    def configure(self):
        pass

    def get_observation(self):
        camera = self.cameras["forearm"]
        state = camera.observation()[STATE]
        names = camera.features()[STATE]["names"]
        touch = {name: float(state[names.index(name)]) for name in ("force_n", "level")}
        return {"joint.pos": self.at, **touch, "forearm": camera.read_latest()}

    def send_action(self, action):
        self.at = action["joint.pos"]
        return action

    def disconnect(self):
        for camera in self.cameras.values():
            camera.disconnect()


@TeleoperatorConfig.register_subclass("simulated_hand")
@dataclass
class SimulatedHandConfig(TeleoperatorConfig):
    pass


class SimulatedHand(Teleoperator):
    config_class, name = SimulatedHandConfig, "simulated_hand"
    action_features = {"joint.pos": float}
    feedback_features = {}
    is_connected = is_calibrated = True

    def connect(self, calibrate=True):
        self.start = time.monotonic()

    def get_action(self):
        return {"joint.pos": float(np.sin(time.monotonic() - self.start))}

    def calibrate(self):
        pass

    configure = send_feedback = disconnect = lambda *_: None


def an_export(path, directory, episodes):
    """LeRobotDataset reads it, with windows in time."""
    out = directory / episodes
    command = [sys.executable, "-m", "hardnessd.export", path, "--to", "lerobot", "--episodes", episodes, "--out", out]
    subprocess.run(command, check=True, capture_output=True)
    data = LeRobotDataset("hardnessd/export", root=out)
    assert (data.num_episodes, data.num_frames) == (data.meta.total_episodes, len(data)) and len(data) > 90
    window = LeRobotDataset("hardnessd/export", root=out, delta_timestamps={ARRAY: [-1 / FPS, 0]}, episodes=[0])
    assert window[5][ARRAY].shape == (2, 28, 28) and np.array_equal(window[5][ARRAY][0], data[4][ARRAY])
    return data.num_episodes, data.num_frames


def a_recorded_episode(bench, directory, pictures):
    """`lerobot-record` with the simulated robot, beside a client of the socket."""
    address = bench.path("events.sock")
    lines = bench.events("--types", "frame,hardness")
    out = directory / "recorded"
    cameras = json.dumps({"forearm": {"type": "hardnessd", "address": address, "sensor": "forearm"}})
    sys.argv = [
        "lerobot-record",
        "--robot.type=simulated_arm",
        f"--robot.cameras={cameras}",
        "--teleop.type=simulated_hand",
        "--dataset.repo_id=hardnessd/recorded",
        f"--dataset.root={out}",
        "--dataset.single_task=press an object",
        f"--dataset.fps={FPS}",
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=8",
        "--dataset.push_to_hub=false",
        "--dataset.video=false",
        "--play_sounds=false",
    ]
    lerobot_record.record()
    lines.kill()
    lines.thread.join()
    live = lines.events
    data = LeRobotDataset("hardnessd/recorded", root=out)
    names = data.features["observation.state"]["names"]
    assert names == ["joint.pos", "force_n", "level"] and data.num_frames > 0.8 * 8 * FPS, (names, data.num_frames)
    forces = [round(event["force_n"], 2) for event in live if event["type"] == "frame" and event["tared"]]
    levels = {event["level"] or 0 for event in live if event["type"] == "hardness"}
    pressed = 0
    for item in data:
        _, force, level = item["observation.state"].tolist()
        assert round(force, 2) in forces and level in {0, *levels}, (force, level)
        image = item["observation.images.forearm"]
        assert image.shape == (3, 224, 224)
        # Another frame may have come between the state and the image.
        if force > 8:
            assert image.max() > 0.9, image.max()
            pressed += 1
    assert pressed > 5, pressed
    if pictures:
        strongest = max(data, key=lambda item: float(item["observation.state"][1]))
        picture = (strongest["observation.images.forearm"].numpy().transpose(1, 2, 0) * 255).astype(np.uint8)
        Image.fromarray(picture).save(os.path.join(pictures, "lerobot.png"))
    return data.num_frames, pressed


def the_array(bench, directory, video):
    """A program of its own with the 2-D feature: every frame of the data set is one of the socket, with what was known
    then."""
    address = bench.path("events.sock")
    lines = bench.events("--types", "frame,hardness")
    config = HardnessdCameraConfig(address=address, image_key="observation.images.forearm")
    with HardnessdCamera(config) as camera:
        data = LeRobotDataset.create(
            "hardnessd/array", fps=FPS, features=camera.features(), root=directory / "array", use_videos=video
        )
        for _ in range(8 * FPS):
            camera.async_read()
            data.add_frame({**camera.observation(), "task": "press an object"})
        data.save_episode()
        data.finalize()
    lines.kill()
    lines.thread.join()
    live = lines.events
    data = LeRobotDataset("hardnessd/array", root=directory / "array")
    names = data.features[STATE]["names"]
    frames = {np.float32(event["newtons"]).tobytes(): event for event in live if event["type"] == "frame"}
    verdicts = {(event["level"] or 0, np.float32(event["confidence"])) for event in live if event["type"] == "hardness"}
    pressed, levels = 0, set()
    for item in data:
        newtons = item[ARRAY].numpy()
        event = frames[newtons.tobytes()]
        state = dict(zip(names, item[STATE].tolist(), strict=True))
        assert np.isclose(state["force_n"], event["force_n"], atol=1e-3), state
        # Frames without a force are alike, so that this event need not be the very frame.
        if state["force_n"] > 1:
            assert state["contact_area_taxels"] == event["contact_area_taxels"], (state, event)
            assert state["approach_known"] == (event["approach_mm"] is not None), (state, event)
            assert np.isclose(state["approach_mm"], event["approach_mm"] or 0, atol=1e-3), (state, event)
            pressed += 1
        verdict = (int(state["level"]), np.float32(state["confidence"]))
        assert verdict in verdicts or (verdict == (0, 0) and state["verdict_age_s"] == 60), state
        assert 0 <= state["verdict_age_s"] <= 60
        levels.add(verdict[0])
        # Each taxel is 8x8 pixels, and black means nothing on it.
        image = item["observation.images.forearm"].numpy()[:, 4::8, 4::8].max(0)
        tolerance = 0.2 if video else 0.02
        assert (image[newtons >= config.brightest_n] > 0.9 - tolerance).all()
        assert (image[newtons == 0] < 0.02 + tolerance).mean() > 0.95
    assert pressed > 20 and levels - {0}, (pressed, levels)
    return len(data), pressed


def the_readme(bench, directory):
    """Its program runs as it is."""
    page = pathlib.Path(__file__).resolve().parents[2] / "clients/lerobot/README.md"
    (program,) = [block for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.S) if "import" in block]
    environment = {**os.environ, "RUNTIME_DIRECTORY": bench.directory.name}
    subprocess.run([sys.executable, "-c", program], cwd=directory, env=environment, check=True, capture_output=True)
    return len(LeRobotDataset("me/touch", root=directory / "touch"))


def no_frame(camera, what):
    """None of the three ways gives a frame. The reasons are in the errors."""
    said = set()
    for read in (camera.read_latest, lambda: camera.async_read(timeout_ms=300), camera.observation):
        try:
            read()
        except TimeoutError as error:
            assert what in str(error) and "\n" not in str(error), error
            said.add(str(error))
        else:
            raise AssertionError(f"{what}: a frame was given")
    return sorted(said)[0]


def wait_until(true, seconds=15):
    deadline = time.monotonic() + seconds
    while True:
        with contextlib.suppress(TimeoutError):
            return true()
        assert time.monotonic() < deadline, "it does not come back"
        time.sleep(0.05)


def nothing_stale(binary):
    reasons = []
    with Bench(binary, frame_rate_hz=FPS) as bench:
        daemon = bench.daemon()
        camera = HardnessdCamera(HardnessdCameraConfig(address=bench.path("events.sock"), sensor="forearm"))
        try:
            camera.connect()
        except ConnectionError as error:
            reasons.append(str(error))
        else:
            raise AssertionError("it connects without a sensor")
        assert not camera.is_connected
        sensor = bench.sensor("forearm", "--force", "15")
        camera.connect()
        camera.read_latest()
        for halted, what in ((sensor, "the sensor is stale"), (daemon, "ms old")):
            halted.send_signal(signal.SIGSTOP)
            time.sleep(0.7)
            reasons.append(no_frame(camera, what if halted is sensor else ""))
            halted.send_signal(signal.SIGCONT)
            wait_until(camera.read_latest)
        sensor.terminate()
        sensor.wait()
        time.sleep(0.3)
        reasons.append(no_frame(camera, "the sensor is lost"))
        bench.sensor("forearm", "--force", "15")
        wait_until(camera.read_latest)
        daemon.terminate()
        daemon.wait(timeout=10)
        time.sleep(0.3)
        reasons.append(no_frame(camera, "no connection"))
        bench.daemon()
        wait_until(camera.observation)
        try:
            HardnessdCamera(HardnessdCameraConfig(address=bench.path("events.sock"), sensor="palm")).connect()
        except ValueError as error:
            reasons.append(str(error))
        camera.disconnect()
    assert len(reasons) == 6, reasons
    return reasons


def main(binary, pictures):
    if pictures:
        os.makedirs(pictures, exist_ok=True)
    register_third_party_plugins()
    assert "hardnessd" in CameraConfig.get_known_choices()
    print("LeRobot", lerobot.__version__)
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        path = directory / "take.mcap"
        taken(binary, path, "--motion", "{control}")
        for episodes in ("recordings", "presses"):
            print("an export of %d episodes and %d frames" % an_export(path, directory, episodes))
        with Bench(binary, frame_rate_hz=FPS) as bench:
            bench.daemon()
            bench.sensor("forearm", "--force", "15", "--seed", "3", "--motion", bench.path("control.sock"))
            print("lerobot-record: %d frames, %d of them pressed" % a_recorded_episode(bench, directory, pictures))
            print("the array, in a data set: %d frames, %d of them pressed" % the_array(bench, directory, True))
            print("the program of the README: %d frames" % the_readme(bench, directory))
        for reason in nothing_stale(binary):
            print("no frame:", reason)


if __name__ == "__main__":
    binary, *pictures = sys.argv[1:]
    main(os.path.abspath(binary), pictures[-1] if pictures else None)
