"""The QP of one motion of a vehicle that keeps apart from others.

Until it differs from the motion in force it is that motion. From there on it is planned over the
accelerations a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with g what it aims at, and a half-plane for each motion and each zone that is near, and each time,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is that motion, or the zone's nearest point, and p̃ the motion in force. It fulfils all of
them, so there is always a solution.

A vehicle that is far from all others has no half-planes, and then no constraint joins two axes:
`alone` solves one after the other. Its numbers are those of `solve`, to the last bit: there a term
of another axis only ever adds 0.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control.apart import HalfPlanes
from skytether.server.control.dual import SOLVED, DualSolver, solved
from skytether.shared.base.kernel import F1, F2, F3, I1, kernel, making_kernel, making_part, part
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


class AxisProblem(NamedTuple):
    """QPs of single axes, and scratch to solve them."""

    root: F3
    """Jᵀ of each axis, see `DualSolver`; shape (axes, N, N)."""
    columns: F3
    """Constraints of each axis; shape (axes, N, 6 N + 1)."""
    linear: F1
    least: F1
    x: F1
    slack: F1
    J: F2
    R: F2
    work: F2
    active: I1


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
        self.solver = solver = DualSolver(np.kron(np.eye(axes), hessian + SMOOTH * np.eye(n)))
        """Solver of QPs with half-planes."""
        to_sample = _positions(self.times, place, T)
        self.posing = Posing(
            T, acceleration_mps2, most, weights, to_position, self.times, to_sample
        )
        """Numbers that all QPs have in common."""
        # The input at the end of each interval, and at its begin: v ± within what it can do.
        ends = [to_velocity + tau_s[x] * np.eye(n) for x in range(axes)]
        before = np.vstack([np.zeros(n), to_velocity[:-1]])
        begins = [before + tau_s[x] * np.eye(n) for x in range(axes)]
        both = np.vstack([np.eye(n * axes), _blocks(ends), _blocks(begins)])
        fixed = np.vstack([_blocks([to_velocity[-1:]] * axes), both, -both])
        self._fixed = np.ascontiguousarray(fixed.T)
        """Columns of the constraints that are always there."""
        self._axes = axes
        of_axis = [range(x * n, (x + 1) * n) for x in range(axes)]
        # In the order of `_pose_axis`.
        rows = [
            [x, *(axes + group * n * axes + i for group in range(6) for i in of_axis[x])]
            for x in range(axes)
        ]
        m = 6 * n + 1
        self.alone = AxisProblem(
            np.stack([solver.root[np.ix_(of, of)] for of in of_axis]),
            np.stack([self._fixed[np.ix_(of, row)] for of, row in zip(of_axis, rows, strict=True)]),
            linear=np.zeros(n),
            least=np.zeros(m),
            x=np.zeros(n),
            slack=np.zeros(m),
            J=np.zeros((n, n)),
            R=np.zeros((n, n)),
            work=np.zeros((5, n + 1)),
            active=np.zeros(n + 1, dtype=np.int64),
        )
        """QPs of single axes."""
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
        kept = len(kept_p)
        position, velocity = np.empty((2, kept + INTERVALS, self._axes))
        position[:kept], velocity[:kept] = kept_p, kept_v
        if not planes or not len(planes.at):
            alone = _fly_alone(self.posing, self.alone, kept, goal, position, velocity)
            return (position, velocity) if alone else None
        x = self.solver.solve(*self.posed(kept_p[-1], kept_v[-1], goal, planes), self._axes)
        if x is None:
            return None
        _fly(self.posing, x, kept, position, velocity)
        return position, velocity

    def posed(
        self, p0: Array, v0: Array, goal: Array, planes: HalfPlanes | None
    ) -> tuple[Array, Array, Array]:
        """The QP of `DualSolver`: linear term, columns of the constraints, and their bounds.

        Args:
            p0, v0: state where the plan begins [m, m/s]; shape (axes,).
            goal, planes: see `solve`.
        """
        columns, (variables, fixed) = self._fixed, self._fixed.shape
        linear = np.empty(variables)
        least = np.empty(fixed + (len(planes.at) if planes else 0))
        _pose(self.posing, p0, v0, goal, linear, least)
        # The constraints that are always there are kept as columns, and half-planes are put behind
        # them.
        if planes and len(planes.at):
            columns = np.empty((variables, len(least)))
            columns[:, :fixed] = self._fixed
            _keep_apart(self.posing, p0, v0, planes, columns, least)
        return linear, columns, least

    def at_times(self, position: Array, velocity: Array) -> Array:
        """Positions at `times` of knots that `solve` has found [m]; shape (times, axes)."""
        position, velocity = position[-INTERVALS - 1 :], velocity[-INTERVALS - 1 :]
        accelerations = np.diff(velocity, axis=0) / self.posing.T
        drifting = position[0] + self.times[:, None] * self.posing.T * velocity[0]
        placed: Array = drifting + self.posing.to_sample @ accelerations
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
            for group, bound in enumerate((-a, -most - v, -most - v, -a, v - most, v - most)):
                least[axes + group * N + x * n + i] = bound
        for j in range(n):
            free = p0[x] + (j + 1) * posing.T * v
            for i in range(n):
                weighed = posing.weights[j] * (free - goal[x])
                linear[x * n + i] -= posing.to_position[j, i] * weighed


@part
def _pose_axis(posing: Posing, x: int, p0: float, v: float, goal: float, one: AxisProblem) -> None:
    """Fill in linear term and bounds of the QP of an axis; see `_pose`."""
    n, a, most = len(posing.weights), posing.acceleration, posing.most[x]
    one.least[0] = -v
    for i in range(n):
        one.linear[i] = 0.0
        for group, bound in enumerate((-a, -most - v, -most - v, -a, v - most, v - most)):
            one.least[1 + group * n + i] = bound
    for j in range(n):
        free = p0 + (j + 1) * posing.T * v
        for i in range(n):
            weighed = posing.weights[j] * (free - goal)
            one.linear[i] -= posing.to_position[j, i] * weighed


@making_kernel
def _fly_alone(
    posing: Posing, one: AxisProblem, kept: int, goal: F1, position: F2, velocity: F2
) -> bool:
    """Fill in the knots of a motion that nothing is near; see `flown_alone`."""
    return flown_alone(posing, one, kept, goal, position, velocity)


@making_part
def flown_alone(
    posing: Posing, one: AxisProblem, kept: int, goal: F1, position: F2, velocity: F2
) -> bool:
    """Fill in the knots of a motion that nothing is near; whether there is one.

    Args:
        posing, one: of the plan.
        kept: number of knots that are given, those of the motion in force.
        goal: what it aims at, g [m]; shape (axes,).
        position, velocity: the knots, those that are given first [m, m/s]; shape (kept + N, axes).
    """
    for x in range(len(goal)):
        p0, v0 = position[kept - 1, x], velocity[kept - 1, x]
        _pose_axis(posing, x, p0, v0, goal[x], one)
        if (
            solved(
                one.root[x],
                one.linear,
                one.x,
                one.columns[x],
                one.least,
                1,
                one.slack,
                one.J,
                one.R,
                one.work,
                one.active,
            )
            != SOLVED
        ):
            return False
        _fly_axis(posing, one.x, 0, x, kept, position, velocity)
    return True


@part
def _fly_axis(
    posing: Posing, found: F1, first: int, x: int, kept: int, position: F2, velocity: F2
) -> None:
    """Fill in the knots of an axis by its accelerations, which begin at `first`."""
    n = len(posing.weights)
    p0, v0 = position[kept - 1, x], velocity[kept - 1, x]
    gained, moved = 0.0, 0.0
    for i in range(n):
        knot = kept + i
        gained += posing.T * found[first + i]
        # The last velocity is 0 to within the tolerance of the solver, and a motion has to end at
        # rest.
        velocity[knot, x] = v0 + gained if i < n - 1 else 0.0
        # Positions of what is flown: that velocity, whatever the solver's tolerance has left.
        moved += 0.5 * posing.T * (velocity[knot, x] + velocity[knot - 1, x])
        position[knot, x] = p0 + moved


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
def _fly(posing: Posing, found: F1, kept: int, position: F2, velocity: F2) -> None:
    """Fill in the knots behind those that are kept, by the accelerations that were found."""
    n = len(posing.weights)
    for x in range(position.shape[1]):
        _fly_axis(posing, found, x * n, x, kept, position, velocity)


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
