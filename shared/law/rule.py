"""The rule of flight: what a vehicle flies at a step with the horizon it holds, eq. (11).

    u*(k) = u(min(k, k_h + n - 1) | k_h)                    k_h: the step the horizon was made for
                                                            n: the inputs it has
                                                            k - k_h: the stage it is at
No input is flown for longer than `link.age_max_s` after the observation that it was planned from:
a horizon that reaches further ends there. After its last input that is held for ever, or braked
along. Without compensation all of its inputs until then are its first.

With feedback aboard the vehicle is led back to where these inputs lead, x̄, also after the last:

    u*(k) = u(k) + K (x̄(k) - x(k)),     x̄(i+1) = A x̄(i) + B (u(i) + ŵ)

ŵ is a disturbance that the inputs reckon with. Once they are braked to nothing it is left out, so
that x̄ comes to rest, and the vehicle stays there in whatever wind.

This is the one source of that rule: `step` and `lead_to` put its parts together for one spatial
axis, and `fly_horizon` for all axes of a vehicle. The client flies by it; the server's replay
compiles the very same functions into its kernels, and so knows what was flown. `speed` alone
belongs to all axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

from skytether.shared.base.compilable import Table, compilable
from skytether.shared.law.model import Array, Axis, advance


class Held(NamedTuple):
    """A horizon as one axis flies it."""

    model: Axis
    """Model of the axis, eq. (4)."""
    inputs: Sequence[float] | Array
    """Inputs of the horizon, from k_h on [m/s]."""
    length: int
    """Number of inputs that are flown."""
    indexed: bool
    """Whether each stage has an input of its own, rather than all of them the first."""
    speed: float
    """Magnitude of the last input over all axes [m/s]."""
    brake: float
    """Speed that braking takes away in a step [m/s]; 0 holds the last input for ever."""
    bound: float
    """Bound u_max of the input [m/s]."""
    feeds_back: bool
    """Whether there is feedback aboard."""
    gain_p: float
    """K on position [1/s]."""
    gain_v: float
    """K on velocity."""
    disturbance: float
    """Disturbance ŵ that the inputs reckon with [m/s]."""


def lasting(length: int, made_for: int, observed: int, age_max: int) -> int:
    """Number of a horizon's inputs that are flown; none where it is less than 1.

    Args:
        length: number of inputs that it has.
        made_for: k_h, the step of the first.
        observed: step of the observation that they were planned from.
        age_max: largest age of that observation [steps].
    """
    # The input at the age `age_max` itself is still flown, hence + 1.
    return min(length, observed + age_max - made_for + 1)


def late_max(horizon: int) -> int:
    """Number of steps after its committed ones at which a horizon may still come into force.

    By then the vehicle has flown other inputs than its plan begins with; a few are made good with
    the next plan, many would make the server's estimate and its plans swing.
    """
    # A longer allowance let the estimate swing until the vehicle flew away
    # (tests/server/test_slow.py).
    return max(2, horizon // 4)


def entry(stage: int, length: int) -> int:
    """Index of the input that counts at a stage of a horizon with so many inputs.

    Source: eq. (11).
    """
    if stage < 0:  # Python, which flies aboard, takes half the time for this of min and max
        return 0
    return stage if stage < length else length - 1


def bounded(u: float, bound: float) -> float:
    """An input within the bound u_max [m/s].

    Source: eq. (6).
    """
    if u < -bound:
        return -bound
    return min(u, bound)


def braked(speed: float, steps: int, brake: float) -> float:
    """Speed that is left after so many steps of braking [m/s].

    Args:
        speed: speed before [m/s].
        steps: number of them.
        brake: speed that braking takes away in a step [m/s].
    """
    return max(0.0, speed - steps * brake)


def remaining(stage: int, length: int, speed: float, brake: float) -> float:
    """Share of the input at `entry` that is told: 1, and after the last what braking leaves of it.

    Args:
        stage: where in the horizon the step is; may lie before its first or after its last input.
        length: how many inputs the horizon has.
        speed: magnitude of its last input over all axes [m/s].
        brake: speed that braking takes away in a step [m/s]; 0 holds the last input for ever.
    """
    # Brake 0 is the paper's vehicle, which holds its last input for ever (E10).
    if stage < length or brake == 0.0:
        return 1.0
    # One share for all axes: the vehicle slows down without turning.
    return braked(speed, stage - length + 1, brake) / speed if speed > 0.0 else 0.0


def leading(told: float, disturbance: float, share: float) -> float:
    """Input under which x̄ goes on [m/s].

    Args:
        told: the input that is told [m/s].
        disturbance: ŵ [m/s].
        share: `remaining`; at 0, x̄ comes to rest.
    """
    # With ŵ left in, x̄ would drift on for ever after the vehicle was told to stand still.
    return told + disturbance if share > 0.0 else 0.0


def led_back(gain_p: float, gain_v: float, dp: float, dv: float) -> float:
    """Feedback aboard K (x̄ - x) [m/s].

    Args:
        gain_p, gain_v: K, on position [1/s] and velocity.
        dp, dv: x̄ - x, in position [m] and velocity [m/s].
    """
    return gain_p * dp + gain_v * dv


def flown(stage: int, told: float, back: float, bound: float) -> float:
    """The input that is flown at a stage of a horizon [m/s].

    Args:
        stage: where in the horizon the step is; before its first input there is no x̄.
        told: the input that is told: `remaining` of that at `entry` [m/s].
        back: `led_back`, or 0 without feedback [m/s].
        bound: u_max [m/s].
    """
    # Before stage 0 there is no x̄ to be led back to: it begins at the step the horizon was made
    # for.
    u = told + back if stage >= 0 else told
    return bounded(u, bound)


def tell(held: Held, stage: int) -> tuple[float, float]:
    """Input that a horizon tells at a stage, without feedback [m/s], and its share `remaining`."""
    share = remaining(stage, held.length, held.speed, held.brake)
    # Without compensation the first input is flown at every stage (E21).
    index = entry(stage, held.length) if held.indexed else 0
    return share * bounded(held.inputs[index], held.bound), share


def lead_on(
    held: Held, told: float, share: float, lead_p: float, lead_v: float
) -> tuple[float, float]:
    """State x̄ at the next stage, position [m] and velocity [m/s].

    Args:
        held: the horizon.
        told, share: see `tell`.
        lead_p, lead_v: x̄ at the stage, position [m] and velocity [m/s].
    """
    return advance(held.model, lead_p, lead_v, leading(told, held.disturbance, share))


def lead_to(held: Held, first: int, last: int, lead_p: float, lead_v: float) -> tuple[float, float]:
    """State x̄ at the stage `last`, position [m] and velocity [m/s].

    Args:
        held: the horizon.
        first: stage from which it is rolled on, 0 or later.
        last: stage to which it is.
        lead_p, lead_v: x̄ at `first`, position [m] and velocity [m/s].
    """
    for stage in range(first, last):
        told, share = tell(held, stage)
        lead_p, lead_v = lead_on(held, told, share, lead_p, lead_v)
    return lead_p, lead_v


def step(
    held: Held, stage: int, lead_p: float, lead_v: float, p: float, v: float
) -> tuple[float, float, float, float]:
    """Fly one axis for a step by the horizon that is held.

    Args:
        held: the horizon.
        stage: k - k_h; may lie before its first or after its last input.
        lead_p, lead_v: x̄ at the stage, position [m] and velocity [m/s].
        p, v: state at the stage, position [m] and velocity [m/s].

    Returns:
        the input that is flown, u*(k) [m/s]; what of it is told, without feedback [m/s]; and x̄ at
        the next stage, position [m] and velocity [m/s], where there is feedback.

    Source: eq. (11).
    """
    (told, share), back = tell(held, stage), 0.0
    if held.feeds_back:
        back = led_back(held.gain_p, held.gain_v, lead_p - p, lead_v - v)
        if stage >= 0:
            lead_p, lead_v = lead_on(held, told, share, lead_p, lead_v)
    return flown(stage, told, back, held.bound), told, lead_p, lead_v


MODEL = len(Axis._fields)
"""Columns of the model, which come first in a table with a row an axis."""
LENGTH, INDEXED, SPEED, BRAKE, BOUND, FEEDS_BACK, GAIN_P, GAIN_V, DISTURBANCE = range(
    MODEL, MODEL + len(Held._fields) - 2
)
"""Columns of a table of horizons: the fields of `Held` but for model and inputs."""


def held_of(table: Table, inputs: Table, axis: int) -> Held:
    """Horizon on one axis, from a table with a row an axis."""
    return Held(
        model=Axis(table[axis, 0], table[axis, 1], table[axis, 2], table[axis, 3]),
        inputs=inputs[axis],
        length=int(table[axis, LENGTH]),
        indexed=table[axis, INDEXED] > 0.0,
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
    lead: Table,
    first: int,
    stage: int,
    state: Table,
    flown: Table,
) -> None:
    """Fly all axes for a step by the horizon that is held, see `step`.

    Args:
        table: the horizon but for its inputs, with a row an axis, see `held_of`.
        inputs: the horizon's inputs [m/s]; shape (axes, n).
        lead: x̄ at the stage `first` [m, m/s], rolled on to `stage` where that is later and there is
            feedback; shape (axes, 2).
        first: stage to which x̄ belongs.
        stage: k - k_h.
        state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        flown: output: the inputs flown, and what of them is told [m/s]; shape (2, axes).
    """
    for axis in range(len(table)):
        held = held_of(table, inputs, axis)
        lead_p, lead_v = lead[axis, 0], lead[axis, 1]
        if held.feeds_back:
            lead_p, lead_v = lead_to(held, first, stage, lead_p, lead_v)
            lead[axis, 0], lead[axis, 1] = lead_p, lead_v
        u, told, _, _ = step(held, stage, lead_p, lead_v, state[axis, 0], state[axis, 1])
        flown[0, axis], flown[1, axis] = u, told


@compilable
def foresee_horizon(
    table: Table, inputs: Table, lead: Table, stage: int, state: Table, ahead: Table
) -> None:
    """State of each axis a step later, flown by the horizon from a state at the stage.

    Args:
        table, inputs, stage, state: see `fly_horizon`.
        lead: x̄ at the stage [m, m/s]; shape (axes, 2).
        ahead: output: the state a step later [m, m/s]; shape (axes, 2).
    """
    for axis in range(len(table)):
        held = held_of(table, inputs, axis)
        p, v = state[axis, 0], state[axis, 1]
        u, _, _, _ = step(held, stage, lead[axis, 0], lead[axis, 1], p, v)
        ahead[axis, 0], ahead[axis, 1] = advance(held.model, p, v, u + held.disturbance)
