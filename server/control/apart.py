"""Distances between motions at every time, and the half-planes that keep motions apart.

Distances along the third axis may count less than those in the plane: all are of coordinates that
are multiplied by `scale` first. So a sphere of that metric is an ellipsoid, higher than it is wide,
as downwash asks for.

Where each vehicle is on its motion the server knows to within the error of the step that it counts
(`clock.StepError`). Between two vehicles only the sum of both counts, and it is that of one number:
by how many steps the other one is further on its motion, or less far, than the server counts. So
one of the two is taken at a step, and the other anywhere between two steps: a swept piece of its
way, which is longer the faster it flies, and a point where it rests.

In space a vehicle that hears nothing lands after a while. From the first step at which it may, it
may be anywhere between its motion, which is at rest by then, and the ground. So in the end any two
motions have to be apart side by side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.server.control.clock import EXACT, StepError
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
from skytether.shared.core.time_of_day import DRIFT
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
    early: F1
    """Error of the steps of the vehicle, see `clock.StepError`; shape (room,)."""
    late: F1
    """Error of the steps of the vehicle the other way; shape (room,)."""
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
        numbers, widths = np.zeros((4, room), dtype=np.int64), np.zeros((3, room))
        knots, corners = np.zeros((2, room, KNOTS, axes)), np.zeros((2, room, axes))
        self.arrays = Flown._make([*numbers, *widths, *knots, *corners])

    def replace(
        self,
        row: int,
        motions: Sequence[Motion],
        ahead: int,
        lands: int,
        wide_m: float,
        error: StepError = EXACT,
    ) -> None:
        """Replace all motions of a vehicle; see `add`."""
        self.count = _remove(self.arrays, self.count, row)
        for motion in motions:
            self.add(row, motion, ahead, lands, wide_m, error)

    def add(
        self,
        row: int,
        motion: Motion,
        ahead: int,
        lands: int,
        wide_m: float,
        error: StepError = EXACT,
    ) -> None:
        """Add a motion.

        Args:
            row: of the vehicle.
            motion: by the steps of its vehicle.
            ahead: number of steps by which that is ahead of those in common.
            lands: first of those in common at which it may begin to land, or NEVER.
            wide_m: distance to be kept from it beyond that from others [m].
            error: of the steps of the vehicle.
        """
        self.make_room(1)
        arrays, m = self.arrays, self.count
        _add(arrays, m, row, motion, ahead, lands, wide_m, error, self.scale, self.dt_s)
        self.count += 1

    def doubt(self, early: Array, late: Array) -> None:
        """Take other errors of the vehicles' steps for all motions.

        Args:
            early, late: by row, see `clock.StepError`; shape (capacity,).
        """
        n, of = self.count, self.of
        self.arrays.early[:n], self.arrays.late[:n] = early[of], late[of]

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
    error: StepError = EXACT,
) -> Flags:
    """Motions that may be flown to which another one may come too near, from a step on for ever.

    Args:
        motion: by the steps in common.
        base: the one in force. Where that is nearer already, and not only by what pieces are off a
            motion, the other need only come no nearer by NEARER_M: it may always fly away.
        begin: step from which on.
        row: the vehicle's, whose own motions do not count.
        lands: first step at which it may begin to land, or NEVER.
        flown: motions of all.
        keep_m: distance that is kept from them [m].
        error: of the vehicle's own steps.

    Returns:
        shape (flown.count + 1,); the last, which is for zones, is False.
    """
    hit = np.zeros(flown.count + 1, dtype=np.bool_)
    those = flown.arrays, flown.scale, flown.dt_s
    _too_near(motion, base, begin, row, lands, error, *those, keep_m, hit)
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
    error: StepError = EXACT,
) -> HalfPlanes:
    """Half-planes normal to the lines from the others' motions to the one in force.

    Of a motion whose step is not known exactly it is the nearest point of where it may be then, and
    the plane is in front of all of that.

    Args:
        times: steps in common; shape (n,).
        held: positions of the one in force then [m]; shape (n, axes).
        reach_m: distance from there within which the plan stays [m]; shape (n,).
        row: the vehicle's, whose own motions do not count.
        lands: first step at which it may begin to land, or NEVER.
        flown: motions of all.
        apart_m: distance that is kept [m]; less where the one in force is nearer already.
        error: of the vehicle's own steps.
    """
    most = len(times) * flown.count
    found = HalfPlanes(
        np.empty(most, dtype=np.int64),
        np.empty((most, held.shape[1])),
        np.empty(most),
        np.empty(most, dtype=np.int64),
    )
    those = flown.arrays, flown.count, flown.scale, flown.dt_s
    n = _half_planes(times, held, reach_m, row, lands, error, *those, apart_m, found)
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
def _last(motion: Motion) -> int:
    """Step at which a motion has come to rest, see `Motion.last`."""
    return motion.first + (len(motion.position) - 1) * SPACING


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
    flown: Flown,
    m: int,
    row: int,
    first: int,
    position: F2,
    velocity: F2,
    lands: int,
    wide: float,
    error: StepError,
) -> None:
    """Write a motion down at a place, but for its box."""
    n, axes = position.shape
    flown.first[m], flown.knots[m], flown.of[m] = first, n, row
    flown.lands[m], flown.wide[m] = lands, wide
    flown.early[m], flown.late[m] = error.early, error.late
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
        error = StepError(flown.early[count], flown.late[count])
        row_of, first = flown.of[count], flown.first[count]
        _write(flown, m, row_of, first, position, velocity, lands, wide, error)
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
    error: StepError,
    scale: F1,
    dt_s: float,
) -> None:
    """Write a motion down at a place, see `FlownMotions.add`."""
    write_down(flown, m, row, motion, ahead, lands, wide, error, scale, dt_s)


@part
def write_down(
    flown: Flown,
    m: int,
    row: int,
    motion: Motion,
    ahead: int,
    lands: int,
    wide: float,
    error: StepError,
    scale: F1,
    dt_s: float,
) -> None:
    """Write a motion down at a place, see `FlownMotions.add`."""
    first, position, velocity = motion.first - ahead, motion.position, motion.velocity
    _write(flown, m, row, first, position, velocity, lands, wide, error)
    bound(motion, lands, scale, dt_s, flown.low[m], flown.high[m])


@part
def _is_down(lands: int, step: float) -> bool:
    """Whether a vehicle may be on its way down at a step; `lands` as in `Flown`."""
    return step >= lands


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


class Extent(NamedTuple):
    """Bounds of how a motion goes on."""

    speed: float
    """Largest speed, scaled [m/s]."""
    bend: float
    """Largest distance from its straight pieces, SAMPLES an interval, scaled [m]."""


@part
def _extent(motion: Motion, scale: F1, dt_s: float) -> Extent:
    """Bounds of how a motion goes on."""
    fastest, turn = 0.0, 0.0
    for knot in range(len(motion.velocity)):
        speed, change = 0.0, 0.0
        for x in range(len(scale)):
            v = scale[x] * motion.velocity[knot, x]
            speed += v * v
            if knot:
                change += (v - scale[x] * motion.velocity[knot - 1, x]) ** 2
        fastest, turn = max(fastest, speed), max(turn, change)
    # Over a piece of the time t a parabola is off the straight line by a t² / 8 at most.
    piece = SPACING / SAMPLES * dt_s
    return Extent(np.sqrt(fastest), np.sqrt(turn) / (SPACING * dt_s) * piece * piece / 8.0)


@part
def sweep(
    other: Motion, step: float, until: float, least: float, most: float
) -> tuple[float, float]:
    """Part of the shifts from `least` to `most` in which another motion is ever elsewhere.

    Args:
        other: the motion, by steps in common.
        step, until: between these it is looked at.
        least, most: steps by which it may be further on.
    """
    last = _last(other)
    return min(max(least, other.first - until), most), max(min(most, last - step), least)


@part
def shifts(one: StepError, other: StepError, drift: float) -> tuple[float, float]:
    """Least and most steps by which another vehicle may be further on than it is counted, when one
    vehicle is where it is counted.

    Args:
        one, other: errors of their steps.
        drift: what is added, for the time for which both are looked ahead [steps].
    """
    return -other.late - one.early - drift, other.early + one.late + drift


@part
def _away(
    one: Motion, other: Motion, step: float, shift: float, x: int, scale: F1, dt_s: float
) -> float:
    """Difference of two motions on an axis, the other one so many steps further on, scaled [m]."""
    return scale[x] * (_place(one, x, step, dt_s) - _place(other, x, step + shift, dt_s))


class Span(NamedTuple):
    """Piece of time for which one motion is compared with another."""

    begin: float
    """Step at which it begins."""
    end: float
    """Step at which it ends; the same where the one motion rests."""
    least: float
    """Least number of steps by which the other one may be further on."""
    most: float
    """Most of them."""
    down: bool
    """Whether who flies the one motion may be landing."""
    other_down: bool
    """Whether who flies the other one may be landing."""


@part
def _span(
    other: Motion,
    begin: int,
    i: int,
    pieces: int,
    lands: int,
    others_land: int,
    least: float,
    most: float,
) -> Span:
    """Piece of time number `i` from a step on: one piece after the other while the one motion
    lasts, then all the time until the other rests too, and then the time when both have landed that
    ever do.
    """
    last = _last(other)
    step = begin + i * (SPACING / SAMPLES)
    if i < pieces:
        end = step + SPACING / SAMPLES
        low, high = sweep(other, step, end, least, most)
        return Span(step, end, low, high, _is_down(lands, end), _is_down(others_land, end + most))
    if i == pieces:
        low, high = sweep(other, step, step, least, max(most, float(last - begin)))
        down, other_down = _is_down(lands, last - least), _is_down(others_land, float(last))
        return Span(step, step, low, high, down, other_down)
    return Span(step, step, last - step, last - step, lands < NEVER, others_land < NEVER)


@part
def _spare(
    one: Motion, other: Motion, span: Span, lands: bool, far: float, scale: F1, dt_s: float
) -> float:
    """Distance of the middles of two motions in a piece of time, beyond a distance [m].

    Args:
        lands: whether any of the two ever does: then heights do not count.
        far: the distance [m].
    """
    square = 0.0
    middle, shift = 0.5 * (span.begin + span.end), 0.5 * (span.least + span.most)
    for x in range(len(scale)):
        if x != ALTITUDE or not lands:
            square += _away(one, other, middle, shift, x, scale, dt_s) ** 2
    return np.sqrt(square) - far


@part
def _least_apart(
    one: Motion,
    other: Motion,
    begin: int,
    lands: int,
    others_land: int,
    error: StepError,
    others: StepError,
    scale: F1,
    dt_s: float,
    limit: float,
    sides: F2,
) -> float:
    """Bound from below of the distance of two motions from a step on, or `limit` if more [m].

    Args:
        lands, others_land: first step at which each vehicle may begin to land, or NEVER.
        error, others: of the steps of each.
        limit: more than this is not told apart [m].
        sides: scratch; shape (4, axes).
    """
    piece_s = SPACING / SAMPLES * dt_s
    one_last = _last(one)
    other_last = _last(other)
    drift = 2.0 * max(max(one_last, other_last) - begin, 0) / DRIFT
    least, most = shifts(error, others, drift)
    pieces = max(int(np.ceil((one_last - begin) * SAMPLES / SPACING)), 0)
    mine, its = _extent(one, scale, dt_s), _extent(other, scale, dt_s)
    fastest = (mine.speed + its.speed) * piece_s
    any_lands = lands < NEVER or others_land < NEVER
    nearest, i = limit, 0
    while i < pieces + 2:
        span = _span(other, begin, i, pieces, lands, others_land, least, most)
        swept = its.speed * 0.5 * (span.most - span.least) * dt_s
        far = nearest + 0.5 * fastest + swept + mine.bend + 2.0 * its.bend
        spare = _spare(one, other, span, any_lands, far, scale, dt_s)
        if spare <= 0.0:
            nearest = min(nearest, _off(one, other, span, mine, its, scale, dt_s, sides))
            i += 1
            continue
        # With each piece the middles come no nearer than by what both fly, and what is swept may
        # grow by a piece: that is less than twice as much.
        skipped = int(spare / (2.0 * fastest)) if fastest > 0.0 else pieces
        i = max(i + 1, min(i + skipped, pieces))
    return max(nearest, 0.0)


@part
def _seen_apart(
    one: Motion,
    other: Motion,
    begin: int,
    lands: int,
    others_land: int,
    error: StepError,
    others: StepError,
    scale: F1,
    dt_s: float,
    limit: float,
) -> float:
    """Bound from above of the distance of two motions from a step on, or `limit` if more [m].

    It is the least distance at some steps, a piece apart, and for some errors of these: each is one
    that the two may come to. Arguments are those of `_least_apart`.
    """
    one_last = _last(one)
    other_last = _last(other)
    least, most = shifts(error, others, 0.0)
    piece = SPACING / SAMPLES
    # At the last step both rest, and are down if they ever land.
    pieces = max(int(np.ceil((max(one_last, other_last - least) - begin) / piece)), 0) + 1
    nearest = limit
    for i in range(pieces + 1):
        step = begin + i * piece
        first, last = sweep(other, step, step, least, most)
        slices = int(np.ceil((last - first) / piece))
        for j in range(slices + 1):
            shift = first + (last - first) * j / max(slices, 1)
            down, other_down = _is_down(lands, step), _is_down(others_land, step + shift)
            if i == pieces:
                down, other_down = lands < NEVER, others_land < NEVER
            square = 0.0
            for x in range(len(scale)):
                away = _away(one, other, step, shift, x, scale, dt_s)
                if x == ALTITUDE:
                    away = _above(away, down, other_down)
                square += away * away
            nearest = min(nearest, np.sqrt(square))
    return nearest


@part
def _off(
    one: Motion,
    other: Motion,
    span: Span,
    mine: Extent,
    its: Extent,
    scale: F1,
    dt_s: float,
    sides: F2,
) -> float:
    """Bound from below of the distance of two motions in a piece of time [m].

    The shift of the other one goes in slices no longer than a piece. In one of them the difference
    of the two motions is p + t a + s b + t s c for t and s from -1/2 to 1/2, where c is small: a
    parallelogram, and |c| / 4 at most off that.
    """
    swept = span.most - span.least
    slices = max(int(np.ceil(swept * SAMPLES / SPACING)), 1)
    nearest = np.inf
    for j in range(slices):
        here, there = span.least + swept * j / slices, span.least + swept * (j + 1) / slices
        for x in range(len(scale)):
            p00 = _away(one, other, span.begin, here, x, scale, dt_s)
            p10 = _away(one, other, span.end, here, x, scale, dt_s)
            p01, p11 = p00, p10
            if swept > 0.0:
                p01 = _away(one, other, span.begin, there, x, scale, dt_s)
                p11 = _away(one, other, span.end, there, x, scale, dt_s)
            if x == ALTITUDE:
                # Who may pass the height of the other in this piece may do so anywhere in it.
                high, low = max(p00, p10, p01, p11), min(p00, p10, p01, p11)
                if (span.down and high > 0.0) or (span.other_down and low < 0.0):
                    p00, p10, p01, p11 = 0.0, 0.0, 0.0, 0.0
            sides[0, x] = 0.25 * (p00 + p10 + p01 + p11)
            sides[1, x] = 0.5 * (p10 + p11 - p00 - p01)
            sides[2, x] = 0.5 * (p01 + p11 - p00 - p10)
            sides[3, x] = p11 - p10 - p01 + p00
        nearest = min(nearest, _off_parallelogram(sides))
    return nearest - mine.bend - (2.0 if swept > 0.0 else 1.0) * its.bend


@part
def _off_parallelogram(sides: F2) -> float:
    """Lower bound of the distance from the origin to the points p + t a + s b + t s c.

    Both t and s go from -1/2 to 1/2. The bound is the distance to the parallelogram, less |c| / 4.

    Args:
        sides: p, a, b and c; shape (4, axes).
    """
    pp, pa, pb, aa, bb, ab, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for x in range(sides.shape[1]):
        p, a, b, c = sides[0, x], sides[1, x], sides[2, x], sides[3, x]
        pp, pa, pb = pp + p * p, pa + p * a, pb + p * b
        aa, bb, ab, cc = aa + a * a, bb + b * b, ab + a * b, cc + c * c
    least, det = np.inf, aa * bb - ab * ab
    if det > 1e-9 * aa * bb:
        t, s = (ab * pb - bb * pa) / det, (ab * pa - aa * pb) / det
        if abs(t) <= 0.5 and abs(s) <= 0.5:
            least = pp + t * pa + s * pb
    # Nearest points of the four sides.
    for end in (-0.5, 0.5):
        s = min(max(-(pb + end * ab) / bb, -0.5), 0.5) if bb > 0.0 else 0.0
        square = pp + end * end * aa + s * s * bb + 2.0 * (end * pa + s * pb + end * s * ab)
        least = min(least, square)
        t = min(max(-(pa + end * ab) / aa, -0.5), 0.5) if aa > 0.0 else 0.0
        square = pp + end * end * bb + t * t * aa + 2.0 * (end * pb + t * pa + end * t * ab)
        least = min(least, square)
    return np.sqrt(max(least, 0.0)) - 0.25 * np.sqrt(cc)


@making_kernel
def _too_near(
    motion: Motion,
    base: Motion,
    begin: int,
    row: int,
    lands: int,
    error: StepError,
    flown: Flown,
    scale: F1,
    dt_s: float,
    keep: float,
    hit: B1,
) -> None:
    """Fill in `too_near`."""
    scratch = np.empty((6, len(scale)))
    bound(motion, lands, scale, dt_s, scratch[4], scratch[5])
    for m in range(len(hit) - 1):
        if flown.of[m] != row:
            hit[m] = is_hit(motion, base, begin, lands, error, flown, m, scale, dt_s, keep, scratch)


@making_part
def is_hit(
    motion: Motion,
    base: Motion,
    begin: int,
    lands: int,
    error: StepError,
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
        scratch: its last two rows are the corners of a box around the motion [m]; shape (6, axes).
    """
    keep_m, sides = keep + flown.wide[m], scratch[:4]
    if _is_far(flown, m, scratch[4], scratch[5], keep_m):
        return False
    other, down = flown_one(flown, m), flown.lands[m]
    steps = StepError(flown.early[m], flown.late[m])
    least = _least_apart(
        motion, other, begin, lands, down, error, steps, scale, dt_s, keep_m, sides
    )
    if least >= keep_m:
        return False
    # The bounds of both motions are compared, or they would come nearer by what these are off,
    # again and again. Where a vehicle may land a bound may be off by more than bends, so one that
    # only looks nearer has to keep the distance.
    held = _least_apart(base, other, begin, lands, down, error, steps, scale, dt_s, keep_m, sides)
    if least < held - NEARER_M:
        return True
    seen = _seen_apart(base, other, begin, lands, down, error, steps, scale, dt_s, keep_m)
    bend = _extent(base, scale, dt_s).bend + _extent(other, scale, dt_s).bend
    return seen >= keep_m - NEARER_M or least < seen - 4.0 * bend - NEARER_M


@making_kernel
def _half_planes(
    times: F1,
    held: F2,
    reach: F1,
    row: int,
    lands: int,
    error: StepError,
    flown: Flown,
    count: int,
    scale: F1,
    dt_s: float,
    apart: float,
    found: HalfPlanes,
) -> int:
    """Fill in `half_planes`; the number of them."""
    n, axes, final = 0, len(scale), len(times) - 1
    low, high, off, at = np.empty((4, axes))
    # Where the other one may be at a time: corners of its way then.
    ways = np.empty(((KNOTS - 1) * SAMPLES + 4, axes))
    drift = 2.0 * (times[final] - times[0]) / DRIFT
    for x in range(axes):
        low[x], high[x] = scale[x] * held[:, x].min(), scale[x] * held[:, x].max()
        if x == ALTITUDE and lands < NEVER:
            low[x] = min(low[x], 0.0)
    for m in range(count):
        keep = apart + flown.wide[m]
        if flown.of[m] == row or _is_far(flown, m, low, high, keep + reach.max()):
            continue
        other = flown_one(flown, m)
        least, most = shifts(error, StepError(flown.early[m], flown.late[m]), drift)
        for i in range(len(times)):
            # At the last time all are at rest, and in the end down that ever land.
            down = _is_down(lands, times[i]) or (i == final and lands < NEVER)
            other_down = _is_down(flown.lands[m], times[i] + most)
            other_down |= i == final and flown.lands[m] < NEVER
            corners = _way(other, times[i], least, most, dt_s, ways)
            away = _off_way(held[i], ways[:corners], down, other_down, scale, off, at)
            # Out of reach, the constraint could never be active; at the very same place it has no
            # direction.
            if away >= keep + reach[i] or away == 0.0:
                continue
            own = 0.0
            for x in range(axes):
                found.normal[n, x] = scale[x] * off[x] / away
                own += found.normal[n, x] * held[i, x]
            # Where two are too near already, the plane runs just behind the motion in force, which
            # so remains a solution.
            ahead = (ways[:corners] * found.normal[n]).sum(axis=1).max()
            found.at[n], found.least[n], found.of[n] = i, min(ahead + keep, own - 1e-4), m
            n += 1
    return n


@part
def _way(other: Motion, step: float, least: float, most: float, dt_s: float, way: F2) -> int:
    """Fill in corners of the way on which another vehicle may be at a step; their number.

    Args:
        least, most: steps by which it may be further on.
        way: output [m]; shape (corners, axes).
    """
    first, last = sweep(other, step, step, least, most)
    slices = int(np.ceil((last - first) * SAMPLES / SPACING))
    for j in range(slices + 1):
        shift = first + (last - first) * j / max(slices, 1)
        for x in range(way.shape[1]):
            way[j, x] = _place(other, x, step + shift, dt_s)
    return slices + 1


@part
def _off_way(place: F1, way: F2, down: bool, other_down: bool, scale: F1, off: F1, at: F1) -> float:
    """Distance of a place from the nearest point of a way, scaled [m].

    Args:
        place: shape (axes,).
        way: its corners; shape (n, axes).
        down, other_down: whether who is at the place, and who is on the way, may be landing.
        off: output: from that point to the place, scaled [m]; shape (axes,).
        at: scratch; shape (axes,).
    """
    nearest = np.inf
    for j in range(max(len(way) - 1, 1)):
        end = min(j + 1, len(way) - 1)
        along, length = 0.0, 0.0
        for x in range(len(scale)):
            here, there = scale[x] * (place[x] - way[j, x]), scale[x] * (way[end, x] - way[j, x])
            if x == ALTITUDE and _above(here, down, other_down) == 0.0:
                continue
            along, length = along + here * there, length + there * there
        t = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
        square = 0.0
        for x in range(len(scale)):
            away = place[x] - way[j, x] - t * (way[end, x] - way[j, x])
            at[x] = scale[x] * (_above(away, down, other_down) if x == ALTITUDE else away)
            square += at[x] * at[x]
        if square < nearest:
            nearest = square
            for x in range(len(scale)):
                off[x] = at[x]
    return float(np.sqrt(nearest))
