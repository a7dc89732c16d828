"""Axes: MAVLink's north, east, down against ours, x north, y east, altitude up.

The way back is the same as the way there: this is the one place that knows of it.
"""

from collections.abc import Sequence


def turned(vector: Sequence[float]) -> tuple[float, float, float]:
    """Vector in north, east, down of one in ours, and the other way round; shape (3,)."""
    x, y, z = vector
    return x, y, -z
