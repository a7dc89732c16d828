"""Reader of recordings: a flight's frames and rows, equal to the last bit.

A file is not trusted: `container` bounds time and memory, and frames that are impossible in a
flight of the scenario are refused.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skytether.shared.base import toml
from skytether.shared.base.errors import RecordingError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.events.flight import Event, Failure, RecordIncomplete, VehicleEvent
from skytether.shared.events.processes import Counted
from skytether.shared.law.model import Indices
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import drops, ends, feed
from skytether.shared.telemetry.feed import Figures, Frame, Opened, Rows, Said, columns_of
from skytether.shared.telemetry.record import FlightEvent, Record
from skytether.shared.telemetry.record import Rows as Table
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.view.frames import Timed
from skytether.view.recordings.container import Container, reading
from skytether.view.recordings.recording import BEGUN, FEED, About, Begun
from skytether.view.rows import check_columns, check_values, no_rows

SPAN_NS_MAX = 40 * 86_400 * SECOND_NS
"""Longest time from the first frame of a recording to its last [ns]."""
TIME_NS_MAX = 2**62
"""Largest time of a frame, and largest offset of a clock [ns]."""


@dataclass(frozen=True)
class Recorded:
    path: Path
    about: About
    """Name of the scenario, seed, version and clock."""
    scenario: Scenario
    frames: Sequence[Timed]
    """Frames in order of time; times count from the first frame [ns]."""
    parts: Mapping[str, Table]
    """Rows of each part of the record that has rows, by the part's name, in order of recording."""
    times_ns: Mapping[str, Indices]
    """Time of each row of `parts`, counted from the first frame [ns]."""
    lost_bytes: int | None
    """Number of bytes lost at the end of an incomplete file; None for a complete file."""
    damaged_bytes: int = 0
    """Number of bytes of damaged records in a complete file, which are skipped."""

    @cached_property
    def summary(self) -> Summary | None:
        """Summary of the first vehicle's flight; None if no step was flown."""
        return summary_of(self.scenario, self.about, self.parts, self.figures)

    @cached_property
    def figures(self) -> dict[str, dict[str, Any]]:
        return {
            process: frame.figures
            for _, process, frame in self.frames
            if isinstance(frame, Figures)
        }

    @property
    def can_be_explained(self) -> bool:
        """Whether the flight can be flown again; over UDP only with the packets of both ends."""
        return not self.about.began or (ends.PART in self.parts and not self.scenario.keeps_apart)

    @property
    def ways(self) -> Directions:
        """Names of both directions of the recorded network."""
        opened = (frame for *_, frame in self.frames if isinstance(frame, Opened))
        return next((each.directions for each in opened if each.directions != FLIGHT), FLIGHT)

    @property
    def begin_ns(self) -> int:
        """Time of the first frame [ns; clock of the processes]."""
        return self.frames[0][2].time_ns if self.frames else 0

    @cached_property
    def record(self) -> Record:
        """Record of the flight; its times count from the first frame."""
        events: list[FlightEvent] = []
        figures: dict[str, Any] = {}
        for time_ns, process, frame in self.frames:
            match frame:
                case Said():
                    events.append(FlightEvent(time_ns, process, frame.event))
                case Figures():
                    figures[process] = frame.figures
        parts: dict[str, Any] = no_rows(self.scenario)
        parts |= {part: rows for part, rows in self.parts.items() if part in parts}
        parts["netem"] = parts["netem"].copy()
        parts["netem"]["arrived_ns"] -= self.begin_ns
        log_events = [each.event for each in events]
        return Record(
            **parts,
            failure=_failure(events),
            figures=figures,
            events=tuple(events),
            incomplete=tuple(event for event in log_events if isinstance(event, RecordIncomplete)),
        )

    def events(self) -> Iterator[tuple[int, str, Event]]:
        """Time [ns], process and event of all events except `Counted`."""
        for time_ns, process, frame in self.frames:
            if isinstance(frame, Said) and not isinstance(frame.event, Counted):
                yield time_ns, process, frame.event


def summary_of(
    scenario: Scenario,
    about: About,
    parts: Mapping[str, Table],
    figures: Mapping[str, Mapping[str, Any]],
) -> Summary | None:
    """Summary of the first vehicle's flight; None if no step was flown."""
    client = parts.get("client")
    if client is None or not len(client):
        return None
    client = client[client["vehicle"] == client["vehicle"].min()]
    rows = client, parts.get("server"), parts.get("netem")
    return summarise(scenario, about.scenario, *rows, figures=figures, secure=about.secure)


def read(path: Path) -> Recorded:
    """Read a recording. If its writer was killed, the result ends with the last complete record;
    damaged records are skipped.

    Raises:
        OSError: the file cannot be read.
        RecordingError: the file is not a recording, or its first record is damaged.
    """
    with closing(Container(path)) as file, reading(path):
        messages = file.messages()
        topic, data = next(messages, ("", b""))
        if topic != BEGUN:
            message = "it is not a recording of Skytether, or its first message is damaged"
            raise RecordingError(f"{path}: {message}")
        begun = msgspec.msgpack.decode(data, type=Begun)
        if abs(begun.about.offset_ns) > TIME_NS_MAX:
            raise ValueError(f"the clock offset {begun.about.offset_ns} ns is too large")
        scenario = check(toml.loads(begun.scenario), "its scenario", any_network=True)
        frames = _Frames(scenario)
        for topic, data in messages:
            if topic.startswith(FEED):
                process, frame = topic.removeprefix(FEED), feed.unpack(data)
                if file.damaged_bytes and not frames.knows(process, frame):
                    file.damaged_bytes += len(data)
                else:
                    frames.add(process, frame)
        lost_bytes = None if file.is_whole else file.lost_bytes
        together = frames.together()
        return Recorded(path, begun.about, scenario, *together, lost_bytes, file.damaged_bytes)


class _Frames:
    """Frames of a recording; checks each frame.

    Args:
        scenario: scenario of the flight.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._frames: list[tuple[str, Frame]] = []
        self._columns: dict[tuple[str, str], np.dtype[np.void]] = {}
        self._begun_ns: dict[str, int] = {}
        self._rows: dict[str, list[tuple[int, Table]]] = {}
        """Time [ns] and rows of each frame with rows, by name of the part."""

    def knows(self, process: str, frame: Frame) -> bool:
        """Whether the columns of a frame's rows were announced."""
        return not isinstance(frame, Rows) or (process, frame.part) in self._columns

    def add(self, process: str, frame: Frame) -> None:
        """Add a frame.

        Raises:
            ValueError: the frame is impossible in flights of this scenario.
        """
        if abs(frame.time_ns) > TIME_NS_MAX:
            raise ValueError(f"a frame has the impossible time {frame.time_ns} ns")
        match frame:
            case Opened():
                self._begun_ns[process] = frame.time_ns
                _check_begun(frame.scenario)
                for part, described in frame.parts.items():
                    columns = self._columns[process, part] = _columns(described)
                    check_columns(part, columns, self._scenario)
            case Rows():
                row_type = self._columns.get((process, frame.part))
                if row_type is None:
                    raise ValueError(f"{process[:20]} has no part {frame.part[:20]!r}")
                if frame.time_ns < self._begun_ns[process]:
                    raise ValueError(f"rows of {process[:20]} before its first frame")
                rows = self._rows.setdefault(frame.part, [])
                rows.append((frame.time_ns, feed.table(frame.rows, row_type)))
                if rows[0][1].dtype != row_type:
                    raise ValueError(f"the part {frame.part} has two sets of columns")
            case Figures():
                drops.counted(frame.figures)
        self._frames.append((process, frame))

    def together(self) -> tuple[list[Timed], dict[str, Table], dict[str, Indices]]:
        """All frames in order of time; rows of each part, and times of the rows.

        Raises:
            ValueError: the recording is too long for a flight, or has impossible rows.
        """
        ordered = sorted(self._frames, key=lambda each: each[1].time_ns)
        begin_ns = ordered[0][1].time_ns if ordered else 0
        timed = [(frame.time_ns - begin_ns, process, frame) for process, frame in ordered]
        if timed and timed[-1][0] > SPAN_NS_MAX:
            raise ValueError(f"the last frame is {timed[-1][0]} ns after the first")
        parts, times_ns = {}, {}
        for part, frames in self._rows.items():
            begins_ns, tables = zip(*frames, strict=True)
            parts[part] = np.concatenate(tables)
            times_ns[part] = np.repeat(np.array(begins_ns) - begin_ns, list(map(len, tables)))
            check_values(part, parts[part], self._scenario)
        return timed, parts, times_ns


@lru_cache(64)
def _columns(described: str) -> np.dtype[np.void]:
    return columns_of(described)


@lru_cache(8)
def _check_begun(scenario: str) -> None:
    """Check a process's scenario; cached, because many processes may have the same scenario."""
    check(toml.loads(scenario), "the scenario of a process", any_network=True)


def _failure(events: list[FlightEvent]) -> Failure | None:
    """Failure of the lowest-numbered vehicle whose last event is a failure, or None."""
    last: dict[int, Event] = {
        each.event.vehicle: each.event
        for each in events
        if each.process == "client" and isinstance(each.event, VehicleEvent)
    }
    ends = (event for _, event in sorted(last.items()))
    return next((event for event in ends if isinstance(event, Failure)), None)
