"""Functions of motions for kernels: state at a step, and bounds of speed and curvature.

Because of downwash, vertical distances may have to be larger than horizontal ones. So coordinates
are multiplied by `MotionMetric.scale` before distances are computed. A sphere in scaled coordinates
is an ellipsoid that is higher than wide.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.base.kernel import F1, F2, kernel, part
from skytether.shared.law.model import ALTITUDE, Array
from skytether.shared.law.motion import SAMPLES, SPACING, Motion


class MotionMetric(NamedTuple):
    scale: F1
    """Factor of each coordinate when distances are computed; shape (axes,)."""
    dt_s: float


class Extent(NamedTuple):
    """Bounds of the speed and curvature of a motion."""

    speed: float
    """Largest speed, scaled [m/s]."""
    bend: float
    """Largest distance of the motion from its chords, of which each interval between knots has
    SAMPLES; scaled [m]."""


def states(motion: Motion, begin: int, count: int, dt_s: float) -> tuple[Array, Array]:
    """Positions [m] and velocities [m/s] at `count` steps, SPACING apart; shapes (count, axes)."""
    position, velocity = np.empty((2, count, motion.position.shape[1]))
    _states(motion, begin, dt_s, position, velocity)
    return position, velocity


def pieces_of(begin: int, end: int) -> Array:
    """Steps that divide a motion into nearly straight pieces, up to its end; shape (n,)."""
    count = max(-(-(end - begin) * SAMPLES // SPACING), 1)
    return np.linspace(begin, begin + count * SPACING / SAMPLES, count + 1)


@kernel
def _states(motion: Motion, begin: int, dt_s: float, position: F2, velocity: F2) -> None:
    for i in range(len(position)):
        for x in range(position.shape[1]):
            step = float(begin + i * SPACING)
            position[i, x], velocity[i, x] = state_at(motion, x, step, dt_s)


@part
def state_at(motion: Motion, axis: int, step: float, dt_s: float) -> tuple[float, float]:
    """Position [m] and velocity [m/s] of a motion on an axis at a step; see `Motion.at`."""
    position, velocity = motion.position, motion.velocity
    along = (step - motion.first) / SPACING
    if along <= 0.0:
        return position[0, axis], velocity[0, axis]
    if along >= len(position) - 1:
        return position[-1, axis], velocity[-1, axis]
    knot = int(along)
    T = SPACING * dt_s
    t = (along - knot) * T
    v = velocity[knot, axis]
    gained = t / T * (velocity[knot + 1, axis] - v)
    return position[knot, axis] + t * (v + 0.5 * gained), v + gained


@part
def position_at(motion: Motion, axis: int, step: float, dt_s: float) -> float:
    return state_at(motion, axis, step, dt_s)[0]


@part
def last_step(motion: Motion) -> int:
    return motion.first + (len(motion.position) - 1) * SPACING


@part
def bounding_box(motion: Motion, lands: bool, metric: MotionMetric, low: F1, high: F1) -> None:
    """Fill in the corners of a box around a motion, down to the ground if `lands`, scaled [m]."""
    position, velocity, scale = motion.position, motion.velocity, metric.scale
    for x in range(len(scale)):
        low[x], high[x], turn = np.inf, -np.inf, 0.0
        for knot in range(len(position)):
            low[x] = min(low[x], position[knot, x])
            high[x] = max(high[x], position[knot, x])
            if knot:
                turn = max(turn, abs(velocity[knot, x] - velocity[knot - 1, x]))
        # Between knots, T apart, a parabola deviates from the straight line by at most Δv T / 8.
        bend = turn * SPACING * metric.dt_s / 8.0
        low[x], high[x] = scale[x] * (low[x] - bend), scale[x] * (high[x] + bend)
        if x == ALTITUDE and lands:
            low[x] = min(low[x], 0.0)


@part
def extent_of(motion: Motion, metric: MotionMetric) -> Extent:
    fastest, turn, scale = 0.0, 0.0, metric.scale
    for knot in range(len(motion.velocity)):
        speed, change = 0.0, 0.0
        for x in range(len(scale)):
            v = scale[x] * motion.velocity[knot, x]
            speed += v * v
            if knot:
                change += (v - scale[x] * motion.velocity[knot - 1, x]) ** 2
        fastest, turn = max(fastest, speed), max(turn, change)
    # Over a piece of duration t a parabola deviates from the straight line by at most a t² / 8.
    piece = SPACING / SAMPLES * metric.dt_s
    return Extent(np.sqrt(fastest), np.sqrt(turn) / (SPACING * metric.dt_s) * piece * piece / 8.0)
