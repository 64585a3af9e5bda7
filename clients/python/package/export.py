"""Recordings as tables (Parquet), or as a data set of LeRobot (v3.0).

    python3 -m hardnessd.export take.mcap --to parquet --out tables
    python3 -m hardnessd.export takes/*.mcap --to parquet --partition --append --skip-damaged --out tables
    python3 -m hardnessd.export takes/*.mcap --to lerobot --episodes presses --out presses

It reads one recording after another, with `--partition` several at once on the processors, and holds a bounded part of
each in memory.

It needs mcap, mcap-ros2-support, numpy and pyarrow: pip install './clients/python[export]'
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import datetime
import hashlib
import json
import os
import pathlib
import signal
import sys
import urllib.parse
from typing import Any, Dict, Iterator, List, NamedTuple, NoReturn, Optional, Sequence, Tuple, Union

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hardnessd import observation, recording
from hardnessd.observation import Array

FRAMES_AT_ONCE = 1024
"""Frames that are held before they are written: 17 MB of the largest array."""

ROWS_AT_ONCE = 16384
"""Rows of the other tables, which are small."""

FILE_BYTES = 100_000_000
"""A data file of LeRobot ends with the episode that reaches this size. It is LeRobot's own limit."""

FILES_IN_A_FOLDER = 1000
"""Also LeRobot's own."""

EPISODES_AT_ONCE = 50
"""Episodes whose description is held before it is written."""

_TIME = pa.timestamp("us", tz="UTC")
_SHORE = pa.struct([("value", pa.float64()), ("low", pa.float64()), ("high", pa.float64())])
_PLACE = [("recording", pa.string()), ("sensor", pa.string()), ("time", _TIME)]

TABLES: Dict[str, pa.Schema] = {
    "recording": pa.schema(
        [
            ("recording", pa.string()),
            ("robot", pa.string()),
            ("run", pa.string()),
            ("version", pa.string()),
            ("labels", pa.map_(pa.string(), pa.string())),
            ("sensors", pa.string()),
        ]
    ),
    "frames": pa.schema(
        [
            *_PLACE,
            ("frame", pa.int64()),
            ("rows", pa.int32()),
            ("cols", pa.int32()),
            ("newtons", pa.list_(pa.float32())),
        ]
    ),
    "contact": pa.schema(
        [
            *_PLACE,
            ("frame", pa.int64()),
            ("force_n", pa.float64()),
            ("contact_area_taxels", pa.int32()),
            ("approach_mm", pa.float64()),
            ("tared", pa.bool_()),
        ]
    ),
    "motion": pa.schema([*_PLACE, ("mono_ns", pa.int64()), ("approach_mm", pa.float64())]),
    "press": pa.schema(
        [
            *_PLACE,
            ("seq", pa.int64()),
            ("press", pa.int64()),
            ("state", pa.string()),
            ("frame", pa.int64()),
            ("reason", pa.string()),
            ("frames", pa.int64()),
            ("context", pa.string()),
        ]
    ),
    "hardness": pa.schema(
        [
            *_PLACE,
            ("seq", pa.int64()),
            ("press", pa.int64()),
            ("phase", pa.string()),
            ("level", pa.int32()),
            ("label", pa.string()),
            ("rejected", pa.string()),
            ("notes", pa.list_(pa.string())),
            ("probabilities", pa.list_(pa.float32())),
            ("confidence", pa.float32()),
            ("frame", pa.int64()),
            ("contact_area_taxels", pa.int32()),
            ("contact_area_mm2", pa.float64()),
            ("force_n", pa.float64()),
            ("model", pa.string()),
            ("state", pa.string()),
            ("context", pa.string()),
            ("mono_ns", pa.int64()),
            ("age_at_publish_ms", pa.float64()),
            ("latency_us", pa.int64()),
            ("shore", _SHORE),
            ("levels", pa.list_(pa.int32())),
            ("course", pa.string()),
            ("stiffness_n_per_mm", pa.float64()),
            ("references", pa.string()),
            ("advice", pa.string()),
            (
                "object",
                pa.struct(
                    [
                        ("name", pa.string()),
                        ("presses", pa.int64()),
                        ("level", pa.int32()),
                        ("probabilities", pa.list_(pa.float32())),
                        ("shore", _SHORE),
                    ]
                ),
            ),
        ]
    ),
}
"""Each table's columns. Events have the fields of docs/protocol.md; `context` is JSON text."""


class Problem(Exception):
    """An error that one line says, and the exit code."""

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = code


class Output:
    """A folder, and what was made in it: on an error exactly that is removed again."""

    def __init__(self, folder: pathlib.Path, append: bool = False) -> None:
        self.folder = folder
        self.made: List[pathlib.Path] = []
        if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not append)):
            raise Problem(f"{folder}: it exists and is not an empty folder: name a new one", 74)
        self._make(folder)

    def path(self, name: str) -> pathlib.Path:
        """The path of a new file."""
        path = self.folder / name
        self._make(path.parent)
        self.made.append(path)
        return path

    def _make(self, folder: pathlib.Path) -> None:
        if not folder.exists():
            self._make(folder.parent)
            # Another process may make it for its own recording.
            folder.mkdir(exist_ok=True)
            self.made.append(folder)

    def remove(self) -> None:
        # Several processes may have made something in one folder, so the deepest goes first.
        for path in sorted(self.made, key=lambda path: len(path.parts), reverse=True):
            try:
                path.rmdir() if path.is_dir() else path.unlink()
            except OSError:
                # It was not made yet, or somebody else put something into the folder.
                pass


class Tables:
    """The tables of TABLES: a file each, or with `--partition` a file of each recording."""

    def __init__(self, output: Output, options: argparse.Namespace) -> None:
        self._output = output
        self._is_parted: bool = options.partition
        self._rows: Dict[str, List[Dict[str, Any]]] = {name: [] for name in TABLES}
        self.counts: Dict[str, int] = dict.fromkeys(TABLES, 0)
        self._writers: Dict[str, pq.ParquetWriter] = {}
        self._parts: List[Tuple[pathlib.Path, pathlib.Path]] = []
        # The folder of a partition says the robot.
        self._schemas = dict(TABLES)
        if self._is_parted:
            columns = TABLES["recording"]
            self._schemas["recording"] = columns.remove(columns.get_field_index("robot"))

    def _begin(self, name: str, take: recording.Recording) -> Optional[str]:
        """Opens the files of a recording. Returns its name in the tables, or None if they have it."""
        folder, file = "", ""
        if self._is_parted:
            first = next(take._messages(["input", "frame", "contact", "press", "hardness", "status"]), None)
            first_ns = first[2] if first else 0
            day = datetime.datetime.fromtimestamp(first_ns / 1e9, datetime.timezone.utc)
            robot = urllib.parse.quote(take.about.get("robot", "unknown"), safe=" ")
            folder = f"robot={robot}/date={day:%Y-%m-%d}/"
            # Recordings of one name are told apart by what they are.
            made_of = hashlib.sha256(f"{take.about.get('run')} {first_ns}".encode()).hexdigest()[:8]
            name = file = f"{os.path.basename(name).removesuffix('.mcap')}-{made_of}"
        elif self._writers:
            return name
        paths = {table: f"{table}/{folder}{file}.parquet" if self._is_parted else f"{table}.parquet" for table in TABLES}
        # Its file comes last: others without it are of an export that was killed.
        if (self._output.folder / paths["recording"]).exists():
            return None
        for table, path in paths.items():
            part = self._output.path(f"{path}.part")
            self._writers[table] = pq.ParquetWriter(part, self._schemas[table], compression="zstd")
            self._parts.append((part, self._output.path(path)))
        return name

    def add(self, file: str, take: recording.Recording) -> None:
        name = self._begin(file, take)
        if name is None:
            print(f"{take.path}: it is there already", file=sys.stderr)
            return
        about = {key: take.about.get(key) for key in ("robot", "run", "version")}
        settings = json.dumps(take.sensors)
        self._row("recording", recording=name, labels=list(take.labels.items()), sensors=settings, **about)
        for sensor, topic, time_ns, message in take.joined(["motion", "press", "hardness"]):
            time_us = time_ns // 1000
            place = {"recording": name, "sensor": sensor, "time": time_us}
            if topic == "touch":
                frame, contact = message
                number = None if contact is None else contact.frame
                if contact is not None:
                    fields = ("frame", "force_n", "contact_area_taxels", "approach_mm", "tared")
                    self._row("contact", **place, **{key: recording._value(key, contact) for key in fields})
                if frame is not None:
                    grid = {"rows": frame.height, "cols": frame.width}
                    self._row("frames", **place, **grid, frame=number, newtons=_newtons(frame).ravel())
            elif topic == "motion":
                for at_ns, mm in zip(message.at_ns, message.approach_mm):
                    then = {**place, "time": time_us + (at_ns - message.mono_ns) // 1000}
                    self._row("motion", **then, mono_ns=at_ns, approach_mm=mm)
            else:
                event = {key: recording._value(key, message) for key in recording._fields(topic)}
                if event["context"] is not None:
                    event["context"] = json.dumps(event["context"])
                self._row(topic, **{**event, **place})
        if self._is_parted:
            self.close()

    def _row(self, name: str, **row: Any) -> None:
        self._rows[name].append(row)
        if len(self._rows[name]) == (FRAMES_AT_ONCE if name == "frames" else ROWS_AT_ONCE):
            self._write(name)

    def _write(self, name: str) -> None:
        self._writers[name].write_table(pa.Table.from_pylist(self._rows[name], schema=self._schemas[name]))
        self.counts[name] += len(self._rows[name])
        self._rows[name].clear()

    def close(self) -> None:
        for name, writer in self._writers.items():
            if self._rows[name]:
                self._write(name)
            writer.close()
        self._writers.clear()
        # A file is there once it is whole, and that of the table `recording` once all are.
        for part, path in reversed(self._parts):
            part.rename(path)
        self._parts.clear()

    def summary(self) -> str:
        return "rows: " + ", ".join(f"{name} {count}" for name, count in self.counts.items())


class Row(NamedTuple):
    """What LeRobot calls a frame."""

    frame: int
    time_ns: int
    values: Dict[str, Array]


class Episode(NamedTuple):
    rows: Iterator[Row]
    about: Dict[str, Any]
    """What `meta/episodes` says of it, beside LeRobot's own."""


class Sensor(NamedTuple):
    """What all episodes of a data set have in common."""

    name: str
    rows: int
    cols: int
    frame_rate_hz: float

    def __str__(self) -> str:
        return f"{self.rows}x{self.cols} taxels of {self.name!r} at {self.frame_rate_hz:g} frames/s"


class Stats:
    """Least, greatest, mean and standard deviation of a feature, along its last axis as LeRobot has them."""

    def __init__(self) -> None:
        self._rows = 0
        self._count = 0
        self._low: Array = np.array(np.inf)
        self._high: Array = np.array(-np.inf)
        self._total: Array = np.array(0.0)
        self._squares: Array = np.array(0.0)

    def add(self, batch: Array) -> None:
        """`batch` has the rows along its first axis."""
        flat = batch.reshape(-1, 1 if batch.ndim == 1 else batch.shape[-1]).astype(np.float64)
        self._rows += len(batch)
        self._count += len(flat)
        self._low = np.minimum(self._low, flat.min(0))
        self._high = np.maximum(self._high, flat.max(0))
        self._total = self._total + flat.sum(0)
        self._squares = self._squares + (flat**2).sum(0)

    def values(self) -> Dict[str, List[Any]]:
        mean = self._total / self._count
        std = np.sqrt(np.maximum(0.0, self._squares / self._count - mean**2))
        found = {"min": self._low, "max": self._high, "mean": mean, "std": std}
        return {**{name: value.tolist() for name, value in found.items()}, "count": [self._rows]}


class LeRobot:
    """A data set of LeRobot, v3.0. `meta/info.json` is written last: without it there is no data set."""

    def __init__(self, output: Output, options: argparse.Namespace) -> None:
        self._output = output
        self._options = options
        self._sensor: Optional[Sensor] = None
        self._first = ""
        self._keys: Dict[str, str] = {}
        self._features: Dict[str, Dict[str, Any]] = {}
        self._schema: pa.Schema = None
        self._data: Optional[pq.ParquetWriter] = None
        self._data_path = pathlib.Path()
        self._files = 0
        self._episodes: List[Dict[str, Any]] = []
        self._episode_writer: Optional[pq.ParquetWriter] = None
        self._stats: Dict[str, Stats] = {}
        self._total_episodes = 0
        self._total_rows = 0

    def add(self, name: str, take: recording.Recording) -> None:
        sensor = self._of(name, take)
        if sensor is None:
            return
        if self._sensor is None:
            self._begin(name, sensor)
        elif sensor != self._sensor:
            raise Problem(f"{take.path}: found {sensor}, expected {self._sensor} as in {self._first}")
        rows = _rows(take, sensor, self._keys)
        pick = _presses if self._options.episodes == "presses" else _whole
        for episode in pick(rows):
            self._write(episode, {"recording": name, "labels": json.dumps(take.labels)})

    def _of(self, name: str, take: recording.Recording) -> Optional[Sensor]:
        """The sensor of a recording, or None if it has no frames."""
        wanted: Optional[str] = self._options.sensor
        if wanted is None and len(take.sensors) > 1:
            raise Problem(f"{take.path}: it has the sensors {', '.join(take.sensors)}: choose one with --sensor", 2)
        wanted = wanted or next(iter(take.sensors))
        if wanted not in take.sensors:
            raise Problem(f"{take.path}: it has no sensor {wanted!r}, only {', '.join(take.sensors)}")
        for frame in take.frames():
            if frame.sensor == wanted:
                rate = take.sensors[wanted].get("frame_rate_hz")
                if rate is None:
                    raise Problem(f"{take.path}: it lacks the settings of {wanted}, and so its frame rate")
                return Sensor(wanted, frame.rows, frame.cols, rate)
        return None

    def _begin(self, name: str, sensor: Sensor) -> None:
        self._sensor, self._first = sensor, name
        self._keys = observation.keys_of(sensor.name, self._options.key)
        own = {"hardnessd.time_s": "float32", "hardnessd.frame": "int64"}
        default = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}
        self._features = {
            **observation.features(self._keys, sensor.rows, sensor.cols),
            **{key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in {**own, **default}.items()},
        }
        self._schema = pa.schema([(key, _arrow(feature)) for key, feature in self._features.items()])
        self._stats = {key: Stats() for key in self._features}

    def _write(self, episode: Episode, about: Dict[str, Any]) -> None:
        assert self._sensor is not None
        writer, first = self._writer(), self._total_rows
        stats = {key: Stats() for key in self._features}
        length, begin_ns = 0, 0
        for rows in _batches(episode.rows):
            begin_ns = begin_ns or rows[0].time_ns
            numbers = np.arange(length, length + len(rows))
            columns = {key: np.stack([row.values[key] for row in rows]) for key in rows[0].values}
            columns["hardnessd.time_s"] = np.array([(row.time_ns - begin_ns) / 1e9 for row in rows])
            columns["hardnessd.frame"] = np.array([row.frame for row in rows])
            columns["timestamp"] = numbers / self._sensor.frame_rate_hz
            columns["frame_index"] = numbers
            columns["episode_index"] = np.full(len(rows), self._total_episodes)
            columns["index"] = first + numbers
            columns["task_index"] = np.zeros(len(rows), np.int64)
            arrays = []
            for key, feature in self._features.items():
                column = columns[key].astype(feature["dtype"])
                # LeRobot stores a vector of one element as a number.
                column = column.reshape(len(rows), *([] if feature["shape"] == (1,) else feature["shape"]))
                stats[key].add(column)
                self._stats[key].add(column)
                arrays.append(_column(column))
            writer.write_table(pa.table(arrays, schema=self._schema))
            length += len(rows)
        if length == 0:
            return
        self._total_rows += length
        described = {
            "episode_index": self._total_episodes,
            "tasks": [self._options.task],
            "length": length,
            "data/chunk_index": (self._files - 1) // FILES_IN_A_FOLDER,
            "data/file_index": (self._files - 1) % FILES_IN_A_FOLDER,
            "dataset_from_index": first,
            "dataset_to_index": self._total_rows,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **{f"hardnessd/{key}": value for key, value in {**about, "time": begin_ns // 1000, **episode.about}.items()},
        }
        for key, found in stats.items():
            described.update({f"stats/{key}/{name}": value for name, value in found.values().items()})
        self._episodes.append(described)
        self._total_episodes += 1
        if len(self._episodes) == EPISODES_AT_ONCE:
            self._describe()

    def _writer(self) -> pq.ParquetWriter:
        """The file of the next episode: an episode is never in two."""
        if self._data and self._data_path.stat().st_size >= FILE_BYTES:
            self._data.close()
            self._data = None
        if self._data is None:
            chunk, file = divmod(self._files, FILES_IN_A_FOLDER)
            self._data_path = self._output.path(f"data/chunk-{chunk:03}/file-{file:03}.parquet")
            self._data = pq.ParquetWriter(self._data_path, self._schema, compression="zstd")
            self._files += 1
        return self._data

    def _describe(self) -> None:
        types = {"hardnessd/time": _TIME, "hardnessd/press": pa.int64(), "hardnessd/level": pa.int32()}
        types.update({f"hardnessd/{key}": pa.string() for key in ("recording", "labels", "label")})
        types["hardnessd/confidence"] = pa.float32()
        table = pa.table(
            {key: pa.array([one[key] for one in self._episodes], types.get(key)) for key in self._episodes[0]}
        )
        if self._episode_writer is None:
            path = self._output.path("meta/episodes/chunk-000/file-000.parquet")
            self._episode_writer = pq.ParquetWriter(path, table.schema, compression="zstd")
        self._episode_writer.write_table(table)
        self._episodes.clear()

    def close(self) -> None:
        if self._sensor is None or self._total_episodes == 0:
            what = "presses" if self._options.episodes == "presses" else "frames after a tare"
            raise Problem(f"the recordings have no {what}: there is nothing to export")
        if self._episodes:
            self._describe()
        assert self._data and self._episode_writer
        self._data.close()
        self._episode_writer.close()
        tasks = pa.table({"task_index": pa.array([0]), "task": [self._options.task]})
        pq.write_table(tasks.replace_schema_metadata(_TASK_INDEX), self._output.path("meta/tasks.parquet"))
        stats = {key: found.values() for key, found in self._stats.items()}
        self._output.path("meta/stats.json").write_text(json.dumps(stats))
        rate = self._sensor.frame_rate_hz
        info = {
            "codebase_version": "v3.0",
            "fps": int(rate) if rate == int(rate) else rate,
            "features": self._features,
            "total_episodes": self._total_episodes,
            "total_frames": self._total_rows,
            "total_tasks": 1,
            "chunks_size": FILES_IN_A_FOLDER,
            "data_files_size_in_mb": FILE_BYTES // 1_000_000,
            "video_files_size_in_mb": 200,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "robot_type": None,
            "splits": {"train": f"0:{self._total_episodes}"},
        }
        self._output.path("meta/info.json").write_text(json.dumps(info, indent=4))

    def summary(self) -> str:
        return f"{self._total_episodes} episodes, {self._total_rows} frames, {self._sensor}"


# Without these lines pandas would not take `task` for the index, and LeRobot expects it there.
_TASK_INDEX = {
    "pandas": json.dumps(
        {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
                for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
            ],
            "pandas_version": "2.0.0",
        }
    )
}


def _newtons(frame: Any) -> Array:
    """[rows, cols] of a sensor_msgs/msg/Image."""
    return np.frombuffer(bytes(frame.data), "<f4").reshape(frame.height, frame.width)


def _rows(
    take: recording.Recording, sensor: Sensor, keys: Dict[str, str]
) -> Iterator[Tuple[str, Any]]:
    """In the order of time: ("row", Row) of each frame after a tare, ("press", message), ("final", event), and
    ("gone", None) where the sensor was stale or lost."""
    # A verdict is in the recording at the time of its frame, and is known only later.
    coming: List[Tuple[int, Dict[str, Any]]] = []
    last: Optional[Tuple[int, Dict[str, Any]]] = None
    for name, topic, time_ns, message in take.joined(["press", "hardness", "status"]):
        if name != sensor.name:
            continue
        if topic == "press":
            yield "press", message
        elif topic == "status":
            if message.state != "live":
                yield "gone", None
        elif topic == "hardness":
            event = {key: recording._value(key, message) for key in ("press", "phase", "level", "label", "confidence")}
            age_ms = recording._value("age_at_publish_ms", message) or 0.0
            coming.append((time_ns + int(age_ms * 1e6), event))
            if event["phase"] == "final":
                yield "final", event
        elif None not in message and message.contact.tared:
            frame, contact = message
            if (frame.height, frame.width) != (sensor.rows, sensor.cols):
                raise Problem(f"{take.path}: found a frame of {frame.height}x{frame.width} taxels, expected {sensor}")
            known = [verdict for verdict in coming if verdict[0] <= time_ns]
            coming = [verdict for verdict in coming if verdict[0] > time_ns]
            last = max([*known, *([last] if last else [])], key=lambda verdict: verdict[0], default=None)
            verdict = last and observation.Verdict(
                last[1]["level"], last[1]["confidence"], (time_ns - last[0]) / 1e9
            )
            approach = recording._value("approach_mm", contact)
            touched = (contact.force_n, contact.contact_area_taxels)
            values = observation.values(keys, _newtons(frame), *touched, approach, verdict)
            yield "row", Row(contact.frame, time_ns, values)


def _whole(found: Iterator[Tuple[str, Any]]) -> Iterator[Episode]:
    """All frames of a recording. After the sensor was stale or lost, another episode begins."""
    first: List[Row] = []

    def until_gone() -> Iterator[Row]:
        yield first.pop()
        for kind, item in found:
            if kind == "gone":
                return
            if kind == "row":
                yield item

    for kind, item in found:
        if kind == "row":
            first.append(item)
            yield Episode(until_gone(), {})


def _presses(found: Iterator[Tuple[str, Any]]) -> Iterator[Episode]:
    """The frames of each press that ended, from its first frame in contact to its last."""
    # A `begin` is published at its frame: a few frames are enough to have it.
    rows: "collections.deque[Row]" = collections.deque(maxlen=8)
    finals: Dict[int, Dict[str, Any]] = {}
    begin: Any = None
    for kind, item in found:
        if kind == "row":
            rows.append(item)
        elif kind == "final":
            finals[item["press"]] = item
        elif kind == "press" and item.state == "begin":
            begin, rows = item, collections.deque(rows)
        elif kind == "press":
            if item.state == "end" and begin is not None:
                final = finals.get(item.press, {})
                about = {key: final.get(key) for key in ("level", "label", "confidence")}
                inside = [row for row in rows if begin.frame <= row.frame <= item.frame]
                yield Episode(iter(inside), {"press": item.press, **about})
            begin, rows, finals = None, collections.deque(rows, maxlen=8), {}


def _batches(rows: Iterator[Row]) -> Iterator[List[Row]]:
    batch: List[Row] = []
    for row in rows:
        batch.append(row)
        if len(batch) == FRAMES_AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch


def _arrow(feature: Dict[str, Any]) -> pa.DataType:
    """How LeRobot stores a feature."""
    kind = pa.float32() if feature["dtype"] == "float32" else pa.int64()
    if feature["shape"] == (1,):
        return kind
    if len(feature["shape"]) == 1:
        return pa.list_(kind, feature["shape"][0])
    return pa.list_(pa.list_(kind))


def _column(values: Array) -> pa.Array:
    """Numbers, vectors or matrices as a column."""
    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(values.ravel())
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    count, rows, cols = values.shape
    inner = pa.ListArray.from_arrays(np.arange(0, count * rows * cols + 1, cols, dtype=np.int32), flat)
    return pa.ListArray.from_arrays(np.arange(0, count * rows + 1, rows, dtype=np.int32), inner)


def _part(path: str, name: str, options: argparse.Namespace) -> Tuple[List[pathlib.Path], Dict[str, int]]:
    """Writes the files of one recording, in a process of its own. Returns what was made, and the rows of each table."""
    output = Output(pathlib.Path(options.out), append=True)
    try:
        tables = Tables(output, options)
        with recording.open(path) as take:
            tables.add(name, take)
        return output.made, tables.counts
    except BaseException:
        output.remove()
        raise


def _parts(taken: Sequence[Tuple[str, str]], output: Output, options: argparse.Namespace) -> Tables:
    """Writes the files of all recordings, on all processors. Returns the tables, which count the rows."""
    tables = Tables(output, options)
    with concurrent.futures.ProcessPoolExecutor() as pool:
        parts = [pool.submit(_part, path, name, options) for path, name in taken]
        try:
            for part in parts:
                part.result()
        finally:
            # What was made counts also after an error, because it is removed then.
            pool.shutdown(cancel_futures=True)
            for part in parts:
                if not part.cancelled() and part.exception() is None:
                    made, counts = part.result()
                    output.made += made
                    tables.counts = {name: count + counts[name] for name, count in tables.counts.items()}
    return tables


LEFT_OUT = "left-out.tsv"
"""The file that names the recordings that `--skip-damaged` left out, and why."""


def export(paths: Sequence[str], options: argparse.Namespace) -> str:
    """Writes the recordings into the folder `options.out`. Returns what is in it, in words."""
    # Two folders may have a recording of the same name.
    names = [os.path.basename(path) for path in paths]
    names = names if len(set(names)) == len(names) else list(paths)
    taken, left_out = [], []
    for path, name in zip(paths, names):
        # A bad file among many is named at once, not after an hour.
        try:
            with recording.open(path) as take:
                if options.skip_damaged:
                    take.check()
                for lack in take.lacks:
                    print(f"{path}: another program has changed this recording. It lacks {lack}", file=sys.stderr)
            taken.append((path, name))
        except recording.Damaged as error:
            if not options.skip_damaged:
                raise
            print(error, file=sys.stderr)
            left_out.append((path, str(error)))
    output = Output(pathlib.Path(options.out), options.append)
    try:
        writer: Union[LeRobot, Tables]
        if options.partition and len(taken) > 1:
            writer = _parts(taken, output, options)
        else:
            writer = LeRobot(output, options) if options.to == "lerobot" else Tables(output, options)
            for path, name in taken:
                with recording.open(path) as take:
                    writer.add(name, take)
        writer.close()
        if left_out:
            rows = [[json.dumps(str(cell), ensure_ascii=False)[1:-1] for cell in row] for row in left_out]
            lines = "".join("\t".join(row) + "\n" for row in rows)
            with open(output.path(LEFT_OUT), "a") as file:
                file.write(lines)
        counted = f"; {len(left_out)} recordings left out, see {LEFT_OUT}" if left_out else ""
        return writer.summary() + counted
    except BaseException:
        output.remove()
        raise


def _key(text: str) -> Tuple[str, str]:
    quantity, equals, key = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected QUANTITY=KEY")
    return quantity, key


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python3 -m hardnessd.export",
        description="Export recordings to Parquet tables, or to a data set of LeRobot (v3.0).",
        epilog="Exit codes: 0 done, 1 a file is damaged, none of hardnessd, or does not fit the others, 2 wrong usage, "
        "66 a file is missing, 74 the folder is not empty or cannot be written, 130 Ctrl-C, 143 SIGTERM.",
    )
    parser.add_argument("file", nargs="+", help="recording (.mcap)")
    parser.add_argument("--to", choices=("parquet", "lerobot"), required=True)
    parser.add_argument("--out", required=True, metavar="DIR", help="new or empty folder")
    parser.add_argument(
        "--skip-damaged", action="store_true", help=f"go on past a damaged recording, and list it in {LEFT_OUT}"
    )
    parquet = parser.add_argument_group("for --to parquet")
    parquet.add_argument(
        "--partition",
        action="store_true",
        help="a file of each recording, in folders robot=NAME/date=YYYY-MM-DD of each table",
    )
    parquet.add_argument(
        "--append", action="store_true", help="with --partition: add to the folder the recordings that it lacks"
    )
    lerobot = parser.add_argument_group("for --to lerobot")
    lerobot.add_argument(
        "--episodes",
        choices=("recordings", "presses"),
        default="recordings",
        help="what an episode is [default: recordings]",
    )
    lerobot.add_argument("--sensor", metavar="NAME", help="sensor to export, if a recording has several")
    lerobot.add_argument("--task", default="press an object", help="[default: press an object]")
    lerobot.add_argument(
        "--key",
        type=_key,
        action="append",
        default=[],
        metavar="QUANTITY=KEY",
        help="key of the feature that has a quantity; an empty key leaves it out. Quantities: " + ", ".join(observation.KEYS),
    )
    return parser


def _stop(*_: Any) -> NoReturn:
    raise SystemExit(143)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The program. Returns its exit code."""
    parser = _arguments()
    options = parser.parse_args(arguments)
    options.key = dict(options.key)
    if options.partition and options.to != "parquet":
        parser.error("--partition: tables have partitions, and --to lerobot has none")
    if options.append and not options.partition:
        parser.error("--append: it needs --partition")
    try:
        observation.keys_of("sensor", options.key)
    except ValueError as error:
        parser.error(f"--key: {error}")
    signal.signal(signal.SIGTERM, _stop)
    try:
        print(f"{options.out}: {export(options.file, options)}", file=sys.stderr)
        return 0
    except (recording.Damaged, Problem) as error:
        code, message = getattr(error, "code", 1), str(error)
    except OSError as error:
        missing = error.filename in options.file
        code, message = 66 if missing else 74, f"{error.filename or options.out}: {error.strerror or error}"
    except ValueError as error:
        code, message = 1, str(error)
    except KeyboardInterrupt:
        return 130
    print(message, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
