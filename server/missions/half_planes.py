"""Half-planes that keep a motion apart from those of other vehicles.

Each is normal to the line from the nearest point where another vehicle may be at a time to the
motion in force then.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.common.clock import EXACT, StepError
from skytether.server.missions.compiled_motion import Metric, position_at
from skytether.server.missions.possible_motions import (
    KNOTS,
    NEVER,
    MotionArrays,
    PossibleMotions,
    height_above,
    is_beyond,
    motion_at,
    moving_shifts,
    shifts,
)
from skytether.shared.base.kernel import F1, F2, I1, making_kernel, part
from skytether.shared.core.time_of_day import DRIFT
from skytether.shared.law.model import ALTITUDE, Array, Flags
from skytether.shared.law.motion import SAMPLES, SPACING, Motion


class HalfPlanes(NamedTuple):
    """Constraints normal · p ≥ bound on positions p at some times."""

    time: I1
    """Index of the time; shape (n,)."""
    normal: F2
    """Shape (n, axes)."""
    bound: F1
    """Shape (n,) [m]."""
    other: I1
    """Index of the motion that is kept apart from; shape (n,)."""

    def from_some(self, chosen: Flags) -> "HalfPlanes":
        """Half-planes that keep apart from the chosen motions alone; shape (motions,)."""
        some = chosen[self.other]
        return HalfPlanes._make(each[some] for each in self)


def half_planes(
    times: Array,
    in_force: Array,
    reach_m: Array,
    row: int,
    lands: int,
    possible: PossibleMotions,
    distance_m: float,
    error: StepError = EXACT,
) -> HalfPlanes:
    """Half-planes normal to the lines from the others' motions to the one in force.

    Of a motion whose step is not known exactly it is the nearest point of where it may be then, and
    the plane is in front of all of that.

    Args:
        times: steps in common; shape (n,).
        in_force: positions of the motion in force then [m]; shape (n, axes).
        reach_m: distance from there within which the plan stays [m]; shape (n,).
        row: row of the vehicle, whose own motions do not count.
        lands: first step at which it may begin to land, or NEVER.
        possible: motions of all vehicles.
        distance_m: distance that is kept [m]; less where the motion in force is nearer already.
        error: error of the vehicle's own steps.
    """
    most = len(times) * possible.count
    planes = HalfPlanes(
        np.empty(most, dtype=np.int64),
        np.empty((most, in_force.shape[1])),
        np.empty(most),
        np.empty(most, dtype=np.int64),
    )
    others = possible.arrays, possible.count, possible.metric
    n = _half_planes(times, in_force, reach_m, row, lands, error, *others, distance_m, planes)
    return HalfPlanes._make(each[:n] for each in planes)


@making_kernel
def _half_planes(
    times: F1,
    in_force: F2,
    reach: F1,
    row: int,
    lands: int,
    error: StepError,
    others: MotionArrays,
    count: int,
    metric: Metric,
    distance: float,
    planes: HalfPlanes,
) -> int:
    """Fill in `half_planes`; the number of them."""
    scale, n, final = metric.scale, 0, len(times) - 1
    axes = len(scale)
    low, high, off, scratch = np.empty((4, axes))
    # Where the other one may be at a time: corners of its way then.
    way = np.empty(((KNOTS - 1) * SAMPLES + 4, axes))
    drift = 2.0 * (times[final] - times[0]) / DRIFT
    for x in range(axes):
        low[x], high[x] = scale[x] * in_force[:, x].min(), scale[x] * in_force[:, x].max()
        if x == ALTITUDE and lands < NEVER:
            low[x] = min(low[x], 0.0)
    for m in range(count):
        keep = distance + others.extra[m]
        if others.row[m] == row or is_beyond(others, m, low, high, keep + reach.max()):
            continue
        other = motion_at(others, m)
        least, most = shifts(error, other.error, drift)
        for i in range(len(times)):
            # At the last time all are at rest, and in the end down that ever land.
            descends = times[i] >= lands or (i == final and lands < NEVER)
            other_descends = times[i] + most >= other.lands or (i == final and other.lands < NEVER)
            corners = _possible_way(other.motion, times[i], least, most, metric.dt_s, way)
            away = _offset_from_way(
                in_force[i], way[:corners], descends, other_descends, scale, off, scratch
            )
            # Out of reach, the constraint could never be active; at the very same place it has no
            # direction.
            if away >= keep + reach[i] or away == 0.0:
                continue
            own = 0.0
            for x in range(axes):
                planes.normal[n, x] = scale[x] * off[x] / away
                own += planes.normal[n, x] * in_force[i, x]
            # Where two are too near already, the plane runs just behind the motion in force, which
            # so remains a solution.
            ahead = (way[:corners] * planes.normal[n]).sum(axis=1).max()
            planes.time[n], planes.bound[n], planes.other[n] = i, min(ahead + keep, own - 1e-4), m
            n += 1
    return n


@part
def _possible_way(
    other: Motion, step: float, least: float, most: float, dt_s: float, way: F2
) -> int:
    """Fill in corners of the way on which another vehicle may be at a step; their number.

    Args:
        least, most: steps by which it may be further on.
        way: output [m]; shape (corners, axes).
    """
    first, last = moving_shifts(other, step, step, least, most)
    slices = int(np.ceil((last - first) * SAMPLES / SPACING))
    for j in range(slices + 1):
        shift = first + (last - first) * j / max(slices, 1)
        for x in range(way.shape[1]):
            way[j, x] = position_at(other, x, step + shift, dt_s)
    return slices + 1


@part
def _offset_from_way(
    place: F1, way: F2, descends: bool, other_descends: bool, scale: F1, off: F1, scratch: F1
) -> float:
    """Distance of a place from the nearest point of a way, scaled [m].

    Args:
        place: shape (axes,).
        way: its corners; shape (n, axes).
        descends, other_descends: whether who is at the place, and who is on the way, may be
            landing.
        off: output: from that point to the place, scaled [m]; shape (axes,).
        scratch: shape (axes,).
    """
    nearest = np.inf
    for j in range(max(len(way) - 1, 1)):
        end = min(j + 1, len(way) - 1)
        along, length = 0.0, 0.0
        for x in range(len(scale)):
            here, there = scale[x] * (place[x] - way[j, x]), scale[x] * (way[end, x] - way[j, x])
            if x == ALTITUDE and height_above(here, descends, other_descends) == 0.0:
                continue
            along, length = along + here * there, length + there * there
        t = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
        square = 0.0
        for x in range(len(scale)):
            away = place[x] - way[j, x] - t * (way[end, x] - way[j, x])
            if x == ALTITUDE:
                away = height_above(away, descends, other_descends)
            scratch[x] = scale[x] * away
            square += scratch[x] * scratch[x]
        if square < nearest:
            nearest = square
            for x in range(len(scale)):
                off[x] = scratch[x]
    return float(np.sqrt(nearest))
