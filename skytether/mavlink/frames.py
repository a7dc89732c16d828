"""Conversion of axes: MAVLink has north, east, down; Skytether has x north, y east, altitude up.

The conversion is its own inverse. No other module converts axes.
"""

from collections.abc import Sequence


def turned(vector: Sequence[float]) -> tuple[float, float, float]:
    """Convert (north, east, down) to (x north, y east, z up), or back; shape (3,)."""
    x, y, z = vector
    return x, y, -z
