"""CSV tables of one or several vehicles, and zips or folders with a table for each vehicle.

| columns | content |
|---|---|
| t, x, y (and z) | seconds, and metres north, east and up |
| t, lat, lon (and alt) | seconds, degrees, and metres above the sea or the origin |
| `Time [msec]`, `x [m]`, `y [m]`, `z [m]` | of Skybrush |
| t, px, py, pz | of MAVSDK's drone show: metres north, east and down |
| duration, x^0 … x^7, y^0 … | of Crazyswarm: polynomials, one piece a row |

With a column `vehicle` a table has the rows of several vehicles. Other columns are ignored.
"""

import re
from array import array
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from math import isfinite
from typing import NamedTuple

import numpy as np

from skytether.shared.formats import Tracks, bounded
from skytether.shared.formats.bounded import POINTS_MAX, SAMPLE_S
from skytether.shared.formats.geographic import Origin, local
from skytether.shared.law.model import Array, Indices

VEHICLES_MAX = 65_535
"""Largest number of a vehicle."""
GROUND_M = 1.0
"""Largest magnitude of the lowest altitude in a table of altitudes above the origin [m]."""
DEGREE = 7
"""Degree of the polynomials of Crazyswarm."""


class TableForm(NamedTuple):
    """Columns of a table, and the conversion of its coordinates to metres north, east and up."""

    columns: tuple[str, str, str, str]
    """Names of the columns of time and three coordinates; with two axes the third is ignored."""
    tick_s: float
    """Unit of the time [s]."""
    place: Callable[[Array, Origin | None], Array]


def _north_east_up(coordinates: Array, _: Origin | None) -> Array:
    return coordinates


def _from_ned(coordinates: Array, _: Origin | None) -> Array:
    return np.concatenate([coordinates[:, :2], -coordinates[:, 2:]], axis=1)


def _from_globe(coordinates: Array, origin: Origin | None) -> Array:
    """Metres from the origin. Altitudes are above the sea if the origin's altitude is known;
    otherwise they are above the origin, and the lowest is near 0.
    """
    heights_m, zero_m = coordinates[:, 2:], 0.0
    if origin is None:
        origin = tuple(coordinates[0, :2].tolist())
    elif len(origin) > 2:
        zero_m = origin[2]
    elif heights_m.size and abs(lowest_m := float(heights_m.min())) > GROUND_M:
        above_sea = "those above the sea need reference.origin = [latitude, longitude, altitude]"
        raise ValueError(f"alt: expected metres from 0 on, got {lowest_m:g} and more; {above_sea}")
    return np.concatenate([local(coordinates[:, 1::-1], origin), heights_m - zero_m], axis=1)


FORMS = (
    TableForm(("t", "x", "y", "z"), 1.0, _north_east_up),
    TableForm(("t", "lat", "lon", "alt"), 1.0, _from_globe),
    TableForm(("Time [msec]", "x [m]", "y [m]", "z [m]"), 1e-3, _north_east_up),
    TableForm(("t", "px", "py", "pz"), 1.0, _from_ned),
)


def tracks(content: bytes, axes: int, origin: Origin | None, _: float) -> Tracks:
    return (_zip if bounded.is_zip(content) else _table)(content, axes, origin)


def axes_of(content: bytes) -> int:
    if bounded.is_zip(content):
        return max(map(axes_of, _members(content).values()))
    names = {*_header(content)}
    flat = any(set(form.columns[:3]) <= names and form.columns[3] not in names for form in FORMS)
    return 2 if flat else 3


def _table(content: bytes, axes: int, origin: Origin | None) -> Tracks:
    """Tracks in a table of one vehicle, or of several with a column `vehicle`."""
    header = _header(content)
    if "duration" in header:
        return {1: _polynomials(content, axes)}
    needed = [form.columns[: axes + 1] for form in FORMS]
    form = next(
        (form for form, names in zip(FORMS, needed, strict=True) if {*names} <= {*header}), None
    )
    if form is None:
        got = ", ".join(map(repr, header))[:80] or "nothing"
        expected = "; or ".join(", ".join(names) for names in needed)
        raise ValueError(f"line 1: expected the columns {expected}; got {got}")
    names = [*form.columns[: axes + 1], *(["vehicle"] if "vehicle" in header else [])]
    rows, lines = _read(content, names)
    if not len(rows):
        raise ValueError("expected at least one line of numbers")
    times_s = rows[:, 0] * form.tick_s
    points_m = form.place(rows[:, 1 : axes + 1], origin)
    numbers = rows[:, axes + 1] if "vehicle" in header else np.ones(len(rows))
    valid = (numbers >= 1) & (numbers <= VEHICLES_MAX) & (numbers == np.rint(numbers))
    if not valid.all():
        line = lines[np.flatnonzero(~valid)[0]]
        raise ValueError(f"line {line}: vehicle: expected numbers from 1 to {VEHICLES_MAX}")
    order = np.argsort(numbers, kind="stable")
    vehicles, begins = np.unique(numbers[order], return_index=True)
    found: Tracks = {}
    for vehicle, at in zip(vehicles.tolist(), np.split(order, begins[1:]), strict=True):
        _check_times(times_s[at], lines[at])
        found[int(vehicle)] = times_s[at], points_m[at]
    return found


def _polynomials(content: bytes, axes: int) -> tuple[Array, Array]:
    """Points along polynomials; each piece is a polynomial of the time since its beginning."""
    names = [f"{axis}^{power}" for axis in "xyz"[:axes] for power in range(DEGREE + 1)]
    rows, lines = _read(content, ["duration", *names])
    lengths_s = rows[:, 0]
    short = np.flatnonzero(lengths_s <= 0.0)
    if not len(rows) or len(short):
        where = f"line {lines[short[0]]}: " if len(short) else ""
        raise ValueError(f"{where}duration: expected more than 0")
    if lengths_s.sum() / SAMPLE_S + len(rows) > POINTS_MAX:
        raise ValueError(f"duration: expected at most {POINTS_MAX * SAMPLE_S:g} s together")
    powers, begin_s = np.arange(DEGREE + 1), 0.0
    times, points = [np.zeros(1)], [rows[0, 1 :: DEGREE + 1][None]]
    for length_s, coefficients in zip(lengths_s, rows[:, 1:], strict=True):
        own_s = np.linspace(0.0, length_s, int(np.ceil(length_s / SAMPLE_S)) + 1)[1:]
        along = own_s[:, None] ** powers
        with np.errstate(over="ignore", invalid="ignore"):  # `tracks` refuses the result
            points.append(along @ coefficients.reshape(axes, DEGREE + 1).T)
        times.append(begin_s + own_s)
        begin_s += length_s
    return np.concatenate(times), np.concatenate(points)


def _zip(content: bytes, axes: int, origin: Origin | None) -> Tracks:
    """Tracks of the CSV files in a zip, one vehicle each, in the natural order of their names."""
    named = _members(content)
    bounded.check_lines(named)
    found: Tracks = {}
    for number, name in enumerate(sorted(named, key=_natural), start=1):
        try:
            own = _table(named[name], axes, origin)
            ((times_s, points_m),) = own.values()
        except ValueError as error:
            said = "expected one vehicle a file" if "unpack" in str(error) else error
            raise ValueError(f"{name[:80]}: {said}") from None
        found[number] = times_s, points_m
    return found


def _members(content: bytes) -> dict[str, bytes]:
    return bounded.members(content, _is_table, "CSV files")


def _is_table(name: str) -> bool:
    """Whether a file is CSV, and not a file of attributes added by macOS."""
    return name.lower().endswith(".csv") and not name.rpartition("/")[2].startswith("._")


def _natural(name: str) -> list[tuple[int, str]]:
    """Key for natural order: drone 2 comes before drone 10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _header(content: bytes) -> list[str]:
    head = content[: 64 * 1024].partition(b"\n")[0].decode("utf-8-sig", "replace")
    return _names(head.split(",")) if head.strip() else []


def _names(header: Iterable[str]) -> list[str]:
    """Names of columns. Crazyswarm's tools begin the header with `#`, or write Duration."""
    names = [name.strip().strip('"').removeprefix("#").strip() for name in header]
    return ["duration" if name == "Duration" else name for name in names]


def _check_times(times_s: Array, lines: Indices) -> None:
    """Raise a ValueError if the times of a vehicle do not start at 0 or do not rise."""
    if times_s[0] != 0.0:
        raise ValueError(f"line {lines[0]}: expected t = 0 as the first time, got {times_s[0]:g}")
    for i in np.flatnonzero(np.diff(times_s) <= 0.0)[:1]:
        after, got = times_s[i : i + 2]
        raise ValueError(f"line {lines[i + 1]}: expected t above {after:g}, got {got:g}")


def _read(content: bytes, names: Sequence[str]) -> tuple[Array, Indices]:
    """Named columns of a CSV table, shape (rows, columns), and the number of each row's line.

    Raises:
        ValueError: the table is invalid; the message names the fault and the line.
    """
    table = bounded.rows(content)
    header = _names(next(table, (1, list[str]()))[1])
    if any(header.count(name) != 1 for name in names):
        got = ", ".join(map(repr, header))[:80] or "nothing"
        raise ValueError(f"line 1: expected the columns {', '.join(names)}, got {got}")
    at = [header.index(name) for name in names]
    rows, lines = array("d"), array("q")  # lists would need several times the memory
    for line, row in table:
        rows.extend(_numbers([row[i] if i < len(row) else None for i in at], line))
        lines.append(line)
    return np.array(rows).reshape(-1, len(names)), np.array(lines)


def _numbers(words: list[str | None], line: int) -> list[float]:
    with suppress(TypeError, ValueError):
        numbers = [float(word) for word in words]  # type: ignore[arg-type]
        if all(map(isfinite, numbers)):
            return numbers
    got = ", ".join(word or "nothing" for word in words)[:80]
    raise ValueError(f"line {line}: expected {len(words)} finite numbers, got {got}")
