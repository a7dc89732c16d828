"""Knots of splines: as few as keep near to a trajectory."""

import numpy as np

from skytether.shared.base.kernel import F3, S2, part, shared
from skytether.shared.law import spline
from skytether.shared.wire.protocol import KNOTS_MAX

INTERVALS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, KNOTS_MAX - 1])
"""Numbers of intervals between knots that are tried, fewest first."""

spline_at = shared(spline.spline_at)


@part
def fewest_knots(intended: F3, dt_s: float, error_m: float, knots: S2) -> tuple[int, int]:
    """Fill in the fewest knots that keep near enough to a trajectory, or else as many as fit.

    Args:
        intended: its states from k on [m, m/s]; shape (axes, seen + 1, 2).
        dt_s: length of a step [s].
        error_m: largest distance on an axis that is near enough [m].
        knots: what is filled in [m, m/s]; shape (axes, 2 KNOTS_MAX).

    Returns:
        number of knots, and steps from one to the next.
    """
    count, spacing, seen = 1, 1, intended.shape[1] - 1
    for intervals in INTERVALS:
        # Knots lie within what the server sees; further on the spline goes straight.
        if intervals > seen:
            break
        count, spacing, away = intervals + 1, max(seen // max(intervals, 1), 1), 0.0
        for axis in range(len(knots)):
            for knot in range(count):
                knots[axis, 2 * knot] = intended[axis, knot * spacing, 0]
                knots[axis, 2 * knot + 1] = intended[axis, knot * spacing, 1]
            # The knots as float32, as they will be read aboard.
            some = knots[axis, : 2 * count]
            for stage in range(seen + 1):
                p, _ = spline_at(some, spacing, dt_s, stage)
                away = max(away, abs(p - intended[axis, stage, 0]))
        if away <= error_m:
            break
    return count, spacing
