"""Recordings: a flight as an MCAP file, for Skytether and for other programs.

Frames are written as they come from the processes' feeds, encoded as msgpack
(`shared.telemetry.feed`). `recorded` reads only these topics:

    /recording           facts about the recording, a `Begun`; the first message
    /feed/PROCESS        frames of a process
    /copy/…              copy of the first message of each topic above

Other programs get a channel of JSON for each topic:

    /vehicle/N/flown     rows of the client's part, see `view.rows`
    /vehicle/N/decided   rows of the server's part
    /vehicle/N/plan      rows of the plans for the vehicle
    /netem/packets       rows of netem's part
    /said                events
    /figures/PROCESS     counters so far

Foxglove and Lichtblick draw /events, and for each of the first VEHICLES_MAX vehicles
/vehicle/N/pose, /vehicle/N/transform and, below /vehicle/N/scene, the vehicle, its plan, its
desired position and its trajectory. The scenario and, at the end, the summary are attachments. A
chunk is complete as soon as it is written. The first message of each topic that `recorded` reads
has its own chunk, and its copy the next chunk, so that the rest can be read if either is lost.
"""

from collections.abc import Mapping
from typing import Any, BinaryIO

import msgspec
import numpy as np

from skytether.shared.events.flight import (
    ChangeRefused,
    Degraded,
    Event,
    Failure,
    Fault,
    RecordIncomplete,
)
from skytether.shared.formats import foxglove
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import feed
from skytether.shared.telemetry.feed import Figures, Frame, Opened, Rows, Said, columns_of
from skytether.shared.telemetry.record import Rows as Table
from skytether.shared.telemetry.summary import Summary
from skytether.view import rows
from skytether.view.recordings.container import COPY, COPY_OF, ENCODING

BEGUN, FEED = "/recording", "/feed/"
"""Topic of the first message, and the prefix of the topics of frames."""
OURS = "skytether"
"""Name of the metadata record and of the writing library in the file."""
SCENARIO, SUMMARY = "scenario.toml", "summary.json"
VEHICLES_MAX = 64
"""Largest number of vehicles with messages for drawings; further vehicles have only rows."""
CHUNK_BYTES = 256 * 1024
POINTS_MAX = 400
WARNINGS = RecordIncomplete, Fault, Degraded, ChangeRefused, Failure

_TOPICS = {"client": "flown", "server": "decided", "plan": "plan"}
_SAID = {
    "type": "object",
    "properties": {
        "process": {"type": "string"},
        "event": {"type": "object", "properties": {"type": {"type": "string"}}},
    },
}


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a recording, also kept in its metadata."""

    scenario: str
    seed: int
    version: str
    began: str
    """Time of day at the start of the recording, ISO 8601; empty in virtual time."""
    offset_ns: int
    """Time of a message minus time of its frame [ns]."""
    secure: bool


class Begun(msgspec.Struct, frozen=True, kw_only=True):
    """First message of a recording."""

    about: About
    scenario: str


class Recording:
    """Recording that is being written as an MCAP file.

    Raises:
        OSError: the file cannot be written; any method may raise this.
    """

    def __init__(self, file: BinaryIO, scenario: Scenario, about: About) -> None:
        self._channels = foxglove.Channels(file, f"{OURS} {about.version}", CHUNK_BYTES)
        self._writer = self._channels.writer
        self._scenario = scenario
        self._offset_ns = about.offset_ns
        self._tables: dict[tuple[str, str], rows.RowTable] = {}
        self._shown: set[int] = set()
        toml = to_toml(scenario)
        begun = Begun(about=about, scenario=toml.decode())
        self._add_twice(BEGUN, msgspec.msgpack.encode(begun))
        facts = msgspec.to_builtins(about)
        self._writer.add_metadata(OURS, {name: _text(value) for name, value in facts.items()})
        self._attach(SCENARIO, "application/toml", toml)
        self.flush()

    def add(self, process: str, frame: Frame) -> None:
        """Record a frame of a process.

        Raises:
            ValueError: the rows do not match the columns that the process announced.
        """
        self._channels.now_ns = max(0, frame.time_ns + self._offset_ns)
        match frame:
            case Opened():
                for part, columns in frame.parts.items():
                    self._tables[process, part] = rows.RowTable(columns_of(columns))
                if (f"{FEED}{process}", "") in self._channels.numbers:
                    self._add_frame(process, frame)
                else:
                    self._add_twice(f"{FEED}{process}", feed.pack(frame))
            case Said():
                self._add_frame(process, frame)
                self._say(process, frame.event)
            case Figures(figures=figures):
                self._add_frame(process, frame)
                self._channels.put(
                    f"/figures/{process}", "skytether.Figures", _schema_of(figures), figures
                )
            case Rows():
                table = self._tables.get((process, frame.part))
                if table is None:
                    raise ValueError(f"{process} has no part {frame.part!r}")
                made = feed.table(frame.rows, table.columns)
                self._add_frame(process, frame)
                self._put_rows(frame.part, table, made)

    def flush(self) -> None:
        """Write everything added so far, so that it survives a kill of the process."""
        self._writer.flush()

    def finish(self, summary: Summary | None) -> None:
        """Write the end of the file: the summary, if there is one, and an index."""
        if summary:
            self._attach(SUMMARY, "application/json", msgspec.json.encode(summary))
        self._writer.finish()
        self._writer.flush()

    def _attach(self, name: str, kind: str, content: bytes) -> None:
        self._writer.add_attachment(0, self._channels.now_ns, name, kind, content)

    def _add_frame(self, process: str, frame: Frame) -> None:
        """Add a frame unchanged, to be read by `recorded`."""
        self._channels.add(f"{FEED}{process}", ENCODING, feed.pack(frame))

    def _add_twice(self, topic: str, content: bytes) -> None:
        """Add the first message of a topic, without which the topic is unreadable, and its copy."""
        self.flush()
        self._channels.add(topic, ENCODING, content)
        self.flush()
        original = {COPY_OF: str(self._channels.numbers[topic, ""])}
        copy = self._writer.register_channel(f"{COPY}{topic}", ENCODING, 0, original)
        now_ns = self._channels.now_ns
        self._writer.add_message(copy, now_ns, content, now_ns)
        self.flush()

    def _say(self, process: str, event: Event) -> None:
        self._channels.put("/said", "skytether.Said", _SAID, {"process": process, "event": event})
        level = foxglove.WARNING if isinstance(event, WARNINGS) else foxglove.INFO
        self._channels.draw("/events", "Log", foxglove.log(process, str(event), level))

    def _put_rows(self, part: str, table: rows.RowTable, made: Table) -> None:
        """For each row, add a message for other programs, and messages that draw the row."""
        for row, message in zip(made, table.messages(made), strict=True):
            number = int(row["vehicle"]) if "vehicle" in table.names else 0
            at = f"/vehicle/{number}/{_TOPICS.get(part, part)}" if number else f"/{part}/packets"
            self._channels.put(at, f"skytether.{part}", table.schema, message)
            if 0 < number <= VEHICLES_MAX:
                self._draw_row(part, number, row)

    def _draw_row(self, part: str, number: int, row: np.void) -> None:
        at, name = f"/vehicle/{number}", f"vehicle {number}"
        channels, now_ns = self._channels, self._channels.now_ns
        match part:
            case "client":
                state = row["state"]
                if not np.isfinite(state).all():
                    return
                channels.draw(f"{at}/pose", "PoseInFrame", foxglove.pose_in_frame(state))
                moved = foxglove.transform(name, state)
                channels.draw(f"{at}/transform", "FrameTransform", moved)
                drawn = foxglove.vehicle(now_ns, name, state)
                channels.draw(f"{at}/scene/vehicle", "SceneUpdate", drawn)
            case "server":
                if np.isfinite(row["reference"]).all():
                    drawn = foxglove.point(now_ns, f"{name}: reference", row["reference"])
                    channels.draw(f"{at}/scene/reference", "SceneUpdate", drawn)
                if number not in self._shown:
                    self._shown.add(number)
                    path = trajectory(self._scenario)
                    drawn = foxglove.line(now_ns, f"{name}: trajectory", path, foxglove.GREY)
                    channels.draw(f"{at}/scene/trajectory", "SceneUpdate", drawn)
            case "plan":
                path = rows.planned(self._scenario, row)
                if np.isfinite(path).all():
                    drawn = foxglove.line(now_ns, f"{name}: plan", path, foxglove.GREEN)
                    channels.draw(f"{at}/scene/plan", "SceneUpdate", drawn)


def _text(value: str | int) -> str:
    """Metadata value as text, because MCAP metadata has only texts; numbers as in JSON."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def trajectory(scenario: Scenario) -> Array:
    """Desired positions of a whole flight [m]; shape (points, axes)."""
    time_s = np.linspace(0.0, scenario.duration, POINTS_MAX)
    path: Array = scenario.unallocated_reference()(time_s)[..., 0]
    return path


def _schema_of(value: Any) -> dict[str, Any]:
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    properties = {
        key: _schema_of(each) if isinstance(each, Mapping) else {"type": kinds[type(each)]}
        for key, each in value.items()
        if isinstance(each, Mapping) or type(each) in kinds
    }
    return {"type": "object", "properties": properties}
