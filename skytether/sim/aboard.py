"""Kernels of a vehicle's usual step in virtual time.

At every step a vehicle does the same: eq. (1) moves it, it measures that, holds it against what it
measured before, filters it, chooses the input by the rule of flight and clamps it. The functions
are those of `client` and `shared`, in the order of `client.pilot`, and the numbers are the same to
the last bit (`tests/sim/test_compiled_pilot.py`). `sim.pilot` calls the kernels.
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from skytether.client import clamp
from skytether.client import filter as kalman
from skytether.client.filter import Spread
from skytether.server.control.law import advance, lead_to, step
from skytether.server.control.trajectory import follow, guided_to
from skytether.shared.base.kernel import F1, F2, R1, kernel, part, record, records, shared
from skytether.shared.law import leap
from skytether.shared.law.model import Axis
from skytether.shared.law.rule import Held
from skytether.shared.law.spline import Guide
from skytether.shared.wire.protocol import FLOAT_MAX

limited = shared(clamp.limited)
velocity_leaps, position_leaps = shared(leap.velocity_leaps), shared(leap.position_leaps)
widened = shared(kalman.widened)
by_position, by_velocity = shared(kalman.by_position), shared(kalman.by_velocity)


class AxisAboard:
    """Record: what does not change from step to step on one axis of a vehicle."""

    true_a01: float
    """Eq. (4) of the vehicle as it is: how far the velocity carries the position [s]."""
    true_a11: float
    """Share of the velocity that is left after a step."""
    true_b0: float
    """How far the input carries the position [s]."""
    true_b1: float
    """Share of the input that the velocity has taken on."""
    true_gain: float
    """Gain g of the vehicle as it is."""
    push: float
    """What the air adds to the input, but for white acceleration [m/s]."""
    windy: bool
    """Whether there is white acceleration."""
    shove_p: float
    """What a unit of white acceleration's first number adds to the position [m]."""
    shove_vp: float
    """What that adds to the velocity [m/s]."""
    shove_v: float
    """What a unit of its second number adds to the velocity [m/s]."""
    a01: float
    """Eq. (4) as the terms have it: how far the velocity carries the position [s]."""
    a11: float
    """Share of the velocity that is left after a step."""
    b0: float
    """How far the input carries the position [s]."""
    b1: float
    """Share of the input that the velocity has taken on."""
    bound: float
    """Bound u_max of the input [m/s]."""
    change_max: float
    """Largest change of the input in a step [m/s]."""
    dt_s: float
    """Length of a step [s]."""
    noise_m: float
    """What noise may add to a change of position [m]."""
    noise_mps: float
    """What noise may add to a change of velocity [m/s]."""
    filters: bool
    """Whether there is a Kalman filter."""
    variance_p: float
    """Variance of a measured position [m²]."""
    variance_v: float
    """Variance of a measured velocity [m²/s²]."""
    noise_pp: float
    """Q of the filter: variance of the position [m²]; the other fields likewise."""
    noise_pv: float
    """Q: covariance of position and velocity."""
    noise_vv: float
    """Q: variance of the velocity."""
    noise_ww: float
    """Q: variance of the disturbance."""


class AxisState:
    """Record: what changes from step to step on one axis of a vehicle."""

    p: float
    """True position [m]."""
    v: float
    """True velocity [m/s]."""
    x_p: float
    """Position that is flown by [m]."""
    x_v: float
    """Velocity that is flown by [m/s]."""
    x_w: float
    """Disturbance ŵ that the filter has found [m/s]; 0 without a filter."""
    u: float
    """Input that is flown [m/s]."""
    lead_p: float
    """Position to which the horizon leads [m]."""
    lead_v: float
    """Velocity to which the horizon leads [m/s]."""
    pp: float
    """P of the filter: variance of the position [m²]; the other fields likewise."""
    pv: float
    """P: covariance of position and velocity."""
    pw: float
    """P: covariance of position and disturbance."""
    vv: float
    """P: variance of the velocity."""
    vw: float
    """P: covariance of velocity and disturbance."""
    ww: float
    """P: variance of the disturbance."""


class AxisPlan:
    """Record: the horizon or spline that is held, on one axis."""

    is_spline: bool
    """Whether it is a spline."""
    length: int
    """Number of stages that are flown."""
    spacing: int
    """Steps from one knot of a spline to the next."""
    indexed: bool
    """Whether each stage of a horizon has an input of its own."""
    last: float
    """Input at the last stage of a spline [m/s]."""
    speed: float
    """Magnitude of the last input over all axes [m/s]."""
    brake: float
    """Speed that braking takes away in a step [m/s]."""
    feeds_back: bool
    """Whether there is feedback."""
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    disturbance: float
    """Disturbance ŵ that the inputs of a horizon reckon with [m/s]."""


AXIS_ABOARD, AXIS_STATE, AXIS_PLAN = record(AxisAboard), record(AxisState), record(AxisPlan)
Constants = Annotated[NDArray[np.void], records(AXIS_ABOARD, 1)]
"""Constants of a vehicle; shape (axes,)."""
StatesNow = Annotated[NDArray[np.void], records(AXIS_STATE, 1)]
"""State of a vehicle; shape (axes,)."""
Plans = Annotated[NDArray[np.void], records(AXIS_PLAN, 1)]
"""Plan of a vehicle; shape (axes,)."""


@part
def measured_on(constants: Constants, now: StatesNow, after: StatesNow, drawn: F2) -> bool:
    """Fly the vehicle to the next step, measure it and filter that; see `fly_step`."""
    usual = True
    for i in range(len(constants)):
        axis, was, now_is = constants[i], now[i], after[i]
        true = Axis(axis.true_a01, axis.true_a11, axis.true_b0, axis.true_b1)
        p, v = advance(true, was.p, was.v, axis.true_gain * was.u + axis.push)
        if axis.windy:
            n, m = drawn[i, 0], drawn[i, 1]
            p, v = p + axis.shove_p * n, v + (axis.shove_vp * n + axis.shove_v * m)
        usual &= not velocity_leaps(was.v, v, axis.dt_s, axis.noise_mps)
        usual &= not position_leaps(was.p, was.v, p, v, axis.dt_s, axis.noise_m)
        x_p, x_v, w = p, v, 0.0
        if axis.filters:
            known = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
            x_p, x_v = advance(known, was.x_p, was.x_v, was.u + was.x_w)
            noise = Spread(axis.noise_pp, axis.noise_pv, 0.0, axis.noise_vv, 0.0, axis.noise_ww)
            spread = Spread(was.pp, was.pv, was.pw, was.vv, was.vw, was.ww)
            (kp, kv, kw), spread = by_position(widened(known, spread, noise), axis.variance_p)
            off = p - x_p
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, was.x_w + kw * off
            (kp, kv, kw), spread = by_velocity(spread, axis.variance_v)
            off = v - x_v
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, w + kw * off
            now_is.pp, now_is.pv, now_is.pw = spread.pp, spread.pv, spread.pw
            now_is.vv, now_is.vw, now_is.ww = spread.vv, spread.vw, spread.ww
        usual &= -FLOAT_MAX <= x_p <= FLOAT_MAX and -FLOAT_MAX <= x_v <= FLOAT_MAX
        now_is.p, now_is.v = p, v
        now_is.x_p, now_is.x_v, now_is.x_w = x_p, x_v, w
    return usual


@part
def guide_of(axis: AxisAboard, plan: AxisPlan, knots: R1) -> Guide:
    """Spline of one axis."""
    return Guide(
        Axis(axis.a01, axis.a11, axis.b0, axis.b1),
        knots,
        plan.spacing,
        axis.dt_s,
        plan.length,
        plan.last,
        plan.speed,
        plan.brake,
        axis.bound,
        plan.gain_p,
        plan.gain_v,
    )


@part
def held_of(axis: AxisAboard, plan: AxisPlan, inputs: R1) -> Held:
    """Horizon of one axis."""
    return Held(
        Axis(axis.a01, axis.a11, axis.b0, axis.b1),
        inputs,
        plan.length,
        plan.indexed,
        plan.speed,
        plan.brake,
        axis.bound,
        plan.feeds_back,
        plan.gain_p,
        plan.gain_v,
        plan.disturbance,
    )


@kernel
def fly_step(
    constants: Constants,
    now: StatesNow,
    after: StatesNow,
    drawn: F2,
    plans: Plans,
    numbers: F2,
    stage: int,
    lead_stage: int,
    told: F1,
) -> bool:
    """Fly a vehicle to its next step, and choose the input from there on.

    Args:
        constants: those of the vehicle.
        now: its state at the step before.
        after: what is filled in: its state at the step.
        drawn: normal numbers of white acceleration; shape (axes, 2).
        plans: the horizon or spline that is held.
        numbers: its inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: where in the plan the step is.
        lead_stage: stage at which `now` has the state to which the plan leads.
        told: what is filled in, for all axes one after the other: true position [m] and velocity
            [m/s], those measured, those flown by, then input [m/s], and part of the input that is
            no feedback [m/s]; shape (8 axes,).

    Returns:
        whether all of that is as usual; if not, it counts for nothing.
    """
    usual, axes = measured_on(constants, now, after, drawn), len(constants)
    for i in range(axes):
        axis, was, now_is, plan = constants[i], now[i], after[i], plans[i]
        lead_p, lead_v, x_p, x_v = was.lead_p, was.lead_v, now_is.x_p, now_is.x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            lead_p, lead_v = guided_to(guide, lead_stage, stage, lead_p, lead_v)
            u, part_told = follow(guide, stage, lead_p, lead_v, x_p, x_v, now_is.x_w)
        else:
            held = held_of(axis, plan, numbers[i])
            if plan.feeds_back:
                lead_p, lead_v = lead_to(held, lead_stage, stage, lead_p, lead_v)
            u, part_told, _, _ = step(held, stage, lead_p, lead_v, x_p, x_v)
        usual &= math.isfinite(u) and math.isfinite(part_told)
        part_flown = part_told if plan.feeds_back else u
        u = limited(u, part_flown, 0.0, was.u, axis.change_max, axis.bound)
        now_is.u, now_is.lead_p, now_is.lead_v = u, lead_p, lead_v
        told[2 * i], told[2 * i + 1] = now_is.p, now_is.v
        told[2 * (axes + i)], told[2 * (axes + i) + 1] = now_is.p, now_is.v
        told[2 * (2 * axes + i)], told[2 * (2 * axes + i) + 1] = x_p, x_v
        told[6 * axes + i], told[7 * axes + i] = u, part_told
    return usual


@kernel
def believe_step(
    constants: Constants,
    now: StatesNow,
    plans: Plans,
    numbers: F2,
    stage: int,
    believed: F2,
    silent: F2,
    told: F2,
    apart: F2,
) -> None:
    """Foresee the state of the next step, as `Compensator.foresee` does.

    Args:
        constants: those of the vehicle.
        now: its state at the step.
        plans: the horizon or spline that is held.
        numbers: its inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: where in the plan the step is.
        believed: state that the server must take it to be in [m, m/s]; shape (axes, 2).
        silent: what is filled in: where that leads [m, m/s]; shape (axes, 2).
        told: what is filled in: where the state leads that is flown by [m, m/s]; shape (axes, 2).
        apart: what is filled in: how far the vehicle is from `believed` [m, m/s]; shape (axes, 2).
    """
    for i in range(len(constants)):
        axis, at, plan = constants[i], now[i], plans[i]
        model = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
        p, v, x_p, x_v = believed[i, 0], believed[i, 1], at.x_p, at.x_v
        apart[i, 0], apart[i, 1] = p - x_p, v - x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            u, _ = follow(guide, stage, at.lead_p, at.lead_v, p, v, 0.0)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u)
            u, _ = follow(guide, stage, at.lead_p, at.lead_v, x_p, x_v, 0.0)
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, u)
        else:
            held = held_of(axis, plan, numbers[i])
            u, _, _, _ = step(held, stage, at.lead_p, at.lead_v, p, v)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u + plan.disturbance)
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, at.u + plan.disturbance)
