"""Shows events in Rerun: the array, force and area, the arm's approach, and the verdicts.

    python3 -m hardnessd.rerun_viewer                              # live: opens the viewer
    python3 -m hardnessd.rerun_viewer --save live.rrd              # live, into a file
    python3 -m hardnessd.rerun_viewer take.mcap --save take.rrd    # a recording; `rerun take.rrd` shows it

A live frame is shown as long as the sensor is live. When it is stale or lost, the picture is empty.

It needs mcap, mcap-ros2-support, numpy and rerun-sdk: pip install './clients/python[rerun]'
"""

from __future__ import annotations

import argparse
import datetime
import os
import pathlib
import signal
import sys
import threading
from typing import Any, Dict, List, NoReturn, Optional, Sequence, cast

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

import hardnessd
from hardnessd import recording

BRIGHTEST_N = 0.5
"""Newtons on a taxel that the picture shows brightest."""

COLOURS = [[74, 139, 203], [83, 184, 123], [224, 160, 60], [217, 83, 79]]
"""Red, green and blue of four levels, from hard to very soft. Rerun chooses those of other models."""

USUAL = {1: "hard", 2: "firm", 3: "soft", 4: "very-soft"}
"""The levels of the built-in model."""

SECONDS_SHOWN = 30.0
"""How much of the past the plots show."""


def blueprint(sensors: Sequence[str], live: bool) -> rrb.Blueprint:
    """The views: array and plots of each sensor, and below them what was said."""
    last = rrb.VisibleTimeRange(
        "time",
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-SECONDS_SHOWN),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    rows: List[Any] = []
    for sensor in sensors:
        plots = [
            rrb.TimeSeriesView(origin=f"{sensor}/{name}", name=title, time_ranges=[last] if live else None)
            for name, title in (
                ("force_n", "force, N"),
                ("contact_area_taxels", "contact area, taxels"),
                ("approach_mm", "the arm's approach, mm"),
                ("probability", "verdicts: probability of each level"),
            )
        ]
        picture = rrb.Spatial2DView(origin=f"{sensor}/frame", name=f"{sensor}: newtons on each taxel")
        rows.append(rrb.Horizontal(picture, rrb.Vertical(*plots), column_shares=[2, 3], name=sensor))
    events = rrb.TextLogView(origin="/", name="presses, verdicts and links")
    return rrb.Blueprint(
        rrb.Vertical(rrb.Tabs(*rows) if len(rows) > 1 else rows[0], events, row_shares=[4, 1]),
        rrb.TimePanel(timeline="time", state="collapsed", play_state="following" if live else None),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


class Log:
    """Logs events to a stream of Rerun. Everything is on the timeline `time`."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._sensors: List[str] = []
        self._hello: Optional[hardnessd.Message] = None
        self._labels: List[str] = []
        self.is_empty = True
        """Whether there is nothing but the state of links."""

    def begin(self, sensors: Sequence[str], levels: Sequence[Dict[str, Any]], live: bool) -> None:
        """The sensors, and the levels with their labels as `hello` has them."""
        self._sensors = list(sensors)
        self._labels = [level["label"] for level in levels]
        self._hello = {"model": {"levels": levels}}
        self._stream.send_blueprint(blueprint(sensors, live))

    def event(self, event: hardnessd.Event) -> None:
        """Any event of a `Client` or a recording, but a frame of a recording."""
        self.is_empty = self.is_empty and event["type"] in ("status", "disconnected")
        if event["type"] == "frame":
            newtons = np.array(event["newtons"], np.float32).reshape(event["rows"], event["cols"])
            time_ns = _time_ns(event["time"])
            touched = (event["force_n"], event["contact_area_taxels"], event["approach_mm"])
            self.frame(event["sensor"], time_ns, newtons, *touched)
        elif event["type"] == "hardness":
            age_ms = event["age_at_publish_ms"] or 0.0
            self._at(_time_ns(event["time"]) + int(age_ms * 1e6))
            path = f"{event['sensor']}/probability"
            levels = range(1, len(event["probabilities"]) + 1)
            names = [self._labels[level - 1] if level <= len(self._labels) else f"level {level}" for level in levels]
            # A verdict is a point, and no line leads from one press to the next.
            colours = COLOURS if len(names) == len(COLOURS) else None
            self._stream.log(path, rr.SeriesPoints(names=names, colors=colours), static=True)
            self._stream.log(path, rr.Scalars(event["probabilities"]))
            self._text(event["sensor"], "verdict", event)
        elif event["type"] == "press":
            self._at(_time_ns(event["time"]))
            self._text(event["sensor"], "press", event)
        elif event["type"] == "status":
            self._at(_time_ns(event["time"]))
            self._text(event["sensor"], "link", event)
            if event["state"] in ("stale", "lost"):
                self._clear(event["sensor"])
        elif event["type"] == "disconnected":
            self.clear()
            self._text("daemon", "connection", event)

    def frame(
        self,
        sensor: str,
        time_ns: int,
        newtons: Any,
        force_n: Optional[float],
        contact_area_taxels: int,
        approach_mm: Optional[float],
    ) -> None:
        """One frame, with shape [rows, cols]. Before the first tare it has no force."""
        self._at(time_ns)
        picture = rr.DepthImage(newtons, meter=1.0, colormap="inferno", depth_range=[0, BRIGHTEST_N])
        self._stream.log(f"{sensor}/frame", picture)
        if force_n is not None:
            self._stream.log(f"{sensor}/force_n", rr.Scalars(force_n))
        self._stream.log(f"{sensor}/contact_area_taxels", rr.Scalars(contact_area_taxels))
        if approach_mm is not None:
            self._stream.log(f"{sensor}/approach_mm", rr.Scalars(approach_mm))

    def clear(self) -> None:
        """From now on nothing is shown of any sensor."""
        self._at(_now_ns())
        for sensor in self._sensors:
            self._clear(sensor)

    def _clear(self, sensor: str) -> None:
        for name in ("frame", "force_n", "contact_area_taxels", "approach_mm"):
            self._stream.log(f"{sensor}/{name}", rr.Clear(recursive=False))

    def _at(self, time_ns: int) -> None:
        self._stream.set_time("time", timestamp=np.datetime64(time_ns, "ns"))

    def _text(self, sensor: str, name: str, event: hardnessd.Event) -> None:
        self._stream.log(f"{sensor}/{name}", rr.TextLog(hardnessd._readable(event, self._hello)))


def log_recording(take: recording.Recording, log: Log) -> None:
    """Logs a recording."""
    # A recording names the levels only where it has a verdict of each. Where these are the usual ones, so are the others.
    verdicts = (event for event in take.events(["hardness"]) if event["type"] == "hardness")
    labels = {event["level"]: event["label"] for event in verdicts if event["level"] is not None}
    if labels.items() <= USUAL.items():
        labels = dict(USUAL)
    levels = [{"level": level, "label": labels.get(level) or f"level {level}"} for level in range(1, max(labels) + 1)]
    log.begin(list(take.sensors), levels, live=False)
    for lack in take.lacks:
        print(f"{take.path}: another program has changed this recording. It lacks {lack}", file=sys.stderr)
    for sensor, topic, time_ns, message in take.joined(["press", "hardness", "status"]):
        if topic == "touch":
            if None not in message:
                frame, contact = message
                newtons = np.frombuffer(bytes(frame.data), "<f4").reshape(frame.height, frame.width)
                force_n, approach_mm = (recording._value(key, contact) for key in ("force_n", "approach_mm"))
                log.frame(sensor, time_ns, newtons, force_n, contact.contact_area_taxels, approach_mm)
        else:
            fields = {key: recording._value(key, message) for key in recording._fields(topic)}
            log.event(cast(hardnessd.Event, {"type": topic, **fields}))


def log_live(client: hardnessd.Client, log: Log) -> None:
    """Logs what a client gets, until the client is closed. After that nothing is shown."""
    known: Any = None
    reason: Optional[str] = None
    try:
        for event in client:
            if client.hello is not known:
                known = client.hello
                log.begin([sensor["name"] for sensor in known["sensors"]], known["model"]["levels"], live=True)
            if event["type"] != "disconnected":
                reason = None
                log.event(event)
            elif event["reason"] != reason:
                # The client gives this event for each failed try. One line says it.
                reason = event["reason"]
                print(f"disconnected: {reason}", file=sys.stderr)
                log.event(event)
    finally:
        log.clear()


def _time_ns(text: str) -> int:
    moment = datetime.datetime.fromisoformat(text.replace("Z", "+00:00"))
    return round((moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)) / datetime.timedelta(microseconds=1)) * 1000


def _now_ns() -> int:
    return _time_ns(datetime.datetime.now(datetime.timezone.utc).isoformat())


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python3 -m hardnessd.rerun_viewer",
        description="Show a running hardnessd or a recording in Rerun.",
        epilog="Exit codes: 0 done, 1 the file is damaged or none of hardnessd, or the daemon refused, 2 wrong usage, "
        "66 the file is missing, 74 the output cannot be written, 130 Ctrl-C, 143 SIGTERM.",
    )
    parser.add_argument(
        "source",
        nargs="?",
        help="recording (.mcap), path of a Unix socket, or HOST:PORT [default: the daemon's socket]",
    )
    out = parser.add_mutually_exclusive_group()
    out.add_argument("--save", metavar="FILE.rrd", help="write a new file [default: open the viewer]")
    out.add_argument("--connect", metavar="URL", help="send to a viewer that runs, such as rerun+http://127.0.0.1:9876/proxy")
    parser.add_argument("--seconds", type=hardnessd._seconds, metavar="S", help="end after S seconds of live events")
    return parser


def _stop(*_: Any) -> NoReturn:
    raise SystemExit(143)


def _is_recording(options: argparse.Namespace) -> bool:
    return bool(options.source and options.source.endswith(".mcap"))


def _show(options: argparse.Namespace, log: Log) -> None:
    if _is_recording(options):
        with recording.open(options.source) as take:
            log_recording(take, log)
        return
    client = hardnessd.Client(options.source, hardnessd.TYPES)
    over = threading.Timer(options.seconds or 0, client.close)
    over.daemon = True
    if options.seconds:
        over.start()
    log_live(client, log)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The program. Returns its exit code."""
    options = _arguments().parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    if _is_recording(options) and not os.path.exists(options.source):
        print(f"{options.source}: no such file", file=sys.stderr)
        return 66
    if options.save:
        try:
            # From here on the file is this program's own, so it may be removed.
            open(options.save, "x").close()
        except FileExistsError:
            print(f"{options.save}: it exists already: name a new file", file=sys.stderr)
            return 74
        except OSError as error:
            print(error, file=sys.stderr)
            return 74
    stream = rr.RecordingStream("hardnessd")
    # When an event was logged says nothing of a recording.
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    try:
        if options.save:
            stream.save(options.save)
        elif options.connect:
            stream.connect_grpc(options.connect)
        else:
            stream.spawn()
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 74
    log = Log(stream)
    try:
        _show(options, log)
        return 0
    except KeyboardInterrupt:
        return 130
    except (hardnessd.Refused, ValueError) as error:
        # Hours of live events stay. The half of a recording goes: another try makes it whole.
        if options.save and (_is_recording(options) or log.is_empty):
            pathlib.Path(options.save).unlink(missing_ok=True)
        print(error, file=sys.stderr)
        return 1
    finally:
        stream.flush()
        stream.disconnect()


if __name__ == "__main__":
    sys.exit(main())
