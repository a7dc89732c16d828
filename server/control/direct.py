"""Motions of several vehicles straight to their goals, in one call.

Most vehicles on a mission are far from all others, and fly to their goals with no more constraints
than their own limits. Whoever is not, or gets nowhere, is left to `together`, which takes in
half-planes and aims elsewhere. Numbers are those of `together`, to the last bit.
"""

import math

import numpy as np

from skytether.server.control.apart import (
    Flown,
    FlownMotions,
    bound,
    flown_one,
    is_hit,
    state,
    write_down,
)
from skytether.server.control.clock import StepError
from skytether.server.control.motionplan import AxisProblem, MotionPlan, Posing, flown_alone
from skytether.shared.base.kernel import F1, F2, F3, I1, making_kernel
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SPACING, Motion

NEAR = 1e-9
"""Difference from a threshold below which rounding might decide [m]."""


class Direct:
    """Planner of motions straight to goals.

    Args:
        plan: the QP.
        flown: motions of all that may be flown, and those that are planned.
        kept: number of knots in which a motion is the one in force.
        keep_m: distance that is kept from others [m].
        stuck: share of the way to the goal, 2 m at most, below which a plan is taken for stuck.
    """

    def __init__(
        self, plan: MotionPlan, flown: FlownMotions, kept: int, keep_m: float, stuck: float
    ) -> None:
        self._plan, self._flown, self._kept = plan, flown, kept
        self._keep_m, self._stuck = keep_m, stuck

    def motions(self, rows: Indices, steps: Indices, ahead: Indices, goals: Array) -> list[Motion]:
        """Motions of the first of some vehicles, one after the other; each keeps clear of all
        before.

        They are those up to the first vehicle that cannot fly straight, and are put to the motions
        that may be flown.

        Args:
            rows: the vehicles, each with one motion that may be flown; shape (n,).
            steps: k of each, of its own; shape (n,).
            ahead: steps by which these are ahead of those in common; shape (n,).
            goals: goal of each [m]; shape (n, axes).
        """
        flown, (n, axes) = self._flown, goals.shape
        flown.make_room(n)
        position, velocity = np.empty((2, n, self._kept + INTERVALS, axes))
        done = _fly_direct(
            self._plan.posing,
            self._plan.alone,
            rows,
            steps - ahead,
            goals,
            flown.arrays,
            flown.count,
            flown.scale,
            flown.dt_s,
            self._kept,
            self._keep_m,
            self._stuck,
            position,
            velocity,
        )
        flown.count += done
        knots = zip(steps[:done].tolist(), position, velocity, strict=False)
        return [Motion(*each) for each in knots]


@making_kernel
def _fly_direct(
    posing: Posing,
    one: AxisProblem,
    rows: I1,
    begins: I1,
    goals: F2,
    flown: Flown,
    count: int,
    scale: F1,
    dt_s: float,
    kept: int,
    keep: float,
    stuck: float,
    position: F3,
    velocity: F3,
) -> int:
    """Fill in the knots of `Direct.motions`; returns the number of motions.

    Args:
        posing, one: of the plan.
        rows, goals: see `Direct.motions`.
        begins: step of each in common; shape (n,).
        flown, count: motions that may be flown, and their number before.
        scale, dt_s: see `FlownMotions`.
        kept, keep, stuck: see `Direct`.
        position, velocity: output: knots of each [m, m/s]; shape (n, knots, axes).
    """
    axes = goals.shape[1]
    scratch = np.empty((6, axes))
    for i in range(len(rows)):
        row, begin, total = rows[i], begins[i], count + i
        own = 0
        while own < total and flown.of[own] != row:
            own += 1
        base = flown_one(flown, own)
        for knot in range(kept):
            for x in range(axes):
                step = float(begin + knot * SPACING)
                position[i, knot, x], velocity[i, knot, x] = state(base, x, step, dt_s)
        if not flown_alone(posing, one, kept, goals[i], position[i], velocity[i]):
            return i
        moved, far = 0.0, 0.0
        for x in range(axes):
            moved += (position[i, -1, x] - position[i, kept - 1, x]) ** 2
            far += (goals[i, x] - position[i, kept - 1, x]) ** 2
        if math.sqrt(moved) < stuck * min(math.sqrt(far), 2.0) + NEAR:
            return i
        motion = Motion(begin, position[i], velocity[i])
        lands, wide = flown.lands[own], flown.wide[own]
        error = StepError(flown.early[own], flown.late[own])
        bound(motion, lands, scale, dt_s, scratch[4], scratch[5])
        for m in range(total):
            if flown.of[m] != row and is_hit(
                motion, base, begin, lands, error, flown, m, scale, dt_s, keep + wide, scratch
            ):
                return i
        write_down(flown, total, row, motion, 0, lands, wide, error, scale, dt_s)
    return len(rows)
