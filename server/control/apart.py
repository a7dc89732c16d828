"""Distances between motions at every time, and the half-planes that keep motions apart.

Distances along the third axis may count less than those in the plane: all are of coordinates that
are multiplied by `scale` first. So a sphere of that metric is an ellipsoid, higher than it is wide,
as downwash asks for.

In space a vehicle that hears nothing lands after a while. From the first step at which it may, it
may be anywhere between its motion, which is at rest by then, and the ground. So in the end any two
motions have to be apart side by side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.shared.base.kernel import (
    B1,
    F1,
    F2,
    F3,
    I1,
    kernel,
    making_kernel,
    making_part,
    part,
)
from skytether.shared.law.model import ALTITUDE, Array, Flags, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SAMPLES, SPACING, Motion

KNOTS = INTERVALS + JOIN_MAX + 1
"""Largest number of knots of a motion."""
NEVER = 2**62
"""Step at which a vehicle lands that never does."""
NEARER_M = 1e-3
"""Tolerance of a solver for motions that are too near already: they may come so much nearer [m]."""


class Flown(NamedTuple):
    """Motions that may be flown, side by side, by steps that all vehicles have in common."""

    first: I1
    """Step of the first knot; shape (room,)."""
    knots: I1
    """Number of knots; shape (room,)."""
    of: I1
    """Row of the vehicle; shape (room,)."""
    lands: I1
    """First step at which it may begin to land; shape (room,)."""
    wide: F1
    """Distance to be kept beyond that from others [m]; shape (room,)."""
    position: F3
    """Positions of the knots [m]; shape (room, KNOTS, axes)."""
    velocity: F3
    """Velocities there [m/s]; shape (room, KNOTS, axes)."""
    low: F2
    """Corner of a box around the whole motion, scaled [m]; shape (room, axes)."""
    high: F2
    """The opposite corner."""


class FlownMotions:
    """All motions that may be flown. Those of a vehicle are replaced when they change.

    Args:
        scale: see above; shape (axes,).
        dt_s: length of a step [s].
    """

    def __init__(self, scale: Array, dt_s: float) -> None:
        self.count = 0
        self.scale, self.dt_s = scale, dt_s
        room, axes = 64, len(scale)
        numbers, widths = np.zeros((4, room), dtype=np.int64), np.zeros(room)
        knots, corners = np.zeros((2, room, KNOTS, axes)), np.zeros((2, room, axes))
        self.arrays = Flown._make([*numbers, widths, *knots, *corners])

    def replace(
        self, row: int, motions: Sequence[Motion], ahead: int, lands: int, wide_m: float
    ) -> None:
        """Replace all motions of a vehicle; see `add`."""
        self.count = _remove(self.arrays, self.count, row)
        for motion in motions:
            self.add(row, motion, ahead, lands, wide_m)

    def add(self, row: int, motion: Motion, ahead: int, lands: int, wide_m: float) -> None:
        """Add a motion.

        Args:
            row: of the vehicle.
            motion: by the steps of its vehicle.
            ahead: number of steps by which that is ahead of those in common.
            lands: first of those in common at which it may begin to land, or NEVER.
            wide_m: distance to be kept from it beyond that from others [m].
        """
        self.make_room(1)
        _add(self.arrays, self.count, row, motion, ahead, lands, wide_m, self.scale, self.dt_s)
        self.count += 1

    def make_room(self, more: int) -> None:
        """Make room for so many more motions."""
        while self.count + more > len(self.arrays.of):
            self.arrays = Flown._make(
                np.concatenate([each, np.zeros_like(each)]) for each in self.arrays
            )

    @property
    def of(self) -> Indices:
        """Row of the vehicle of each; shape (count,)."""
        return self.arrays.of[: self.count]


def states(motion: Motion, begin: int, count: int, dt_s: float) -> tuple[Array, Array]:
    """Positions [m] and velocities [m/s] of a motion at steps SPACING apart; see `Motion.at`.

    Args:
        motion: any.
        begin: the first step.
        count: number of steps.
        dt_s: length of a step [s].

    Returns:
        two arrays of shape (count, axes).
    """
    position, velocity = np.empty((2, count, motion.position.shape[1]))
    _states(motion, begin, dt_s, position, velocity)
    return position, velocity


def too_near(
    motion: Motion,
    base: Motion,
    begin: int,
    row: int,
    lands: int,
    flown: FlownMotions,
    keep_m: float,
) -> Flags:
    """Motions that may be flown to which another one comes too near, from a step on for ever.

    Distances are those of straight pieces, SAMPLES an interval, which `motion.bend_m` makes up for.

    Args:
        motion: by the steps in common.
        base: the one in force. Where that is nearer already, the other need only come no nearer by
            NEARER_M: it may always fly away.
        begin: step from which on.
        row: the vehicle's, whose own motions do not count.
        lands: first step at which it may begin to land, or NEVER.
        flown: motions of all.
        keep_m: distance that is kept from them [m].

    Returns:
        shape (flown.count + 1,); the last, which is for zones, is False.
    """
    hit = np.zeros(flown.count + 1, dtype=np.bool_)
    those = flown.arrays, flown.scale, flown.dt_s
    _too_near(motion, base, begin, row, lands, *those, keep_m, hit)
    return hit


def pieces_of(begin: int, end: int) -> Array:
    """Steps between which motions are taken for straight, until they rest; shape (n,)."""
    count = max(-(-(end - begin) * SAMPLES // SPACING), 1)
    return np.linspace(begin, begin + count * SPACING / SAMPLES, count + 1)


class HalfPlanes(NamedTuple):
    """Constraints normal · p ≥ least on positions at some times."""

    at: I1
    """Index of the time; shape (n,)."""
    normal: F2
    """Shape (n, axes)."""
    least: F1
    """Shape (n,) [m]."""
    of: I1
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
    lands: int,
    flown: FlownMotions,
    apart_m: float,
) -> HalfPlanes:
    """Half-planes normal to the lines from the others' motions to the one in force.

    Args:
        times: steps in common; shape (n,).
        held: positions of the one in force then [m]; shape (n, axes).
        reach_m: distance from there within which the plan stays [m]; shape (n,).
        row: the vehicle's, whose own motions do not count.
        lands: first step at which it may begin to land, or NEVER.
        flown: motions of all.
        apart_m: distance that is kept [m]; less where the one in force is nearer already.
    """
    most = len(times) * flown.count
    found = HalfPlanes(
        np.empty(most, dtype=np.int64),
        np.empty((most, held.shape[1])),
        np.empty(most),
        np.empty(most, dtype=np.int64),
    )
    those = flown.arrays, flown.count, flown.scale, flown.dt_s
    n = _half_planes(times, held, reach_m, row, lands, *those, apart_m, found)
    return HalfPlanes(found.at[:n], found.normal[:n], found.least[:n], found.of[:n])


@part
def state(motion: Motion, axis: int, step: float, dt_s: float) -> tuple[float, float]:
    """Position and velocity of a motion on an axis at a step; see `Motion.at`."""
    position, velocity = motion.position, motion.velocity
    along = (step - motion.first) / SPACING
    if along <= 0.0:
        return position[0, axis], velocity[0, axis]
    if along >= len(position) - 1:
        return position[-1, axis], velocity[-1, axis]
    knot = int(along)
    T = SPACING * dt_s
    t = (along - knot) * T
    v = velocity[knot, axis]
    gained = t / T * (velocity[knot + 1, axis] - v)
    return position[knot, axis] + t * (v + 0.5 * gained), v + gained


@part
def _place(motion: Motion, axis: int, step: float, dt_s: float) -> float:
    """Position of a motion on an axis at a step."""
    return state(motion, axis, step, dt_s)[0]


@kernel
def _states(motion: Motion, begin: int, dt_s: float, position: F2, velocity: F2) -> None:
    """Fill in `states`."""
    for i in range(len(position)):
        for x in range(position.shape[1]):
            step = float(begin + i * SPACING)
            position[i, x], velocity[i, x] = state(motion, x, step, dt_s)


@making_part  # numba counts references to what it returns
def flown_one(flown: Flown, m: int) -> Motion:
    """The motion at a place of those that may be flown."""
    n = flown.knots[m]
    return Motion(flown.first[m], flown.position[m, :n], flown.velocity[m, :n])


@part
def bound(motion: Motion, lands: int, scale: F1, dt_s: float, low: F1, high: F1) -> None:
    """Fill in two corners of a box around a motion, and the landing behind it, scaled [m]."""
    position, velocity = motion.position, motion.velocity
    for x in range(len(scale)):
        low[x], high[x], turn = np.inf, -np.inf, 0.0
        for knot in range(len(position)):
            low[x] = min(low[x], position[knot, x])
            high[x] = max(high[x], position[knot, x])
            if knot:
                turn = max(turn, abs(velocity[knot, x] - velocity[knot - 1, x]))
        # Between two knots, T apart, a parabola is off the straight line by Δv T / 8 at most.
        bend = turn * SPACING * dt_s / 8.0
        low[x], high[x] = scale[x] * (low[x] - bend), scale[x] * (high[x] + bend)
        if x == ALTITUDE and lands < NEVER:
            low[x] = min(low[x], 0.0)


@part
def _is_far(flown: Flown, m: int, low: F1, high: F1, keep: float) -> bool:
    """Whether boxes alone say that a motion keeps its distance from one that may be flown."""
    square = 0.0
    for x in range(len(low)):
        off = max(low[x] - flown.high[m, x], flown.low[m, x] - high[x], 0.0)
        square += off * off
    return square > keep * keep


@part
def _write(
    flown: Flown, m: int, row: int, first: int, position: F2, velocity: F2, lands: int, wide: float
) -> None:
    """Write a motion down at a place, but for its box."""
    n, axes = position.shape
    flown.first[m], flown.knots[m], flown.of[m] = first, n, row
    flown.lands[m], flown.wide[m] = lands, wide
    for knot in range(n):
        for x in range(axes):
            flown.position[m, knot, x] = position[knot, x]
            flown.velocity[m, knot, x] = velocity[knot, x]


@kernel
def _remove(flown: Flown, count: int, row: int) -> int:
    """Remove the motions of a vehicle, the last ones taking their places; number that is left."""
    for m in range(count - 1, -1, -1):
        if flown.of[m] != row:
            continue
        count -= 1
        n, lands, wide = flown.knots[count], flown.lands[count], flown.wide[count]
        position, velocity = flown.position[count, :n], flown.velocity[count, :n]
        _write(flown, m, flown.of[count], flown.first[count], position, velocity, lands, wide)
        for x in range(flown.low.shape[1]):
            flown.low[m, x], flown.high[m, x] = flown.low[count, x], flown.high[count, x]
    return count


@kernel
def _add(
    flown: Flown,
    m: int,
    row: int,
    motion: Motion,
    ahead: int,
    lands: int,
    wide: float,
    scale: F1,
    dt_s: float,
) -> None:
    """Write a motion down at a place, see `FlownMotions.add`."""
    write_down(flown, m, row, motion, ahead, lands, wide, scale, dt_s)


@part
def write_down(
    flown: Flown,
    m: int,
    row: int,
    motion: Motion,
    ahead: int,
    lands: int,
    wide: float,
    scale: F1,
    dt_s: float,
) -> None:
    """Write a motion down at a place, see `FlownMotions.add`."""
    first, position, velocity = motion.first - ahead, motion.position, motion.velocity
    _write(flown, m, row, first, position, velocity, lands, wide)
    bound(motion, lands, scale, dt_s, flown.low[m], flown.high[m])


@part
def _is_down(lands: int, step: float, rest: bool) -> bool:
    """Whether a vehicle may be on its way down.

    Args:
        lands: first step at which it may begin to land, or NEVER.
        step: the present one.
        rest: whether that is after all that is flown, and all have landed that ever do.
    """
    return step >= lands or (rest and lands < NEVER)


@part
def _above(away: float, one_lands: bool, other_lands: bool) -> float:
    """Height of one vehicle above another that counts, each of which may be on its way down.

    Args:
        away: height of the motion of the first above that of the second; negative below it [m].
        one_lands, other_lands: whether each may be landing, and so anywhere below its motion.
    """
    if (one_lands and away > 0.0) or (other_lands and away < 0.0):
        return 0.0
    return away


@part
def _least_apart(
    one: Motion,
    other: Motion,
    begin: int,
    one_lands: int,
    other_lands: int,
    scale: F1,
    dt_s: float,
    here: F1,
    there: F1,
) -> float:
    """Least distance of two motions from a step on, of straight pieces [m].

    Args:
        one_lands, other_lands: first step at which each vehicle may begin to land, or NEVER.
        here, there: scratch; shape (axes,).
    """
    longest = max(
        len(one.position) * SPACING + one.first, len(other.position) * SPACING + other.first
    )
    pieces = max(-(-(longest - SPACING - begin) * SAMPLES // SPACING), 1)
    nearest, height = np.inf, 0.0
    # One piece more than they fly: in the end both may have landed that ever do.
    for i in range(pieces + 2):
        step = begin + i * (SPACING / SAMPLES)
        one_down = _is_down(one_lands, step + SPACING / SAMPLES, i > pieces)
        other_down = _is_down(other_lands, step + SPACING / SAMPLES, i > pieces)
        for x in range(len(scale)):
            away = _place(one, x, step, dt_s) - _place(other, x, step, dt_s)
            passes = False
            if x == ALTITUDE:
                # Who passes the height of the other in this piece may do so anywhere in it.
                passes = (one_down or other_down) and height * away < 0.0
                height = away
                away = 0.0 if passes else _above(away, one_down, other_down)
            here[x], there[x] = there[x] if i else scale[x] * away, scale[x] * away
            if passes:
                here[x] = 0.0
        way, off = 0.0, 0.0
        for x in range(len(scale)):
            way += (there[x] - here[x]) ** 2
            off -= here[x] * (there[x] - here[x])
        # Nearest point of the straight piece from `here` to `there` to the origin, where the
        # other one is.
        t = min(max(off / way, 0.0), 1.0) if way > 0.0 else 0.0
        square = 0.0
        for x in range(len(scale)):
            square += (here[x] + t * (there[x] - here[x])) ** 2
        nearest = min(nearest, square)
    return float(np.sqrt(nearest))


@making_kernel
def _too_near(
    motion: Motion,
    base: Motion,
    begin: int,
    row: int,
    lands: int,
    flown: Flown,
    scale: F1,
    dt_s: float,
    keep: float,
    hit: B1,
) -> None:
    """Fill in `too_near`."""
    scratch = np.empty((4, len(scale)))
    bound(motion, lands, scale, dt_s, scratch[2], scratch[3])
    for m in range(len(hit) - 1):
        if flown.of[m] != row:
            hit[m] = is_hit(motion, base, begin, lands, flown, m, scale, dt_s, keep, scratch)


@making_part
def is_hit(
    motion: Motion,
    base: Motion,
    begin: int,
    lands: int,
    flown: Flown,
    m: int,
    scale: F1,
    dt_s: float,
    keep: float,
    scratch: F2,
) -> bool:
    """Whether a motion comes too near to one that may be flown; see `too_near`.

    Args:
        m: place of the latter.
        scratch: its last two rows are the corners of a box around the motion [m]; shape (4, axes).
    """
    here, there, low, high = scratch[0], scratch[1], scratch[2], scratch[3]
    keep_m = keep + flown.wide[m]
    if _is_far(flown, m, low, high, keep_m):
        return False
    other, down = flown_one(flown, m), flown.lands[m]
    least = _least_apart(motion, other, begin, lands, down, scale, dt_s, here, there)
    if least >= keep_m:
        return False
    held = _least_apart(base, other, begin, lands, down, scale, dt_s, here, there)
    return least < held - NEARER_M


@making_kernel
def _half_planes(
    times: F1,
    held: F2,
    reach: F1,
    row: int,
    lands: int,
    flown: Flown,
    count: int,
    scale: F1,
    dt_s: float,
    apart: float,
    found: HalfPlanes,
) -> int:
    """Fill in `half_planes`; the number of them."""
    n, axes = 0, len(scale)
    place, off, low, high = np.empty((4, axes))
    for x in range(axes):
        low[x], high[x] = scale[x] * held[:, x].min(), scale[x] * held[:, x].max()
        if x == ALTITUDE and lands < NEVER:
            low[x] = min(low[x], 0.0)
    for m in range(count):
        keep = apart + flown.wide[m]
        if flown.of[m] == row or _is_far(flown, m, low, high, keep + reach.max()):
            continue
        other = flown_one(flown, m)
        for i in range(len(times)):
            # At the last time all are at rest, and in the end down that ever land.
            down = _is_down(lands, times[i], i == len(times) - 1)
            other_down = _is_down(flown.lands[m], times[i], i == len(times) - 1)
            square = 0.0
            for x in range(axes):
                place[x] = _place(other, x, times[i], dt_s)
                away = held[i, x] - place[x]
                if x == ALTITUDE:
                    away = _above(away, down, other_down)
                off[x] = scale[x] * away
                square += off[x] * off[x]
            away = np.sqrt(square)
            # Out of reach, the constraint could never be active; at the very same place it has no
            # direction.
            if away >= keep + reach[i] or away == 0.0:
                continue
            # Where two are too near already, the plane runs just behind the motion in force, which
            # so remains a solution.
            offset = min(keep, away - 1e-4)
            for x in range(axes):
                found.normal[n, x] = scale[x] * off[x] / away
                offset += found.normal[n, x] * place[x]
            found.at[n], found.least[n], found.of[n] = i, offset, m
            n += 1
    return n
