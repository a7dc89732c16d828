"""Rows of the record as plain columns: one number each, with axis and unit in its name.

Exported tables have these columns, and messages for other programs have them as keys. An array of
the Python library has all axes of one quantity.
"""

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import ends
from skytether.shared.telemetry.record import (
    DOWNLINK,
    PACKET_COLUMNS,
    UPLINK,
    Compared,
    Reason,
    Rows,
    client_columns,
    plan_columns,
    server_columns,
)
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shared.wire.protocol import Mode

AXES = "xyz"
SHORT = {"inputs": "input"}
"""Names of columns of velocities that are shortened in plain columns, and the short names."""
WORDS: Mapping[str, Mapping[int, str]] = {
    "mode": {mode: str(mode) for mode in Mode},
    "reason": {reason: str(reason) for reason in Reason},
    "compared": {figure: str(figure) for figure in Compared},
    "direction": {UPLINK: FLIGHT[0], DOWNLINK: FLIGHT[1]},
    "end": {end: str(end) for end in ends.End},
    "happened": {what: str(what) for what in ends.Happened},
}
FLOWN_S_MAX = 2 * 86_400.0
"""Latest accepted time of a step [s]; a scenario lasts for a day at most."""
TIMES = "arrived_ns", "time_ns", "due_ns"
"""Columns with times on a process's clock."""
TIME_NS_MAX = 2**62
"""Largest accepted time on a process's clock [ns]."""
DELAY_NS_MAX = 86_400 * SECOND_NS
"""Longest accepted delay of a packet [ns]."""
NUMBER_MAX = 1e100
"""Largest number accepted in a row, so that squares do not overflow."""

Columns = dict[str, NDArray[Any]]
"""Columns of a table, all of one length, by name."""


def plain(columns: np.dtype[np.void]) -> np.dtype[np.void]:
    """Plain columns of the record's row type, at the same offsets in memory.

    A state, of shape (axes, 2), becomes `position_x_m`, `velocity_x_mps` and so on, prefixed by the
    column's name unless it is `state`. Velocities, of shape (axes,), or (axes, steps) for the
    inputs of a plan, become `input_x_mps` and so on.

    Raises:
        ValueError: a column is neither a number nor of these shapes.
    """
    fields: list[Any] = []
    for name in columns.names or ():
        kind = columns[name]
        axes, *rest = kind.shape or (0,)
        if not kind.shape:
            fields.append((name, kind))
        elif axes <= len(AXES) and (not rest or name == "inputs"):
            shape = [tuple(rest)] if rest else []
            fields += [
                (f"{SHORT.get(name, name)}_{axis}_mps", kind.base, *shape) for axis in AXES[:axes]
            ]
        elif axes <= len(AXES) and rest == [2]:
            before = "" if name == "state" else f"{name}_"
            for axis in AXES[:axes]:
                fields.append((f"{before}position_{axis}_m", kind.base))
                fields.append((f"{before}velocity_{axis}_mps", kind.base))
        else:
            raise ValueError(f"column {name}: got shape {kind.shape}, expected that of a state")
    flat = np.dtype(fields)
    if flat.itemsize != columns.itemsize:
        raise ValueError(f"got rows of {columns.itemsize} B, expected {flat.itemsize} B")
    return flat


class RowTable:
    """Converter of a part's rows to JSON messages with a key for each plain column.

    Numbers that are not finite are left out, because JSON has no notation for them.

    Raises:
        ValueError: see `plain`.
    """

    def __init__(self, columns: np.dtype[np.void]) -> None:
        self.columns = columns
        self._plain = plain(columns)
        self.names: tuple[str, ...] = self._plain.names or ()
        self.schema = {"type": "object", "properties": dict(map(self._property, self.names))}

    def _property(self, name: str) -> tuple[str, dict[str, Any]]:
        column = self._plain[name]
        kind = {"type": {"b": "boolean", "f": "number"}.get(column.base.kind, "integer")}
        return name, {"type": "array", "items": kind} if column.shape else kind

    def messages(self, rows: Rows) -> list[dict[str, Any]]:
        flat = np.ascontiguousarray(rows).view(self._plain)
        values = zip(*(flat[name].tolist() for name in self.names), strict=True)
        return [
            {name: value for name, value in zip(self.names, row, strict=True) if _is_finite(value)}
            for row in values
        ]


def _is_finite(value: Any) -> bool:
    return all(map(isfinite, value)) if isinstance(value, list) else isfinite(value)


def check_columns(part: str, columns: np.dtype[np.void], scenario: Scenario) -> None:
    """Refuse columns that a part of the record of a scenario's flight cannot have.

    Additional columns are accepted. Plans may have any number of inputs.

    Raises:
        ValueError: a column is missing or wrong; the message names it and the part.
    """
    axes = scenario.model.axes
    match part:
        case "client":
            expected = client_columns(axes)
        case "server":
            expected = server_columns(axes, scenario.control.scheme)
        case "plan":
            expected = plan_columns(axes, 1)
        case "netem":
            expected = PACKET_COLUMNS
        case ends.PART:
            expected = ends.COLUMNS
        case _:
            raise ValueError(f"no flight has a part {part[:20]!r}")
    plain(columns)
    names = columns.names or ()
    for name in expected.names or ():
        kind = columns[name] if name in names else None
        if name == "inputs" and kind is not None and len(kind.shape) == 2:
            kind = np.dtype((kind.base, (kind.shape[0], 1)))
        if kind != expected[name]:
            raise ValueError(f"{part}: the column {name} is {kind}, expected {expected[name]}")


def check_values(part: str, rows: Rows, scenario: Scenario) -> None:
    """Refuse rows with impossible values for a flight of a scenario.

    Raises:
        ValueError: a value is out of range; the message names part, column, value and range.
    """
    most = {
        "step": int(FLOWN_S_MAX / scenario.control.dt),
        "begins": int(FLOWN_S_MAX / scenario.control.dt),
        "path": PATHS_MAX - 1,
        "delay_ns": DELAY_NS_MAX,
        **dict.fromkeys(TIMES, TIME_NS_MAX),
        "age_ns": 2**62,
        "solve_ns": 2**62,
        **{name: len(words) - 1 for name, words in WORDS.items()},
    }
    least = {"age_ns": -1, "solve_ns": -1, **dict.fromkeys(TIMES, -TIME_NS_MAX)}
    for name in (rows.dtype.names or ()) if len(rows) else ():
        values = rows[name]
        if values.dtype.kind == "f":
            finite = np.abs(values[np.isfinite(values)])
            low, high, bound = 0.0, float(finite.max(initial=0.0)), NUMBER_MAX
        elif name in most:
            low, high, bound = int(values.min()), int(values.max()), most[name]
        else:
            continue
        if low < least.get(name, 0) or high > bound:
            extreme = low if low < least.get(name, 0) else high
            raise ValueError(
                f"{part}: {name}: got {extreme}, expected {least.get(name, 0)} to {bound}"
            )


def readable(rows: Rows, ways: Directions = FLIGHT) -> Columns:
    """Plain columns of rows, with words for codes, and one column per input of a plan.

    Args:
        ways: words for the two directions.
    """
    said = {**WORDS, "direction": {UPLINK: ways[0], DOWNLINK: ways[1]}}
    flat = np.ascontiguousarray(rows).view(plain(rows.dtype))
    result: Columns = {}
    for name in flat.dtype.names or ():
        if flat.dtype[name].shape:
            result |= {f"{name}_{k}": each for k, each in enumerate(flat[name].T)}
        elif name in said:
            words = said[name]
            result[name] = np.array(
                [words.get(number, str(number)) for number in flat[name].tolist()], dtype=np.str_
            )
        else:
            result[name] = flat[name]
    return result


def arrays(rows: Rows) -> Columns:
    """Plain columns of rows, with columns of all axes joined to one array.

    `position_x_m` and `position_y_m` become `position_m`, of shape (rows, axes); inputs of plans
    have the shape (rows, axes, steps).
    """
    flat = np.ascontiguousarray(rows).view(plain(rows.dtype))
    together: dict[str, list[NDArray[Any]]] = {}
    for name in flat.dtype.names or ():
        words = name.split("_")
        if set(words[-2:-1]) & set(AXES):
            del words[-2]
        together.setdefault("_".join(words), []).append(flat[name])
    return {
        name: each[0] if len(each) == 1 else np.stack(each, axis=1)
        for name, each in together.items()
    }


def planned(scenario: Scenario, row: np.void) -> Array:
    """Positions along a plan [m], from its initial state on; shape (steps + 1, axes).

    Args:
        row: row of the part "plan".
    """
    inputs = row["inputs"] + row["disturbance"][:, np.newaxis]
    return scenario.terms().model.roll(row["state"], inputs)[:, :, 0]


def no_rows(scenario: Scenario) -> dict[str, Rows]:
    """Parts of a record without rows."""
    axes = scenario.model.axes
    return {
        "client": np.empty(0, client_columns(axes)),
        "server": np.empty(0, server_columns(axes, scenario.control.scheme)),
        "netem": np.empty(0, PACKET_COLUMNS),
        "plan": np.empty(0, plan_columns(axes, scenario.control.horizon)),
    }
