"""Distances between motions at every time: whether one comes too near to what others may fly."""

from typing import NamedTuple

import numpy as np

from skytether.server.missions.compiled_motion import (
    Extent,
    Metric,
    bounding_box,
    extent_of,
    last_step,
    position_at,
)
from skytether.server.missions.possible_motions import (
    NEVER,
    MotionArrays,
    PossibleMotion,
    PossibleMotions,
    height_above,
    is_beyond,
    motion_at,
    moving_shifts,
    shifts,
)
from skytether.shared.base.kernel import B1, F2, making_kernel, making_part, part
from skytether.shared.core.time_of_day import DRIFT
from skytether.shared.law.model import ALTITUDE, Flags
from skytether.shared.law.motion import SAMPLES, SPACING, Motion

NEARER_M = 1e-3
"""Tolerance of a solver for motions that are too near already: they may come so much nearer [m]."""


class Pair(NamedTuple):
    """Motions of two vehicles."""

    one: PossibleMotion
    other: PossibleMotion
    metric: Metric


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
    descends: bool
    """Whether who flies the one motion may be landing."""
    other_descends: bool
    """Whether who flies the other one may be landing."""


def too_near(
    planned: PossibleMotion,
    in_force: Motion,
    begin: int,
    row: int,
    possible: PossibleMotions,
    distance_m: float,
) -> Flags:
    """Possible motions to which a planned one may come too near, from a step on for ever.

    Args:
        planned: the planned motion.
        in_force: motion of the same vehicle that is in force. Where that is nearer already, and not
            only by what pieces are off a motion, the planned one need only come no nearer by
            NEARER_M: it may always fly away.
        begin: step from which on.
        row: row of the vehicle, whose own motions do not count.
        possible: motions of all vehicles.
        distance_m: distance that is kept from them [m].

    Returns:
        shape (possible.count + 1,); the last, which is for zones, is False.
    """
    is_near = np.zeros(possible.count + 1, dtype=np.bool_)
    others = possible.arrays, possible.metric
    _too_near(planned, in_force, begin, row, *others, distance_m, is_near)
    return is_near


@making_kernel
def _too_near(
    planned: PossibleMotion,
    in_force: Motion,
    begin: int,
    row: int,
    others: MotionArrays,
    metric: Metric,
    distance: float,
    is_near: B1,
) -> None:
    """Fill in `too_near`."""
    scratch = np.empty((6, len(metric.scale)))
    bounding_box(planned.motion, planned.lands < NEVER, metric, scratch[4], scratch[5])
    for m in range(len(is_near) - 1):
        if others.row[m] != row:
            is_near[m] = comes_too_near(
                planned, in_force, begin, others, m, metric, distance, scratch
            )


@making_part
def comes_too_near(
    planned: PossibleMotion,
    in_force: Motion,
    begin: int,
    others: MotionArrays,
    m: int,
    metric: Metric,
    distance: float,
    scratch: F2,
) -> bool:
    """Whether a planned motion comes too near to a possible one; see `too_near`.

    Args:
        others, m: all possible motions, and the index of this one.
        scratch: its last two rows are the corners of a box around the planned motion [m]; shape
            (6, axes).
    """
    keep, sides = distance + others.extra[m], scratch[:4]
    if is_beyond(others, m, scratch[4], scratch[5], keep):
        return False
    other = motion_at(others, m)
    least = _least_distance(Pair(planned, other, metric), begin, keep, sides)
    if least >= keep:
        return False
    # The bounds of both motions are compared, or they would come nearer by what these are off,
    # again and again. Where a vehicle may land a bound may be off by more than bends, so one that
    # only looks nearer has to keep the distance.
    before = Pair(PossibleMotion(in_force, planned.lands, planned.error), other, metric)
    if least < _least_distance(before, begin, keep, sides) - NEARER_M:
        return True
    sampled = _sampled_distance(before, begin, keep)
    bend = extent_of(in_force, metric).bend + extent_of(other.motion, metric).bend
    return sampled >= keep - NEARER_M or least < sampled - 4.0 * bend - NEARER_M


@part
def _least_distance(pair: Pair, begin: int, limit: float, sides: F2) -> float:
    """Bound from below of the distance of two motions from a step on, or `limit` if more [m].

    Args:
        limit: distances above it need not be told apart [m].
        sides: scratch; shape (4, axes).
    """
    one, other, metric = pair.one, pair.other, pair.metric
    piece_s = SPACING / SAMPLES * metric.dt_s
    last = last_step(one.motion)
    drift = 2.0 * max(max(last, last_step(other.motion)) - begin, 0) / DRIFT
    least, most = shifts(one.error, other.error, drift)
    pieces = max(int(np.ceil((last - begin) * SAMPLES / SPACING)), 0)
    extent, other_extent = extent_of(one.motion, metric), extent_of(other.motion, metric)
    fastest = (extent.speed + other_extent.speed) * piece_s
    lands = one.lands < NEVER or other.lands < NEVER
    nearest, i = limit, 0
    while i < pieces + 2:
        span = _span(pair, begin, i, pieces, least, most)
        swept = other_extent.speed * 0.5 * (span.most - span.least) * metric.dt_s
        far = nearest + 0.5 * fastest + swept + extent.bend + 2.0 * other_extent.bend
        spare = _distance_of_middles(pair, span, lands) - far
        if spare <= 0.0:
            within = _least_distance_within(pair, span, extent, other_extent, sides)
            nearest = min(nearest, within)
            i += 1
            continue
        # With each piece the middles come no nearer than by what both fly, and what is swept may
        # grow by a piece: that is less than twice as much.
        skipped = int(spare / (2.0 * fastest)) if fastest > 0.0 else pieces
        i = max(i + 1, min(i + skipped, pieces))
    return max(nearest, 0.0)


@part
def _sampled_distance(pair: Pair, begin: int, limit: float) -> float:
    """Bound from above of the distance of two motions from a step on, or `limit` if more [m].

    It is the least distance at some steps, a piece apart, and for some errors of these: each is one
    that the two may come to.
    """
    one, other, metric = pair.one, pair.other, pair.metric
    least, most = shifts(one.error, other.error, 0.0)
    piece = SPACING / SAMPLES
    # At the last step both rest, and are down if they ever land.
    last = max(last_step(one.motion), last_step(other.motion) - least)
    pieces = max(int(np.ceil((last - begin) / piece)), 0) + 1
    nearest = limit
    for i in range(pieces + 1):
        step = begin + i * piece
        low, high = moving_shifts(other.motion, step, step, least, most)
        slices = int(np.ceil((high - low) / piece))
        for j in range(slices + 1):
            shift = low + (high - low) * j / max(slices, 1)
            descends, other_descends = step >= one.lands, step + shift >= other.lands
            if i == pieces:
                descends, other_descends = one.lands < NEVER, other.lands < NEVER
            square = 0.0
            for x in range(len(metric.scale)):
                away = _difference(pair, step, shift, x)
                if x == ALTITUDE:
                    away = height_above(away, descends, other_descends)
                square += away * away
            nearest = min(nearest, np.sqrt(square))
    return nearest


@part
def _difference(pair: Pair, step: float, shift: float, x: int) -> float:
    """Difference of two motions on an axis, the other one so many steps further on, scaled [m]."""
    dt_s = pair.metric.dt_s
    here = position_at(pair.one.motion, x, step, dt_s)
    return pair.metric.scale[x] * (here - position_at(pair.other.motion, x, step + shift, dt_s))


@part
def _span(pair: Pair, begin: int, i: int, pieces: int, least: float, most: float) -> Span:
    """Piece of time number `i` from a step on: one piece after the other while the one motion
    lasts, then all the time until the other rests too, and then the time when both have landed that
    ever do.
    """
    other, lands, other_lands = pair.other.motion, pair.one.lands, pair.other.lands
    last = last_step(other)
    step = begin + i * (SPACING / SAMPLES)
    if i < pieces:
        end = step + SPACING / SAMPLES
        low, high = moving_shifts(other, step, end, least, most)
        return Span(step, end, low, high, end >= lands, end + most >= other_lands)
    if i == pieces:
        low, high = moving_shifts(other, step, step, least, max(most, float(last - begin)))
        return Span(step, step, low, high, last - least >= lands, last >= other_lands)
    return Span(step, step, last - step, last - step, lands < NEVER, other_lands < NEVER)


@part
def _distance_of_middles(pair: Pair, span: Span, lands: bool) -> float:
    """Distance of the middles of two motions in a piece of time [m].

    Args:
        lands: whether any of the two ever does: then heights do not count.
    """
    square = 0.0
    middle, shift = 0.5 * (span.begin + span.end), 0.5 * (span.least + span.most)
    for x in range(len(pair.metric.scale)):
        if x != ALTITUDE or not lands:
            square += _difference(pair, middle, shift, x) ** 2
    return np.sqrt(square)


@part
def _least_distance_within(
    pair: Pair, span: Span, extent: Extent, other_extent: Extent, sides: F2
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
        for x in range(len(pair.metric.scale)):
            p00 = _difference(pair, span.begin, here, x)
            p10 = _difference(pair, span.end, here, x)
            p01, p11 = p00, p10
            if swept > 0.0:
                p01 = _difference(pair, span.begin, there, x)
                p11 = _difference(pair, span.end, there, x)
            if x == ALTITUDE:
                # Who may pass the height of the other in this piece may do so anywhere in it.
                high, low = max(p00, p10, p01, p11), min(p00, p10, p01, p11)
                if (span.descends and high > 0.0) or (span.other_descends and low < 0.0):
                    p00, p10, p01, p11 = 0.0, 0.0, 0.0, 0.0
            sides[0, x] = 0.25 * (p00 + p10 + p01 + p11)
            sides[1, x] = 0.5 * (p10 + p11 - p00 - p01)
            sides[2, x] = 0.5 * (p01 + p11 - p00 - p10)
            sides[3, x] = p11 - p10 - p01 + p00
        nearest = min(nearest, _distance_from_parallelogram(sides))
    return nearest - extent.bend - (2.0 if swept > 0.0 else 1.0) * other_extent.bend


@part
def _distance_from_parallelogram(sides: F2) -> float:
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
