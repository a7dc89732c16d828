"""A desired trajectory as a spline, and the rule by which a vehicle flies along it.

On each axis a spline has knots at uniform distances, a position and a velocity at each; between two
knots, a time T apart, it is the cubic Hermite polynomial, with s from 0 to 1,

    p̄(s) = (1 + 2 s) (1 - s)² p₀ + s (1 - s)² T v₀ + s² (3 - 2 s) p₁ - s² (1 - s) T v₁

and v̄ its derivative. Before the first knot and after the last it goes straight on: one knot is a
state that goes on by itself, p̄ = p₀ + t v₀. Stages count steps from the first knot.

The vehicle flies, at each stage i,

    u*(i) = λ u(i-1) + (1 - λ) [ū(i) + K (x̄(i) - x(i)) - ŵ]        v̄(i+1) = a v̄(i) + b ū(i)

ū is the input under which the velocity of eq. (4) follows the spline, K and λ the vehicle's
regulator (`shared.scenario.gain`), u(i-1) the input flown until now, and ŵ the disturbance that the
vehicle's own filter has found. x is the state in which the input meets the vehicle
(`shared.law.dead_time`), so the spline is of the desired trajectory that much later. No input is
flown for longer than `link.age_max_s` after the observation behind it: from there on ū is held, or
braked to nothing as in `shared.law.rule`, and x̄ follows eq. (4) under that until it rests.

As there, the client flies by these functions, and the server compiles them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Axis, advance
from skytether.shared.law.rule import MODEL, bounded, led_back, remaining

Knots = Sequence[float] | NDArray[np.floating[Any]]
"""Knots of one axis: position [m] and velocity [m/s] of one after the other; shape (2 n,)."""


class Guide(NamedTuple):
    """A spline as one axis flies along it."""

    model: Axis
    """Model of the axis, eq. (4)."""
    knots: Knots
    """Knots of the axis."""
    spacing: int
    """Steps from one knot to the next."""
    dt_s: float
    """Length of a step [s]."""
    length: int
    """Number of stages at which it is flown."""
    last: float
    """Input ū at the last of them [m/s]."""
    speed: float
    """Magnitude of that over all axes [m/s]."""
    brake: float
    """Speed that braking takes away in a step [m/s]; 0 goes on along the spline for ever."""
    bound: float
    """Bound u_max of the input [m/s]."""
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    lag: float
    """Share λ of the input before that is kept, 0 to below 1."""


def spline_at(knots: Knots, spacing: int, dt_s: float, stage: int) -> tuple[float, float]:
    """State x̄ of a spline at a stage, position [m] and velocity [m/s].

    Args:
        knots: those of the axis.
        spacing: steps from one knot to the next.
        dt_s: length of a step [s].
        stage: steps since the first knot; before that it is negative.
    """
    # Knots are one flat row of positions and velocities: numba and Python index it alike.
    last = len(knots) // 2 - 1
    knot = stage // spacing
    if knot < 0 or knot >= last:
        # Straight on at both ends: a spline that is late or has ended never bends away.
        knot = 0 if knot < 0 else last
        v = float(knots[2 * knot + 1])
        return float(knots[2 * knot]) + (stage - knot * spacing) * dt_s * v, v
    p0, v0 = float(knots[2 * knot]), float(knots[2 * knot + 1])
    p1, v1 = float(knots[2 * knot + 2]), float(knots[2 * knot + 3])
    T, s = spacing * dt_s, (stage - knot * spacing) / spacing
    r, way = 1.0 - s, p1 - p0
    p = p0 + s * s * (3.0 - 2.0 * s) * way + s * r * T * (r * v0 - s * v1)
    v = 6.0 * s * r * way / T + r * (1.0 - 3.0 * s) * v0 + s * (3.0 * s - 2.0) * v1
    return p, v


def along(model: Axis, knots: Knots, spacing: int, dt_s: float, stage: int) -> float:
    """Input ū under which the velocity of eq. (4) follows a spline at a stage [m/s]."""
    _, v = spline_at(knots, spacing, dt_s, stage)
    _, ahead = spline_at(knots, spacing, dt_s, stage + 1)
    # The second row of eq. (4), solved for u: the velocity is met exactly at each step, and the
    # position to within the curvature of a step.
    return (ahead - model.a11 * v) / model.b1


def guided(guide: Guide, stage: int) -> float:
    """Input ū at a stage [m/s]."""
    if stage < guide.length or guide.brake == 0.0:
        told = along(guide.model, guide.knots, guide.spacing, guide.dt_s, stage)
        return bounded(told, guide.bound)
    share = remaining(stage, guide.length, guide.speed, guide.brake)
    return share * bounded(guide.last, guide.bound)


def guided_to(
    guide: Guide, first: int, last: int, lead_p: float, lead_v: float
) -> tuple[float, float]:
    """State x̄ at the stage `last`, position [m] and velocity [m/s].

    Args:
        guide: the spline.
        first: stage at which x̄ is known; of account only behind the last that is flown.
        last: stage to which it is rolled.
        lead_p, lead_v: x̄ at `first`, position [m] and velocity [m/s].
    """
    ends = guide.length
    if last <= ends or guide.brake == 0.0:
        return spline_at(guide.knots, guide.spacing, guide.dt_s, last)
    if first <= ends:
        first = ends
        lead_p, lead_v = spline_at(guide.knots, guide.spacing, guide.dt_s, ends)
    for stage in range(first, last):
        told = guided(guide, stage)
        lead_p, lead_v = advance(guide.model, lead_p, lead_v, told)
    return lead_p, lead_v


def regulated(
    guide: Guide, stage: int, lead_p: float, lead_v: float, p: float, v: float, w: float
) -> tuple[float, float]:
    """Input that the regulator asks for on one axis, towards which `follow` moves.

    Args:
        guide: the spline.
        stage: steps since its first knot.
        lead_p, lead_v: x̄ at the stage, position [m] and velocity [m/s].
        p, v: state at the stage, position [m] and velocity [m/s].
        w: disturbance ŵ [m/s].

    Returns:
        ū + K (x̄ - x) - ŵ within the bound [m/s]; and ū [m/s].
    """
    told = guided(guide, stage)
    back = led_back(guide.gain_p, guide.gain_v, lead_p - p, lead_v - v)
    return bounded(told + back - w, guide.bound), told


def follow(
    guide: Guide,
    stage: int,
    lead_p: float,
    lead_v: float,
    p: float,
    v: float,
    w: float,
    before: float,
) -> tuple[float, float]:
    """Fly one axis for a step along a spline.

    Args:
        guide, stage, lead_p, lead_v, p, v, w: see `regulated`.
        before: input flown until now, u(i-1), within the bound [m/s].

    Returns:
        the input that is flown, u* [m/s]; and ū, what of it belongs to the spline [m/s].
    """
    wanted, told = regulated(guide, stage, lead_p, lead_v, p, v, w)
    return guide.lag * before + (1.0 - guide.lag) * wanted, told


SPACING, DT_S, LENGTH, LAST, SPEED, BRAKE, BOUND, GAIN_P, GAIN_V, LAG = range(
    MODEL, MODEL + len(Guide._fields) - 2
)
"""Columns of a table of splines: the fields of `Guide` but for model and knots."""


def guide_of(table: Table, knots: Table, axis: int) -> Guide:
    """Spline on one axis, from a table with a row an axis."""
    return Guide(
        model=Axis(table[axis, 0], table[axis, 1], table[axis, 2], table[axis, 3]),
        knots=knots[axis],
        spacing=int(table[axis, SPACING]),
        dt_s=table[axis, DT_S],
        length=int(table[axis, LENGTH]),
        last=table[axis, LAST],
        speed=table[axis, SPEED],
        brake=table[axis, BRAKE],
        bound=table[axis, BOUND],
        gain_p=table[axis, GAIN_P],
        gain_v=table[axis, GAIN_V],
        lag=table[axis, LAG],
    )


@compilable
def fly_spline(
    table: Table,
    knots: Table,
    lead: Table,
    first: int,
    stage: int,
    state: Table,
    disturbance: Numbers,
    before: Numbers,
    flown: Table,
) -> None:
    """Fly all axes for a step along a spline, see `follow`.

    Args:
        table: the spline but for its knots, with a row an axis, see `guide_of`.
        knots: shape (axes, 2 n).
        lead: x̄ at the stage `first` [m, m/s], put to that at `stage`; shape (axes, 2).
        first: stage to which x̄ belongs.
        stage: steps since the first knot.
        state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        disturbance: ŵ of each axis [m/s].
        before: input flown until now, of each axis [m/s].
        flown: output: the inputs flown, and ū [m/s]; shape (2, axes).
    """
    for axis in range(len(table)):
        guide = guide_of(table, knots, axis)
        lead_p, lead_v = guided_to(guide, first, stage, lead[axis, 0], lead[axis, 1])
        lead[axis, 0], lead[axis, 1] = lead_p, lead_v
        p, v, w = state[axis, 0], state[axis, 1], disturbance[axis]
        u, told = follow(guide, stage, lead_p, lead_v, p, v, w, before[axis])
        flown[0, axis], flown[1, axis] = u, told


@compilable
def foresee_spline(
    table: Table, knots: Table, lead: Table, stage: int, state: Table, ahead: Table
) -> None:
    """State of each axis a step later, flown along the spline from a state at the stage.

    What λ keeps of the input before is left out: it lasts for a few steps only. What the wind does
    is flown off.

    Args:
        table, knots, stage, state: see `fly_spline`.
        lead: x̄ at the stage [m, m/s]; shape (axes, 2).
        ahead: output: the state a step later [m, m/s]; shape (axes, 2).
    """
    for axis in range(len(table)):
        guide = guide_of(table, knots, axis)
        p, v = state[axis, 0], state[axis, 1]
        u, _ = regulated(guide, stage, lead[axis, 0], lead[axis, 1], p, v, 0.0)
        ahead[axis, 0], ahead[axis, 1] = advance(guide.model, p, v, u)
