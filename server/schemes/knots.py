"""Fit of a spline to a trajectory, with the fewest knots for which the error is within a bound."""

import numpy as np

from skytether.shared.base.kernel import F3, S2, part, shared
from skytether.shared.law import spline
from skytether.shared.wire.protocol import KNOTS_MAX

INTERVALS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, KNOTS_MAX - 1])
"""Numbers of intervals of a spline that are tried, in this order."""

spline_at = shared(spline.spline_at)


@part
def fewest_knots(intended: F3, dt_s: float, error_m: float, knots: S2) -> tuple[int, int]:
    """Fit a spline with the fewest knots that meet the bound, or else with KNOTS_MAX.

    Args:
        intended: states of the trajectory from k on [m, m/s]; shape (axes, seen + 1, 2).
        error_m: largest error on each axis [m].
        knots: output: position and velocity of each knot [m, m/s]; shape (axes, 2 KNOTS_MAX).

    Returns:
        number of knots, and steps between two knots.
    """
    count, spacing, seen = 1, 1, intended.shape[1] - 1
    for intervals in INTERVALS:
        # Knots lie within the known part of the trajectory; after it the spline is a straight line.
        if intervals > seen:
            break
        count, spacing, error = intervals + 1, max(seen // max(intervals, 1), 1), 0.0
        for axis in range(len(knots)):
            for knot in range(count):
                knots[axis, 2 * knot] = intended[axis, knot * spacing, 0]
                knots[axis, 2 * knot + 1] = intended[axis, knot * spacing, 1]
            # Compare with the knots rounded to float32, as the vehicle receives them.
            own = knots[axis, : 2 * count]
            for stage in range(seen + 1):
                p, _ = spline_at(own, spacing, dt_s, stage)
                error = max(error, abs(p - intended[axis, stage, 0]))
        if error <= error_m:
            break
    return count, spacing
