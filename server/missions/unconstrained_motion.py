"""Motions of several vehicles straight to their goals, in one call.

Most vehicles on a mission are far from all others, and fly to their goals with no more constraints
than their own limits. The others, and those that get nowhere, are left to `mission_planner`, which
adds half-planes and other waypoints. Numbers are those of `mission_planner`, to the last bit.
"""

import math

import numpy as np

from skytether.server.missions.compiled_motion import Metric, bounding_box, state_at
from skytether.server.missions.possible_motions import (
    NEVER,
    MotionArrays,
    PossibleMotion,
    PossibleMotions,
    motion_at,
    write,
)
from skytether.server.missions.separation import comes_too_near
from skytether.server.missions.trajectory_qp import (
    AxisProblem,
    QPConstants,
    TrajectoryQP,
    solve_axes,
)
from skytether.shared.base.kernel import F2, F3, I1, making_kernel
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SPACING, Motion

TIE_M = 1e-9
"""Difference from a threshold below which rounding might decide [m]."""


class UnconstrainedPlanner:
    """Planner of motions straight to goals.

    Args:
        qp: the QP.
        possible: motions of all that may be flown, and those that are planned.
        kept: number of knots in which a motion is the one in force.
        distance_m: distance that is kept from others [m].
        stuck: share of the way to the goal, 2 m at most, below which a plan is taken for stuck.
    """

    def __init__(
        self,
        qp: TrajectoryQP,
        possible: PossibleMotions,
        kept: int,
        distance_m: float,
        stuck: float,
    ) -> None:
        self._qp, self._possible, self._kept = qp, possible, kept
        self._distance_m, self._stuck = distance_m, stuck

    def motions(self, rows: Indices, steps: Indices, ahead: Indices, goals: Array) -> list[Motion]:
        """Motions of the first of some vehicles, one after the other; each keeps clear of all
        before.

        Planning stops at the first vehicle that cannot fly straight. The motions are added to those
        that may be flown.

        Args:
            rows: the vehicles, each with one motion that may be flown; shape (n,).
            steps: k of each, of its own; shape (n,).
            ahead: steps by which these are ahead of those in common; shape (n,).
            goals: goal of each [m]; shape (n, axes).
        """
        possible, (n, axes) = self._possible, goals.shape
        possible.reserve(n)
        position, velocity = np.empty((2, n, self._kept + INTERVALS, axes))
        done = _plan_motions(
            self._qp.constants,
            self._qp.axis_problem,
            rows,
            steps - ahead,
            goals,
            possible.arrays,
            possible.count,
            possible.metric,
            self._kept,
            self._distance_m,
            self._stuck,
            position,
            velocity,
        )
        possible.count += done
        knots = zip(steps[:done].tolist(), position, velocity, strict=False)
        return [Motion(*each) for each in knots]


@making_kernel
def _plan_motions(
    constants: QPConstants,
    problem: AxisProblem,
    rows: I1,
    begins: I1,
    goals: F2,
    possible: MotionArrays,
    count: int,
    metric: Metric,
    kept: int,
    distance: float,
    stuck: float,
    position: F3,
    velocity: F3,
) -> int:
    """Fill in the knots of `UnconstrainedPlanner.motions`; returns the number of motions.

    Args:
        constants, problem: see `TrajectoryQP`.
        rows, goals: see `UnconstrainedPlanner.motions`.
        begins: step of each in common; shape (n,).
        possible, count: motions that may be flown, and their number before.
        metric: see `PossibleMotions`.
        kept, distance, stuck: see `UnconstrainedPlanner`.
        position, velocity: output: knots of each [m, m/s]; shape (n, knots, axes).
    """
    axes = goals.shape[1]
    scratch = np.empty((6, axes))
    for i in range(len(rows)):
        row, begin, total = rows[i], begins[i], count + i
        own = 0
        while own < total and possible.row[own] != row:
            own += 1
        in_force, extra = motion_at(possible, own), possible.extra[own]
        for knot in range(kept):
            for x in range(axes):
                step = float(begin + knot * SPACING)
                state = state_at(in_force.motion, x, step, metric.dt_s)
                position[i, knot, x], velocity[i, knot, x] = state
        if not solve_axes(constants, problem, kept, goals[i], position[i], velocity[i]):
            return i
        moved, far = 0.0, 0.0
        for x in range(axes):
            moved += (position[i, -1, x] - position[i, kept - 1, x]) ** 2
            far += (goals[i, x] - position[i, kept - 1, x]) ** 2
        if math.sqrt(moved) < stuck * min(math.sqrt(far), 2.0) + TIE_M:
            return i
        motion = Motion(begin, position[i], velocity[i])
        planned = PossibleMotion(motion, in_force.lands, in_force.error)
        bounding_box(motion, planned.lands < NEVER, metric, scratch[4], scratch[5])
        for m in range(total):
            if possible.row[m] != row and comes_too_near(
                planned, in_force.motion, begin, possible, m, metric, distance + extra, scratch
            ):
                return i
        write(possible, total, row, planned, extra, metric)
    return len(rows)
