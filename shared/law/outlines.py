"""Outlines of zones, and a test whether a straight line comes too near to a zone.

The server compiles the test, because it tests every straight piece of every motion.
"""

from typing import Annotated, NamedTuple

from skytether.shared.law.model import Array


class Outlines(NamedTuple):
    """Outlines of zones as arrays: polygons, each between a lowest and a highest height."""

    edges: Annotated[Array, 3]
    """Start and end of each edge, x and y [m]; shape (zones, edges, 4)."""
    counts: Annotated[Array, 1]
    boxes: Annotated[Array, 2]
    """Least and largest x, y, and height [m]; shape (zones, 6)."""
    fences: Annotated[Array, 1]
    """1 if vehicles stay within the zone, 0 if they keep out of it; shape (zones,)."""


def is_near(
    outlines: Outlines,
    zone: int,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    low_m: float,
    high_m: float,
    clearance_m: float,
) -> bool:
    """Whether a straight line comes nearer than a clearance to the forbidden side of a zone, or
    touches it.

    Args:
        zone: index of the zone.
        x0, y0, x1, y1: both ends of the line [m].
        low_m, high_m: least and largest height of the line [m].
        clearance_m: distance to keep [m].
    """
    box, is_fence = outlines.boxes[zone], outlines.fences[zone] > 0.0
    off_m = max(box[4] - high_m, low_m - box[5])
    clearance2 = clearance_m * clearance_m if clearance_m > 0.0 else 0.0
    if is_fence:
        if min(low_m - box[4], box[5] - high_m) < clearance_m:
            return True
    else:
        # A line above or below the zone needs less distance in the plane.
        if off_m > 0.0:
            clearance2 -= off_m * off_m
        beside_x = max(box[0] - max(x0, x1), min(x0, x1) - box[1], 0.0)
        beside_y = max(box[2] - max(y0, y1), min(y0, y1) - box[3], 0.0)
        if beside_x * beside_x + beside_y * beside_y > clearance2:
            return False
    line_x, line_y = x1 - x0, y1 - y0
    inside, after = False, False
    for i in range(int(outlines.counts[zone])):
        edge = outlines.edges[zone, i]
        x, y, along_x, along_y = edge[0], edge[1], edge[2] - edge[0], edge[3] - edge[1]
        nearest2 = min(
            _off2(x0 - x, y0 - y, along_x, along_y),
            _off2(x1 - x, y1 - y, along_x, along_y),
            _off2(x - x0, y - y0, line_x, line_y),
        )
        if nearest2 < clearance2 or _crosses(x - x0, y - y0, line_x, line_y, along_x, along_y):
            return True
        inside ^= _is_left(x0, y0, x, y, edge[2], edge[3])
        after ^= _is_left(x1, y1, x, y, edge[2], edge[3])
    return bool(inside != is_fence or after != is_fence)


def _off2(x: float, y: float, along_x: float, along_y: float) -> float:
    """Squared distance of a point from a straight line that starts at the origin [m²]."""
    square = max(along_x * along_x + along_y * along_y, 1e-18)
    share = min(max((x * along_x + y * along_y) / square, 0.0), 1.0)
    x, y = x - share * along_x, y - share * along_y
    return x * x + y * y


def _crosses(
    x: float, y: float, line_x: float, line_y: float, along_x: float, along_y: float
) -> bool:
    """Whether an edge crosses a line; (x, y): start of the edge minus start of the line [m]."""
    begins = line_x * y - line_y * x
    ends = line_x * (y + along_y) - line_y * (x + along_x)
    line_begins = along_y * x - along_x * y
    line_ends = along_x * (line_y - y) - along_y * (line_x - x)
    return begins * ends < 0.0 and line_begins * line_ends < 0.0


def _is_left(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Whether a polygon's edge passes to the right of a point. If an odd number of edges do, the
    point is inside the polygon.

    Args:
        x, y: the point [m].
        x0, y0, x1, y1: both ends of the edge [m].
    """
    # Coordinates are compared, not subtracted: rounding must not make two edges disagree on which
    # side of their common corner the point is.
    if (y0 > y) == (y1 > y):
        return False
    return x < x0 + (y - y0) / (y1 - y0) * (x1 - x0)
