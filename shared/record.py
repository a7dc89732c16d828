"""What a process writes down about a flight: rows of one numpy structured type.

Each process keeps its own part: the client what flew, the server what it thought, netem the fate of
every packet. A part is a line of JSON that names the columns, then the rows as they are in memory.
So a part may end anywhere, as that of a process that is killed does: half a row is left out.
"""

import json
import math
from enum import IntEnum
from pathlib import Path
from struct import Struct
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.void]


class Reason(IntEnum):
    """Cause of what a vehicle does, see `client.failsafe`."""

    BEGUN = 0
    OPENED = 1
    GOOD = 2
    UNARMED = 3
    HORIZON = 4
    OLD = 5
    ENDED = 6
    LOST = 7
    CLOSED = 8
    RESTARTED = 9
    LATE = 10
    MALFORMED = 11
    RESYNC = 12
    STALLED = 13
    STILL = 14
    ALONE = 15
    NOT_FINITE = 16

    def __str__(self) -> str:
        return REASON_TEXTS[self]


REASON_TEXTS = {
    Reason.BEGUN: "it has just begun",
    Reason.OPENED: "its session is open",
    Reason.GOOD: "the link has been good for a second",
    Reason.UNARMED: "it is not armed",
    Reason.HORIZON: "a horizon has come",
    Reason.OLD: "no newer horizon has come",
    Reason.ENDED: "its plan has ended",
    Reason.LOST: "the server is silent",
    Reason.CLOSED: "the server has closed the session",
    Reason.RESTARTED: "the server has restarted",
    Reason.LATE: "horizons come too late",
    Reason.MALFORMED: "the server sends malformed messages",
    Reason.RESYNC: "the server plans for impossible times",
    Reason.STALLED: "its own computer was asleep",
    Reason.STILL: "it stands still",
    Reason.ALONE: "the server has been silent for long",
    Reason.NOT_FINITE: "its state or its input is not finite",
}


def client_columns(axes: int) -> np.dtype[np.void]:
    """Columns of the client's part: one row for each step of each vehicle."""
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),
            ("state", "<f8", (axes, 2)),  # true position [m] and velocity [m/s]
            ("measured", "<f8", (axes, 2)),  # had of it since the step before, NaN for nothing
            ("estimate", "<f8", (axes, 2)),  # what is reported and flown by
            ("input", "<f8", (axes,)),  # desired velocity that is flown from here on [m/s]
            ("covered", "?"),  # whether that is an input of a horizon, neither hovering nor braking
            ("in_force", "<i8"),  # step that its horizon was made for, -1 for none
            ("age_ns", "<i8"),  # since the observation behind that horizon, -1 for none
            ("stale", "<i8"),  # horizons older than the one held, so far
            ("missed", "<i8"),  # steps slept through, so far
            ("mode", "<u1"),  # what it does from here on, a `shared.protocol.Mode`
            ("reason", "<u1"),  # and why, a `Reason`
        ]
    )


def server_columns(axes: int) -> np.dtype[np.void]:
    """Columns of the server's part: one row for each vehicle and tick."""
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),
            ("reference", "<f8", (axes, 2)),  # x_d(k), as the server knew it then
            ("estimate", "<f8", (axes, 2)),  # x̂(k)
            ("ahead", "<i8"),  # d: planning starts at k + d
            ("planned", "<f8", (axes, 2)),  # x_p(k+d|k-1)
            ("input", "<f8", (axes,)),  # û(k), or the committed input of k
            ("observed_step", "<i8"),  # of the observation behind x̂
            ("error", "<f8"),  # V(k), or what the trigger compares instead
            ("threshold", "<f8"),  # S(k), or what it compares that with
            ("event", "?"),
            ("solved", "?"),
            ("solve_ns", "<i8"),  # both MPCs, all vehicles of the tick; -1 where not measured
            ("stale", "<i8"),  # observations older than the newest, so far
            ("missed", "<i8"),  # ticks slept through, so far
        ]
    )


def plan_columns(axes: int, planned: int) -> np.dtype[np.void]:
    """Columns of the server's plans: one row for each horizon that it sends.

    With dead reckoning there is no plan: the state is where the target is told to be, and the one
    input the velocity at which it goes on from there.

    Args:
        planned: number of its inputs on each axis, see `shared.terms.Terms.planned`.
    """
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),  # k, at which it was made
            ("begins", "<i8"),  # step of the first of the inputs, k + d
            ("state", "<f8", (axes, 2)),  # x̂(k+d), where they lead on from [m, m/s]
            ("inputs", "<f4", (axes, planned)),  # desired velocities, one a step [m/s]
            ("disturbance", "<f8", (axes,)),  # input that is reckoned with besides [m/s]
        ]
    )


UPLINK, DOWNLINK = 0, 1

PACKET_COLUMNS: np.dtype[np.void] = np.dtype(
    [
        ("direction", "<u1"),  # UPLINK or DOWNLINK
        ("flow", "<u4"),  # which client
        ("number", "<u4"),  # of the packet in its flow and direction
        ("bytes", "<u2"),  # UDP payload
        ("arrived_ns", "<i8"),  # [netem's clock]
        ("delay_ns", "<i8"),  # as drawn, also when lost
        ("lost", "?"),
        ("overtaken", "?"),  # by a later packet of the same flow
    ]
)
"""Columns of netem's part: one row for each packet."""


class Sink(Protocol):
    """What takes a part of the record, as a binary file does."""

    def write(self, piece: bytes, /) -> object:
        """Take the header, or whole rows."""


class Recorder:
    """Appends rows to sinks.

    Args:
        columns: those of the rows.
        sink: takes the header first; None for a recorder whose rows only go to those that follow.
    """

    def __init__(self, columns: np.dtype[np.void], sink: Sink | None = None) -> None:
        self.columns = columns
        self._sinks: list[Sink] = []
        self._row = _row(columns)
        if sink is not None:
            sink.write(json.dumps(columns.descr).encode() + b"\n")
            self._sinks.append(sink)

    def follow(self, sink: Sink) -> None:
        """Have another sink take the rows from now on, and no header."""
        self._sinks.append(sink)

    def append(self, count: int, **values: Any) -> None:
        """Append `count` rows; a value is one for all of them, or an array with the rows first."""
        rows = np.zeros(count, self.columns)
        for name, value in values.items():
            rows[name] = value
        self._write(rows.tobytes())

    def append_row(self, *values: float) -> None:
        """Append one row, faster: a value for every column in order, arrays number by number."""
        self._write(self._row.pack(*values))

    def _write(self, rows: bytes) -> None:
        for sink in self._sinks:
            sink.write(rows)


def _row(columns: np.dtype[np.void]) -> Struct:
    """Layout of a row in memory."""
    formats = {"u1": "B", "u2": "H", "u4": "I", "i8": "q", "f4": "f", "f8": "d", "b1": "?"}
    row = "<"
    for name in columns.names or ():
        kind = columns[name]
        row += f"{math.prod(kind.shape)}{formats[kind.base.str[1:]]}"
    return Struct(row)


def parse(part: bytes) -> Rows:
    """The rows of a part; half a row at its end (a killed writer's) is left out.

    Raises:
        ValueError: it is no part.
    """
    header, _, body = part.partition(b"\n")
    try:
        descr = [(name, kind, *map(tuple, shape)) for name, kind, *shape in json.loads(header)]
        columns = np.dtype(descr)
    except TypeError:
        raise ValueError("not a part of a record") from None
    if columns.itemsize == 0:
        raise ValueError("not a part of a record: no columns")
    return np.frombuffer(body[: len(body) - len(body) % columns.itemsize], columns)


def read(path: Path) -> Rows:
    """The rows of a part in a file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no part.
    """
    return parse(path.read_bytes())
