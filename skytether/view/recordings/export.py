"""Recordings as tables: one for each part of the record, and one of the events.

A column is a number with its unit in its name, as in `position_x_m`; a plan has a column for each
of its inputs (`input_x_mps_0`). The codes in `mode`, `reason`, `direction` and `compared` become
words. Durations are in ms, as in a summary, and `error_m` is the distance of a vehicle from its
desired position.
"""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.figures.tables import to_csv
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import position_error
from skytether.view.recordings.recorded import Recorded
from skytether.view.rows import Columns, readable

PASSES_NS = ("age_ns", "solve_ns", "delay_ns")
"""Columns of durations [ns]; a negative value is a missing measurement."""
STEPS = ("in_force", "observed_step")
"""Columns of steps; a negative value is a missing step."""


def tables(recorded: Recorded) -> dict[str, Columns]:
    """Tables of a recording, by name; `time_s` is the time since the first message."""
    parts = recorded.parts
    result = {
        part: {"time_s": recorded.times_ns[part] / SECOND_NS}
        | dict(_in_ms(name, column) for name, column in readable(rows, recorded.ways).items())
        for part, rows in parts.items()
    }
    if "client" in parts:
        client, server = parts["client"], parts.get("server")
        result["client"]["error_m"] = _errors_m(recorded.scenario, client, server)
    events = [
        (time_ns / SECOND_NS, process, type(event).__name__, str(event))
        for time_ns, process, event in recorded.events()
    ]
    if events:
        names = ("time_s", "process", "type", "text")
        columns = zip(*events, strict=True)
        result["events"] = dict(zip(names, map(np.array, columns), strict=True))
    return result


def _in_ms(name: str, column: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    """Name and values of a column, durations converted to ms; NaN for a missing measurement."""
    if name not in PASSES_NS:
        return name, column
    return name.replace("_ns", "_ms"), np.where(column < 0, np.nan, column / MILLISECOND_NS)


def _errors_m(scenario: Scenario, client: Rows, server: Rows | None) -> Array:
    """Distance of each vehicle from its desired position, per row [m]; NaN if unknown."""
    errors_m = np.empty(len(client))
    for number in np.unique(client["vehicle"]):
        own = client["vehicle"] == number
        errors_m[own] = np.linalg.norm(position_error(scenario, client[own], server), axis=1)
    return errors_m


def csv(columns: Columns) -> str:
    values = [_values(name, column) for name, column in columns.items()]
    return to_csv(list(columns), zip(*values, strict=True))


def parquet() -> Callable[[Columns], bytes]:
    """Function that writes a table as Parquet.

    Raises:
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet as files

    def written(columns: Columns) -> bytes:
        file = io.BytesIO()
        table = {
            name: _values(name, column) if name in STEPS else column
            for name, column in columns.items()
        }
        files.write_table(pyarrow.table(table), file, compression="zstd")
        return file.getvalue()

    return written


def _values(name: str, column: NDArray[Any]) -> list[Any]:
    """Values of a column; None for unknown values, which are NaN, or -1 for a step."""
    values: list[Any] = column.tolist()
    if name in STEPS:
        return [None if value < 0 else value for value in values]
    if column.dtype.kind != "f":
        return values
    return [None if value != value else value for value in values]  # noqa: PLR0124 - NaN
