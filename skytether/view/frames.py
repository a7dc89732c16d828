"""Frames of a flight in virtual time, as its processes would send them over UDP."""

from collections.abc import Iterator
from heapq import merge

import numpy as np

from skytether.shared.events.flight import Flying
from skytether.shared.law.model import Indices
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import Figures, Frame, Opened, Said, described
from skytether.shared.telemetry.feed import Rows as RowsFrame
from skytether.shared.telemetry.record import Record, Rows

Timed = tuple[int, str, Frame]
"""Time [ns], process name and frame."""
PROCESSES = {"client": "client", "server": "server", "plan": "server", "netem": "netem"}
"""Name of the process that records each part, by the part's name."""


def of_flight(scenario: Scenario, name: str, flight: Record) -> Iterator[Timed]:
    """Frames of a flight in virtual time, in order of time, from time 0 on.

    Args:
        name: name of the scenario.
    """
    begins = _begins(flight)
    parts: dict[str, Rows] = {part: getattr(flight, part) for part in PROCESSES}
    streams = [
        _rows(part, rows, _times_ns(scenario, part, rows, begins)) for part, rows in parts.items()
    ]
    toml = to_toml(scenario).decode()
    for process in dict.fromkeys(PROCESSES.values()):
        columns = described({p: rows.dtype for p, rows in parts.items() if PROCESSES[p] == process})
        opened = Opened(
            process=process, name=name, scenario=toml, parts=columns, wall_ns=0, time_ns=0
        )
        yield 0, process, opened
    events = (
        (each.time_ns, each.process, Said(time_ns=each.time_ns, event=each.event))
        for each in flight.events
    )
    end_ns = 0
    for timed in merge(events, *streams, key=lambda each: each[0]):
        end_ns = timed[0]
        yield timed
    for process, figures in flight.figures.items():
        yield end_ns, process, Figures(time_ns=end_ns, figures=dict(figures))


def _begins(flight: Record) -> Indices:
    begins = {
        event.vehicle: time_ns
        for time_ns, _, event in reversed(flight.events)
        if isinstance(event, Flying)
    }
    return np.array([begins.get(n, 0) for n in range(max(begins, default=0) + 1)], dtype=np.int64)


def _times_ns(scenario: Scenario, part: str, rows: Rows, begins: Indices) -> Indices:
    """Time of each row [ns], raised so that it never decreases."""
    if part == "netem":
        times_ns = rows["arrived_ns"]
    else:
        at = np.minimum(rows["vehicle"], len(begins) - 1)
        times_ns = begins[at] + rows["step"] * scenario.dt_ns
    return np.maximum.accumulate(np.maximum(times_ns, 0)) if len(rows) else times_ns


def _rows(part: str, rows: Rows, times_ns: Indices) -> Iterator[Timed]:
    """Frames of a part; rows with the same time are in one frame."""
    starts = np.flatnonzero(np.diff(times_ns, prepend=-1))
    ends = np.append(starts[1:], len(rows))[: len(starts)]
    for begin, end in zip(starts, ends, strict=True):
        time_ns = int(times_ns[begin])
        piece = rows[begin:end].tobytes()
        yield time_ns, PROCESSES[part], RowsFrame(part=part, time_ns=time_ns, rows=piece)
