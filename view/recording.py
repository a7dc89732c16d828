"""Recordings: a flight as an MCAP file, written frame by frame, read back to the last bit, mended.

The frames of the flight's processes (`shared.feed`) are written as messages of JSON, a channel for
each topic, in chunks that are whole as soon as they are written:

    /opened              a process, its scenario and the columns of its rows
    /vehicle/N/flown     rows of the client's part, see `view.rows`
    /vehicle/N/decided   rows of the server's part
    /vehicle/N/plan      rows of its plans
    /netem/packets       rows of netem's part
    /said                events, as a program reads them
    /figures/PROCESS     numbers counted so far

Beside these, which are the flight, there is what Foxglove and Lichtblick draw of it: /events, and
for each of the first VEHICLES_MAX vehicles /vehicle/N/pose, /vehicle/N/transform and, below
/vehicle/N/scene, the vehicle, its plan, where it should be and its trajectory. The scenario lies
beside the messages as an attachment, and so does the summary, at the end.
"""

import os
import stat
import struct
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, Self

import msgspec
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message
from mcap.writer import Writer

from shared import config
from shared.config import ConfigError, Scenario, to_toml
from shared.events import ChangeRefused, Degraded, Event, Failure, Fault, RecordIncomplete
from shared.feed import Figures, Frame, Opened, Rows, Said, columns_of
from shared.model import Array, advance, discretise
from shared.record import Rows as Table
from shared.summary import Summary, summarise
from view import foxglove, rows
from view.frames import Timed

FRAME = "frame"
"""Key of a channel's metadata that names the kind of frame that its messages were made of."""
SUFFIX = ".mcap"
"""Suffix of a recording's file."""
OURS = "skytether"
"""Name of the metadata that makes an MCAP file a recording, and of the library that writes it."""
SCENARIO, SUMMARY = "scenario.toml", "summary.json"
"""Names of the attachments."""
MAGIC = b"\x89MCAP0\r\n"
"""Bytes that an MCAP file begins and ends with."""
VEHICLES_MAX = 64
"""Most vehicles that are drawn; of those with larger numbers only the rows are recorded."""
CHUNK_BYTES = 256 * 1024
"""Size of the messages in a chunk from which it is written, at the latest [B]."""
POINTS_MAX = 400
"""Most points of a drawn trajectory."""
WARNINGS = RecordIncomplete, Fault, Degraded, ChangeRefused, *Failure.__args__
"""Events that are shown as warnings."""

_TOPICS = {"client": "flown", "server": "decided", "plan": "plan"}
_SAID = {
    "type": "object",
    "properties": {
        "process": {"type": "string"},
        "event": {"type": "object", "properties": {"type": {"type": "string"}}},
    },
}
_OPENED = {
    "type": "object",
    "properties": {
        "process": {"type": "string"},
        "name": {"type": "string"},
        "scenario": {"type": "string"},
        "parts": {"type": "object", "properties": {}},
        "wall_ns": {"type": "integer"},
        "time_ns": {"type": "integer"},
    },
}
BROKEN = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,  # a place in the file that cannot be
    TypeError,
    ValueError,
)
"""What the library, or what reads the messages, may meet in a file that is damaged."""


class RecordingError(ValueError):
    """Error: a file is no recording, or none that can be read; one line that names it."""


class Told(msgspec.Struct, frozen=True, kw_only=True):
    """An event and the process that has told it."""

    process: str
    event: Event


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording says of itself."""

    scenario: str
    """Name of the scenario."""
    seed: int
    """Seed of the flight."""
    version: str
    """Version of Skytether that flew it."""
    began: str
    """Time of day at which it began, ISO 8601; empty in virtual time."""
    offset_ns: int
    """Time of a message minus time of the frame that it was made of [ns]."""
    secure: bool
    """Whether the link was sealed."""


class Recording:
    """An MCAP file that is being written.

    Args:
        file: where it is written; nothing is read from it.
        scenario: what is flown.
        about: what it says of itself.

    Raises:
        OSError: the file cannot be written; any method may say so.
    """

    def __init__(self, file: BinaryIO, scenario: Scenario, about: About) -> None:
        self._writer = Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library=f"{OURS} {about.version}")
        self._scenario = scenario
        self._offset_ns = about.offset_ns
        self._tables: dict[tuple[str, str], rows.Table] = {}
        """Columns of each part, by process and part."""
        self._channels: dict[str, int] = {}
        self._schemas: dict[bytes, int] = {}
        self._shown: set[int] = set()
        """Vehicles whose trajectory has been drawn."""
        self._now_ns = 0
        said = msgspec.to_builtins(about)
        self._writer.add_metadata(OURS, {name: _text(value) for name, value in said.items()})
        self._attach(SCENARIO, "application/toml", to_toml(scenario))
        self.flush()

    def add(self, process: str, frame: Frame) -> None:
        """Record a frame of a process.

        Raises:
            ValueError: its rows are not what the process has said of them.
        """
        self._now_ns = max(0, frame.time_ns + self._offset_ns)
        match frame:
            case Opened():
                for part, columns in frame.parts.items():
                    self._tables[process, part] = rows.Table(columns_of(columns))
                self._put("/opened", "skytether.Opened", _OPENED, frame, {FRAME: "Opened"})
            case Said():
                self._say(process, frame.event)
            case Figures():
                schema, about = _schema_of(frame.figures), {FRAME: "Figures", "process": process}
                topic = f"/figures/{process}"
                self._put(topic, "skytether.Figures", schema, frame.figures, about)
            case Rows():
                self._add_rows(process, frame)

    def flush(self) -> None:
        """Write what has been added; from here on not even a kill can lose it."""
        self._writer.flush()

    def finish(self, summary: Summary | None) -> None:
        """Write the end of the file: the flight's summary where there is one, and an index."""
        if summary:
            self._attach(SUMMARY, "application/json", msgspec.json.encode(summary))
        self._writer.finish()
        self._writer.flush()

    def _attach(self, name: str, kind: str, content: bytes) -> None:
        self._writer.add_attachment(0, self._now_ns, name, kind, content)

    def _say(self, process: str, event: Event) -> None:
        told = Told(process=process, event=event)
        self._put("/said", "skytether.Said", _SAID, told, {FRAME: "Said"})
        level = foxglove.WARNING if isinstance(event, WARNINGS) else foxglove.INFO
        self._draw("/events", "Log", foxglove.log(self._now_ns, process, str(event), level))

    def _add_rows(self, process: str, frame: Rows) -> None:
        table = self._tables.get((process, frame.part))
        if table is None or len(frame.rows) % table.columns.itemsize:
            raise ValueError(f"{process} has no rows of {len(frame.rows)} B in {frame.part!r}")
        made = np.frombuffer(frame.rows, table.columns)
        about = {
            FRAME: "Rows",
            "process": process,
            "part": frame.part,
            "columns": msgspec.json.encode(table.columns.descr).decode(),
        }
        for row, message in zip(made, table.messages(made), strict=True):
            if "vehicle" in table.names:
                number = int(row["vehicle"])
                topic = f"/vehicle/{number}/{_TOPICS.get(frame.part, frame.part)}"
            else:
                number, topic = 0, f"/{frame.part}/packets"
            self._put(topic, f"skytether.{frame.part}", table.schema(), message, about)
            if 0 < number <= VEHICLES_MAX:
                self._draw_row(frame.part, number, row)

    def _draw_row(self, part: str, number: int, row: np.void) -> None:
        """Draw what a row says of a vehicle."""
        at, name, now_ns = f"/vehicle/{number}", f"vehicle {number}", self._now_ns
        match part:
            case "client":
                state = row["state"]
                if not np.isfinite(state).all():
                    return
                self._draw(f"{at}/pose", "PoseInFrame", foxglove.pose_in_frame(now_ns, state))
                moved = foxglove.transform(now_ns, name, state)
                self._draw(f"{at}/transform", "FrameTransform", moved)
                drawn = foxglove.vehicle(now_ns, name, state)
                self._draw(f"{at}/scene/vehicle", "SceneUpdate", drawn)
            case "server":
                if np.isfinite(row["reference"]).all():
                    drawn = foxglove.point(now_ns, f"{name}: reference", row["reference"])
                    self._draw(f"{at}/scene/reference", "SceneUpdate", drawn)
                if number not in self._shown:
                    self._shown.add(number)
                    path = trajectory(self._scenario)
                    drawn = foxglove.line(now_ns, f"{name}: trajectory", path, foxglove.GREY)
                    self._draw(f"{at}/scene/trajectory", "SceneUpdate", drawn)
            case "plan":
                path = planned(self._scenario, row)
                if np.isfinite(path).all():
                    drawn = foxglove.line(now_ns, f"{name}: plan", path, foxglove.GREEN)
                    self._draw(f"{at}/scene/plan", "SceneUpdate", drawn)

    def _draw(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        name = f"foxglove.{kind}"
        self._put(topic, name, foxglove.SCHEMAS[name], message)

    def _put(
        self,
        topic: str,
        name: str,
        schema: Mapping[str, Any],
        message: Any,
        about: Mapping[str, str] | None = None,
    ) -> None:
        """Add a message; its channel and schema, named here, come before the first of the topic."""
        channel = self._channels.get(topic)
        if channel is None:
            content = name.encode() + msgspec.json.encode(schema)
            if content not in self._schemas:
                written = msgspec.json.encode({"title": name, **schema})
                self._schemas[content] = self._writer.register_schema(name, "jsonschema", written)
            known = self._schemas[content]
            channel = self._writer.register_channel(topic, "json", known, dict(about or {}))
            self._channels[topic] = channel
        data = msgspec.json.encode(message)
        self._writer.add_message(channel, self._now_ns, data, self._now_ns)


def _text(value: str | int) -> str:
    """A value of metadata, which are texts alone: a number or flag is written as in JSON."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def trajectory(scenario: Scenario) -> Array:
    """Desired positions of a whole flight [m]; shape (points, axes)."""
    time_s = np.linspace(0.0, scenario.duration, POINTS_MAX)
    path: Array = scenario.make_reference()(time_s)[..., 0]
    return path


def planned(scenario: Scenario, row: np.void) -> Array:
    """Positions along a plan [m], from the state at its beginning on; shape (steps + 1, axes).

    Args:
        row: row of the part "plan".
    """
    model = discretise(scenario.tau_s, scenario.control.dt)
    inputs = row["inputs"] + row["disturbance"][:, np.newaxis]
    paths = []
    for axis, (p, v), along in zip(
        model.axes(), row["state"].tolist(), inputs.tolist(), strict=True
    ):
        path = [p]
        for u in along:
            p, v = advance(axis, p, v, u)  # noqa: PLW2901 - rolled along
            path.append(p)
        paths.append(path)
    return np.array(paths).T


def _schema_of(value: Any) -> dict[str, Any]:
    """JSON schema of figures such as these; what has no figure yet is left out."""
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    properties = {
        key: _schema_of(each) if isinstance(each, Mapping) else {"type": kinds[type(each)]}
        for key, each in value.items()
        if isinstance(each, Mapping) or type(each) in kinds
    }
    return {"type": "object", "properties": properties}


class Recorded:
    """A recording that is read.

    Args:
        path: its file.

    Raises:
        OSError: the file cannot be read.
        RecordingError: it is no recording, or has no end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        """Its file."""
        self._file, size = opened(path)
        self._reader = SeekingReader(self._file, validate_crcs=True, record_size_limit=size)
        try:
            self._read_ends()
        except BaseException:
            self.close()
            raise

    def _read_ends(self) -> None:
        """Read what stands before and behind the messages."""
        path = self.path
        try:
            if self._reader.get_summary() is None:
                raise ValueError
        except BROKEN:
            said = f"it has no end, as that of a killed flight; see skytether recover {path}"
            raise RecordingError(f"{path}: {said}") from None
        with reading(path):
            metadata = {each.name: each.metadata for each in self._reader.iter_metadata()}
            attached = {each.name: each.data for each in self._reader.iter_attachments()}
            summary = attached.get(SUMMARY)
            self.summary = msgspec.json.decode(summary, type=Summary) if summary else None
            """Summary of the flight; None where no vehicle has flown."""
        self.about, self.scenario = known_of(path, metadata, attached)
        self.name = self.about.scenario
        """Name of the scenario."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def parts(self) -> dict[str, Table]:
        """Rows of each part of the record, in the order in which they were made, by its name.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            messages = self._reader.iter_messages(log_time_order=False)
            return parts_of((channel, message) for _, channel, message in messages)

    def columns(self) -> dict[str, np.dtype[np.void]]:
        """Columns of each part of the record that has rows, by its name.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            summary = self._reader.get_summary()
            channels = summary.channels.values() if summary else ()
            return {
                channel.metadata["part"]: columns_of(channel.metadata["columns"])
                for channel in channels
                if "part" in channel.metadata
            }

    def frames(self) -> Iterator[Timed]:
        """Frames in the order of their times, which are counted from the first one's on [ns].

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            own = (
                (message.log_time, channel, message.data)
                for _, channel, message in self._reader.iter_messages()
                if FRAME in channel.metadata
            )
            offset_ns, begin_ns = self.about.offset_ns, None
            for (time_ns, *_), group in groupby(own, key=lambda each: _instant(*each[:2])):
                begin_ns = time_ns if begin_ns is None else begin_ns
                for process, frame in _frames(time_ns - offset_ns, group):
                    yield time_ns - begin_ns, process, frame


def summary_of(scenario: Scenario, about: About, parts: Mapping[str, Table]) -> Summary | None:
    """Summary of the first vehicle's flight; None where none has flown."""
    client = parts.get("client")
    if client is None or not len(client):
        return None
    client = client[client["vehicle"] == client["vehicle"].min()]
    others = parts.get("server"), parts.get("netem")
    return summarise(scenario, about.scenario, client, *others, secure=about.secure)


def opened(path: Path) -> tuple[BinaryIO, int]:
    """A file that begins as an MCAP file does, and its size [B]."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise RecordingError(f"{path}: it is no plain file, expected a recording ({SUFFIX})")
    file = os.fdopen(descriptor, "rb")
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        what = "it is no MCAP file" if status.st_size else "it is empty"
        raise RecordingError(f"{path}: {what}, expected a recording ({SUFFIX})")
    file.seek(0)
    return file, status.st_size


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Make one error of whatever is met in a damaged file."""
    try:
        yield
    except RecordingError:
        raise
    except BROKEN as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: it is damaged: {what}") from None


def known_of(
    path: Path, metadata: Mapping[str, Mapping[str, str]], attached: Mapping[str, bytes]
) -> tuple[About, Scenario]:
    """What a recording says of itself, and its scenario.

    Raises:
        RecordingError: there is no such thing, or none that this version knows.
    """
    if OURS not in metadata or SCENARIO not in attached:
        raise RecordingError(f"{path}: it is no recording of Skytether, or nothing is whole of it")
    with reading(path):
        about = msgspec.convert(metadata[OURS], About, strict=False)
        table = tomllib.loads(attached[SCENARIO].decode())
        try:
            return about, config.check(table, f"{path}: {SCENARIO}")
        except ConfigError as error:  # another version's, or its trajectory's file is elsewhere
            raise RecordingError(str(error)) from None


def parts_of(messages: Iterable[tuple[Channel, Message]]) -> dict[str, Table]:
    """Rows of each part, of messages of which some hold rows."""
    columns: dict[str, str] = {}
    rows_of: dict[str, list[Any]] = {}
    for channel, message in messages:
        if part := channel.metadata.get("part"):
            columns[part] = channel.metadata["columns"]
            rows_of.setdefault(part, []).append(msgspec.json.decode(message.data))
    return {part: _table(columns[part]).rows(each) for part, each in rows_of.items()}


@lru_cache(64)
def _table(columns: str) -> rows.Table:
    """What makes rows of messages, by their columns."""
    return rows.Table(columns_of(columns))


def _instant(time_ns: int, channel: Channel) -> tuple[int, str, str]:
    """What the messages of a frame have in common: time, process and part."""
    about = channel.metadata
    return time_ns, about.get("process", ""), about.get("part", "")


def _frames(
    time_ns: int, messages: Iterable[tuple[int, Channel, bytes]]
) -> Iterator[tuple[str, Frame]]:
    """Frames of the messages of an instant, with their processes: one of rows, or each its own."""
    together = list(messages)
    about = together[0][1].metadata
    if part := about.get("part"):
        decoded = [msgspec.json.decode(data) for _, _, data in together]
        made = _table(about["columns"]).rows(decoded)
        yield about["process"], Rows(part=part, time_ns=time_ns, rows=made.tobytes())
        return
    for _, channel, data in together:
        match channel.metadata[FRAME]:
            case "Opened":
                opened = msgspec.json.decode(data, type=Opened)
                yield opened.process, opened
            case "Said":
                told = msgspec.json.decode(data, type=Told)
                yield told.process, Said(time_ns=time_ns, event=told.event)
            case "Figures":
                figures = msgspec.json.decode(data)
                yield channel.metadata["process"], Figures(time_ns=time_ns, figures=figures)
