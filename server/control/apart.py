"""Distances between motions at every time, and the half-planes that keep motions apart.

Distances along the third axis may count less than those in the plane: all are of coordinates that
are multiplied by `scale` first. So a sphere of that metric is an ellipsoid, higher than it is wide,
as downwash asks for.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.base.kernel import F1, F2, F3, I1, making_kernel, making_part
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, Motion

KNOTS = INTERVALS + JOIN_MAX + 1
"""Largest number of knots of a motion."""
SAMPLES = 4
"""Number of straight pieces that an interval of a motion is taken for."""


class FlownMotions:
    """Motions that may be flown, side by side, by steps that all vehicles have in common.

    Args:
        axes: number of axes.
    """

    def __init__(self, axes: int) -> None:
        self._axes = axes
        self.clear(64)

    def clear(self, room: int = 0) -> None:
        """Remove all motions; makes room for so many where that is more than there was."""
        self.count = 0
        if room:
            self._first, self._knots, self._of = (np.zeros(room, dtype=np.int64) for _ in range(3))
            self._wide = np.zeros(room)
            self._position, self._velocity = np.zeros((2, room, KNOTS, self._axes))

    def add(self, motion: Motion, ahead: int, row: int, wide_m: float = 0.0) -> None:
        """Add a motion.

        Args:
            motion: by the steps of its vehicle.
            ahead: number of steps by which that is ahead of those in common.
            row: of the vehicle.
            wide_m: distance to be kept from it beyond that from others [m].
        """
        i, knots = self.count, len(motion.position)
        if i == len(self._first):
            for name in ("_first", "_knots", "_of", "_wide", "_position", "_velocity"):
                held = getattr(self, name)
                setattr(self, name, np.concatenate([held, np.zeros_like(held)]))
        self._first[i], self._knots[i], self._of[i] = motion.first - ahead, knots, row
        self._wide[i] = wide_m
        self._position[i, :knots], self._velocity[i, :knots] = motion.position, motion.velocity
        self.count += 1

    @property
    def of(self) -> Indices:
        """Row of the vehicle of each; shape (count,)."""
        return self._of[: self.count]

    @property
    def wide_m(self) -> Array:
        """Distance to be kept from each beyond that from others [m]; shape (count,)."""
        return self._wide[: self.count]

    @property
    def arrays(self) -> tuple[Indices, Indices, Array, Array, Indices]:
        """First step, number of knots, positions and velocities of these, and row of each."""
        n = self.count
        return self._first[:n], self._knots[:n], self._position[:n], self._velocity[:n], self.of

    @property
    def last(self) -> int:
        """Step from which on all of them rest."""
        first, knots, *_ = self.arrays
        return int((first + (knots - 1) * SPACING).max(initial=-(2**62)))


def least_apart(
    motion: Motion, begin: int, row: int, flown: FlownMotions, scale: Array, dt_s: float
) -> Array:
    """Least distance of a motion from each that may be flown, from a step on for ever [m].

    It is that of straight pieces, SAMPLES an interval, which `bend_m` makes up for.

    Args:
        motion: by the steps in common.
        begin: step from which on.
        row: the vehicle's, whose own motions do not count.
        flown: motions of all.
        scale: see above; shape (axes,).
        dt_s: length of a step [s].

    Returns:
        shape (flown.count,); infinite for its own.
    """
    least = np.empty(flown.count)
    points, _ = motion.at(pieces_of(begin, max(motion.last, flown.last)), dt_s)
    _least_apart(points, begin, row, *flown.arrays, scale, dt_s, least)
    return least


def pieces_of(begin: int, end: int) -> Array:
    """Steps between which motions are taken for straight, until they rest; shape (n,)."""
    count = max(-(-(end - begin) * SAMPLES // SPACING), 1)
    return np.linspace(begin, begin + count * SPACING / SAMPLES, count + 1)


def bend_m(acceleration_mps2: float, dt_s: float) -> float:
    """Largest distance of a motion of at most this acceleration from its straight pieces [m]."""
    return acceleration_mps2 * (SPACING / SAMPLES * dt_s) ** 2 / 8.0


class HalfPlanes(NamedTuple):
    """Constraints normal · p ≥ least on positions at some times."""

    at: Indices
    """Index of the time; shape (n,)."""
    normal: Array
    """Shape (n, axes)."""
    least: Array
    """Shape (n,) [m]."""
    of: Indices
    """Index of the other motion; shape (n,)."""

    def of_some(self, taken: Flags) -> "HalfPlanes":
        """Half-planes that keep apart from some of the other motions."""
        some = taken[self.of]
        return HalfPlanes(self.at[some], self.normal[some], self.least[some], self.of[some])


def half_planes(
    times: Array,
    held: Array,
    reach_m: Array,
    row: int,
    flown: FlownMotions,
    scale: Array,
    apart_m: float,
    dt_s: float,
) -> HalfPlanes:
    """Half-planes normal to the lines from the others' motions to the one in force.

    Args:
        times: steps in common; shape (n,).
        held: positions of the one in force then [m]; shape (n, axes).
        reach_m: distance from there within which the plan stays [m]; shape (n,).
        row: the vehicle's, whose own motions do not count.
        flown: motions of all.
        scale: see above; shape (axes,).
        apart_m: distance that is kept [m]; less where the one in force is nearer already.
        dt_s: length of a step [s].
    """
    most = len(times) * flown.count
    found = HalfPlanes(
        np.empty(most, dtype=np.int64),
        np.empty((most, len(scale))),
        np.empty(most),
        np.empty(most, dtype=np.int64),
    )
    those = (*flown.arrays, flown.wide_m + apart_m)
    n = _half_planes(times, held, reach_m, row, *those, scale, dt_s, *found)
    return HalfPlanes(found.at[:n], found.normal[:n], found.least[:n], found.of[:n])


@making_part
def _place(
    first: int, knots: int, position: F2, velocity: F2, axis: int, step: float, dt_s: float
) -> float:
    """Position of a motion on an axis at a step."""
    along = (step - first) / SPACING
    if along <= 0.0:
        return float(position[0, axis])
    if along >= knots - 1:
        return float(position[knots - 1, axis])
    knot = int(along)
    T = SPACING * dt_s
    t = (along - knot) * T
    v = velocity[knot, axis]
    return float(position[knot, axis] + t * (v + 0.5 * t / T * (velocity[knot + 1, axis] - v)))


@making_kernel
def _least_apart(
    points: F2,
    begin: int,
    row: int,
    first: I1,
    knots: I1,
    position: F3,
    velocity: F3,
    rows: I1,
    scale: F1,
    dt_s: float,
    least: F1,
) -> None:
    """Fill in `least_apart` of points SPACING / SAMPLES steps apart, from `begin` on."""
    axes = points.shape[1]
    here, there = np.empty(axes), np.empty(axes)
    for m in range(len(first)):
        nearest = np.inf
        if rows[m] == row:
            least[m] = nearest
            continue
        for i in range(len(points)):
            step = begin + i * (SPACING / SAMPLES)
            for x in range(axes):
                q = _place(first[m], knots[m], position[m], velocity[m], x, step, dt_s)
                here[x] = there[x]
                there[x] = scale[x] * (points[i, x] - q)
            if i == 0:
                here[:] = there
            way, off = 0.0, 0.0
            for x in range(axes):
                way += (there[x] - here[x]) ** 2
                off -= here[x] * (there[x] - here[x])
            # Nearest point of the straight piece from `here` to `there` to the origin, where the
            # other one is.
            t = min(max(off / way, 0.0), 1.0) if way > 0.0 else 0.0
            square = 0.0
            for x in range(axes):
                square += (here[x] + t * (there[x] - here[x])) ** 2
            nearest = min(nearest, square)
        least[m] = np.sqrt(nearest)


@making_kernel
def _half_planes(
    times: F1,
    held: F2,
    reach: F1,
    row: int,
    first: I1,
    knots: I1,
    position: F3,
    velocity: F3,
    rows: I1,
    apart: F1,
    scale: F1,
    dt_s: float,
    at: I1,
    normal: F2,
    least: F1,
    of: I1,
) -> int:
    """Fill in `half_planes`; the number of them."""
    n, axes = 0, len(scale)
    place, off = np.empty(axes), np.empty(axes)
    for m in range(len(first)):
        if rows[m] == row:
            continue
        for i in range(len(times)):
            square = 0.0
            for x in range(axes):
                place[x] = _place(first[m], knots[m], position[m], velocity[m], x, times[i], dt_s)
                off[x] = scale[x] * (held[i, x] - place[x])
                square += off[x] * off[x]
            away = np.sqrt(square)
            # Out of reach, the constraint could never be active; at the very same place it has no
            # direction.
            if away >= apart[m] + reach[i] or away == 0.0:
                continue
            # Where two are too near already, the plane runs just behind the motion in force, which
            # so remains a solution.
            offset = min(apart[m], away - 1e-4)
            for x in range(axes):
                normal[n, x] = scale[x] * off[x] / away
                offset += normal[n, x] * place[x]
            at[n], least[n], of[n] = i, offset, m
            n += 1
    return n
