"""Rule of flight: the input that a vehicle flies at a step with the horizon in force, eq. (11).

    u*(k) = u(min(k, k_h + n - 1) | k_h)                    k_h: the step the horizon was made for
                                                            n: number of its inputs
                                                            k - k_h: the present stage

Inputs are flown until `link.age_max_s` after the observation from which they were planned, even if
the horizon is longer. After the last input the vehicle repeats this input for ever, or brakes from
this input. Without compensation the vehicle flies the first input at all stages of the horizon.

With feedback aboard the vehicle is controlled towards the reference state x̄ of these inputs, also
after the last input:

    u*(k) = u(k) + K (x̄(k) - x(k)),     x̄(i+1) = A x̄(i) + B (u(i) + ŵ)

ŵ is the disturbance that the inputs compensate. Once braking has ended, ŵ is omitted, so that x̄
comes to rest; the feedback then holds the vehicle at x̄ in any wind.

This is the only implementation of the rule: `step` and `reference_at` combine its parts for one
spatial axis, `fly_horizon` for all axes of a vehicle. The client calls these functions, and the
server's replay compiles them, so both compute the same input. Only `speed` depends on all axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

from skytether.shared.base.compilable import Table, compilable
from skytether.shared.law.model import Array, Axis, advance


class AxisHorizon(NamedTuple):
    model: Axis
    inputs: Sequence[float] | Array
    """Inputs of the horizon, from k_h on [m/s]."""
    length: int
    """Number of inputs that may be flown."""
    speed: float
    """Magnitude of the last input over all axes [m/s]."""
    brake: float
    """Decrease of speed per step when braking [m/s]; 0 repeats the last input for ever."""
    bound: float
    feeds_back: bool
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    disturbance: float
    """Disturbance ŵ that the inputs compensate [m/s]."""


def lasting(length: int, made_for: int, observed: int, age_max: int) -> int:
    """Number of a horizon's inputs that may be flown; no input if this is 0 or negative.

    Args:
        length: number of the horizon's inputs.
        made_for: k_h, the step of the first input.
        observed: step of the observation from which the inputs were planned.
        age_max: largest age of that observation [steps].
    """
    # + 1, because the input at the age `age_max` is still flown.
    return min(length, observed + age_max - made_for + 1)


def entry(stage: int, length: int) -> int:
    """Index of the input at a stage of a horizon with `length` inputs.

    Source: eq. (11).
    """
    if stage < 0:  # in interpreted Python this is twice as fast as min and max
        return 0
    return stage if stage < length else length - 1


def bounded(u: float, bound: float) -> float:
    """Input within the bound u_max [m/s].

    Source: eq. (6).
    """
    if u < -bound:
        return -bound
    return min(u, bound)


def braked(speed: float, steps: int, brake: float) -> float:
    """Remaining speed after a number of steps of braking [m/s]; `brake` is the decrease per step
    [m/s].
    """
    return max(0.0, speed - steps * brake)


def remaining(stage: int, length: int, speed: float, brake: float) -> float:
    """Braking factor of the input at `entry`: 1 until the horizon ends, then falling to 0.

    Args:
        stage: present stage; may be before the first or after the last input.
        length: number of inputs of the horizon.
        speed: magnitude of the horizon's last input over all axes [m/s].
        brake: decrease of speed per step when braking [m/s]; 0 repeats the last input for ever.
    """
    # Brake 0 means the paper's vehicle, which repeats its last input for ever (E10).
    if stage < length or brake == 0.0:
        return 1.0
    # The factor is the same for all axes, so that the vehicle slows down without turning.
    return braked(speed, stage - length + 1, brake) / speed if speed > 0.0 else 0.0


def reference_input(without_feedback: float, disturbance: float, share: float) -> float:
    """Input that drives the reference state x̄ [m/s]: `without_feedback` plus the disturbance ŵ, or
    0 once braking has ended (`share` is 0).
    """
    # With ŵ, x̄ would drift without end after the vehicle has braked.
    return without_feedback + disturbance if share > 0.0 else 0.0


def feedback(gain_p: float, gain_v: float, dp: float, dv: float) -> float:
    """Feedback aboard K (x̄ - x) [m/s].

    Args:
        gain_p, gain_v: K, on position [1/s] and velocity.
        dp, dv: x̄ - x, in position [m] and velocity [m/s].
    """
    return gain_p * dp + gain_v * dv


def flown(stage: int, without_feedback: float, back: float, bound: float) -> float:
    """Input that is flown at a stage of a horizon [m/s].

    Args:
        stage: present stage; if negative, `back` is ignored.
        without_feedback: `remaining` times the input at `entry` [m/s].
        back: result of `feedback`; 0 without feedback aboard [m/s].
        bound: u_max [m/s].
    """
    # There is no x̄ before stage 0, the step that the horizon was made for.
    u = without_feedback + back if stage >= 0 else without_feedback
    return bounded(u, bound)


def planned_input(horizon: AxisHorizon, stage: int) -> tuple[float, float]:
    """Input of a horizon at a stage without feedback [m/s], and its braking factor `remaining`."""
    share = remaining(stage, horizon.length, horizon.speed, horizon.brake)
    return share * bounded(horizon.inputs[entry(stage, horizon.length)], horizon.bound), share


def next_reference(
    horizon: AxisHorizon, without_feedback: float, share: float, ref_p: float, ref_v: float
) -> tuple[float, float]:
    """Reference state x̄ at the next stage, position [m] and velocity [m/s].

    Args:
        without_feedback, share: see `planned_input`.
        ref_p, ref_v: x̄ at this stage, position [m] and velocity [m/s].
    """
    return advance(
        horizon.model, ref_p, ref_v, reference_input(without_feedback, horizon.disturbance, share)
    )


def reference_at(
    horizon: AxisHorizon, first: int, last: int, ref_p: float, ref_v: float
) -> tuple[float, float]:
    """Reference state x̄ at the stage `last`, position [m] and velocity [m/s].

    Args:
        first: stage of the given x̄, 0 or later.
        last: stage of the result.
        ref_p, ref_v: x̄ at `first`, position [m] and velocity [m/s].
    """
    for stage in range(first, last):
        without_feedback, share = planned_input(horizon, stage)
        ref_p, ref_v = next_reference(horizon, without_feedback, share, ref_p, ref_v)
    return ref_p, ref_v


def step(
    horizon: AxisHorizon, stage: int, ref_p: float, ref_v: float, p: float, v: float
) -> tuple[float, float, float, float]:
    """Fly one axis for a step with the horizon in force.

    Args:
        stage: k - k_h; may be before the first or after the last input.
        ref_p, ref_v: x̄ at the stage, position [m] and velocity [m/s].
        p, v: state at the stage, position [m] and velocity [m/s].

    Returns:
        the input that is flown, u*(k) [m/s]; this input without feedback [m/s]; and, with
            feedback, x̄ at the next stage, position [m] and velocity [m/s].

    Source: eq. (11).
    """
    (without_feedback, share), back = planned_input(horizon, stage), 0.0
    if horizon.feeds_back:
        back = feedback(horizon.gain_p, horizon.gain_v, ref_p - p, ref_v - v)
        if stage >= 0:
            ref_p, ref_v = next_reference(horizon, without_feedback, share, ref_p, ref_v)
    return flown(stage, without_feedback, back, horizon.bound), without_feedback, ref_p, ref_v


MODEL = len(Axis._fields)
"""Number of columns that hold the model: the first columns of a table with one row per axis."""
LENGTH, SPEED, BRAKE, BOUND, FEEDS_BACK, GAIN_P, GAIN_V, DISTURBANCE = range(
    MODEL, MODEL + len(AxisHorizon._fields) - 2
)
"""Columns of a table of horizons: the fields of `AxisHorizon` except model and inputs."""


def horizon_of(table: Table, inputs: Table, axis: int) -> AxisHorizon:
    return AxisHorizon(
        model=Axis(table[axis, 0], table[axis, 1], table[axis, 2], table[axis, 3]),
        inputs=inputs[axis],
        length=int(table[axis, LENGTH]),
        speed=table[axis, SPEED],
        brake=table[axis, BRAKE],
        bound=table[axis, BOUND],
        feeds_back=table[axis, FEEDS_BACK] > 0.0,
        gain_p=table[axis, GAIN_P],
        gain_v=table[axis, GAIN_V],
        disturbance=table[axis, DISTURBANCE],
    )


@compilable
def fly_horizon(
    table: Table,
    inputs: Table,
    reference: Table,
    first: int,
    stage: int,
    state: Table,
    flown: Table,
) -> None:
    """Fly all axes for a step with the horizon in force, see `step`.

    Args:
        table: the horizon without its inputs, one row per axis, see `horizon_of`.
        inputs: inputs of the horizon [m/s]; shape (axes, n).
        reference: x̄ at the stage `first` [m, m/s], with feedback replaced by x̄ at `stage`; shape
            (axes, 2).
        first: stage of the given x̄.
        stage: k - k_h.
        state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        flown: output: row 0 the inputs flown, row 1 without feedback [m/s]; shape (2, axes).
    """
    for axis in range(len(table)):
        horizon = horizon_of(table, inputs, axis)
        ref_p, ref_v = reference[axis, 0], reference[axis, 1]
        if horizon.feeds_back:
            ref_p, ref_v = reference_at(horizon, first, stage, ref_p, ref_v)
            reference[axis, 0], reference[axis, 1] = ref_p, ref_v
        u, without_feedback, _, _ = step(
            horizon, stage, ref_p, ref_v, state[axis, 0], state[axis, 1]
        )
        flown[0, axis], flown[1, axis] = u, without_feedback


@compilable
def foresee_horizon(
    table: Table, inputs: Table, reference: Table, stage: int, state: Table, ahead: Table
) -> None:
    """State of each axis one step later, if the vehicle flies the horizon from a given state.

    Args:
        table, inputs, stage, state: see `fly_horizon`.
        reference: x̄ at the stage [m, m/s]; shape (axes, 2).
        ahead: output: the state one step later [m, m/s]; shape (axes, 2).
    """
    for axis in range(len(table)):
        horizon = horizon_of(table, inputs, axis)
        p, v = state[axis, 0], state[axis, 1]
        u, _, _, _ = step(horizon, stage, reference[axis, 0], reference[axis, 1], p, v)
        ahead[axis, 0], ahead[axis, 1] = advance(horizon.model, p, v, u + horizon.disturbance)
