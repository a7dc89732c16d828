"""A trajectory as a spline, and the rule of flight along it.

On each axis a spline has knots at uniform intervals, a position and a velocity at each; between two
knots, a time T apart, it is the cubic Hermite polynomial, with s from 0 to 1,

    p̄(s) = (1 + 2 s) (1 - s)² p₀ + s (1 - s)² T v₀ + s² (3 - 2 s) p₁ - s² (1 - s) T v₁

and v̄ is its derivative. Before the first knot and after the last the spline is straight: a single
knot means motion at constant velocity, p̄ = p₀ + t v₀. Stages count steps from the first knot.

The vehicle flies, at each stage i,

    u*(i) = λ u(i-1) + (1 - λ) [ū(i) + K (x̄(i) - x(i)) - ŵ]        v̄(i+1) = a v̄(i) + b ū(i)

ū is the input under which the velocity of eq. (4) follows the spline, K and λ the vehicle's
regulator (`shared.scenario.gain`), u(i-1) the input flown until now, and ŵ the disturbance
estimated by the vehicle's own filter. x is the state in which the input takes effect
(`shared.law.dead_time`), so the spline is the desired trajectory shifted by the dead time. From
`link.age_max_s` after the observation on which the plan is based, ū brakes as in `shared.law.rule`,
and x̄ follows eq. (4) with this ū until x̄ rests; without braking, the spline is flown for ever.
The client calls these functions, and the server compiles them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Axis, advance
from skytether.shared.law.rule import MODEL, bounded, feedback, remaining

Knots = Sequence[float] | NDArray[np.floating[Any]]
"""Knots of one axis: position [m] and velocity [m/s] of each in turn; shape (2 n,)."""


class AxisSpline(NamedTuple):
    model: Axis
    knots: Knots
    spacing: int
    dt_s: float
    length: int
    """Number of stages at which the spline may be flown."""
    last: float
    """Input ū at the last stage that may be flown [m/s]."""
    speed: float
    """Magnitude of ū at the last stage, over all axes [m/s]."""
    brake: float
    """Decrease of speed per step when braking [m/s]; 0 continues along the spline for ever."""
    bound: float
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    lag: float
    """Share λ of the previous input in the new input; 0 ≤ λ < 1."""


def spline_at(knots: Knots, spacing: int, dt_s: float, stage: int) -> tuple[float, float]:
    """State x̄ of a spline at a stage, position [m] and velocity [m/s].

    Args:
        knots: knots of the axis.
        spacing: steps from one knot to the next.
        dt_s: length of a step [s].
        stage: steps since the first knot; negative before it.
    """
    # Knots are a flat row, because numba and Python index a flat row in the same way.
    last = len(knots) // 2 - 1
    knot = stage // spacing
    if knot < 0 or knot >= last:
        # The spline is straight before the first and after the last knot: cubics would bend away.
        knot = 0 if knot < 0 else last
        v = float(knots[2 * knot + 1])
        return float(knots[2 * knot]) + (stage - knot * spacing) * dt_s * v, v
    p0, v0 = float(knots[2 * knot]), float(knots[2 * knot + 1])
    p1, v1 = float(knots[2 * knot + 2]), float(knots[2 * knot + 3])
    T, s = spacing * dt_s, (stage - knot * spacing) / spacing
    r, distance = 1.0 - s, p1 - p0
    p = p0 + s * s * (3.0 - 2.0 * s) * distance + s * r * T * (r * v0 - s * v1)
    v = 6.0 * s * r * distance / T + r * (1.0 - 3.0 * s) * v0 + s * (3.0 * s - 2.0) * v1
    return p, v


def along(model: Axis, knots: Knots, spacing: int, dt_s: float, stage: int) -> float:
    """Input ū under which the velocity of eq. (4) follows a spline at a stage [m/s]."""
    _, v = spline_at(knots, spacing, dt_s, stage)
    _, ahead = spline_at(knots, spacing, dt_s, stage + 1)
    # Second row of eq. (4), solved for u. At each step the velocity is exact; the position has a
    # small error, because the spline bends within a step.
    return (ahead - model.a11 * v) / model.b1


def guided(guide: AxisSpline, stage: int) -> float:
    """Input ū at a stage, along the spline or braking [m/s]."""
    if stage < guide.length or guide.brake == 0.0:
        u_spline = along(guide.model, guide.knots, guide.spacing, guide.dt_s, stage)
        return bounded(u_spline, guide.bound)
    share = remaining(stage, guide.length, guide.speed, guide.brake)
    return share * bounded(guide.last, guide.bound)


def guided_to(
    guide: AxisSpline, first: int, last: int, ref_p: float, ref_v: float
) -> tuple[float, float]:
    """State x̄ at the stage `last`, position [m] and velocity [m/s].

    Args:
        first: stage of the given x̄, which is used only after the last stage that may be flown.
        last: stage of the result.
        ref_p, ref_v: x̄ at `first`, position [m] and velocity [m/s].
    """
    ends = guide.length
    if last <= ends or guide.brake == 0.0:
        return spline_at(guide.knots, guide.spacing, guide.dt_s, last)
    if first <= ends:
        first = ends
        ref_p, ref_v = spline_at(guide.knots, guide.spacing, guide.dt_s, ends)
    for stage in range(first, last):
        u_spline = guided(guide, stage)
        ref_p, ref_v = advance(guide.model, ref_p, ref_v, u_spline)
    return ref_p, ref_v


def regulated(
    guide: AxisSpline, stage: int, ref_p: float, ref_v: float, p: float, v: float, w: float
) -> tuple[float, float]:
    """Input demanded by the regulator on one axis, before `follow` smooths it.

    Args:
        stage: steps since the first knot.
        ref_p, ref_v: x̄ at the stage, position [m] and velocity [m/s].
        p, v: state at the stage, position [m] and velocity [m/s].
        w: disturbance ŵ [m/s].

    Returns:
        ū + K (x̄ - x) - ŵ within the bound [m/s]; and ū [m/s].
    """
    u_spline = guided(guide, stage)
    back = feedback(guide.gain_p, guide.gain_v, ref_p - p, ref_v - v)
    return bounded(u_spline + back - w, guide.bound), u_spline


def follow(
    guide: AxisSpline,
    stage: int,
    ref_p: float,
    ref_v: float,
    p: float,
    v: float,
    w: float,
    before: float,
) -> tuple[float, float]:
    """Fly one axis for a step along a spline.

    Args:
        guide, stage, ref_p, ref_v, p, v, w: see `regulated`.
        before: input flown until now, u(i-1), within the bound [m/s].

    Returns:
        the input that is flown, u* [m/s]; and the spline's own input ū [m/s].
    """
    wanted, u_spline = regulated(guide, stage, ref_p, ref_v, p, v, w)
    return guide.lag * before + (1.0 - guide.lag) * wanted, u_spline


SPACING, DT_S, LENGTH, LAST, SPEED, BRAKE, BOUND, GAIN_P, GAIN_V, LAG = range(
    MODEL, MODEL + len(AxisSpline._fields) - 2
)
"""Columns of a table of splines: the fields of `AxisSpline` except model and knots."""


def spline_of(table: Table, knots: Table, axis: int) -> AxisSpline:
    return AxisSpline(
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
    reference: Table,
    first: int,
    stage: int,
    state: Table,
    disturbance: Numbers,
    before: Numbers,
    flown: Table,
) -> None:
    """Fly all axes for a step along a spline, see `follow`.

    Args:
        table: the spline without its knots, one row per axis, see `spline_of`.
        knots: position [m] and velocity [m/s] of each knot in turn; shape (axes, 2 n).
        reference: x̄ at the stage `first` [m, m/s], replaced by x̄ at `stage`; shape (axes, 2).
        first: stage of the given x̄.
        stage: steps since the first knot.
        state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        disturbance: ŵ of each axis [m/s].
        before: input flown until now, of each axis [m/s].
        flown: output: row 0 the inputs flown, row 1 ū [m/s]; shape (2, axes).
    """
    for axis in range(len(table)):
        guide = spline_of(table, knots, axis)
        ref_p, ref_v = guided_to(guide, first, stage, reference[axis, 0], reference[axis, 1])
        reference[axis, 0], reference[axis, 1] = ref_p, ref_v
        p, v, w = state[axis, 0], state[axis, 1], disturbance[axis]
        u, u_spline = follow(guide, stage, ref_p, ref_v, p, v, w, before[axis])
        flown[0, axis], flown[1, axis] = u, u_spline


@compilable
def foresee_spline(
    table: Table, knots: Table, reference: Table, stage: int, state: Table, ahead: Table
) -> None:
    """State of each axis one step later, if the vehicle follows the spline from a given state.

    The share λ of the previous input is omitted, because its effect lasts only a few steps. Wind is
    assumed to be compensated.

    Args:
        table, knots, stage, state: see `fly_spline`.
        reference: x̄ at the stage [m, m/s]; shape (axes, 2).
        ahead: output: the state one step later [m, m/s]; shape (axes, 2).
    """
    for axis in range(len(table)):
        guide = spline_of(table, knots, axis)
        p, v = state[axis, 0], state[axis, 1]
        u, _ = regulated(guide, stage, reference[axis, 0], reference[axis, 1], p, v, 0.0)
        ahead[axis, 0], ahead[axis, 1] = advance(guide.model, p, v, u)
