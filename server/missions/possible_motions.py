"""Possible motions of all vehicles in arrays, with their uncertainty.

The server knows the position of each vehicle on its motion up to the error of the vehicle's step
number by the server's count (`planning.clock.StepError`). For two vehicles only the sum of their
errors matters: the number of steps by which the second may be ahead or behind. So the first vehicle
is assumed to be at its step by the server's count, and the second anywhere between two steps, on a
piece of its path. The piece is longer at a higher speed, and a single point at rest.

In three dimensions a vehicle without contact lands after a while. From the first possible step of
the landing on, the vehicle may be anywhere between the end of its motion and the ground. So in the
end any two motions have to be apart horizontally.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.server.missions.compiled_motion import MotionMetric, bounding_box, last_step
from skytether.server.planning.clock import EXACT, StepError
from skytether.shared.base.kernel import F1, F2, F3, I1, kernel, making_kernel, making_part, part
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, Motion

KNOTS = INTERVALS + JOIN_MAX + 1
"""Largest number of knots of a motion."""
NEVER = 2**62


class PossibleMotion(NamedTuple):
    """Motion that a vehicle may be flying, in steps of the common time grid."""

    motion: Motion
    lands: int = NEVER
    error: StepError = EXACT


class MotionArrays(NamedTuple):
    """Possible motions as arrays with a row for each motion; shapes (capacity, …)."""

    first: I1
    knots: I1
    row: I1
    lands: I1
    extra: F1
    """Additional distance to keep from the motion [m]."""
    early: F1
    """Largest number of steps by which the vehicle may be ahead of the server's estimate, see
    `planning.clock.StepError`."""
    late: F1
    """Largest number of steps by which the vehicle may be behind the server's estimate."""
    position: F3
    """Positions of the knots [m]; shape (capacity, KNOTS, axes)."""
    velocity: F3
    """Velocities of the knots [m/s]; shape (capacity, KNOTS, axes)."""
    low: F2
    """Lower corner of a box around the whole motion, scaled [m]; shape (capacity, axes)."""
    high: F2
    """Upper corner of the box, scaled [m]; shape (capacity, axes)."""


class PossibleMotions:
    """All motions that vehicles may be flying; `scale`: see `MotionMetric`."""

    def __init__(self, scale: Array, dt_s: float) -> None:
        self.count = 0
        self.metric = MotionMetric(scale, dt_s)
        capacity, axes = 64, len(scale)
        numbers, floats = np.zeros((4, capacity), dtype=np.int64), np.zeros((3, capacity))
        knots, corners = np.zeros((2, capacity, KNOTS, axes)), np.zeros((2, capacity, axes))
        self.arrays = MotionArrays._make([*numbers, *floats, *knots, *corners])

    def replace(self, row: int, motions: Sequence[PossibleMotion], extra_m: float = 0.0) -> None:
        self.count = _remove(self.arrays, self.count, row, self.metric)
        for motion in motions:
            self.add(row, motion, extra_m)

    def add(self, row: int, motion: PossibleMotion, extra_m: float = 0.0) -> None:
        """Add a motion; other vehicles keep the additional distance `extra_m` [m] from it."""
        if self.count == len(self.arrays.row):
            self.arrays = MotionArrays._make(
                np.concatenate([each, np.zeros_like(each)]) for each in self.arrays
            )
        _add(self.arrays, self.count, row, motion, extra_m, self.metric)
        self.count += 1

    def set_errors(self, early: Array, late: Array) -> None:
        """Set the errors of all vehicles' step numbers, by row [steps]; shape (capacity,)."""
        n, rows = self.count, self.rows
        self.arrays.early[:n], self.arrays.late[:n] = early[rows], late[rows]

    @property
    def rows(self) -> Indices:
        return self.arrays.row[: self.count]


@making_part  # compiled with reference counts, because it returns arrays
def motion_at(arrays: MotionArrays, m: int) -> PossibleMotion:
    n = arrays.knots[m]
    return PossibleMotion(
        Motion(arrays.first[m], arrays.position[m, :n], arrays.velocity[m, :n]),
        arrays.lands[m],
        StepError(arrays.early[m], arrays.late[m]),
    )


@part
def write(
    arrays: MotionArrays,
    m: int,
    row: int,
    motion: PossibleMotion,
    extra: float,
    metric: MotionMetric,
) -> None:
    position, velocity = motion.motion.position, motion.motion.velocity
    n, axes = position.shape
    arrays.first[m], arrays.knots[m], arrays.row[m] = motion.motion.first, n, row
    arrays.lands[m], arrays.extra[m] = motion.lands, extra
    arrays.early[m], arrays.late[m] = motion.error.early, motion.error.late
    for knot in range(n):
        for x in range(axes):
            arrays.position[m, knot, x] = position[knot, x]
            arrays.velocity[m, knot, x] = velocity[knot, x]
    lands = motion.lands < NEVER
    bounding_box(motion.motion, lands, metric, arrays.low[m], arrays.high[m])


@kernel
def _add(
    arrays: MotionArrays,
    m: int,
    row: int,
    motion: PossibleMotion,
    extra: float,
    metric: MotionMetric,
) -> None:
    write(arrays, m, row, motion, extra, metric)


@making_kernel
def _remove(arrays: MotionArrays, count: int, row: int, metric: MotionMetric) -> int:
    """Remove a vehicle's motions, fill the gaps with the last motions; return the number left."""
    for m in range(count - 1, -1, -1):
        if arrays.row[m] == row:
            count -= 1
            write(
                arrays, m, arrays.row[count], motion_at(arrays, count), arrays.extra[count], metric
            )
    return count


@part
def is_beyond(arrays: MotionArrays, m: int, low: F1, high: F1, distance: float) -> bool:
    square = 0.0
    for x in range(len(low)):
        off = max(low[x] - arrays.high[m, x], arrays.low[m, x] - high[x], 0.0)
        square += off * off
    return square > distance * distance


@part
def height_above(height: float, one_lands: bool, other_lands: bool) -> float:
    """Height difference that is part of the distance of two vehicles; 0 if the higher may land.

    Args:
        height: height of the first motion above the second [m]; may be negative.
        one_lands, other_lands: whether the first or second vehicle may be landing, and so anywhere
            below its motion.
    """
    if (one_lands and height > 0.0) or (other_lands and height < 0.0):
        return 0.0
    return height


@part
def shifts(one: StepError, other: StepError, drift: float) -> tuple[float, float]:
    """Least and largest number of steps by which another vehicle may be ahead of the first, if the
    first is at its step by the server's count.

    Args:
        one, other: errors of the steps of both vehicles.
        drift: drift of the clocks up to the end of the comparison [steps].
    """
    return -other.late - one.early - drift, other.early + one.late + drift


@part
def moving_shifts(
    other: Motion, begin: float, end: float, least: float, most: float
) -> tuple[float, float]:
    """Bounds of the shifts, between `least` and `most`, at which another motion is not at rest.

    Args:
        begin, end: steps between which the motion is evaluated.
        least, most: bounds of the steps by which the other vehicle may be ahead.
    """
    last = last_step(other)
    return min(max(least, other.first - end), most), max(min(most, last - begin), least)
