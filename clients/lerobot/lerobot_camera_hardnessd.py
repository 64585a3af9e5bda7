"""A tactile array of hardnessd as a camera of LeRobot.

    from lerobot_camera_hardnessd import HardnessdCamera, HardnessdCameraConfig

    with HardnessdCamera(HardnessdCameraConfig(sensor="forearm")) as camera:
        print(camera.features())
        print(camera.observation())

`read`, `async_read` and `read_latest` give an image to look at. `observation` gives what a policy learns from:
newtons on each taxel, force, contact area, the arm's approach and the last verdict with its age. A sensor of 150
frames/s has several frames between two pictures of 30: with `window`, `observation` gives them all.

A frame is given only while it is fresh: when the sensor is stale or lost, or the daemon is gone, each of them raises
TimeoutError and says why.
"""

import collections
import threading
import time
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import hardnessd
import numpy as np
from hardnessd import observation
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

__all__ = ["HardnessdCamera", "HardnessdCameraConfig"]

CONNECT_S = 5.0


@CameraConfig.register_subclass("hardnessd")
@dataclass(kw_only=True)
class HardnessdCameraConfig(CameraConfig):
    """Which sensor of which daemon, and how it is shown."""

    address: str | None = None
    """Path of a Unix socket, or HOST:PORT of [publish.tcp]. Without it, the daemon's socket on this machine."""
    sensor: str | None = None
    """Name of the sensor. Without it, the only one."""
    fps: int | None = 30
    """A robot of LeRobot wants one. The sensor sends at its own rate, whatever this is."""
    width: int | None = 224
    height: int | None = 224
    """Pixels of the image. Each taxel is a square of pixels; what is left over is black."""
    brightest_n: float = 0.5
    """Newtons on a taxel that the image shows brightest."""
    max_age_ms: int = 500
    """An older frame is not given. Raise it for a sensor of fewer than 3 frames/s."""
    window: int = 1
    """How many of the newest frames `observation` gives, the oldest first: features then have this as their first
    axis, and the feature `fresh` says how many came since the last observation. Until there are so many, the first
    one stands in for those before it."""
    keys: dict[str, str] = field(default_factory=dict)
    """Keys of features in place of `hardnessd.observation.KEYS`. An empty key leaves the quantity out."""
    image_key: str = ""
    """Key of the image in `features` and `observation`, such as observation.images.forearm. Without it they have none:
    LeRobot's own robots add the images of their cameras themselves."""

    def __post_init__(self) -> None:
        observation.keys_of("sensor", self.keys)
        if self.brightest_n <= 0:
            raise ValueError(f"brightest_n: found {self.brightest_n}, expected more than 0")
        if self.window < 1:
            raise ValueError(f"window: found {self.window}, expected 1 or more")


class HardnessdCamera(Camera):
    """A sensor of a running daemon. A thread follows its events."""

    def __init__(self, config: HardnessdCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._client: hardnessd.Client | None = None
        self._thread: threading.Thread | None = None
        # Everything below is guarded by this condition, which is notified of every change.
        self._changed = threading.Condition()
        self._frame: hardnessd.Frame | None = None
        # The newest frames with what was known at each, and how many of them no observation has had.
        self._recent: collections.deque[dict[str, NDArray[Any]]] = collections.deque(maxlen=config.window)
        self._fresh_count = 0
        self._arrived_s = 0.0
        self._taken = True
        self._why = "not connected"
        self._verdict: hardnessd.Hardness | None = None
        self._verdict_s = 0.0

    def __str__(self) -> str:
        return f"HardnessdCamera({self.config.sensor or 'the only sensor'})"

    @property
    def is_connected(self) -> bool:
        return self._client is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The sensors of the daemon on this machine."""
        address = hardnessd.default_address()
        try:
            sensors = _sensors(address)
        except OSError:
            return []
        return [{"type": "hardnessd", "id": sensor["name"], "address": address, **sensor} for sensor in sensors]

    def connect(self, warmup: bool = True) -> None:
        if self._client is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        address = self.config.address or hardnessd.default_address()
        sensors = {sensor["name"]: sensor for sensor in _sensors(address)}
        name = self.config.sensor or (next(iter(sensors)) if len(sensors) == 1 else None)
        if name not in sensors:
            raise ValueError(f"sensor: found {self.config.sensor!r}, expected one of {', '.join(sensors)}")
        self._name, self._rows, self._cols = name, sensors[name]["rows"], sensors[name]["cols"]
        self._keys = observation.keys_of(name, self.config.keys)
        if self.config.image_key in self._keys.values():
            raise ValueError(f"image_key: found {self.config.image_key!r}, which another quantity has too")
        self._why = "no frame has arrived yet"
        # Of a slow reader's frames only the newest counts, unless it wants several.
        policy: Literal["latest", "queue"] = "latest" if self.config.window == 1 else "queue"
        self._client = hardnessd.Client(address, hardnessd.TYPES, policy=policy)
        self._thread = threading.Thread(target=self._follow, args=(self._client,), daemon=True)
        self._thread.start()
        if warmup:
            try:
                self._wait(CONNECT_S * 1000, new=False)
            except TimeoutError as error:
                self.disconnect()
                raise ConnectionError(str(error)) from error

    def disconnect(self) -> None:
        if self._client is None or self._thread is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        self._client.close()
        self._thread.join()
        self._client = self._thread = None
        self._lose("not connected")
        self._verdict = None

    def read(self) -> NDArray[Any]:
        """Waits for the next frame, and returns its image."""
        with self._changed:
            self._taken = True
        return self._image(self._wait(10_000.0))

    def async_read(self, timeout_ms: float = 1000) -> NDArray[Any]:
        """Returns the image of the newest frame that no `read` has returned, and waits for one if there is none."""
        return self._image(self._wait(timeout_ms))

    def read_latest(self, max_age_ms: int | None = None) -> NDArray[Any]:
        """Returns the image of the newest frame without waiting. `max_age_ms` goes before that of the configuration."""
        return self._image(self._fresh(max_age_ms))

    def features(self) -> dict[str, dict[str, Any]]:
        """The features of a LeRobotDataset that `observation` fills. The camera must be connected."""
        if self._client is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        found = observation.features(self._keys, self._rows, self._cols)
        if self.config.window > 1:
            for feature in found.values():
                feature["shape"] = (self.config.window, *feature["shape"])
                feature["names"] = ["frames", *feature["names"]] if len(feature["shape"]) > 2 else None
            found[self._fresh_key()] = {"dtype": "int64", "shape": (1,), "names": ["fresh"]}
        if self.config.image_key:
            shape, names = (self.height, self.width, 3), ["height", "width", "channels"]
            found[self.config.image_key] = {"dtype": "video", "shape": shape, "names": names}
        return found

    def observation(self, max_age_ms: int | None = None) -> dict[str, NDArray[Any]]:
        """The newest frames with the last verdict. `max_age_ms` goes before that of the configuration."""
        with self._changed:
            frame = self._fresh(max_age_ms)
            if self.config.window == 1:
                found = self._values(frame)
            else:
                recent = list(self._recent)
                whole = [recent[0]] * (self.config.window - len(recent)) + recent
                found = {key: np.stack([values[key] for values in whole]) for key in recent[0]}
                found[self._fresh_key()] = np.array([self._fresh_count], np.int64)
                self._fresh_count = 0
        if self.config.image_key:
            found[self.config.image_key] = self._image(frame)
        return found

    def _fresh_key(self) -> str:
        return f"observation.tactile.{self._name}.fresh"

    def _values(self, frame: hardnessd.Frame) -> dict[str, NDArray[Any]]:
        """What is known at a frame that has just come."""
        verdict, age_s = self._verdict, time.monotonic() - self._verdict_s
        newtons = np.array(frame["newtons"]).reshape(self._rows, self._cols)
        known = verdict and observation.Verdict(verdict["level"], verdict["confidence"], age_s)
        touched = (frame["force_n"] or 0.0, frame["contact_area_taxels"])
        return observation.values(self._keys, newtons, *touched, frame["approach_mm"], known)

    def _follow(self, client: hardnessd.Client) -> None:
        try:
            for event in client:
                self._take(event)
        except hardnessd.Refused as error:
            self._lose(f"the daemon refused: {error}")

    def _take(self, event: hardnessd.Event) -> None:
        if event["type"] == "disconnected":
            self._lose(f"no connection: {event['reason']}")
        elif event["type"] == "gap" or event["sensor"] != self._name:
            pass
        elif event["type"] == "status":
            if event["state"] != "live":
                self._lose(f"the sensor is {event['state']}" + (f": {event['reason']}" if event["reason"] else ""))
        elif event["type"] == "hardness":
            with self._changed:
                self._verdict, self._verdict_s = event, time.monotonic()
        elif event["type"] == "frame":
            if (event["rows"], event["cols"]) != (self._rows, self._cols):
                self._lose(f"found {event['rows']}x{event['cols']} taxels, expected {self._rows}x{self._cols}")
            elif not event["tared"]:
                self._lose("the sensor has no tare yet")
            else:
                with self._changed:
                    self._frame, self._arrived_s, self._taken = event, time.monotonic(), False
                    if self.config.window > 1:
                        self._recent.append(self._values(event))
                        self._fresh_count += 1
                    self._changed.notify_all()

    def _lose(self, why: str) -> None:
        """From now on there is no frame."""
        with self._changed:
            self._frame, self._why = None, why
            self._recent.clear()
            self._fresh_count = 0
            self._changed.notify_all()

    def _fresh(self, max_age_ms: int | None = None) -> hardnessd.Frame:
        if self._client is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        with self._changed:
            if self._frame is None:
                raise TimeoutError(f"{self}: {self._why}")
            age_ms = 1000 * (time.monotonic() - self._arrived_s)
            most_ms = self.config.max_age_ms if max_age_ms is None else max_age_ms
            if age_ms > most_ms:
                raise TimeoutError(f"{self}: the last frame is {age_ms:.0f} ms old, expected at most {most_ms} ms")
            self._taken = True
            return self._frame

    def _wait(self, timeout_ms: float, new: bool = True) -> hardnessd.Frame:
        """The newest frame, or the next one if somebody has it."""
        if self._client is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        with self._changed:
            arrived = self._changed.wait_for(
                lambda: self._frame is not None and not (new and self._taken), timeout_ms / 1000
            )
            if not arrived:
                why = f": {self._why}" if self._frame is None else ""
                raise TimeoutError(f"{self}: no new frame within {timeout_ms:g} ms{why}")
            return self._fresh()

    def _image(self, frame: hardnessd.Frame) -> NDArray[Any]:
        """Colours from black over purple and orange to light yellow, as uint8 [height, width, 3], RGB."""
        newtons = np.array(frame["newtons"]).reshape(self._rows, self._cols)
        grey = np.clip(255 * newtons / self.config.brightest_n, 0, 255).astype(np.uint8)
        colours = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
        side = max(1, min(self.height // self._rows, self.width // self._cols))
        colours = colours.repeat(side, 0).repeat(side, 1)[: self.height, : self.width]
        image = np.zeros((self.height, self.width, 3), np.uint8)
        image[: colours.shape[0], : colours.shape[1]] = colours
        return image


def _sensors(address: hardnessd.Address) -> list[dict[str, Any]]:
    """Name, rows and columns of each sensor of a daemon."""
    connection = hardnessd.Connection(address, CONNECT_S)
    try:
        hello = connection.receive()
    finally:
        connection.close()
    if "sensors" not in hello:
        raise ConnectionError(hello.get("message", f"{address}: this is not hardnessd"))
    return list(hello["sensors"])
