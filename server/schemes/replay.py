"""Course of a vehicle: which horizon is in force from which step on, and the flight along it.

A course is charted from what is in force and under way, and rolled by the rule of flight
(`shared.law.rule`), one axis after the other. With it the committed scheme foresees a vehicle, the
disturbance observer replays what was flown, and doubt asks what follows from a loss.

    x(i+1) = A x(i) + B (u(i) + w)
"""

from typing import NamedTuple

from skytether.server.common.compiled import advance, axis_of, reference_at, step
from skytether.server.schemes.sent import HOVERS, Sent
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings
from skytether.shared.base.kernel import F1, F2, I1, inline, part
from skytether.shared.law.rule import AxisHorizon


class HorizonsInForce(NamedTuple):
    """Horizons with the step from which each is in force; room for more than can be in flight."""

    begins: I1
    """First step of each leg."""
    numbers: I1
    """Number of the horizon flown on it, HOVERS or UNKNOWN."""


class FlownTrack(NamedTuple):
    """Inputs flown on one axis, step by step, and the states they led to."""

    commands: F1
    """Inputs [m/s]."""
    states: F2
    """Position [m] and velocity [m/s] at each step and after the last."""


@part
def chart(
    course: HorizonsInForce,
    sent: Sent,
    row: int,
    begin: int,
    flown: int,
    following: range,
) -> int:
    """Number of legs of the course from `begin`: `flown`, then each of those following it.

    Args:
        following: numbers of horizons, each in force when it is due.
    """
    ring, legs = sent.plans.shape[1], 1
    course.begins[0], course.numbers[0] = begin, flown
    for number in following:
        due = sent.plans[row, number % ring].due
        # In force already when the course begins: the newest such horizon counts.
        if due <= begin:
            course.numbers[0] = number
            continue
        course.begins[legs], course.numbers[legs] = due, number
        legs += 1
    return legs


@part
def roll(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    axis: int,
    course: HorizonsInForce,
    legs: int,
    end: int,
    x: tuple[float, float, float, float],
    track: FlownTrack,
) -> None:
    """Fly one axis along a course from its begin to step `end`, into `track`.

    Args:
        x: position [m] and velocity [m/s] at the begin, the input flown from there on [m/s], and
            the magnitude of that over all axes [m/s].
    """
    law, begin = settings.laws[axis], course.begins[0]
    model, bound, w = axis_of(law), law.bound, memory.state[row, axis].w
    gain_p, gain_v = law.gain_p, law.gain_v
    p, v, told_first, speed_told = x
    for leg in range(legs):
        first = course.begins[leg]
        last = min(end, course.begins[leg + 1] if leg + 1 < legs else end)
        number = course.numbers[leg]
        if first >= last:
            continue
        if number < 0:
            # Unknown horizon: assume that the last input is held.
            brake = settings.brake if number == HOVERS else 0.0
            stands = AxisHorizon(
                model, (told_first,), 1, True, speed_told, brake, bound, False, 0.0, 0.0, 0.0
            )
            p, v = _fly(stands, begin, 0.0, 0.0, p, v, w, first, last, begin, told_first, track)
            continue
        slot = number % memory.sent.plans.shape[1]
        horizon, led = memory.horizons[row, slot], memory.led[row, slot, axis]
        made_for, led_p, led_v = memory.sent.plans[row, slot].step, led.p, led.v
        held = AxisHorizon(
            model,
            memory.inputs[row, slot, axis],
            horizon.length,
            True,
            horizon.speed,
            settings.brake,
            bound,
            settings.feeds_back,
            gain_p,
            gain_v,
            led.w,
        )
        if settings.feeds_back:
            led_p, led_v = reference_at(held, led.stage, first - made_for, led_p, led_v)
            if leg == 0 and first - made_for > led.stage:
                led.stage, led.p, led.v = first - made_for, led_p, led_v
        p, v = _fly(held, made_for, led_p, led_v, p, v, w, first, last, begin, told_first, track)
    after = max(end - begin, 0)
    track.states[after, 0], track.states[after, 1] = p, v


@inline
def _fly(
    held: AxisHorizon,
    made_for: int,
    led_p: float,
    led_v: float,
    p: float,
    v: float,
    w: float,
    first: int,
    last: int,
    begin: int,
    told_first: float,
    track: FlownTrack,
) -> tuple[float, float]:
    """Fly one axis by a horizon from step `first` to `last`, into `track`; the state then.

    Args:
        held: the horizon.
        made_for: step that it was made for.
        led_p, led_v: where it leads at `first`, x̄ [m, m/s].
        p, v: position [m] and velocity [m/s] at `first`.
        w: disturbance [m/s].
        first, last: steps.
        begin: step at which the track begins.
        told_first: input that the vehicle says it flies there [m/s].
        track: what is filled in.
    """
    for k in range(first, last):
        u, _, led_p, led_v = step(held, k - made_for, led_p, led_v, p, v)
        if k == begin:
            u = told_first  # as it says itself, whatever the rule
        track.commands[k - begin] = u
        track.states[k - begin, 0], track.states[k - begin, 1] = p, v
        p, v = advance(held.model, p, v, u + w)
    return p, v
