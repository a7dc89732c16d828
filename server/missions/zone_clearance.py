"""Kernels that test whether straight lines keep a clearance from zones."""

import numpy as np

from skytether.shared.base.kernel import B1, F2, kernel, part, shared
from skytether.shared.law import outlines
from skytether.shared.law.model import Array, Flags
from skytether.shared.law.outlines import Outlines
from skytether.shared.missions.zones import Zones

is_near = shared(outlines.is_near)


def comes_near(zones: Zones, points: Array, clearance_m: float) -> bool:
    """Whether a polyline through points comes nearer to a zone than a clearance."""
    return _comes_near(zones.outlines, points, clearance_m)


def are_clear(zones: Zones, here: Array, there: Array, clearance_m: float) -> Flags:
    """Whether horizontal lines keep a clearance from zones, whatever their heights; shape (n,)."""
    clear = np.empty(len(here), dtype=np.bool_)
    _are_clear(zones.outlines, here, there, clearance_m, clear)
    return clear


@kernel
def _comes_near(outlines: Outlines, points: F2, clearance: float) -> bool:
    for i in range(len(points) - 1):
        if _line_comes_near(outlines, points[i], points[i + 1], clearance):
            return True
    return False


@kernel
def _are_clear(outlines: Outlines, starts: F2, ends: F2, clearance: float, clear: B1) -> None:
    for i in range(len(clear)):
        clear[i] = not _line_comes_near(outlines, starts[i], ends[i], clearance)


@part
def _line_comes_near(outlines: Outlines, start: Array, end: Array, clearance: float) -> bool:
    low, high = 0.0, 0.0
    if len(start) > 2:
        low, high = min(start[2], end[2]), max(start[2], end[2])
    for zone in range(len(outlines.counts)):
        if is_near(outlines, zone, start[0], start[1], end[0], end[1], low, high, clearance):
            return True
    return False
