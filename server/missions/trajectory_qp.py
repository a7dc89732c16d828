"""Trajectory QP: the QP for one motion of a vehicle that keeps away from others.

The beginning of the motion equals the motion in force. The rest is planned over the accelerations
a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g_n|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with the targets g_n (equal for all n if the target is a waypoint), and with a half-plane for each
time and each near motion or zone,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is the near motion, or the zone's nearest point, and p̃ the motion in force. The motion in
force fulfils all constraints, so there is always a solution. DAQP, a dual active-set method, finds
the solution in a time that depends on the number of active constraints only.
"""

from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray

from skytether.server.missions.half_planes import HalfPlanes
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SPACING, speed_bounds
from skytether.shared.law.terms import Terms

TIMES_PER_INTERVAL = 2
"""Number of times in each interval between two knots at which distances are constrained."""
ACCELERATION_WEIGHT = 0.05
"""Weight r of accelerations [s⁴]."""
LAST_WEIGHT = 5.0
"""Weight w_N of the last position; the weights of all other positions are 1."""
VIOLATED = 1e-9
"""Tolerance above which a constraint counts as violated."""
EQUALITY, SOLVED = 5, 1
"""DAQP's codes for an equality constraint and for a solved problem."""


class MotionProblem(NamedTuple):
    """QP over x, the N accelerations of the first axis, then those of the other axes.

    min  ½ xᵀ H x + fᵀ x     lower ≤ (x, A x) ≤ upper
    """

    H: Array
    f: Array
    A: Array
    """Constraint rows, in this order: rest at the end, inputs at the ends and at the beginnings of
    intervals, half-planes."""
    upper: Array
    lower: Array
    sense: NDArray[np.int32]
    """Kind of each constraint, as DAQP's code."""


class TrajectoryQP:
    """Solver of the QP for one motion.

    Args:
        acceleration_mps2: largest acceleration on an axis, a_max [m/s²].
        speed_mps: largest speed over all axes [m/s]; 0: only the inputs are bounded.
    """

    def __init__(self, terms: Terms, acceleration_mps2: float, speed_mps: float) -> None:
        n, axes = INTERVALS, terms.axes
        self._T = T = SPACING * terms.dt_s
        """Time between successive knots of a motion [s]."""
        tau_s, gain = np.array(terms.tau_s), np.array(terms.gain)
        most = speed_bounds(np.array(terms.u_max), gain, speed_mps)
        place = np.arange(n)
        self._until_knot_s = T * np.arange(1.0, n + 1.0)[:, None]
        to_position = _positions(np.arange(1.0, n + 1.0), place, T)
        self.times: Array = np.arange(n * TIMES_PER_INTERVAL + 1) / TIMES_PER_INTERVAL
        """Times at which distances are constrained, from the planned part's start [intervals]."""
        self._after_s = self.times[:, None] * T
        self._to_sample = _positions(self.times, place, T)
        """Matrix that maps accelerations to positions at `times` [s²]; shape (times, N)."""
        weights = np.ones(n)
        weights[-1] = LAST_WEIGHT
        self._to_gradient = to_position.T * weights
        """Matrix that maps offsets from the targets to the QP's linear term [s²]; shape (N, N)."""
        one = self._to_gradient @ to_position
        hessian = np.kron(np.eye(axes), one + ACCELERATION_WEIGHT * np.eye(n))
        self._hessian = hessian.astype(np.float64)
        # Inputs v + τ a at the end and at the beginning of each interval.
        self._to_velocity = T * np.tril(np.ones((n, n)))
        """Matrix that maps accelerations to velocities at the knots [s]; shape (N, N)."""
        to_velocity = np.kron(np.eye(axes), self._to_velocity)
        before = np.kron(np.eye(axes), T * np.tril(np.ones((n, n)), -1))
        lag = np.diag(np.repeat(tau_s, n))
        self._rows = np.vstack([to_velocity[n - 1 :: n], to_velocity + lag, before + lag])
        """Matrix A without half-planes; shape (axes + 2 axes N, axes N)."""
        moves = np.kron(np.eye(axes), np.ones((n, 1)))
        self._to_bounds = -np.vstack([0.0 * moves, np.eye(axes), moves, moves])
        """Matrix that maps the initial velocity to the bounds; shape (axes + 3 axes N, axes)."""
        a_max, u = np.full(n * axes, acceleration_mps2), np.repeat(most, n)
        self._upper = np.concatenate([a_max, np.zeros(axes), u, u])
        self._sense = np.where(self._upper == 0.0, EQUALITY, 0).astype(np.int32)
        passed_s = self.times * T
        along_m = np.minimum(acceleration_mps2 * passed_s**2, 2.0 * most.max() * passed_s)
        self.reach_m = np.sqrt(axes) * along_m
        """Largest distance at `times` between two motions that start in the same state [m]."""

    def solve(
        self, kept_p: Array, kept_v: Array, targets: Array, planes: HalfPlanes | None = None
    ) -> tuple[Array, Array] | None:
        """Positions and velocities of all knots, `kept` first; None without a solution.

        Args:
            kept_p, kept_v: knots of the motion in force up to the beginning of the plan [m, m/s];
                shape (kept, axes).
            targets: g_1 … g_N [m]; shape (N, axes).
            planes: constraints on positions at `times`.
        """
        kept, axes = kept_p.shape
        problem = self.problem(kept_p[-1], kept_v[-1], targets, planes)
        x, _, result, _ = daqp.solve(*problem, primal_tol=VIOLATED)
        if result != SOLVED:
            return None
        velocity = np.concatenate([kept_v, kept_v[-1] + self._to_velocity @ x.reshape(axes, -1).T])
        # A motion has to end at rest; the solution ends at rest only within a tolerance.
        velocity[-1] = 0.0
        # Positions are computed from the velocities, so that both agree exactly.
        twice = velocity[kept:] + velocity[kept - 1 : -1]
        position = np.concatenate([kept_p, kept_p[-1] + self._to_velocity @ (0.5 * twice)])
        return position, velocity

    def problem(
        self, p0: Array, v0: Array, targets: Array, planes: HalfPlanes | None
    ) -> MotionProblem:
        """QP of a motion that starts from the state p0, v0."""
        off_m = p0 + self._until_knot_s * v0 - targets
        linear = (self._to_gradient @ off_m).T.ravel()
        shift, rows, sense = self._to_bounds @ v0, self._rows, self._sense
        upper, lower = shift + self._upper, shift - self._upper
        if planes and len(planes.time):
            at, normal = planes.time, planes.normal
            away = normal[:, :, None] * self._to_sample[at, None]
            rests = p0 + self._after_s[at] * v0
            least = planes.bound - (normal * rests).sum(axis=1)
            rows = np.concatenate([rows, away.reshape(len(at), -1)])
            lower = np.concatenate([lower, least])
            upper = np.concatenate([upper, np.full(len(at), np.inf)])
            sense = np.concatenate([sense, np.zeros(len(at), dtype=np.int32)])
        return MotionProblem(self._hessian, linear, rows, upper, lower, sense)

    def at_times(self, position: Array, velocity: Array) -> Array:
        """Positions at `times` of a motion with knots from `solve` [m]; shape (times, axes)."""
        position, velocity = position[-INTERVALS - 1 :], velocity[-INTERVALS - 1 :]
        accelerations = np.diff(velocity, axis=0) / self._T
        drifting = position[0] + self.times[:, None] * self._T * velocity[0]
        placed: Array = drifting + self._to_sample @ accelerations
        return placed


def _positions(times: Array, place: Indices, T: float) -> Array:
    """Matrix [s²] that maps accelerations to positions at `times` [intervals]; shape (times, n)."""
    into = np.clip(times[:, None] - place, 0.0, None)
    inside = np.minimum(into, 1.0)
    moved: Array = T * T * (0.5 * inside**2 + inside * (into - inside))
    return moved
