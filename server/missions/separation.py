"""Separation: test whether a motion comes too near to the motions that other vehicles may fly."""

from typing import NamedTuple

import numpy as np

from skytether.server.missions.compiled_motion import (
    Extent,
    MotionMetric,
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
from skytether.shared.endpoints.time_of_day import DRIFT
from skytether.shared.law.model import ALTITUDE, Flags
from skytether.shared.law.motion import SAMPLES, SPACING, Motion

NEARER_M = 1e-3
"""Distance by which motions that are already too near may approach: the solver's tolerance [m]."""
PIECES_MAX = 10_000
"""Largest number of pieces sampled for a pair of motions; hundreds are usual."""


class Pair(NamedTuple):
    one: PossibleMotion
    other: PossibleMotion
    metric: MotionMetric


class Span(NamedTuple):
    """Time interval in which a motion is compared with another motion."""

    begin: float
    end: float
    """Last step; equal to `begin` if the first motion rests."""
    least: float
    """Least number of steps by which the other vehicle may be ahead."""
    most: float
    """Largest number of steps by which the other vehicle may be ahead."""
    descends: bool
    """Whether the first vehicle may be landing."""
    other_descends: bool


def too_near(
    planned: PossibleMotion,
    in_force: Motion,
    begin: int,
    row: int,
    possible: PossibleMotions,
    distance_m: float,
) -> Flags:
    """Flags of the possible motions to which a planned motion may come too near; shape
    (possible.count + 1,). The last flag is for zones; here it is False.

    Args:
        in_force: motion in force of the same vehicle. If it is too near already (by more than the
            error of straight pieces), the planned motion may be nearer by NEARER_M at most: so the
            vehicle can always fly away.
        begin: first step to compare.
        row: row of the vehicle; its own motions are ignored.
        distance_m: distance to keep from the possible motions [m].
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
    metric: MotionMetric,
    distance: float,
    is_near: B1,
) -> None:
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
    metric: MotionMetric,
    distance: float,
    scratch: F2,
) -> bool:
    """Whether a planned motion comes too near to the possible motion m; see `too_near`.

    Args:
        scratch: its last two rows are the corners of a box around the planned motion [m]; shape (6,
            axes).
    """
    keep, sides = distance + others.extra[m], scratch[:4]
    if is_beyond(others, m, scratch[4], scratch[5], keep):
        return False
    other = motion_at(others, m)
    least = _least_distance(Pair(planned, other, metric), begin, keep, sides)
    if least >= keep:
        return False
    # Lower bounds of both motions are compared; otherwise each plan could come nearer by the error
    # of the pieces. If a vehicle may land, a bound may be wrong by more than the curvature; so the
    # planned motion has to keep the distance if the motion in force only seems too near.
    before = Pair(PossibleMotion(in_force, planned.lands, planned.error), other, metric)
    if least < _least_distance(before, begin, keep, sides) - NEARER_M:
        return True
    sampled = _sampled_distance(before, begin, keep)
    bend = extent_of(in_force, metric).bend + extent_of(other.motion, metric).bend
    return sampled >= keep - NEARER_M or least < sampled - 4.0 * bend - NEARER_M


@part
def _least_distance(pair: Pair, begin: int, limit: float, sides: F2) -> float:
    """Lower bound of the distance of two motions from a step on, at most `limit` [m]."""
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
        # Per piece, the midpoints approach by at most the distance that both vehicles fly, and
        # `swept` grows by at most a piece: together less than twice this distance.
        skipped = int(spare / (2.0 * fastest)) if fastest > 0.0 else pieces
        i = max(i + 1, min(i + skipped, pieces))
    return max(nearest, 0.0)


@part
def _sampled_distance(pair: Pair, begin: int, limit: float) -> float:
    """Upper bound of the distance of two motions from a step on, at most `limit` [m].

    It is the least distance at sampled steps, one per piece, and for sampled errors of these steps.
    """
    one, other, metric = pair.one, pair.other, pair.metric
    least, most = shifts(one.error, other.error, 0.0)
    piece = SPACING / SAMPLES
    # At the last step both vehicles rest, after all possible landings.
    last = max(last_step(one.motion), last_step(other.motion) - least)
    # Any subset of steps gives an upper bound, so with an unbounded clock error some are skipped.
    pieces = int(np.ceil(min(max((last - begin) / piece, 0.0), PIECES_MAX))) + 1
    nearest = limit
    for i in range(pieces + 1):
        step = begin + i * piece if i < pieces else max(begin + i * piece, last)
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
    """Scaled difference of two motions on an axis [m]; the second motion is `shift` steps ahead."""
    dt_s = pair.metric.dt_s
    position = position_at(pair.one.motion, x, step, dt_s)
    return pair.metric.scale[x] * (position - position_at(pair.other.motion, x, step + shift, dt_s))


@part
def _span(pair: Pair, begin: int, i: int, pieces: int, least: float, most: float) -> Span:
    """Time interval number `i` from a step on: first the pieces until the first motion ends, then
    the time until the other rests too, then the time after all landings.
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
    """Distance of two motions at the middle of a time interval [m]; without heights if `lands`."""
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
    """Lower bound of the distance of two motions in a time interval [m].

    The shift, by which the other motion is ahead, is divided into slices of at most SPACING /
    SAMPLES steps. Between the corners of a slice the difference of the two motions is interpolated
    as p + t a + s b + t s c, where t is the time and s the shift, both scaled to -1/2 to 1/2.
    Without the small term c this is a parallelogram; c moves a point by at most |c| / 4. The
    curvature of the motions between the corners is subtracted at the end (`Extent.bend`).
    """
    swept = span.most - span.least
    slices = max(int(np.ceil(swept * SAMPLES / SPACING)), 1)
    nearest = np.inf
    for j in range(slices):
        shift, next_shift = span.least + swept * j / slices, span.least + swept * (j + 1) / slices
        for x in range(len(pair.metric.scale)):
            p00 = _difference(pair, span.begin, shift, x)
            p10 = _difference(pair, span.end, shift, x)
            p01, p11 = p00, p10
            if swept > 0.0:
                p01 = _difference(pair, span.begin, next_shift, x)
                p11 = _difference(pair, span.end, next_shift, x)
            if x == ALTITUDE:
                # A vehicle that may pass the other's height in this interval may pass it at any
                # time of the interval.
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

    Both t and s go from -1/2 to 1/2. The bound is the distance to the parallelogram minus |c| / 4.

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
    # Nearest points on the four sides.
    for end in (-0.5, 0.5):
        s = min(max(-(pb + end * ab) / bb, -0.5), 0.5) if bb > 0.0 else 0.0
        square = pp + end * end * aa + s * s * bb + 2.0 * (end * pa + s * pb + end * s * ab)
        least = min(least, square)
        t = min(max(-(pa + end * ab) / aa, -0.5), 0.5) if aa > 0.0 else 0.0
        square = pp + end * end * bb + t * t * aa + 2.0 * (end * pb + t * pa + end * t * ab)
        least = min(least, square)
    return np.sqrt(max(least, 0.0)) - 0.25 * np.sqrt(cc)
