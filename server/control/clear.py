"""Straight pieces of motions and ways that keep clear of zones, compiled."""

import numpy as np

from skytether.shared.base.kernel import B1, F2, kernel, part, shared
from skytether.shared.law import outlines
from skytether.shared.law.model import Array, Flags
from skytether.shared.law.outlines import Outlines
from skytether.shared.scenario.zones import Zones

is_near = shared(outlines.is_near)
shared(outlines._off2), shared(outlines._crosses), shared(outlines._is_left)


def touches(zones: Zones, points: Array, room_m: float) -> bool:
    """Whether a way through points comes nearer to a zone than this, or touches one.

    Args:
        zones: may be none.
        points: at least two [m]; shape (n, axes).
        room_m: distance that is to be kept [m].
    """
    return _touches(zones.outlines, points, room_m)


def seen(zones: Zones, here: Array, there: Array, room_m: float) -> Flags:
    """Whether straight lines in the plane keep this distance from zones, of any height.

    Args:
        zones: may be none.
        here, there: where they begin and end [m]; shape (n, 2).
        room_m: distance that is to be kept [m].

    Returns:
        shape (n,).
    """
    found = np.empty(len(here), dtype=np.bool_)
    _seen(zones.outlines, here, there, room_m, found)
    return found


@kernel
def _touches(outlines: Outlines, points: F2, room: float) -> bool:
    """See `touches`."""
    for i in range(len(points) - 1):
        if _is_touched(outlines, points[i], points[i + 1], room):
            return True
    return False


@part
def _is_touched(outlines: Outlines, here: Array, there: Array, room: float) -> bool:
    """Whether a straight piece comes too near to any zone."""
    low, high = 0.0, 0.0
    if len(here) > 2:
        low, high = min(here[2], there[2]), max(here[2], there[2])
    for zone in range(len(outlines.counts)):
        if is_near(outlines, zone, here[0], here[1], there[0], there[1], low, high, room):
            return True
    return False


@kernel
def _seen(outlines: Outlines, here: F2, there: F2, room: float, found: B1) -> None:
    """Fill in `seen`."""
    for i in range(len(found)):
        found[i] = not _is_touched(outlines, here[i], there[i], room)
