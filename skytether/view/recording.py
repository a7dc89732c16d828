"""Recordings: a flight as an MCAP file, written frame by frame, and read back to the last bit.

The frames of the flight's processes (`shared.telemetry.feed`) are written as messages of JSON, a
channel for each topic, in chunks that are complete as soon as they are written:

    /opened              a process, its scenario and the columns of its rows
    /vehicle/N/flown     rows of the client's part, see `view.rows`
    /vehicle/N/decided   rows of the server's part
    /vehicle/N/plan      rows of its plans
    /netem/packets       rows of netem's part
    /said                events, as a program reads them
    /figures/PROCESS     numbers counted so far

These messages are the flight. Further messages are drawn by Foxglove and Lichtblick: /events, and
for each of the first VEHICLES_MAX vehicles /vehicle/N/pose, /vehicle/N/transform and, below
/vehicle/N/scene, the vehicle, its plan, where it should be and its trajectory. The scenario and, at
the end, the summary are attachments.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, Self

import msgspec
import numpy as np
from mcap.records import Channel, Message
from mcap.writer import Writer

from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError, RecordingError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.events import (
    ChangeRefused,
    Degraded,
    Event,
    Failure,
    Fault,
    RecordIncomplete,
)
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import check, to_toml
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.feed import Figures, Frame, Opened, Rows, Said, columns_of
from skytether.shared.telemetry.record import Rows as Table
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.view import foxglove, rows
from skytether.view.container import (
    BROKEN,
    Bounded,
    attached,
    in_time,
    index_of,
    messages,
    opened,
    reading,
)
from skytether.view.frames import Timed

FRAME = "frame"
"""Key in a channel's metadata: the kind of frame that its messages were made of."""
OURS = "skytether"
"""Name of the metadata that marks an MCAP file as a recording, and of the writing library."""
SCENARIO, SUMMARY = "scenario.toml", "summary.json"
"""Names of the attachments."""
VEHICLES_MAX = 64
"""Most vehicles that are drawn; for larger numbers only rows are recorded."""
CHUNK_BYTES = 256 * 1024
"""Size of messages after which a chunk is written [B]."""
POINTS_MAX = 400
"""Most points of a drawn trajectory."""
WARNINGS = RecordIncomplete, Fault, Degraded, ChangeRefused, *Failure.__args__
"""Events that are shown as warnings."""

SPAN_NS_MAX = 40 * 86_400 * SECOND_NS
"""Longest time from the first message of a recording to its last [ns]."""
ROW_TEXT_MAX = 64 * 1024
"""Largest size of a row's message [B]."""
TOGETHER = 1024
"""Most messages that are decoded before they become rows."""

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


class EventLine(msgspec.Struct, frozen=True, kw_only=True):
    """Event and the process that reported it."""

    process: str
    event: Event


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a recording, kept in its metadata."""

    scenario: str
    """Name of the scenario."""
    seed: int
    """Seed of the flight."""
    version: str
    """Version of Skytether that flew it."""
    began: str
    """Time of day at the beginning, ISO 8601; empty in virtual time."""
    offset_ns: int
    """Time of a message minus time of its frame [ns]."""
    secure: bool
    """Whether the link was encrypted."""


class Recording:
    """Recording that is being written as an MCAP file.

    Args:
        file: file opened for writing.
        scenario: what is flown.
        about: facts for its metadata.

    Raises:
        OSError: the file cannot be written; any method may raise this.
    """

    def __init__(self, file: BinaryIO, scenario: Scenario, about: About) -> None:
        self._writer = Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library=f"{OURS} {about.version}")
        self._scenario = scenario
        self._offset_ns = about.offset_ns
        self._tables: dict[tuple[str, str], rows.RowTable] = {}
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
            ValueError: the rows do not match the columns that the process announced.
        """
        self._now_ns = max(0, frame.time_ns + self._offset_ns)
        match frame:
            case Opened():
                for part, columns in frame.parts.items():
                    self._tables[process, part] = rows.RowTable(columns_of(columns))
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
        """Write all that was added; after this, a kill does not lose it."""
        self._writer.flush()

    def finish(self, summary: Summary | None) -> None:
        """Write the end of the file: the summary, if there is one, and an index."""
        if summary:
            self._attach(SUMMARY, "application/json", msgspec.json.encode(summary))
        self._writer.finish()
        self._writer.flush()

    def _attach(self, name: str, kind: str, content: bytes) -> None:
        self._writer.add_attachment(0, self._now_ns, name, kind, content)

    def _say(self, process: str, event: Event) -> None:
        told = EventLine(process=process, event=event)
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
        """Add the drawn messages of a row."""
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
                path = rows.planned(self._scenario, row)
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
        """Add a message; its channel and schema are written before the first message of a topic."""
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
    """Metadata value as text, the only type there; numbers and flags as in JSON."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def trajectory(scenario: Scenario) -> Array:
    """Desired positions of a whole flight [m]; shape (points, axes)."""
    time_s = np.linspace(0.0, scenario.duration, POINTS_MAX)
    path: Array = scenario.given_reference()(time_s)[..., 0]
    return path


def _schema_of(value: Any) -> dict[str, Any]:
    """JSON schema of figures; groups that are still empty are left out."""
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    properties = {
        key: _schema_of(each) if isinstance(each, Mapping) else {"type": kinds[type(each)]}
        for key, each in value.items()
        if isinstance(each, Mapping) or type(each) in kinds
    }
    return {"type": "object", "properties": properties}


class Recorded:
    """Recording that is read.

    Args:
        path: its file.

    Raises:
        OSError: the file cannot be read.
        RecordingError: the file is no recording, or has no end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        """File of the recording."""
        self._file, size = opened(path)
        self._bytes = Bounded(self._file, size)
        self._checked = False
        """Whether all rows were checked to be those of a possible flight."""
        try:
            self._read_ends()
        except BaseException:
            self.close()
            raise

    def _read_ends(self) -> None:
        """Read the metadata and attachments."""
        path = self.path
        try:
            self._index = index_of(self._bytes)
        except BROKEN:
            said = f"it has no end, as that of a killed flight; see skytether recover {path}"
            raise RecordingError(f"{path}: {said}") from None
        with reading(path):
            metadata, attachments = attached(self._bytes, self._index)
            summary = attachments.get(SUMMARY)
            self._summary = msgspec.json.decode(summary, type=Summary) if summary else None
        self.about, self.scenario = known_of(path, metadata, attachments)
        self.name = self.about.scenario
        """Name of the scenario."""
        with reading(path):
            self._columns = {
                channel.metadata["part"]: columns_in(channel, self.scenario)
                for channel in self._index.channels.values()
                if "part" in channel.metadata
            }

    @cached_property
    def summary(self) -> Summary | None:
        """Summary of the flight, computed if the file has none; None where nothing was flown.

        Raises:
            RecordingError: the file is damaged.
        """
        return self._summary or summary_of(self.scenario, self.about, self.parts())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def parts(self) -> dict[str, Table]:
        """Rows of each part of the record by its name, in the order of recording.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            made = parts_of(self.messages(), self.scenario)
        self._checked = True
        return made

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Messages in file order, with their channels.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            yield from messages(self._bytes, self._index)

    def columns(self) -> dict[str, np.dtype[np.void]]:
        """Columns of each part of the record that has rows, by its name."""
        return self._columns

    def frames(self) -> Iterator[Timed]:
        """Frames in order of time, counted from the first one [ns].

        Raises:
            RecordingError: the file is damaged.
        """
        begin_ns = None
        for time_ns, process, frame in self.timed():
            begin_ns = time_ns if begin_ns is None else begin_ns
            yield time_ns - begin_ns, process, frame

    def timed(self) -> Iterator[Timed]:
        """Frames in order of their messages' time [ns].

        Raises:
            RecordingError: the file is damaged.
        """
        # all rows of an instant at once cost a fifth of decoding them one by one
        if not self._checked:
            self.parts()
        with reading(self.path):
            own = (
                (message.log_time, channel, message.data)
                for channel, message in in_time(self._bytes, self._index)
                if FRAME in channel.metadata
            )
            begin_ns = None
            for (time_ns, *_), group in groupby(own, key=lambda each: _instant(*each[:2])):
                begin_ns = time_ns if begin_ns is None else begin_ns
                if time_ns - begin_ns > SPAN_NS_MAX:
                    raise ValueError(f"a message {time_ns - begin_ns} ns after the first")
                for process, frame in _frames(time_ns - self.about.offset_ns, group, self.scenario):
                    yield time_ns, process, frame


def summary_of(scenario: Scenario, about: About, parts: Mapping[str, Table]) -> Summary | None:
    """Summary of the first vehicle's flight; None where nothing was flown."""
    client = parts.get("client")
    if client is None or not len(client):
        return None
    client = client[client["vehicle"] == client["vehicle"].min()]
    others = parts.get("server"), parts.get("netem")
    return summarise(scenario, about.scenario, client, *others, secure=about.secure)


def known_of(
    path: Path, metadata: Mapping[str, Mapping[str, str]], attached: Mapping[str, bytes]
) -> tuple[About, Scenario]:
    """Facts about a recording, and its scenario.

    Raises:
        RecordingError: they are missing, or of an unknown version.
    """
    if OURS not in metadata or SCENARIO not in attached:
        raise RecordingError(f"{path}: it is no recording of Skytether, or nothing is whole of it")
    with reading(path):
        about = msgspec.convert(metadata[OURS], About, strict=False)
        table = toml.loads(attached[SCENARIO].decode())
        try:
            return about, check(table, f"{path}: {SCENARIO}")
        # written by another version, or its trajectory's file is on another machine
        except ConfigError as error:
            raise RecordingError(str(error)) from None


def parts_of(messages: Iterable[tuple[Channel, Message]], scenario: Scenario) -> dict[str, Table]:
    """Rows of each part, from messages of any kind.

    Raises:
        ValueError: they are no rows of a flight of this scenario.
    """
    columns: dict[str, np.dtype[np.void]] = {}
    pieces: dict[str, list[bytes]] = {}
    waiting: dict[str, tuple[Channel, list[bytes]]] = {}

    def convert(channel: Channel, given: list[bytes]) -> None:
        part = channel.metadata["part"]
        made = _rows(channel, given, scenario)
        if columns.setdefault(part, made.dtype) != made.dtype:
            raise ValueError(f"the part {part} has columns of two kinds")
        pieces.setdefault(part, []).append(made.tobytes())

    for channel, message in messages:
        part = channel.metadata.get("part")
        if not part:
            continue
        before, given = waiting.setdefault(part, (channel, []))
        if len(given) == TOGETHER or before.metadata["columns"] != channel.metadata["columns"]:
            convert(before, given)
            waiting[part] = channel, (given := [])
        given.append(message.data)
    for channel, given in waiting.values():
        convert(channel, given)
    made = {part: np.frombuffer(b"".join(pieces[part]), columns[part]) for part in pieces}
    for part, table in made.items():
        rows.check_values(part, table, scenario)
    return made


@lru_cache(64)
def _table(columns: str) -> rows.RowTable:
    """Converter of messages to rows, by their columns."""
    return rows.RowTable(columns_of(columns))


@lru_cache(8)
def _check_begun(scenario: str) -> None:
    """Check the scenario of a process; equal ones, which may come thousands of times, only once.

    Raises:
        ConfigError: the scenario is invalid.
        ValueError: the text is no TOML.
    """
    check(toml.loads(scenario), "the scenario of a process")


def columns_in(channel: Channel, scenario: Scenario) -> np.dtype[np.void]:
    """Columns of the rows of a channel.

    Raises:
        ValueError: flights of this scenario have no such part, or other columns in it.
    """
    part, columns = channel.metadata["part"], _table(channel.metadata["columns"]).columns
    rows.check_columns(part, columns, scenario)
    return columns


def _rows(channel: Channel, given: Sequence[bytes], scenario: Scenario) -> Table:
    """Rows of the messages of a channel.

    Raises:
        ValueError: they are no rows of a flight of this scenario.
    """
    if (most := max(map(len, given))) > ROW_TEXT_MAX:
        raise ValueError(f"a row of {most} B, expected at most {ROW_TEXT_MAX} B")
    columns_in(channel, scenario)
    return _table(channel.metadata["columns"]).rows(map(msgspec.json.decode, given))


def _instant(time_ns: int, channel: Channel) -> tuple[int, str, str]:
    """Time, process and part, which all messages of a frame share."""
    about = channel.metadata
    return time_ns, about.get("process", ""), about.get("part", "")


def _frames(
    time_ns: int, messages: Iterable[tuple[int, Channel, bytes]], scenario: Scenario
) -> Iterator[tuple[str, Frame]]:
    """Frames of an instant's messages, with their processes: rows share a frame, others have their
    own.
    """
    together = list(messages)
    first = together[0][1]
    if part := first.metadata.get("part"):
        made = _rows(first, [data for _, _, data in together], scenario)
        rows_ = Rows(part=part, time_ns=time_ns, rows=made.tobytes())
        yield first.metadata["process"], rows_
        return
    for _, channel, data in together:
        match channel.metadata[FRAME]:
            case "Opened":
                begun = msgspec.json.decode(data, type=Opened)
                _check_begun(begun.scenario)
                for name, columns in begun.parts.items():
                    rows.check_columns(name, _table(columns).columns, scenario)
                yield begun.process, begun
            case "Said":
                told = msgspec.json.decode(data, type=EventLine)
                yield told.process, Said(time_ns=time_ns, event=told.event)
            case "Figures":
                figures = msgspec.json.decode(data)
                yield channel.metadata["process"], Figures(time_ns=time_ns, figures=figures)
