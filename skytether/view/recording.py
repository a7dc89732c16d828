"""Recordings: a flight as an MCAP file, written frame by frame, read back to the last bit, mended.

The frames of the flight's processes (`shared.telemetry.feed`) are written as messages of JSON, a
channel for each topic, in chunks that are whole as soon as they are written:

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

import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, Self

import msgspec
import numpy as np
from mcap.records import Channel, Message
from mcap.writer import Writer

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
from skytether.shared.scenario.reading import FILE_BYTES_MAX, check, to_toml
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
"""Key of a channel's metadata that names the kind of frame that its messages were made of."""
OURS = "skytether"
"""Name of the metadata that makes an MCAP file a recording, and of the library that writes it."""
SCENARIO, SUMMARY = "scenario.toml", "summary.json"
"""Names of the attachments."""
VEHICLES_MAX = 64
"""Most vehicles that are drawn; of those with larger numbers only the rows are recorded."""
CHUNK_BYTES = 256 * 1024
"""Size of the messages in a chunk from which it is written, at the latest [B]."""
POINTS_MAX = 400
"""Most points of a drawn trajectory."""
WARNINGS = RecordIncomplete, Fault, Degraded, ChangeRefused, *Failure.__args__
"""Events that are shown as warnings."""

SPAN_NS_MAX = 40 * 86_400 * SECOND_NS
"""Longest time from the first message of a recording to its last [ns]."""
ROW_TEXT_MAX = 64 * 1024
"""Largest size of a row's message [B]."""
TOGETHER = 1024
"""Most messages that are decoded before rows are made of them."""

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
            ValueError: its rows are not what the process has said of them.
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
    path: Array = scenario.given_reference()(time_s)[..., 0]
    return path


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
        self._bytes = Bounded(self._file, size)
        self._checked = False
        """Whether all rows are known to be such as a flight has."""
        try:
            self._read_ends()
        except BaseException:
            self.close()
            raise

    def _read_ends(self) -> None:
        """Read what stands before and behind the messages."""
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
        """Summary of the flight, computed where it is not in the file; None where none has flown.

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
        """Rows of each part of the record, in the order in which they were made, by its name.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            made = parts_of(self.messages(), self.scenario)
        self._checked = True
        return made

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Messages as they lie in the file, with their channels.

        Raises:
            RecordingError: the file is damaged.
        """
        with reading(self.path):
            yield from messages(self._bytes, self._index)

    def columns(self) -> dict[str, np.dtype[np.void]]:
        """Columns of each part of the record that has rows, by its name."""
        return self._columns

    def frames(self) -> Iterator[Timed]:
        """Frames in the order of their times, which are counted from the first one's on [ns].

        Raises:
            RecordingError: the file is damaged.
        """
        begin_ns = None
        for time_ns, process, frame in self.timed():
            begin_ns = time_ns if begin_ns is None else begin_ns
            yield time_ns - begin_ns, process, frame

    def timed(self) -> Iterator[Timed]:
        """Frames in the order of the times of their messages [ns].

        Raises:
            RecordingError: the file is damaged.
        """
        if not self._checked:  # all rows at once cost a fifth of what one after the other does
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
    """Summary of the first vehicle's flight; None where none has flown."""
    client = parts.get("client")
    if client is None or not len(client):
        return None
    client = client[client["vehicle"] == client["vehicle"].min()]
    others = parts.get("server"), parts.get("netem")
    return summarise(scenario, about.scenario, client, *others, secure=about.secure)


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
        if len(attached[SCENARIO]) > FILE_BYTES_MAX:
            raise ValueError(f"{SCENARIO} is larger than {FILE_BYTES_MAX} B")
        about = msgspec.convert(metadata[OURS], About, strict=False)
        table = tomllib.loads(attached[SCENARIO].decode())
        try:
            return about, check(table, f"{path}: {SCENARIO}")
        except ConfigError as error:  # another version's, or its trajectory's file is elsewhere
            raise RecordingError(str(error)) from None


def parts_of(messages: Iterable[tuple[Channel, Message]], scenario: Scenario) -> dict[str, Table]:
    """Rows of each part, of messages of which some hold rows.

    Raises:
        ValueError: they are no rows of such a scenario's flight.
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
    """What makes rows of messages, by their columns."""
    return rows.RowTable(columns_of(columns))


@lru_cache(8)
def _check_begun(scenario: str) -> None:
    """Refuse the scenario of a process; the same one, told thousands of times, costs once.

    Raises:
        ConfigError: what is wrong with it.
        ValueError: it is no TOML.
    """
    check(tomllib.loads(scenario), "the scenario of a process")


def columns_in(channel: Channel, scenario: Scenario) -> np.dtype[np.void]:
    """Columns of the rows of a channel.

    Raises:
        ValueError: a flight of this scenario has no such part, or other columns in it.
    """
    part, columns = channel.metadata["part"], _table(channel.metadata["columns"]).columns
    rows.check_columns(part, columns, scenario)
    return columns


def _rows(channel: Channel, given: Sequence[bytes], scenario: Scenario) -> Table:
    """Rows of the messages of a channel.

    Raises:
        ValueError: they are none, or none of such a scenario's flight.
    """
    if (most := max(map(len, given))) > ROW_TEXT_MAX:
        raise ValueError(f"a row of {most} B, expected at most {ROW_TEXT_MAX} B")
    columns_in(channel, scenario)
    return _table(channel.metadata["columns"]).rows(map(msgspec.json.decode, given))


def _instant(time_ns: int, channel: Channel) -> tuple[int, str, str]:
    """What the messages of a frame have in common: time, process and part."""
    about = channel.metadata
    return time_ns, about.get("process", ""), about.get("part", "")


def _frames(
    time_ns: int, messages: Iterable[tuple[int, Channel, bytes]], scenario: Scenario
) -> Iterator[tuple[str, Frame]]:
    """Frames of the messages of an instant, with their processes: one of rows, or each its own."""
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
