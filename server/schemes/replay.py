"""Replay of horizons: a schedule of the horizon in force at each step, and the resulting flight.

The schedule is made from the horizons in force and in flight, and flown by the rule of flight
(`shared.law.rule`), one axis after the other:

    x(i+1) = A x(i) + B (u(i) + w)

The scheme "committed", its disturbance observer and its loss scenarios use this replay.
"""

from typing import NamedTuple

from skytether.server.planning.compiled import advance, axis_of, reference_at, step
from skytether.server.schemes.sent import HOVERS, Sent
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings
from skytether.shared.base.kernel import F1, F2, I1, inline, part
from skytether.shared.law.rule import AxisHorizon


class HorizonSchedule(NamedTuple):
    """Legs: successive steps with the same horizon in force. The arrays are longer than needed."""

    begins: I1
    """First step of each leg."""
    numbers: I1
    """Number of the horizon in force on the leg, or HOVERS or UNKNOWN."""


class FlownTrack(NamedTuple):
    """Inputs flown on one axis and the resulting states, one row per step."""

    commands: F1
    """Inputs [m/s]."""
    states: F2
    """Position [m] and velocity [m/s] at each step and after the last."""


@part
def make_schedule(
    schedule: HorizonSchedule,
    sent: Sent,
    row: int,
    begin: int,
    in_force: int,
    following: range,
) -> int:
    """Fill in the schedule from step `begin` on; returns the number of legs.

    Args:
        in_force: number of the horizon in force at `begin`.
        following: numbers of later horizons, each in force from the step at which it is due.
    """
    ring, legs = sent.plans.shape[1], 1
    schedule.begins[0], schedule.numbers[0] = begin, in_force
    for number in following:
        due = sent.plans[row, number % ring].due
        # Of horizons that are due before the schedule begins, the newest is in force.
        if due <= begin:
            schedule.numbers[0] = number
            continue
        schedule.begins[legs], schedule.numbers[legs] = due, number
        legs += 1
    return legs


@part
def fly_schedule(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    axis: int,
    schedule: HorizonSchedule,
    legs: int,
    end: int,
    x: tuple[float, float, float, float],
    track: FlownTrack,
) -> None:
    """Fly one axis by a schedule from its first step to step `end`.

    Args:
        legs: number of legs of the schedule.
        end: step after the last flown step.
        x: observation at the first step: position [m], velocity [m/s], input flown on this axis
            [m/s], and magnitude of the input over all axes [m/s].
        track: output: inputs and states from the first step on.
    """
    law, begin = settings.laws[axis], schedule.begins[0]
    model, bound, w = axis_of(law), law.bound, memory.state[row, axis].w
    gain_p, gain_v = law.gain_p, law.gain_v
    p, v, first_input, first_speed = x
    for leg in range(legs):
        first = schedule.begins[leg]
        last = min(end, schedule.begins[leg + 1] if leg + 1 < legs else end)
        number = schedule.numbers[leg]
        if first >= last:
            continue
        if number < 0:
            # If the horizon is unknown, the observed input is assumed to be held.
            brake = settings.brake if number == HOVERS else 0.0
            one_input = AxisHorizon(
                model, (first_input,), 1, first_speed, brake, bound, False, 0.0, 0.0, 0.0
            )
            p, v = _fly(one_input, begin, 0.0, 0.0, p, v, w, first, last, begin, first_input, track)
            continue
        slot = number % memory.sent.plans.shape[1]
        sent, reference = memory.horizons[row, slot], memory.reference[row, slot, axis]
        made_for, ref_p, ref_v = memory.sent.plans[row, slot].step, reference.p, reference.v
        horizon = AxisHorizon(
            model,
            memory.inputs[row, slot, axis],
            sent.length,
            sent.speed,
            settings.brake,
            bound,
            settings.feeds_back,
            gain_p,
            gain_v,
            reference.w,
        )
        if settings.feeds_back:
            stage = first - made_for
            ref_p, ref_v = reference_at(horizon, reference.stage, stage, ref_p, ref_v)
            if leg == 0 and stage > reference.stage:
                reference.stage, reference.p, reference.v = stage, ref_p, ref_v
        p, v = _fly(
            horizon, made_for, ref_p, ref_v, p, v, w, first, last, begin, first_input, track
        )
    after = max(end - begin, 0)
    track.states[after, 0], track.states[after, 1] = p, v


@inline
def _fly(
    horizon: AxisHorizon,
    made_for: int,
    ref_p: float,
    ref_v: float,
    p: float,
    v: float,
    w: float,
    first: int,
    last: int,
    begin: int,
    first_input: float,
    track: FlownTrack,
) -> tuple[float, float]:
    """Fly one axis by a horizon from step `first` to `last`; returns position [m] and velocity
    [m/s] at `last`.

    Args:
        made_for: step that the horizon was made for.
        ref_p, ref_v: reference state x̄ at `first` [m, m/s].
        p, v: position [m] and velocity [m/s] at `first`.
        w: disturbance [m/s].
        first, last: first step, and step after the last.
        begin: first step of `track`.
        first_input: observed input at `begin` [m/s].
        track: output: inputs and states.
    """
    for k in range(first, last):
        u, _, ref_p, ref_v = step(horizon, k - made_for, ref_p, ref_v, p, v)
        if k == begin:
            u = first_input  # the observed input replaces the input by the rule of flight
        track.commands[k - begin] = u
        track.states[k - begin, 0], track.states[k - begin, 1] = p, v
        p, v = advance(horizon.model, p, v, u + w)
    return p, v
