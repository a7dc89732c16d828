"""Times of tracks: on one clock for all vehicles of a file, or computed from a speed."""

import re
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.units import SECOND_NS
from skytether.shared.formats import Tracks
from skytether.shared.formats.bounded import POINTS_MAX
from skytether.shared.law.model import Array

_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)\d*(?:Z|([+-])(\d\d):?(\d\d))?"
)
"""Pattern of a date and time in ISO 8601, and of its offset from UTC."""


class Line(NamedTuple):
    """Points of one vehicle."""

    name: str
    """Name of the vehicle in the file, for messages."""
    points_m: Array
    """Points [m]; shape (n, axes)."""
    times_ns: NDArray[np.int64] | None
    """Times on the file's clock [ns]; shape (n,); None if the points have no times."""


def moment_ns(text: str) -> int:
    """Time since 1970 of a text in ISO 8601 [ns]; raises ValueError if it is invalid."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"expected a time such as 2026-05-01T12:00:00Z, got {text.strip()[:40]!r}")
    offset_s = 0 if match[2] is None else 3600 * int(match[3]) + 60 * int(match[4])
    at_ns = int(np.datetime64(match[1], "ns").astype(np.int64))
    return at_ns - SECOND_NS * (-offset_s if match[2] == "-" else offset_s)


def together(lines: Iterable[Line], speed_mps: float) -> Tracks:
    """Tracks of the vehicles of a file, numbered from 1 in the order of the file.

    All times count from the earliest of the file; a vehicle that begins later waits at its first
    point. A line without times is followed at `speed_mps`. Of points of a vehicle at the same time
    only the first is used.

    Raises:
        ValueError: there are too many points, or decreasing times.
    """
    lines = list(lines)
    if sum(len(line.points_m) for line in lines) > POINTS_MAX:
        raise ValueError(f"expected at most {POINTS_MAX} points")
    begin_ns = min(
        (int(line.times_ns[0]) for line in lines if line.times_ns is not None), default=0
    )
    return {
        number: _at_speed(line.points_m, speed_mps)
        if line.times_ns is None
        else _timed(line, (line.times_ns - begin_ns) / SECOND_NS)
        for number, line in enumerate(lines, start=1)
    }


def _timed(line: Line, times_s: Array) -> tuple[Array, Array]:
    steps_s, points_m = np.diff(times_s), line.points_m
    if (steps_s < 0.0).any():
        at = int(np.argmax(steps_s < 0.0)) + 2
        raise ValueError(f"{line.name}, point {at}: expected a time after that of the point before")
    keeps = np.concatenate([[True], steps_s > 0.0])
    times_s, points_m = times_s[keeps], points_m[keeps]
    if times_s[0] > 0.0:
        times_s = np.concatenate([[0.0], times_s])
        points_m = np.concatenate([points_m[:1], points_m])
    return times_s, points_m


def _at_speed(points_m: Array, speed_mps: float) -> tuple[Array, Array]:
    away_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    keeps = np.concatenate([[True], away_m > 0.0])
    times_s = np.concatenate([[0.0], np.cumsum(away_m) / speed_mps])
    return times_s[keeps], points_m[keeps]
