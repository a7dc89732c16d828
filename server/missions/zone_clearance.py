"""Clearance of straight lines from zones, compiled."""

import numpy as np

from skytether.shared.base.kernel import B1, F2, kernel, part, shared
from skytether.shared.law import outlines
from skytether.shared.law.model import Array, Flags
from skytether.shared.law.outlines import Outlines
from skytether.shared.scenario.zones import Zones

is_near = shared(outlines.is_near)


def comes_near(zones: Zones, points: Array, clearance_m: float) -> bool:
    """Whether straight lines from point to point come nearer to a zone than a clearance, or touch
    one.

    Args:
        zones: may be empty.
        points: at least two [m]; shape (n, axes).
        clearance_m: distance to keep [m].
    """
    return _comes_near(zones.outlines, points, clearance_m)


def are_clear(zones: Zones, here: Array, there: Array, clearance_m: float) -> Flags:
    """Whether straight lines in the plane keep a clearance from zones, of any height.

    Args:
        zones: may be empty.
        here, there: start and end of each line [m]; shape (n, 2).
        clearance_m: distance to keep [m].

    Returns:
        shape (n,).
    """
    clear = np.empty(len(here), dtype=np.bool_)
    _are_clear(zones.outlines, here, there, clearance_m, clear)
    return clear


@kernel
def _comes_near(outlines: Outlines, points: F2, clearance: float) -> bool:
    """Compiled `comes_near`."""
    for i in range(len(points) - 1):
        if _line_comes_near(outlines, points[i], points[i + 1], clearance):
            return True
    return False


@kernel
def _are_clear(outlines: Outlines, here: F2, there: F2, clearance: float, clear: B1) -> None:
    """Fill in `are_clear`."""
    for i in range(len(clear)):
        clear[i] = not _line_comes_near(outlines, here[i], there[i], clearance)


@part
def _line_comes_near(outlines: Outlines, here: Array, there: Array, clearance: float) -> bool:
    """Whether a straight line comes too near to any zone."""
    low, high = 0.0, 0.0
    if len(here) > 2:
        low, high = min(here[2], there[2]), max(here[2], there[2])
    for zone in range(len(outlines.counts)):
        if is_near(outlines, zone, here[0], here[1], there[0], there[1], low, high, clearance):
            return True
    return False
