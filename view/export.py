"""Recordings as tables: one for each part of the record, and one of the events.

A column is a number with its unit in its name, as in `position_x_m`; a plan has one for each of its
inputs (`input_x_mps_0`). What the record has numbers for, and people words, is words: `mode`,
`reason`, `direction`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.sweep import to_csv
from shared.endpoint import SECOND_NS
from shared.events import Counted
from shared.feed import Rows, Said
from shared.protocol import Mode
from shared.record import DOWNLINK, UPLINK, Reason
from view.recording import Recorded
from view.rows import Table

Columns = dict[str, NDArray[Any]]
"""Columns of a table, all of one length, by name."""

WORDS: Mapping[str, Mapping[int, str]] = {
    "mode": {mode: str(mode) for mode in Mode},
    "reason": {reason: str(reason) for reason in Reason},
    "direction": {UPLINK: "uplink", DOWNLINK: "downlink"},
}
"""Words for the numbers of some columns."""


def tables(recorded: Recorded) -> dict[str, Columns]:
    """Tables of a recording, by name; `time_s` is counted from its first message on.

    Raises:
        RecordingError: the file is damaged.
    """
    times_ns: dict[str, list[int]] = {}
    pieces: dict[str, list[bytes]] = {}
    events: list[tuple[float, str, str, str]] = []
    columns = recorded.columns()
    for time_ns, process, frame in recorded.frames():
        if isinstance(frame, Rows):
            count = len(frame.rows) // columns[frame.part].itemsize
            times_ns.setdefault(frame.part, []).extend([time_ns] * count)
            pieces.setdefault(frame.part, []).append(frame.rows)
        elif isinstance(frame, Said) and not isinstance(frame.event, Counted):
            said = type(frame.event).__name__, str(frame.event)
            events.append((time_ns / SECOND_NS, process, *said))
    made = {
        part: {"time_s": np.array(times_ns[part]) / SECOND_NS}
        | _columns(np.frombuffer(b"".join(rows), columns[part]))
        for part, rows in pieces.items()
    }
    if events:
        names = ("time_s", "process", "type", "text")
        made["events"] = {
            name: np.array(values)
            for name, values in zip(names, zip(*events, strict=True), strict=True)
        }
    return made


def csv(columns: Columns) -> str:
    """A table as CSV text; what is not known, NaN, is empty."""
    values = [_known(column) for column in columns.values()]
    return to_csv(list(columns), zip(*values, strict=True))


def parquet() -> Callable[[Columns, str], None]:
    """What writes a table to a Parquet file of this name.

    Raises:
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet as files

    def write(columns: Columns, path: str) -> None:
        files.write_table(pyarrow.table(columns), path, compression="zstd")

    return write


def _columns(rows: NDArray[np.void]) -> Columns:
    table = Table(rows.dtype)
    flat = rows.view(table.plain)
    made: Columns = {}
    for name in table.names:
        if table.plain[name].shape:
            made |= {f"{name}_{k}": each for k, each in enumerate(flat[name].T)}
        elif name in WORDS:
            words = WORDS[name]
            made[name] = np.array(
                [words.get(number, str(number)) for number in flat[name].tolist()]
            )
        else:
            made[name] = flat[name]
    return made


def _known(column: NDArray[Any]) -> list[Any]:
    values: list[Any] = column.tolist()
    if column.dtype.kind != "f":
        return values
    return [None if value != value else value for value in values]  # noqa: PLR0124 - NaN
