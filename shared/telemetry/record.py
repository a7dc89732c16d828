"""Records of a flight by each process: rows of a numpy structured type.

Each process writes its own part: the client the inputs that it flew, the server its estimates and
decisions, netem the fate of every packet. A part is a line of JSON that names the columns, followed
by the rows as in memory. A part may end anywhere, for example because its process was killed;
readers leave out an incomplete last row.
"""

import hashlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from struct import Struct
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from skytether.shared.events.flight import Event, Failure, RecordIncomplete
from skytether.shared.scenario.schemes import properties

Rows = NDArray[np.void]

RECORDING = ".mcap"
"""Suffix of a recording of a flight; other files are parts of the record."""


class Reason(IntEnum):
    """Reason why a vehicle is in its mode, see `client.failsafe`."""

    def __new__(cls, number: int, text: str = "") -> "Reason":
        made = int.__new__(cls, number)
        made._value_, made.text = number, text
        return made

    text: str

    BEGUN = 0, "it has just begun"
    OPENED = 1, "its session is open"
    GOOD = 2, "the link has been good for a second"
    UNARMED = 3, "it is not armed"
    HORIZON = 4, "a horizon has come"
    OLD = 5, "no newer horizon has arrived"
    ENDED = 6, "its plan has ended"
    LOST = 7, "the server is silent"
    CLOSED = 8, "the server has closed the session"
    RESTARTED = 9, "the server has restarted"
    LATE = 10, "horizons arrive too late"
    MALFORMED = 11, "the server sends malformed messages"
    RESYNC = 12, "the server sends horizons from the future"
    STALLED = 13, "its own computer woke it too late"
    BRAKED = 14, "it has braked"
    ALONE = 15, "the server has been silent for long"
    NOT_FINITE = 16, "its state or its input is not finite"
    LEAPT = 17, "its state has jumped further than a vehicle can move"
    TAKEN = 18, "a pilot, or its autopilot, has taken over"
    DISARMED = 19, "its motors are disarmed"
    RETURNED = 20, "its autopilot follows commands again"
    BATTERY = 21, "its battery is low"
    ASTRAY = 22, "its autopilot has no position estimate"
    MUTE = 23, "its autopilot or robot is silent"
    WAITED = 24, "it has waited too long for its link, its autopilot or an operator"
    RESUMED = 25, "its process has restarted, and it continues its motion"
    HOMEWARD = 26, "the server has been silent for long"
    RIVAL = 27, "somebody else commands it too"
    STRAYED = 28, "it does not follow its commands"
    UNUSABLE = 29, "its measured positions cannot be used"
    OVER = 30, "its flight is over"

    def __str__(self) -> str:
        return self.text


class Compared(IntEnum):
    """Figure that a trigger compares with its threshold; its name is a column of the record.

    `server.planning.scheme.PlanFigures` defines the figures.
    """

    NOTHING = 0
    STATE_GAP = 1
    COST_GAP = 2
    EXPECTED_GAP = 3
    DEVIATION_M = 4
    OWN = 5
    """A figure that a plug-in's policy computes, in the policy's own unit."""

    def __str__(self) -> str:
        return self.name.lower()


def client_columns(axes: int) -> np.dtype[np.void]:
    """Columns of the client's part: one row for each step of each vehicle."""
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),
            ("state", "<f8", (axes, 2)),  # true state [m, m/s]; of a real vehicle, the estimate
            ("measured", "<f8", (axes, 2)),  # state measured since the last step [m, m/s], or NaN
            ("estimate", "<f8", (axes, 2)),  # state used by feedback and observations [m, m/s]
            ("input", "<f8", (axes,)),  # desired velocity that is flown from this step on [m/s]
            ("covered", "?"),  # whether the input is from a horizon, not from hovering or braking
            ("in_force", "<i8"),  # step for which the horizon in force was made; -1: no horizon
            ("age_ns", "<i8"),  # age of the horizon's observation; -1: no horizon in force
            ("stale", "<i8"),  # number of horizons so far that arrived after a newer one
            ("missed", "<i8"),  # number of missed steps so far
            ("mode", "<u1"),  # mode from this step on, a `shared.wire.protocol.Mode`
            ("reason", "<u1"),  # reason for the mode, a `Reason`
        ]
    )


def server_columns(axes: int, scheme: str) -> np.dtype[np.void]:
    """Columns of the server's part: one row for each vehicle and tick.

    The columns include the figures for triggers that `control.scheme` computes, see
    `server.planning.scheme.PlanFigures`.
    """
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),
            ("reference", "<f8", (axes, 2)),  # desired state x_d(k) as known at this tick [m, m/s]
            ("estimate", "<f8", (axes, 2)),  # estimated state x̂(k) [m, m/s]
            ("ahead", "<i8"),  # delay bound d: planning starts at k + d
            ("planned", "<f8", (axes, 2)),  # planned state x_p(k+d|k-1) [m, m/s]
            ("input", "<f8", (axes,)),  # û(k), or the committed input of step k [m/s]
            ("observed_step", "<i8"),  # step of the observation from which x̂ was predicted
            # state_gap, cost_gap, expected_gap [all: cost], deviation_m [m]. NaN without a plan;
            # expected_gap also without a trigger that needs it
            *((figure, "<f8") for figure in properties(scheme).figures),
            (str(Compared.OWN), "<f8"),  # figure of a plug-in's policy, in its own unit, or NaN
            ("threshold", "<f8"),  # threshold of the compared figure; 0 without a threshold
            ("compared", "<u1"),  # figure compared with the threshold, a `Compared`
            ("event", "?"),
            ("solved", "?"),
            ("solve_ns", "<i8"),  # time of both MPCs for all vehicles; -1 if not measured
            ("stale", "<i8"),  # number of observations so far that arrived after a newer one
            ("missed", "<i8"),  # number of missed ticks so far
        ]
    )


def plan_columns(axes: int, planned: int) -> np.dtype[np.void]:
    """Columns of the server's plans: one row for each horizon that it sends.

    With the scheme "trajectory" the state is the first knot, and the inputs follow the spline.
    `planned` is H, the number of planned inputs per axis.
    """
    return np.dtype(
        [
            ("vehicle", "<u2"),
            ("step", "<i8"),  # step k at which the plan was made
            ("begins", "<i8"),  # step of the first planned input, k + d
            ("state", "<f8", (axes, 2)),  # x̂(k+d), the state from which the inputs start [m, m/s]
            ("inputs", "<f4", (axes, planned)),  # desired velocity of each step [m/s]
            ("disturbance", "<f8", (axes,)),  # ŵ, disturbance assumed in the prediction [m/s]
        ]
    )


PIECE_ROWS = 1024

UPLINK, DOWNLINK = 0, 1

PACKET_COLUMNS: np.dtype[np.void] = np.dtype(
    [
        ("direction", "<u1"),  # UPLINK or DOWNLINK
        ("path", "<u1"),  # number of the session's path, from 0
        ("flow", "<u4"),  # number of the client
        ("number", "<u4"),  # number of the packet in its flow and direction
        ("bytes", "<u2"),  # size of the UDP payload; with `netem run`, of the IP packet
        ("arrived_ns", "<i8"),  # time of arrival at netem [netem's clock]
        ("delay_ns", "<i8"),  # drawn delay, also of a lost packet
        ("lost", "?"),
        ("overtaken", "?"),  # whether a later packet of the flow left earlier
    ]
)
"""Columns of netem's part: one row for each packet."""


class Sink(Protocol):
    """Destination of a part of the record, such as a binary file."""

    def write(self, piece: bytes, /) -> object:
        pass


class Recorder:
    """Writer of rows to sinks.

    Args:
        sink: receives the header first; None for a recorder whose sinks are added by `follow`.
    """

    def __init__(self, columns: np.dtype[np.void], sink: Sink | None = None) -> None:
        self.columns = columns
        self._sinks: list[Sink] = []
        self._row = _row(columns)
        self.pack = self._row.pack
        """Function that encodes a row from the values of all columns, in their order."""
        if sink is not None:
            sink.write(json.dumps(columns.descr).encode() + b"\n")
            self._sinks.append(sink)

    def follow(self, sink: Sink) -> None:
        """Add a sink that receives the rows from now on, without header."""
        self._sinks.append(sink)

    def append(self, count: int, **values: Any) -> None:
        """Append `count` rows. Each value is a scalar for all rows, or an array by row."""
        rows = np.zeros(count, self.columns)
        for name, value in values.items():
            rows[name] = value
        for sink in self._sinks:
            sink.write(rows.tobytes())

    def append_row(self, *values: float) -> None:
        """Append one row, faster than `append`. `values` has all columns, with arrays flattened."""
        row = self._row.pack(*values)
        for sink in self._sinks:
            sink.write(row)

    def append_packed(self, rows: Sequence[bytes]) -> None:
        """Append rows encoded by `pack`, with few writes to the sinks."""
        # A full sink drops a whole piece, so pieces are short.
        for first in range(0, len(rows), PIECE_ROWS):
            piece = b"".join(rows[first : first + PIECE_ROWS])
            for sink in self._sinks:
                sink.write(piece)


class MemoryRecorder(Recorder):
    """Recorder that stores its rows in memory."""

    def __init__(self, columns: np.dtype[np.void]) -> None:
        super().__init__(columns)
        self._written = io.BytesIO()
        self.follow(self._written)

    @property
    def count(self) -> int:
        """Number of rows so far."""
        return self._written.tell() // self.columns.itemsize

    def rows(self, first: int = 0) -> Rows:
        """Rows so far, from number `first` on; a negative number counts from the end."""
        written = self._written.getbuffer()[first * self.columns.itemsize :]
        return np.frombuffer(bytes(written), self.columns)


def _row(columns: np.dtype[np.void]) -> Struct:
    formats = {"u1": "B", "u2": "H", "u4": "I", "i8": "q", "f4": "f", "f8": "d", "b1": "?"}
    row = "<"
    for name in columns.names or ():
        kind = columns[name]
        row += f"{math.prod(kind.shape)}{formats[kind.base.str[1:]]}"
    return Struct(row)


class FlightEvent(NamedTuple):
    time_ns: int
    """Time in the flight [ns]; over real UDP, time since the first event."""
    host: str
    """Host of the event: "server", "netem SEED", "netem SEED/PATH" or "client SEED.VEHICLE"; over
    real UDP the name of the process."""
    event: Event

    @property
    def process(self) -> str:
        """Name of the process, "server", "netem" or "client", without seed and vehicle."""
        return self.host.partition(" ")[0]


@dataclass(frozen=True, slots=True)
class Record:
    """Record of a flight: the parts of its processes, and its events."""

    client: Rows
    server: Rows
    netem: Rows
    failure: Failure | None = None
    """Event that ended the flight of a vehicle; the first one if there are several."""
    figures: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the endpoints "server" and "netem" (see `Endpoint.figures`); in a batch, their
    figures at the end of the batch."""
    events: tuple[FlightEvent, ...] = ()
    """Events of the run's own endpoints, and the server's events about its vehicles, in order."""
    incomplete: tuple[RecordIncomplete, ...] = ()
    """Gaps in the record of a flight over real UDP, one per part."""
    plan: Rows = field(default_factory=lambda: np.empty(0, plan_columns(2, 1)))
    """Plans sent by the server; empty in a batch, or over real UDP."""

    def trace_hash(self) -> str:
        """Hash of the record, equal for two flights that are equal to the last bit."""
        return trace_hash(self.client, self.server, self.netem)


def trace_hash(*parts: Rows) -> str:
    """Hash of parts of a record, equal for parts that are equal to the last bit."""
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()
