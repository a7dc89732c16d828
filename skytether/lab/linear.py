"""Closed loop without active bounds: linear, for a given timing of packets.

The effect of each push, that is a step's wind or a measurement's noise, is propagated through
vehicle, observations, horizons in flight and disturbance observer along the timing of a flight, as
one column of numbers. Each component is that of `server.control.committed`,
`server.control.planner`, `client.compensator` and `client.simulated.plant`, without bounds.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control.law import advance, lasting, lead_to
from skytether.server.control.law import step as fly
from skytether.server.control.memory import HOVERS, UNKNOWN
from skytether.server.control.observer import learned
from skytether.server.control.predictive import APART_NS
from skytether.server.control.trajectory import follow
from skytether.shared.base.kernel import B1, F1, F2, F3, I1, inline, making_kernel, making_part
from skytether.shared.law.model import Axis
from skytether.shared.law.rule import Held
from skytether.shared.law.spline import Guide

WIND, NOISE = 2, 2
"""Number of random inputs per step and axis: of the wind, and of the measurement."""
COMMITTED, PREDICTIVE, NONE, TRAJECTORY = range(4)
SCHEMES = ("committed", "predictive", "none", "trajectory")
"""Schemes, by the numbers that kernels use."""


class Timing(NamedTuple):
    """Timing of a flight's packets, as both ends recorded it."""

    in_force: I1
    """Step that the horizon in force at each step was made for, or -1; shape (steps,)."""
    step: I1
    """Step k of each tick of the server; shape (ticks,)."""
    ahead: I1
    """Delay bound d at each tick [steps]; shape (ticks,)."""
    observed: I1
    """Step of the newest observation at each tick; shape (ticks,)."""
    event: B1
    """Whether a horizon was sent; shape (ticks,)."""


class Loop(NamedTuple):
    """Linear loop on one axis."""

    model: Axis
    """Model that both ends know, eq. (4)."""
    true: Axis
    """Model of the true vehicle, eq. (4), with its gain in b0 and b1."""
    late: F1
    """Part of b0 and b1 that belongs to the input of the previous step, due to the dead time; shape
    (2,)."""
    dead_steps: int
    """Whole steps of the vehicle's dead time."""
    known_late: F1
    """Like `late`, for the dead time that both ends know; shape (2,)."""
    known_dead_steps: int
    """Whole steps of the dead time that both ends know."""
    rest: Axis
    """Model, eq. (4), over the fractional step of the known dead time; over zero time without
    one."""
    push: F2
    """Square root of a step's covariance under white acceleration of strength 1; shape (2, 2)."""
    sensor_delay: int
    """Time from a measurement until it is available [steps]."""
    corrections: F3
    """Gains of the filter at each step, from measured position and velocity to position, velocity
    and disturbance; 0 without a measurement; shape (steps, 2, 3). With no steps, the state is known
    exactly."""
    predicts: bool
    """Whether the filter predicts its state by the model between measurements."""
    scheme: int
    """COMMITTED, PREDICTIVE, NONE or TRAJECTORY."""
    plan: F2
    """Gains from position and velocity at the plan's start, and from ŵ, to the plan's inputs; shape
    (H, 3)."""
    before: F2
    """Gains from the shifted previous plan to the plan's inputs; shape (H, H), or (0, 0)."""
    feeds_back: bool
    """Whether there is feedback aboard."""
    back: F1
    """Gains of the feedback aboard, on position [1/s] and velocity, shape (2,); along a trajectory
    also λ, shape (3,)."""
    decay: float
    """Share of its error that the disturbance observer keeps per step; 1 without an observer."""
    holds: bool
    """Whether the last input of a horizon is held for ever, instead of braking."""
    age_max: int
    """Largest usable age of an observation [steps]."""
    dt_ns: int
    """Length of a step [ns]."""


class Past(NamedTuple):
    """Memory of the loop; the last axis of each array has one column per push."""

    true: F3
    """State at each step, a ring; shape (reach, 2, columns)."""
    filtered: F2
    """State of the filter aboard: position, velocity and disturbance; shape (3, columns)."""
    reported: F3
    """State reported at each step, a ring; shape (reach, 2, columns)."""
    flown: F2
    """Input of each step, a ring; shape (reach, columns)."""
    first: F2
    """First input of each step's plan, û of eq. (12), a ring; shape (reach, columns)."""
    made: I1
    """Step that each sent horizon was made for, a ring; shape (room,)."""
    due: I1
    """Step at which each sent horizon comes into force, or is lost; shape (room,)."""
    length: I1
    """Number of usable inputs of each sent horizon; shape (room,)."""
    inputs: F3
    """Inputs of each sent horizon; shape (room, most + H, columns)."""
    origins: F3
    """Predicted position, velocity and ŵ at the start of each horizon; shape (room, 3, columns)."""
    plan: F2
    """Inputs of the newest plan; shape (H, columns)."""
    scratch: F2
    """Inputs of the plan being computed; shape (H, columns)."""
    disturbance: F1
    """Disturbance ŵ; shape (columns,)."""
    led: F2
    """Predicted state x̄ of the horizon in force; shape (2, columns)."""
    commands: F2
    """Inputs of a simulated stretch; shape (longest, columns)."""
    track: F3
    """States of a simulated stretch; shape (longest + 1, 2, columns)."""
    marks: I1
    """Scalar state, indexed by the names below; shape (5,)."""


SENT, BASE, START, LED_MADE, LED_STAGE = range(5)
"""Indices into `marks`: number of horizons sent; step of the observation that the observer has
used; start of the previous plan; and the horizon and stage that x̄ belongs to."""


@making_part
def _number(past: Past, made_for: int) -> int:
    """Number of the horizon made for a step, see `server.control.memory`."""
    room, sent = len(past.made), past.marks[SENT]
    if made_for < 0:
        return HOVERS
    for number in range(sent - 1, max(sent - room, 0) - 1, -1):
        if past.made[number % room] <= made_for:
            return number if past.made[number % room] == made_for else UNKNOWN
    return UNKNOWN


@making_part
def _first_under_way(past: Past, in_force: int, observed: int) -> int:
    """Number of the first horizon made after the one in force that is not due yet."""
    room, sent = len(past.made), past.marks[SENT]
    number = sent
    while number > max(sent - room, 0):
        slot = (number - 1) % room
        if past.made[slot] <= in_force or past.due[slot] <= observed:
            break
        number -= 1
    return number


@making_part
def _move(axis: Axis, x: F2, u: F1, w: F1, to: F2) -> None:
    """Advance all columns by a step, from `x` to `to`, which may be the same array."""
    for c in range(x.shape[1]):
        to[0, c], to[1, c] = advance(axis, x[0, c], x[1, c], u[c] + w[c])


@inline
def _held(loop: Loop, past: Past, number: int, column: int) -> Held:
    """Inputs of a horizon in one column, by `shared.law.rule` without bounds; braking is
    immediate.
    """
    slot = number % len(past.made)
    return Held(
        loop.model,
        past.inputs[slot, :, column],
        past.length[slot],
        loop.scheme != NONE,
        1.0,
        0.0 if loop.holds else np.inf,
        np.inf,
        loop.feeds_back,
        loop.back[0],
        loop.back[1],
        past.origins[slot, 2, column],
    )


@making_part
def _flown(loop: Loop, past: Past, number: int, stage: int, led: F2, x: F2, u: F1) -> None:
    """Compute the input at a stage of a horizon, and advance x̄ to the next stage."""
    for c in range(len(u)):
        held = _held(loop, past, number, c)
        u[c], _, led[0, c], led[1, c] = fly(held, stage, led[0, c], led[1, c], x[0, c], x[1, c])


@making_part
def _lead(loop: Loop, past: Past, number: int, first: int, last: int, led: F2) -> None:
    """Advance x̄ of a horizon from one stage to another."""
    for c in range(led.shape[1]):
        held = _held(loop, past, number, c)
        led[0, c], led[1, c] = lead_to(held, first, last, led[0, c], led[1, c])


@making_part
def _go_on(loop: Loop, last: F1, stage: int, holds: bool, u: F1) -> None:
    """Compute the input without a horizon: the last one is held, or the vehicle brakes at once."""
    brake = 0.0 if holds else np.inf
    for c in range(len(u)):
        held = Held(loop.model, (last[c],), 1, True, 1.0, brake, np.inf, False, 0.0, 0.0, 0.0)
        u[c], _, _, _ = fly(held, stage, 0.0, 0.0, 0.0, 0.0)


@making_part
def _follow(loop: Loop, past: Past, x: F2, before: F1, u: F1) -> None:
    """Compute the input along a trajectory that rests at the origin."""
    rests = (0.0, 0.0)
    gain_p, gain_v, lag = loop.back[0], loop.back[1], loop.back[2]
    guide = Guide(loop.model, rests, 1, 1.0, 1, 0.0, 0.0, 0.0, np.inf, gain_p, gain_v, lag)
    for c in range(len(u)):
        u[c], _ = follow(guide, 0, 0.0, 0.0, x[0, c], x[1, c], past.filtered[2, c], before[c])


@making_part
def _fly_leg(loop: Loop, past: Past, number: int, begin: int, first: int, last: int) -> None:
    """Simulate the plan in force from one step to another, in the stretch that began at `begin`."""
    room, w, made, led = len(past.made), past.disturbance, begin, past.scratch[:2]
    if number >= 0:
        made = past.made[number % room]
        led[:] = past.origins[number % room, :2]
        if loop.feeds_back:
            _lead(loop, past, number, 0, first - made, led)
    for k in range(first, last):
        u, x = past.commands[k - begin], past.track[k - begin]
        if number >= 0:
            _flown(loop, past, number, k - made, led, x, u)
        else:
            _go_on(loop, past.commands[0], k - begin, loop.holds or number == UNKNOWN, u)
        if k == begin:
            u[:] = past.flown[k % len(past.flown)]  # by the number in the horizon itself
        _move(loop.model, x, u, w, past.track[k - begin + 1])


@making_part
def _roll(loop: Loop, past: Past, begin: int, flying: int, under_way: range, end: int) -> None:
    """Simulate from an observation with the horizons in force and under way, to step `end`."""
    past.track[0] = past.reported[begin % len(past.reported)]
    first, number = begin, flying
    for following in under_way:
        due = past.due[following % len(past.made)]
        if due <= begin:
            number = following
            continue
        _fly_leg(loop, past, number, begin, first, min(due, end))
        first, number = min(due, end), following
    _fly_leg(loop, past, number, begin, first, end)


@making_part
def _learn(loop: Loop, past: Past, end: int, m: int, trip_ns: int) -> None:
    """Correct ŵ by the error of the velocity predicted over `m` steps, see `control.observer`."""
    velocity, w = past.reported[end % len(past.reported), 1], past.disturbance
    for c in range(len(w)):
        off = velocity[c] - past.track[m, 1, c]
        w[c] = learned(w[c], off, m, loop.model.a11, loop.decay, trip_ns, np.inf)


@making_part
def _observe(loop: Loop, timing: Timing, past: Past, t: int) -> None:
    """Disturbance observer of committed inputs, to the observation of tick `t`."""
    begin, end = past.marks[BASE], timing.observed[t]
    past.marks[BASE] = end
    if begin < 0 or not 0 < end - begin <= loop.age_max:
        return
    before, after, since = timing.in_force[begin], timing.in_force[end], end
    while since > 0 and timing.in_force[since - 1] == after:
        since -= 1
    flying, newest = _number(past, before), _number(past, after)
    if min(flying, newest) == UNKNOWN:
        return
    # Up to `since` by the expected inputs, and from there on by the known ones.
    if since <= begin:
        _roll(loop, past, begin, newest, range(0), end)
    else:
        first = _first_under_way(past, before, begin)
        _roll(loop, past, begin, flying, range(first, max(newest, first)), since)
        _fly_leg(loop, past, newest, begin, since, end)
    _learn(loop, past, end, end - begin, (timing.step[t] + timing.ahead[t] - end) * loop.dt_ns)


@making_part
def _observe_between(loop: Loop, timing: Timing, past: Past, t: int) -> None:
    """Disturbance observer of the scheme "predictive", to the observation of tick `t`."""
    begin, end, reach = past.marks[BASE], timing.observed[t], len(past.reported)
    m = end - begin
    past.marks[BASE] = end
    if begin < 0 or not 0 < m <= max(1, APART_NS // loop.dt_ns):
        return
    one, other = past.flown[begin % reach], past.flown[end % reach]
    past.track[0] = past.reported[begin % reach]
    for step in range(m):
        past.commands[step] = one + (step / m) * (other - one)
        _move(
            loop.model,
            past.track[step],
            past.commands[step],
            past.disturbance,
            past.track[step + 1],
        )
    _learn(loop, past, end, m, (timing.step[t] - end) * loop.dt_ns)


@making_part
def _estimate(loop: Loop, timing: Timing, past: Past, t: int) -> None:
    """Predict the newest observation to the present by û.

    Source: eq. (13).
    """
    k, o, reach = timing.step[t], timing.observed[t], len(past.first)
    past.track[0] = past.reported[o % len(past.reported)]
    if loop.scheme == NONE:
        return
    for step in range(o, k):
        _move(
            loop.model,
            past.track[step - o],
            past.first[step % reach],
            past.disturbance,
            past.track[step - o + 1],
        )


@making_part
def _plan(loop: Loop, past: Past, start: int, x: F2) -> None:
    """Plan from a state at step `start`, without bounds; the result is in `past.plan`.

    Source: eq. (10).
    """
    H, w, plan = len(loop.plan), past.disturbance, past.plan
    gap = start - past.marks[START]
    past.marks[START] = start
    if len(loop.before):
        past.scratch[:H] = plan
    for stage in range(H):
        on_p, on_v, on_w = loop.plan[stage]
        for c in range(len(w)):
            plan[stage, c] = on_p * x[0, c] + on_v * x[1, c] + on_w * w[c]
    for stage in range(len(loop.before)):
        for i in range(H):
            share, then = loop.before[stage, i], past.scratch[min(max(i + gap, 0), H - 1)]
            for c in range(len(w)):
                plan[stage, c] += share * then[c]


@making_part
def _tick(loop: Loop, timing: Timing, past: Past, t: int) -> None:
    """Simulate a tick of the server."""
    k, d, o, H = timing.step[t], timing.ahead[t], timing.observed[t], len(loop.plan)
    if loop.scheme == COMMITTED:
        if loop.decay < 1.0:
            _observe(loop, timing, past, t)
        if not (timing.event[t] or len(loop.before)):
            return
        flying = _number(past, timing.in_force[o])
        first = _first_under_way(past, timing.in_force[o], o)
        _roll(loop, past, o, flying, range(first, past.marks[SENT]), k + d)
        start = past.track[max(k + d - o, 0)]
    else:
        d = 0
        if loop.decay < 1.0:
            _observe_between(loop, timing, past, t)
        _estimate(loop, timing, past, t)
        start = past.track[max(k - o, 0) if loop.scheme == PREDICTIVE else 0]
    now, slot = k - o, past.marks[SENT] % len(past.made)
    if timing.event[t]:
        past.origins[slot, :2] = past.track[max(now, 0)]
        past.origins[slot, 2] = past.disturbance
        past.inputs[slot, :d] = 0.0
        for stage in range(max(-now, 0), d):
            past.inputs[slot, stage] = past.commands[now + stage]
    _plan(loop, past, k + d, start)
    if loop.scheme != COMMITTED:
        reach = len(past.first)
        last = timing.step[t - 1] if t else k
        for missed in range(max(last + 1, k - reach + 1), k):
            past.first[missed % reach] = past.first[last % reach]
        past.first[k % reach] = past.plan[0]
    if timing.event[t]:
        past.inputs[slot, d : d + H] = past.plan
        given = d + H if loop.scheme != NONE else loop.age_max + H
        past.made[slot], past.due[slot] = k, k + d
        past.length[slot] = lasting(given, k, o, loop.age_max)
        past.marks[SENT] += 1


@making_part
def _choose(loop: Loop, timing: Timing, past: Past, s: int) -> None:
    """Simulate the compensator aboard at step `s`."""
    reach = len(past.flown)
    u, x = past.flown[s % reach], past.reported[s % reach]
    if loop.scheme == TRAJECTORY:
        _follow(loop, past, x, past.flown[(s - 1) % reach], u)
        return
    made = timing.in_force[s]
    number = _number(past, made)
    if number < 0:
        _go_on(loop, past.flown[(s - 1) % reach], 1, loop.holds, u)
        return
    if past.marks[LED_MADE] != made:
        past.led[:] = past.origins[number % len(past.made), :2]
        past.marks[LED_MADE], past.marks[LED_STAGE] = made, 0
    if loop.feeds_back:
        _lead(loop, past, number, past.marks[LED_STAGE], s - made, past.led)
    _flown(loop, past, number, s - made, past.led, x, u)
    past.marks[LED_STAGE] = max(s - made + 1, 0)


@making_part
def _know(loop: Loop, past: Past, s: int, push: int) -> None:
    """Compute the report of the vehicle at step `s`, from its measurement and filter.

    Args:
        push: column of the measurement's noise, or -1.
    """
    reach, delay = len(past.reported), loop.sensor_delay
    filtered, reported = past.filtered, past.reported[s % reach]
    if s >= len(loop.corrections):
        reported[:] = past.true[s % reach]
        _predict(loop, past, s, reported)
        return
    if loop.predicts and s > 0:
        _act(loop, past, s - 1 - delay, filtered)
    measured, width = past.true[(s - delay) % reach], filtered.shape[1] // (WIND + NOISE)
    for which in range(2):
        on_p, on_v, on_w = loop.corrections[s, which]
        if on_p == 0.0 and on_v == 0.0 and on_w == 0.0:
            continue
        for c in range(filtered.shape[1]):
            noise = 1.0 if push >= 0 and c == (WIND + which) * width + push else 0.0
            off = measured[which, c] + noise - filtered[which, c]
            filtered[0, c] += on_p * off
            filtered[1, c] += on_v * off
            filtered[2, c] += on_w * off
    reported[:] = filtered[:2]
    if loop.predicts:
        for back in range(delay, 0, -1):
            _act(loop, past, s - back, reported)
    _predict(loop, past, s, reported)


@making_part
def _act(loop: Loop, past: Past, step: int, x: F2) -> None:
    """Advance the known state `x` by a step with the inputs that act in it."""
    reach = len(past.flown)
    due = past.flown[(step - loop.known_dead_steps) % reach]
    before = past.flown[(step - loop.known_dead_steps - 1) % reach]
    _move(loop.model, x, due, past.filtered[2], x)
    for c in range(x.shape[1]):
        x[0, c] += loop.known_late[0] * (before[c] - due[c])
        x[1, c] += loop.known_late[1] * (before[c] - due[c])


@making_part
def _predict(loop: Loop, past: Past, s: int, x: F2) -> None:
    """Predict the state known at step `s` to the time at which the next input acts."""
    reach, n, w = len(past.flown), loop.known_dead_steps, past.filtered[2]
    if n == 0 and loop.rest.a01 == 0.0:
        return
    _move(loop.rest, x, past.flown[(s - n - 1) % reach], w, x)
    for step in range(s - n, s):
        _move(loop.model, x, past.flown[step % reach], w, x)


@making_part
def _forget(past: Past, column: int) -> None:
    """Reset the column of a push for reuse."""
    for rows in (past.filtered, past.flown, past.first, past.plan, past.led):
        rows[:, column] = 0.0
    for blocks in (past.true, past.reported, past.inputs, past.origins):
        blocks[:, :, column] = 0.0
    past.disturbance[column] = 0.0


@making_kernel
def propagate(
    loop: Loop, timing: Timing, past: Past, begin: int, every: int, squares: F3, counts: I1
) -> None:
    """Simulate the effect of pushes from step `begin` on, along a flight's timing.

    Args:
        every: steps from one push to the next; as many are simulated at once as there are columns.
        squares: output, added to: p² and u² by source and number of steps after a push; shape (2,
            sources, window).
        counts: output: number of pushes added to each; shape (window,).
    """
    sources, window = squares.shape[1], squares.shape[2]
    reach, tick, steps = len(past.reported), 0, len(timing.in_force)
    width = past.reported.shape[2] // sources
    none = np.zeros(sources * width)
    for s in range(steps):
        # The horizon in force was made, and its observation taken, before this step.
        made = max(timing.in_force[s], s - 1)
        while tick < len(timing.step) and timing.step[tick] <= made and timing.observed[tick] < s:
            _tick(loop, timing, past, tick)
            tick += 1
        pushed, push = s >= begin and (s - begin) % every == 0, (s - begin) // every
        if pushed:
            for source in range(sources):
                _forget(past, source * width + push % width)
        _know(loop, past, s, push % width if pushed else -1)
        _choose(loop, timing, past, s)
        x, u, then = past.true[s % reach], past.flown[s % reach], past.true[(s + 1) % reach]
        for before in range(max(push - width + 1, 0), push + 1):
            age = s - begin - before * every
            if 0 <= age < window:
                counts[age] += 1
                for source in range(sources):
                    column = source * width + before % width
                    squares[0, source, age] += x[0, column] ** 2
                    squares[1, source, age] += u[column] ** 2
        due = past.flown[(s - loop.dead_steps) % reach]
        late = past.flown[(s - loop.dead_steps - 1) % reach]
        _move(loop.true, x, due, none, then)
        for c in range(x.shape[1]):
            then[0, c] += loop.late[0] * (late[c] - due[c])
            then[1, c] += loop.late[1] * (late[c] - due[c])
        if pushed:
            then[0, push % width] += loop.push[0, 0]
            then[1, push % width] += loop.push[1, 0]
            then[1, width + push % width] += loop.push[1, 1]
