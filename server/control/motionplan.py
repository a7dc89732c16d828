"""The QP of one motion of a vehicle that keeps apart from others.

Until it differs from the motion in force it is that motion. From there on it is planned over the
accelerations a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with g what it aims at, and a half-plane for each motion and each zone that is near, and each time,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is that motion, or the zone's nearest point, and p̃ the motion in force. It fulfils all of
them, so there is always a solution.
"""

import numpy as np

from skytether.server.control.dual import DualSolver
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
        self._acceleration = acceleration_mps2
        place = np.arange(n)
        self._to_velocity = T * np.tril(np.ones((n, n)))
        self._to_position = _positions(np.arange(1.0, n + 1.0), place, T)
        self.times: Array = np.arange(n * SUB + 1) / SUB
        """Times at which distances are kept, in intervals from where the plan begins."""
        self._to_sample = _positions(self.times, place, T)
        self._weights = np.ones(n)
        self._weights[-1] = LAST
        hessian = self._to_position.T @ (self._weights[:, None] * self._to_position)
        self._solver = DualSolver(np.kron(np.eye(axes), hessian + SMOOTH * np.eye(n)))
        # The input at the end of each interval, and at its begin: v ± within what it can do.
        ends = [self._to_velocity + tau_s[x] * np.eye(n) for x in range(axes)]
        before = np.vstack([np.zeros(n), self._to_velocity[:-1]])
        begins = [before + tau_s[x] * np.eye(n) for x in range(axes)]
        both = np.vstack([np.eye(n * axes), _blocks(ends), _blocks(begins)])
        fixed = np.vstack([_blocks([self._to_velocity[-1:]] * axes), both, -both])
        self._fixed = np.ascontiguousarray(fixed.T)
        """Columns of the constraints that are always there."""
        self._most, self._axes, self._T = most, axes, T
        passed_s = self.times * T
        along_m = np.minimum(acceleration_mps2 * passed_s**2, 2.0 * most.max() * passed_s)
        self.reach_m = np.sqrt(axes) * along_m
        """Largest distance between two motions from one state at those times [m]."""

    def solve(
        self,
        p0: Array,
        v0: Array,
        goal: Array,
        planes: tuple[Indices, Array, Array] | None = None,
    ) -> tuple[Array, Array] | None:
        """Positions and velocities of the knots, the given state first; None without a solution.

        Args:
            p0, v0: where it begins [m, m/s]; shape (axes,).
            goal: what it aims at, g [m]; shape (axes,).
            planes: constraints normal · p ≥ least: index of `times`, normal and least of each
                [m]; shapes (n,), (n, axes), (n,).
        """
        n, axes, T = INTERVALS, self._axes, self._T
        free = p0 + np.arange(1, n + 1)[:, None] * T * v0
        linear = (self._to_position.T @ (self._weights[:, None] * (free - goal))).T.ravel()
        a = np.full(n * axes, self._acceleration)
        most, v = np.repeat(self._most, n), np.repeat(v0, n)
        low = [-v0, -a, -most - v, -most - v, -a, v - most, v - most]
        # The constraints that are always there are kept as columns, and half-planes are put behind
        # them.
        columns = self._fixed
        if planes is not None and len(planes[0]):
            at, normal, least = planes
            sample = self._to_sample[at].T
            near = np.concatenate([normal[:, x] * sample for x in range(axes)])
            columns = np.concatenate([columns, near], axis=1)
            drifting = p0 + self.times[at][:, None] * T * v0
            low.append(least - np.einsum("ij,ij->i", normal, drifting))
        x = self._solver.solve(-linear, columns, np.concatenate(low), axes)
        if x is None:
            return None
        found = x.reshape(axes, n).T
        velocity = np.vstack([v0, v0 + self._to_velocity @ found])
        # The last velocity is 0 to within the tolerance of the solver, and a motion has to end at
        # rest.
        velocity[-1] = 0.0
        # Positions of what is flown: that velocity, whatever the solver's tolerance has left.
        steps = 0.5 * T * (velocity[1:] + velocity[:-1])
        position = np.vstack([p0, p0 + np.cumsum(steps, axis=0)])
        return position, velocity

    def at_times(self, position: Array, velocity: Array) -> Array:
        """Positions at `times` of knots that `solve` has found [m]; shape (times, axes)."""
        accelerations = np.diff(velocity, axis=0) / self._T
        drifting = position[0] + self.times[:, None] * self._T * velocity[0]
        placed: Array = drifting + self._to_sample @ accelerations
        return placed


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
