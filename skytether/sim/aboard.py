"""Kernels of a vehicle's regular step in virtual time.

A regular step: eq. (1) moves the vehicle; it measures its state, checks it against the previous
one, filters it, chooses the input by the rule of flight and clamps it. The functions are those of
`client` and `shared`, in the order of `client.pilot`, and the numbers are equal to the last bit
(`tests/sim/test_compiled_pilot.py`). `sim.pilot` calls the kernels.
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from skytether.client import clamp
from skytether.client import filter as kalman
from skytether.client.filter import Spread
from skytether.server.common.compiled import advance, lead_to, step
from skytether.server.schemes.trajectory import follow, guided_to, regulated
from skytether.shared.base.kernel import F1, F2, F3, R1, kernel, part, record, records, shared
from skytether.shared.law import leap
from skytether.shared.law.model import Axis
from skytether.shared.law.rule import Held
from skytether.shared.law.spline import Guide
from skytether.shared.wire.protocol import FLOAT_MAX

limited = shared(clamp.limited)
velocity_leaps, position_leaps = shared(leap.velocity_leaps), shared(leap.position_leaps)
shared(leap.displacement)
widened = shared(kalman.widened)
by_position, by_velocity = shared(kalman.by_position), shared(kalman.by_velocity)


class AxisAboard:
    """Record: constants of one axis of a vehicle."""

    true_a01: float
    """Model of the true vehicle, eq. (4): position gained per unit of velocity in a step [s]."""
    true_a11: float
    """Share of the true velocity that is left after a step."""
    true_b0: float
    """Position that the true vehicle gains per unit of input in a step [s]."""
    true_b1: float
    """Share of the input that the true velocity takes on in a step."""
    true_gain: float
    """Gain g of the true vehicle."""
    push: float
    """Velocity that wind adds to the input, apart from white acceleration [m/s]."""
    windy: bool
    """Whether there is white acceleration (random gusts)."""
    shove_p: float
    """Position added per unit of white acceleration's first random number [m]."""
    shove_vp: float
    """Velocity added per unit of white acceleration's first random number [m/s]."""
    shove_v: float
    """Velocity added per unit of white acceleration's second random number [m/s]."""
    a01: float
    """Model of the terms, eq. (4): position gained per unit of velocity in a step [s]."""
    a11: float
    """Share of the velocity that is left after a step, in the model."""
    b0: float
    """Position gained per unit of input in a step, in the model [s]."""
    b1: float
    """Share of the input that the velocity takes on in a step, in the model."""
    bound: float
    """Bound u_max of the input [m/s]."""
    change_max: float
    """Largest change of the input in a step [m/s]."""
    dt_s: float
    """Length of a step [s]."""
    noise_m: float
    """Largest change of position in a step that noise explains [m]."""
    noise_mps: float
    """Largest change of velocity in a step that noise explains [m/s]."""
    is_exact: bool
    """Whether the state is measured as it is."""
    bias_p: float
    """Bias of a measured position [m]."""
    bias_v: float
    """Bias of a measured velocity [m/s]."""
    sigma_p: float
    """Standard deviation of a measured position's noise [m]."""
    sigma_v: float
    """Standard deviation of a measured velocity's noise [m/s]."""
    filters: bool
    """Whether there is a Kalman filter."""
    variance_p: float
    """Variance of a measured position [m²]."""
    variance_v: float
    """Variance of a measured velocity [m²/s²]."""
    noise_pp: float
    """Filter's process noise Q: variance of the position [m²]."""
    noise_pv: float
    """Filter's process noise Q: covariance of position and velocity [m²/s]."""
    noise_vv: float
    """Filter's process noise Q: variance of the velocity [m²/s²]."""
    noise_ww: float
    """Filter's process noise Q: variance of the disturbance [m²/s²]."""


class AxisState:
    """Record: state of one axis of a vehicle, which changes from step to step."""

    p: float
    """True position [m]."""
    v: float
    """True velocity [m/s]."""
    z_p: float
    """Measured position [m]."""
    z_v: float
    """Measured velocity [m/s]."""
    x_p: float
    """Position estimate that the vehicle flies by [m]."""
    x_v: float
    """Velocity estimate that the vehicle flies by [m/s]."""
    x_w: float
    """Disturbance ŵ that the filter estimates [m/s]; 0 without a filter."""
    u: float
    """Input in force [m/s]."""
    lead_p: float
    """Position predicted by the horizon [m]."""
    lead_v: float
    """Velocity predicted by the horizon [m/s]."""
    pp: float
    """Filter's P: variance of the position [m²]."""
    pv: float
    """Filter's P: covariance of position and velocity [m²/s]."""
    pw: float
    """Filter's P: covariance of position and disturbance [m²/s]."""
    vv: float
    """Filter's P: variance of the velocity [m²/s²]."""
    vw: float
    """Filter's P: covariance of velocity and disturbance [m²/s²]."""
    ww: float
    """Filter's P: variance of the disturbance [m²/s²]."""


class AxisPlan:
    """Record: horizon or spline in force, on one axis."""

    is_spline: bool
    """Whether it is a spline."""
    length: int
    """Number of stages in the plan."""
    spacing: int
    """Steps from one knot of a spline to the next."""
    indexed: bool
    """Whether each stage of a horizon has its own input."""
    last: float
    """Input at the last stage of a spline [m/s]."""
    speed: float
    """Magnitude of the last input over all axes [m/s]."""
    brake: float
    """Speed lost per step while braking [m/s]."""
    feeds_back: bool
    """Whether there is feedback."""
    gain_p: float
    """Feedback gain K on position [1/s]."""
    gain_v: float
    """Feedback gain K on velocity."""
    lag: float
    """Share λ of the input before that is kept along a spline."""
    disturbance: float
    """Disturbance ŵ that a horizon's inputs already compensate [m/s]."""


AXIS_ABOARD, AXIS_STATE, AXIS_PLAN = record(AxisAboard), record(AxisState), record(AxisPlan)
Constants = Annotated[NDArray[np.void], records(AXIS_ABOARD, 1)]
"""Constants of a vehicle; shape (axes,)."""
StatesNow = Annotated[NDArray[np.void], records(AXIS_STATE, 1)]
"""State of a vehicle; shape (axes,)."""
StatesAhead = Annotated[NDArray[np.void], records(AXIS_STATE, 2)]
"""State of a vehicle at one step after the other; shape (n, axes)."""
Plans = Annotated[NDArray[np.void], records(AXIS_PLAN, 1)]
"""Plan of a vehicle; shape (axes,)."""


@part
def measured_on(
    constants: Constants, now: StatesNow, after: StatesNow, drawn: F2, sensed: F2
) -> bool:
    """Move the vehicle to the next step, measure and filter; see `fly_step`."""
    usual = True
    for i in range(len(constants)):
        axis, was, now_is = constants[i], now[i], after[i]
        true = Axis(axis.true_a01, axis.true_a11, axis.true_b0, axis.true_b1)
        p, v = advance(true, was.p, was.v, axis.true_gain * was.u + axis.push)
        if axis.windy:
            n, m = drawn[i, 0], drawn[i, 1]
            p, v = p + axis.shove_p * n, v + (axis.shove_vp * n + axis.shove_v * m)
        z_p, z_v = p, v
        if not axis.is_exact:
            z_p = p + axis.bias_p + axis.sigma_p * sensed[0, i]
            z_v = v + axis.bias_v + axis.sigma_v * sensed[1, i]
        usual &= not velocity_leaps(was.z_v, z_v, axis.dt_s, axis.noise_mps)
        usual &= not position_leaps(was.z_p, was.z_v, z_p, z_v, axis.dt_s, axis.noise_m)
        x_p, x_v, w = z_p, z_v, 0.0
        if axis.filters:
            known = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
            x_p, x_v = advance(known, was.x_p, was.x_v, was.u + was.x_w)
            noise = Spread(axis.noise_pp, axis.noise_pv, 0.0, axis.noise_vv, 0.0, axis.noise_ww)
            spread = Spread(was.pp, was.pv, was.pw, was.vv, was.vw, was.ww)
            (kp, kv, kw), spread = by_position(widened(known, spread, noise), axis.variance_p)
            off = z_p - x_p
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, was.x_w + kw * off
            (kp, kv, kw), spread = by_velocity(spread, axis.variance_v)
            off = z_v - x_v
            x_p, x_v, w = x_p + kp * off, x_v + kv * off, w + kw * off
            now_is.pp, now_is.pv, now_is.pw = spread.pp, spread.pv, spread.pw
            now_is.vv, now_is.vw, now_is.ww = spread.vv, spread.vw, spread.ww
        usual &= -FLOAT_MAX <= x_p <= FLOAT_MAX and -FLOAT_MAX <= x_v <= FLOAT_MAX
        now_is.p, now_is.v, now_is.z_p, now_is.z_v = p, v, z_p, z_v
        now_is.x_p, now_is.x_v, now_is.x_w = x_p, x_v, w
    return usual


@part
def guide_of(axis: AxisAboard, plan: AxisPlan, knots: R1) -> Guide:
    """Spline of one axis, for the rule of flight."""
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
        plan.lag,
    )


@part
def held_of(axis: AxisAboard, plan: AxisPlan, inputs: R1) -> Held:
    """Horizon of one axis, for the rule of flight."""
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


@part
def flown_on(
    constants: Constants,
    now: StatesNow,
    after: StatesNow,
    drawn: F2,
    sensed: F2,
    plans: Plans,
    numbers: F2,
    stage: int,
    lead_stage: int,
    told: F1,
) -> bool:
    """Fly a vehicle to its next step; see `fly_step`."""
    usual, axes = measured_on(constants, now, after, drawn, sensed), len(constants)
    for i in range(axes):
        axis, was, now_is, plan = constants[i], now[i], after[i], plans[i]
        lead_p, lead_v, x_p, x_v = was.lead_p, was.lead_v, now_is.x_p, now_is.x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            lead_p, lead_v = guided_to(guide, lead_stage, stage, lead_p, lead_v)
            u, part_told = follow(guide, stage, lead_p, lead_v, x_p, x_v, now_is.x_w, was.u)
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
        told[2 * (axes + i)], told[2 * (axes + i) + 1] = now_is.z_p, now_is.z_v
        told[2 * (2 * axes + i)], told[2 * (2 * axes + i) + 1] = x_p, x_v
        told[6 * axes + i], told[7 * axes + i] = u, part_told
    return usual


@kernel
def fly_step(
    constants: Constants,
    now: StatesNow,
    after: StatesNow,
    drawn: F2,
    sensed: F2,
    plans: Plans,
    numbers: F2,
    stage: int,
    lead_stage: int,
    told: F1,
) -> bool:
    """Fly a vehicle to its next step, and choose the input from there on.

    Args:
        constants: constants of the vehicle.
        now: its state at the previous step.
        after: output: its state at the step.
        drawn: normal numbers of white acceleration; shape (axes, 2).
        sensed: numbers of the sensor's noise, of positions and of velocities; shape (2, axes).
        plans: horizon or spline in force.
        numbers: the plan's inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: stage of the plan at the step.
        lead_stage: stage to which the predicted state in `now` belongs.
        told: output, for all axes one after the other: true position [m] and velocity [m/s], those
            measured, those flown by, the input [m/s], and its part without feedback [m/s]; shape (8
            axes,).

    Returns:
        whether the step was regular; if not, the outputs must not be used.
    """
    return flown_on(constants, now, after, drawn, sensed, plans, numbers, stage, lead_stage, told)


@part
def silent_on(
    constants: Constants,
    now: StatesNow,
    plans: Plans,
    numbers: F2,
    stage: int,
    believed: F2,
    silent: F2,
    apart: F2,
) -> None:
    """Predict the state at the next step from the one that the server must assume.

    The arguments are those of `believe_step`.
    """
    for i in range(len(constants)):
        axis, at, plan = constants[i], now[i], plans[i]
        model = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
        p, v = believed[i, 0], believed[i, 1]
        apart[i, 0], apart[i, 1] = p - at.x_p, v - at.x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            u, _ = regulated(guide, stage, at.lead_p, at.lead_v, p, v, 0.0)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u)
        else:
            held = held_of(axis, plan, numbers[i])
            u, _, _, _ = step(held, stage, at.lead_p, at.lead_v, p, v)
            silent[i, 0], silent[i, 1] = advance(model, p, v, u + plan.disturbance)


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
    """Predict the state at the next step, as `Compensator.foresee` does.

    Args:
        constants: constants of the vehicle.
        now: its state at the step.
        plans: horizon or spline in force.
        numbers: the plan's inputs [m/s] or knots [m, m/s]; shape (axes, n).
        stage: stage of the plan at the step.
        believed: state that the server must assume [m, m/s]; shape (axes, 2).
        silent: output: prediction from `believed` [m, m/s]; shape (axes, 2).
        told: output: prediction from the state that is flown by [m, m/s]; shape (axes, 2).
        apart: output: distance of the vehicle from `believed` [m, m/s]; shape (axes, 2).
    """
    silent_on(constants, now, plans, numbers, stage, believed, silent, apart)
    for i in range(len(constants)):
        axis, at, plan = constants[i], now[i], plans[i]
        model = Axis(axis.a01, axis.a11, axis.b0, axis.b1)
        x_p, x_v = at.x_p, at.x_v
        if plan.is_spline:
            guide = guide_of(axis, plan, numbers[i])
            u, _ = regulated(guide, stage, at.lead_p, at.lead_v, x_p, x_v, 0.0)
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, u)
        else:
            told[i, 0], told[i, 1] = advance(model, x_p, x_v, at.u + plan.disturbance)


@kernel
def fly_ahead(
    constants: Constants,
    states: StatesAhead,
    drawn: F3,
    sensed: F3,
    plans: Plans,
    numbers: F2,
    stage: int,
    lead_stage: int,
    told: F2,
    believed: F3,
    apart: F3,
) -> int:
    """Fly a vehicle over steps at which it sends nothing, as `fly_step` and `believe_step` do.

    Args:
        constants: constants of the vehicle.
        states: its states, one step after the other; that at the previous step comes first and is
            given, the others are output; shape (n + 1, axes).
        drawn, sensed: see `fly_step`; shape (n, axes, 2) and (n, 2, axes).
        plans, numbers: see `fly_step`.
        stage: stage of the plan at the first of the steps.
        lead_stage: stage to which the predicted state in `states[0]` belongs.
        told: output: see `fly_step`; shape (n, 8 axes).
        believed: states that the server must assume, one step after the other; that at the first
            step is given, the others are output [m, m/s]; shape (n + 1, axes, 2).
        apart: output: distances of the vehicle from these [m, m/s]; shape (n, axes, 2).

    Returns:
        number of steps before the first that is not regular; the outputs of others must not be
        used.
    """
    for i in range(len(told)):
        if not flown_on(
            constants,
            states[i],
            states[i + 1],
            drawn[i],
            sensed[i],
            plans,
            numbers,
            stage + i,
            lead_stage,
            told[i],
        ):
            return i
        lead_stage = max(stage + i, lead_stage)
        silent_on(
            constants,
            states[i + 1],
            plans,
            numbers,
            stage + i,
            believed[i],
            believed[i + 1],
            apart[i],
        )
    return len(told)
