"""Half-planes that keep a vehicle's new motion away from the motions of other vehicles.

At each sampled time the boundary is normal to the line from the nearest possible position of the
other vehicle to the vehicle's position on its motion in force.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.missions.compiled_motion import MotionMetric, position_at
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
from skytether.server.planning.clock import EXACT, StepError
from skytether.shared.base.kernel import F1, F2, I1, making_kernel, part
from skytether.shared.endpoints.time_of_day import DRIFT
from skytether.shared.law.model import ALTITUDE, Array, Flags
from skytether.shared.law.motion import SAMPLES, SPACING, Motion


class HalfPlanes(NamedTuple):
    """Constraints normal · p ≥ bound on positions p, each at one of the sampled times."""

    time: I1
    """Index of each constraint's time in the sampled times; shape (n,)."""
    normal: F2
    """Unit vector away from the other vehicle; shape (n, axes)."""
    bound: F1
    """Right-hand side of normal · p ≥ bound [m]; shape (n,)."""
    other: I1
    """Index of the possible motion that each constraint keeps away from; shape (n,)."""

    def from_some(self, chosen: Flags) -> "HalfPlanes":
        """Half-planes of the motions whose flag in `chosen` is True; `chosen`: shape (motions,)."""
        selected = chosen[self.other]
        return HalfPlanes._make(each[selected] for each in self)


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
    """Half-planes normal to the lines from other vehicles' motions to the motion in force.

    If the step of another vehicle is not known exactly, the line starts at its nearest possible
    position, and all its possible positions lie behind the plane.

    Args:
        times: sampled steps of the common time grid; shape (n,).
        in_force: positions of the motion in force at these steps [m]; shape (n, axes).
        reach_m: largest distance of the plan from these positions [m]; shape (n,).
        row: row of the vehicle; its own motions are ignored.
        lands: first step at which the vehicle may begin to land, or NEVER.
        possible: motions of all vehicles.
        distance_m: distance to keep [m]; reduced where the motion in force is already nearer.
        error: error of the vehicle's step number by the server's count.
    """
    capacity = len(times) * possible.count
    planes = HalfPlanes(
        np.empty(capacity, dtype=np.int64),
        np.empty((capacity, in_force.shape[1])),
        np.empty(capacity),
        np.empty(capacity, dtype=np.int64),
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
    metric: MotionMetric,
    distance: float,
    planes: HalfPlanes,
) -> int:
    scale, n, final = metric.scale, 0, len(times) - 1
    axes = len(scale)
    low, high, off, scratch = np.empty((4, axes))
    # Possible positions of the other vehicle at a time: corners of a polyline.
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
        least, capacity = shifts(error, other.error, drift)
        for i in range(len(times)):
            # At the last sampled time all vehicles rest, and vehicles that may land have landed.
            descends = times[i] >= lands or (i == final and lands < NEVER)
            other_descends = times[i] + capacity >= other.lands or (
                i == final and other.lands < NEVER
            )
            corners = _possible_way(other.motion, times[i], least, capacity, metric.dt_s, way)
            away = _offset_from_way(
                in_force[i], way[:corners], descends, other_descends, scale, off, scratch
            )
            # No constraint if the vehicles cannot come near each other, or at the same position,
            # so that the plane has no direction.
            if away >= keep + reach[i] or away == 0.0:
                continue
            own = 0.0
            for x in range(axes):
                planes.normal[n, x] = scale[x] * off[x] / away
                own += planes.normal[n, x] * in_force[i, x]
            # If the two vehicles are too near already, the boundary runs just behind the motion in
            # force, so that this motion remains feasible.
            ahead = (way[:corners] * planes.normal[n]).sum(axis=1).max()
            planes.time[n], planes.bound[n], planes.other[n] = i, min(ahead + keep, own - 1e-4), m
            n += 1
    return n


@part
def _possible_way(
    other: Motion, step: float, least: float, most: float, dt_s: float, way: F2
) -> int:
    """Fill in a polyline of another vehicle's possible positions [m]; return the corner count."""
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
    """Distance of a point from the nearest point of a polyline, scaled [m].

    Args:
        place: the point; shape (axes,).
        way: corners of the polyline; shape (n, axes).
        descends, other_descends: whether the vehicle at the point, and the vehicle on the polyline,
            may be landing.
        off: output: vector from the nearest point to `place`, scaled [m]; shape (axes,).
    """
    nearest = np.inf
    for j in range(max(len(way) - 1, 1)):
        end = min(j + 1, len(way) - 1)
        along, length = 0.0, 0.0
        for x in range(len(scale)):
            offset, side = scale[x] * (place[x] - way[j, x]), scale[x] * (way[end, x] - way[j, x])
            if x == ALTITUDE and height_above(offset, descends, other_descends) == 0.0:
                continue
            along, length = along + offset * side, length + side * side
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
