"""Knots of splines: as few as keep near to a trajectory, and the inputs that follow them."""

import numpy as np

from skytether.server.common.compiled import Axes, axis_at, bounded
from skytether.shared.base.kernel import F1, F3, I1, S2, kernel, part, shared
from skytether.shared.law import spline
from skytether.shared.wire.protocol import KNOTS_MAX

INTERVALS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, KNOTS_MAX - 1])
"""Numbers of intervals between knots that are tried, fewest first."""

spline_at, along = shared(spline.spline_at), shared(spline.along)


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


@kernel
def inputs_along(
    model: Axes, bounds: F1, dt_s: float, knots: F3, number: I1, spacing: I1, inputs: F3
) -> None:
    """Fill in the inputs ū along splines [m/s].

    Args:
        model: eq. (4).
        bounds: u_max of each axis [m/s]; shape (axes,).
        dt_s: length of a step [s].
        knots: knots of each, as in `Splines` [m, m/s]; shape (n, axes, 2 KNOTS_MAX).
        number: number of them; shape (n,).
        spacing: steps from one to the next; shape (n,).
        inputs: what is filled in; shape (n, axes, H).
    """
    for i in range(len(number)):
        for axis in range(len(bounds)):
            some = knots[i, axis, : 2 * number[i]]
            for stage in range(inputs.shape[2]):
                u = along(axis_at(model, axis), some, spacing[i], dt_s, stage)
                inputs[i, axis, stage] = bounded(u, bounds[axis])
