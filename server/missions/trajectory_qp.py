"""Trajectory QP: the QP for one motion of a vehicle that keeps away from others.

The beginning of the motion equals the motion in force. After that it is planned over the
accelerations a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g_n|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with the targets g_n, all the same for a waypoint, and a half-plane for each near motion and zone
and each time,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is the near motion, or the zone's nearest point, and p̃ the motion in force. The motion in
force fulfils all constraints, so there is always a solution.

For a vehicle far from all others there are no half-planes, and no constraint couples the axes:
`solve_axes` solves them one by one. Its result equals that of `solve` to the last bit, where the
terms of other axes only add 0.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.missions.dual_active_set import (
    SOLVED,
    DualActiveSet,
    DualWorkspace,
    solve_qp,
    workspace,
)
from skytether.server.missions.half_planes import HalfPlanes
from skytether.shared.base.kernel import F1, F2, F3, kernel, making_kernel, part
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SPACING, speed_bounds
from skytether.shared.law.terms import Terms

TIMES_PER_INTERVAL = 2
"""Number of times per interval at which distances are kept."""
ACCELERATION_WEIGHT = 0.05
"""Weight r of accelerations [s⁴]."""
LAST_WEIGHT = 5.0
"""Weight w_N of the last position; the others are 1."""


class QPConstants(NamedTuple):
    T: float
    """Time between successive knots of a motion [s]."""
    acceleration: float
    """Largest acceleration on an axis, a_max [m/s²]."""
    most: F1
    """Bound u of v_n + τ a_n [m/s]; shape (axes,)."""
    weights: F1
    """Weights w_n of positions; shape (N,)."""
    to_position: F2
    """Positions of the knots from accelerations [s²]; shape (N, N)."""
    times: F1
    """Times at which distances are kept [intervals]; shape (times,)."""
    to_sample: F2
    """Positions at `times` from accelerations [s²]; shape (times, N)."""


class AxisProblem(NamedTuple):
    """QPs of single axes, and scratch arrays for solving them."""

    root: F3
    """Jᵀ of each axis, see `DualActiveSet`; shape (axes, N, N)."""
    columns: F3
    """Constraints of each axis; shape (axes, N, 6 N + 1)."""
    linear: F1
    bounds: F1
    x: F1
    scratch: DualWorkspace


class TrajectoryQP:
    """Solver of the QP for one motion.

    Args:
        acceleration_mps2: largest acceleration on an axis, a_max [m/s²].
        speed_mps: largest speed over all axes [m/s]; 0: limited by the input bound only.
    """

    def __init__(self, terms: Terms, acceleration_mps2: float, speed_mps: float) -> None:
        n, axes = INTERVALS, terms.axes
        T = SPACING * terms.dt_s
        tau_s, gain = np.array(terms.tau_s), np.array(terms.gain)
        most = speed_bounds(np.array(terms.u_max), gain, speed_mps)
        place = np.arange(n)
        to_velocity = T * np.tril(np.ones((n, n)))
        to_position = _positions(np.arange(1.0, n + 1.0), place, T)
        self.times: Array = np.arange(n * TIMES_PER_INTERVAL + 1) / TIMES_PER_INTERVAL
        """Times at which distances are kept, from the beginning of the plan [intervals]."""
        weights = np.ones(n)
        weights[-1] = LAST_WEIGHT
        hessian = to_position.T @ (weights[:, None] * to_position)
        self.solver = solver = DualActiveSet(
            np.kron(np.eye(axes), hessian + ACCELERATION_WEIGHT * np.eye(n))
        )
        """Solver of QPs with half-planes."""
        to_sample = _positions(self.times, place, T)
        self.constants = QPConstants(
            T, acceleration_mps2, most, weights, to_position, self.times, to_sample
        )
        # Bounds of the input v + τ a at the end and at the beginning of each interval.
        ends = [to_velocity + tau_s[x] * np.eye(n) for x in range(axes)]
        before = np.vstack([np.zeros(n), to_velocity[:-1]])
        begins = [before + tau_s[x] * np.eye(n) for x in range(axes)]
        both = np.vstack([np.eye(n * axes), _blocks(ends), _blocks(begins)])
        fixed = np.vstack([_blocks([to_velocity[-1:]] * axes), both, -both])
        self._fixed = np.ascontiguousarray(fixed.T)
        """Columns of the constraints that are always present."""
        self._axes = axes
        of_axis = [range(x * n, (x + 1) * n) for x in range(axes)]
        # In the order of `_fill_axis`.
        rows = [
            [x, *(axes + group * n * axes + i for group in range(6) for i in of_axis[x])]
            for x in range(axes)
        ]
        m = 6 * n + 1
        self.axis_problem = AxisProblem(
            np.stack([solver.root[np.ix_(of, of)] for of in of_axis]),
            np.stack([self._fixed[np.ix_(of, row)] for of, row in zip(of_axis, rows, strict=True)]),
            linear=np.zeros(n),
            bounds=np.zeros(m),
            x=np.zeros(n),
            scratch=workspace(n, m),
        )
        passed_s = self.times * T
        along_m = np.minimum(acceleration_mps2 * passed_s**2, 2.0 * most.max() * passed_s)
        self.reach_m = np.sqrt(axes) * along_m
        """Largest distance at `times` between two motions from the same state [m]."""

    def solve(
        self, kept_p: Array, kept_v: Array, targets: Array, planes: HalfPlanes | None = None
    ) -> tuple[Array, Array] | None:
        """Positions and velocities of the knots, kept ones first; None without a solution.

        Args:
            kept_p, kept_v: knots of the motion in force up to the beginning of the plan [m, m/s];
                shape (kept, axes).
            targets: g_1 … g_N [m]; shape (N, axes).
            planes: constraints on positions at `times`.
        """
        kept = len(kept_p)
        position, velocity = np.empty((2, kept + INTERVALS, self._axes))
        position[:kept], velocity[:kept] = kept_p, kept_v
        if not planes or not len(planes.time):
            is_solved = solve_axes(
                self.constants, self.axis_problem, kept, targets, position, velocity
            )
            return (position, velocity) if is_solved else None
        x = self.solver.solve(*self.problem(kept_p[-1], kept_v[-1], targets, planes), self._axes)
        if x is None:
            return None
        _integrate(self.constants, x, kept, position, velocity)
        return position, velocity

    def problem(
        self, p0: Array, v0: Array, targets: Array, planes: HalfPlanes | None
    ) -> tuple[Array, Array, Array]:
        """QP for `DualActiveSet` from the state p0, v0 on: linear term, columns and bounds."""
        columns, (variables, fixed) = self._fixed, self._fixed.shape
        linear = np.empty(variables)
        bounds = np.empty(fixed + (len(planes.time) if planes else 0))
        _fill_qp(self.constants, p0, v0, targets, linear, bounds)
        # Half-planes follow the constraints that are always present.
        if planes and len(planes.time):
            columns = np.empty((variables, len(bounds)))
            columns[:, :fixed] = self._fixed
            _append_half_planes(self.constants, p0, v0, planes, columns, bounds)
        return linear, columns, bounds

    def at_times(self, position: Array, velocity: Array) -> Array:
        """Positions at `times` of knots returned by `solve` [m]; shape (times, axes)."""
        position, velocity = position[-INTERVALS - 1 :], velocity[-INTERVALS - 1 :]
        accelerations = np.diff(velocity, axis=0) / self.constants.T
        drifting = position[0] + self.times[:, None] * self.constants.T * velocity[0]
        placed: Array = drifting + self.constants.to_sample @ accelerations
        return placed


@kernel
def _fill_qp(constants: QPConstants, p0: F1, v0: F1, targets: F2, linear: F1, bounds: F1) -> None:
    axes = len(p0)
    for x in range(axes):
        _fill_axis(constants, x, p0[x], v0[x], targets, linear, bounds, x, axes)


@part
def _fill_axis(
    constants: QPConstants,
    x: int,
    p0: float,
    v: float,
    targets: F2,
    linear: F1,
    bounds: F1,
    at: int,
    axes: int,
) -> None:
    """Fill in linear term and bounds of axis x, which is number `at` of a QP's axes."""
    n, a, most = len(constants.weights), constants.acceleration, constants.most[x]
    bounds[at] = -v
    for i in range(n):
        linear[at * n + i] = 0.0
        # In the order of `TrajectoryQP._fixed`: accelerations, inputs at the ends and beginnings of
        # intervals, each lower and then upper bound.
        for group, limit in enumerate((-a, -most - v, -most - v, -a, v - most, v - most)):
            bounds[axes + (group * axes + at) * n + i] = limit
    for j in range(n):
        free = p0 + (j + 1) * constants.T * v
        for i in range(n):
            weighed = constants.weights[j] * (free - targets[j, x])
            linear[at * n + i] -= constants.to_position[j, i] * weighed


@making_kernel
def solve_axes(
    constants: QPConstants, problem: AxisProblem, kept: int, targets: F2, position: F2, velocity: F2
) -> bool:
    """Fill in the knots of a motion without half-planes; returns whether there is a solution.

    Args:
        kept: number of knots taken from the motion in force.
        targets: g_1 … g_N [m]; shape (N, axes).
        position, velocity: knots, the kept ones first [m, m/s]; shape (kept + N, axes).
    """
    linear, bounds = problem.linear, problem.bounds
    for x in range(targets.shape[1]):
        p0, v0 = position[kept - 1, x], velocity[kept - 1, x]
        _fill_axis(constants, x, p0, v0, targets, linear, bounds, 0, 1)
        columns, scratch = problem.columns[x], problem.scratch
        if solve_qp(problem.root[x], linear, problem.x, columns, bounds, 1, scratch) != SOLVED:
            return False
        _integrate_axis(constants, problem.x, 0, x, kept, position, velocity)
    return True


@part
def _integrate_axis(
    constants: QPConstants,
    accelerations: F1,
    first: int,
    x: int,
    kept: int,
    position: F2,
    velocity: F2,
) -> None:
    """Fill in the knots of an axis from its accelerations, which begin at index `first`."""
    n = len(constants.weights)
    p0, v0 = position[kept - 1, x], velocity[kept - 1, x]
    gained, moved = 0.0, 0.0
    for i in range(n):
        knot = kept + i
        gained += constants.T * accelerations[first + i]
        # The last velocity is 0 only within the solver's tolerance, but a motion has to end at
        # rest.
        velocity[knot, x] = v0 + gained if i < n - 1 else 0.0
        # Positions follow from these velocities, whatever error the solver's tolerance has left.
        moved += 0.5 * constants.T * (velocity[knot, x] + velocity[knot - 1, x])
        position[knot, x] = p0 + moved


@kernel
def _append_half_planes(
    constants: QPConstants, p0: F1, v0: F1, planes: HalfPlanes, columns: F2, bounds: F1
) -> None:
    n, fixed = len(constants.weights), len(bounds) - len(planes.time)
    for m in range(len(planes.time)):
        at = planes.time[m]
        bound = planes.bound[m]
        for x in range(len(p0)):
            normal = planes.normal[m, x]
            bound -= normal * (p0[x] + constants.times[at] * constants.T * v0[x])
            for i in range(n):
                columns[x * n + i, fixed + m] = normal * constants.to_sample[at, i]
        bounds[fixed + m] = bound


@kernel
def _integrate(
    constants: QPConstants, accelerations: F1, kept: int, position: F2, velocity: F2
) -> None:
    n = len(constants.weights)
    for x in range(position.shape[1]):
        _integrate_axis(constants, accelerations, x * n, x, kept, position, velocity)


def _positions(times: Array, place: Indices, T: float) -> Array:
    """Positions from accelerations of intervals, at times in intervals [s²]; shape (times, n)."""
    into = np.clip(times[:, None] - place, 0.0, None)
    inside = np.minimum(into, 1.0)
    moved: Array = T * T * (0.5 * inside**2 + inside * (into - inside))
    return moved


def _blocks(blocks: list[Array]) -> Array:
    rows, columns = (sum(block.shape[axis] for block in blocks) for axis in (0, 1))
    whole, row, column = np.zeros((rows, columns)), 0, 0
    for block in blocks:
        whole[row : row + len(block), column : column + block.shape[1]] = block
        row, column = row + len(block), column + block.shape[1]
    return whole
