"""The QP of one motion of a vehicle that keeps apart from others.

Until it differs from the motion in force it is that motion. From there on it is planned over the
accelerations a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with g what it aims at, and a half-plane for each motion and each zone that is near, and each time,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is that motion, or the zone's nearest point, and p̃ the motion in force. It fulfils all of
them, so there is always a solution.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control.apart import HalfPlanes
from skytether.server.control.dual import DualSolver
from skytether.shared.base.kernel import F1, F2, kernel
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SPACING
from skytether.shared.law.terms import Terms

SUB = 2
"""Number of times in each interval at which distances are kept."""
SHARE = 0.9
"""Share of the bound of the input that a motion may use."""
SMOOTH = 0.05
"""Weight r on accelerations [s⁴]."""
LAST = 5.0
"""Weight w_N on the last position; the others are 1."""


class Posing(NamedTuple):
    """All QPs of motions have these in common."""

    T: float
    """Time from one knot of a motion to the next [s]."""
    acceleration: float
    """Largest acceleration on an axis, a_max [m/s²]."""
    most: F1
    """Bound of v_n + τ a_n on each axis, u [m/s]; shape (axes,)."""
    weights: F1
    """Weights w_n of positions; shape (N,)."""
    to_position: F2
    """Positions of the knots by accelerations [s²]; shape (N, N)."""
    times: F1
    """Times at which distances are kept, in intervals; shape (times,)."""
    to_sample: F2
    """Positions at these times by accelerations [s²]; shape (times, N)."""


class MotionPlan:
    """Solver of the QP of one motion.

    Args:
        terms: the rule of flight.
        acceleration_mps2: largest acceleration on an axis, a_max [m/s²].
        speed_mps: largest speed over all axes [m/s]; 0: as the bound of the input allows.
    """

    def __init__(self, terms: Terms, acceleration_mps2: float, speed_mps: float) -> None:
        n, axes = INTERVALS, terms.axes
        T = SPACING * terms.dt_s
        tau_s, gain = np.array(terms.tau_s), np.array(terms.gain)
        most = SHARE * np.array(terms.u_max) * gain
        if speed_mps:
            # On each axis alone, so that the constraints stay linear: on the diagonal it is exact,
            # along an axis cautious.
            most = np.minimum(most, speed_mps / np.sqrt(axes))
        place = np.arange(n)
        to_velocity = T * np.tril(np.ones((n, n)))
        to_position = _positions(np.arange(1.0, n + 1.0), place, T)
        self.times: Array = np.arange(n * SUB + 1) / SUB
        """Times at which distances are kept, in intervals from where the plan begins."""
        weights = np.ones(n)
        weights[-1] = LAST
        hessian = to_position.T @ (weights[:, None] * to_position)
        self._solver = DualSolver(np.kron(np.eye(axes), hessian + SMOOTH * np.eye(n)))
        to_sample = _positions(self.times, place, T)
        self._posing = Posing(
            T, acceleration_mps2, most, weights, to_position, self.times, to_sample
        )
        # The input at the end of each interval, and at its begin: v ± within what it can do.
        ends = [to_velocity + tau_s[x] * np.eye(n) for x in range(axes)]
        before = np.vstack([np.zeros(n), to_velocity[:-1]])
        begins = [before + tau_s[x] * np.eye(n) for x in range(axes)]
        both = np.vstack([np.eye(n * axes), _blocks(ends), _blocks(begins)])
        fixed = np.vstack([_blocks([to_velocity[-1:]] * axes), both, -both])
        self._fixed = np.ascontiguousarray(fixed.T)
        """Columns of the constraints that are always there."""
        self._axes = axes
        passed_s = self.times * T
        along_m = np.minimum(acceleration_mps2 * passed_s**2, 2.0 * most.max() * passed_s)
        self.reach_m = np.sqrt(axes) * along_m
        """Largest distance between two motions from one state at those times [m]."""

    def solve(
        self, kept_p: Array, kept_v: Array, goal: Array, planes: HalfPlanes | None = None
    ) -> tuple[Array, Array] | None:
        """Positions and velocities of the knots, the given ones first; None without a solution.

        Args:
            kept_p, kept_v: knots of the motion in force, the last one where the plan begins
                [m, m/s]; shape (kept, axes).
            goal: what it aims at, g [m]; shape (axes,).
            planes: constraints on positions at `times`.
        """
        columns, (variables, fixed) = self._fixed, self._fixed.shape
        linear = np.empty(variables)
        least = np.empty(fixed + (len(planes.at) if planes else 0))
        p0, v0 = kept_p[-1], kept_v[-1]
        _pose(self._posing, p0, v0, goal, linear, least)
        # The constraints that are always there are kept as columns, and half-planes are put behind
        # them.
        if planes and len(planes.at):
            columns = np.empty((variables, len(least)))
            columns[:, :fixed] = self._fixed
            _keep_apart(self._posing, p0, v0, planes, columns, least)
        x = self._solver.solve(linear, columns, least, self._axes)
        if x is None:
            return None
        position, velocity = np.empty((2, len(kept_p) + INTERVALS, self._axes))
        _fly(self._posing, x, kept_p, kept_v, position, velocity)
        return position, velocity

    def at_times(self, position: Array, velocity: Array) -> Array:
        """Positions at `times` of knots that `solve` has found [m]; shape (times, axes)."""
        position, velocity = position[-INTERVALS - 1 :], velocity[-INTERVALS - 1 :]
        accelerations = np.diff(velocity, axis=0) / self._posing.T
        drifting = position[0] + self.times[:, None] * self._posing.T * velocity[0]
        placed: Array = drifting + self._posing.to_sample @ accelerations
        return placed


@kernel
def _pose(posing: Posing, p0: F1, v0: F1, goal: F1, linear: F1, least: F1) -> None:
    """Fill in the linear term, and the bounds of the constraints that are always there."""
    n, axes, a = len(posing.weights), len(p0), posing.acceleration
    N = n * axes
    for x in range(axes):
        v, most = v0[x], posing.most[x]
        least[x] = -v
        for i in range(n):
            linear[x * n + i] = 0.0
            # In the order of `_fixed`: accelerations, inputs at the ends and at the begins of
            # intervals, each from below and then from above.
            for part, bound in enumerate((-a, -most - v, -most - v, -a, v - most, v - most)):
                least[axes + part * N + x * n + i] = bound
        for j in range(n):
            free = p0[x] + (j + 1) * posing.T * v
            for i in range(n):
                weighed = posing.weights[j] * (free - goal[x])
                linear[x * n + i] -= posing.to_position[j, i] * weighed


@kernel
def _keep_apart(posing: Posing, p0: F1, v0: F1, planes: HalfPlanes, columns: F2, least: F1) -> None:
    """Fill in the last columns and bounds, those of half-planes."""
    n, fixed = len(posing.weights), len(least) - len(planes.at)
    for m in range(len(planes.at)):
        at = planes.at[m]
        room = planes.least[m]
        for x in range(len(p0)):
            normal = planes.normal[m, x]
            room -= normal * (p0[x] + posing.times[at] * posing.T * v0[x])
            for i in range(n):
                columns[x * n + i, fixed + m] = normal * posing.to_sample[at, i]
        least[fixed + m] = room


@kernel
def _fly(posing: Posing, found: F1, kept_p: F2, kept_v: F2, position: F2, velocity: F2) -> None:
    """Fill in the knots: those that are kept, and others by the accelerations that were found."""
    n, kept = len(posing.weights), len(kept_p)
    for x in range(position.shape[1]):
        for knot in range(kept):
            position[knot, x], velocity[knot, x] = kept_p[knot, x], kept_v[knot, x]
        p0, v0 = kept_p[kept - 1, x], kept_v[kept - 1, x]
        gained, moved = 0.0, 0.0
        for i in range(n):
            knot = kept + i
            gained += posing.T * found[x * n + i]
            # The last velocity is 0 to within the tolerance of the solver, and a motion has to end
            # at rest.
            velocity[knot, x] = v0 + gained if i < n - 1 else 0.0
            # Positions of what is flown: that velocity, whatever the solver's tolerance has left.
            moved += 0.5 * posing.T * (velocity[knot, x] + velocity[knot - 1, x])
            position[knot, x] = p0 + moved


def _positions(times: Array, place: Indices, T: float) -> Array:
    """Position by accelerations of intervals at times, in intervals [s²]; shape (times, n)."""
    into = np.clip(times[:, None] - place, 0.0, None)
    inside = np.minimum(into, 1.0)
    moved: Array = T * T * (0.5 * inside**2 + inside * (into - inside))
    return moved


def _blocks(parts: list[Array]) -> Array:
    """Matrix with these along its diagonal."""
    rows, columns = (sum(each.shape[axis] for each in parts) for axis in (0, 1))
    whole, row, column = np.zeros((rows, columns)), 0, 0
    for each in parts:
        whole[row : row + len(each), column : column + each.shape[1]] = each
        row, column = row + len(each), column + each.shape[1]
    return whole
