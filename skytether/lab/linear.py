"""Closed loop without active bounds: linear, for a given timing of packets.

The effect of each push, that is a step's wind or a measurement's noise, is propagated through
vehicle, observations, horizons in flight and disturbance observer along the timing of a flight, as
one column of numbers. Each component is that of `server.control.committed`,
`server.control.planner`, `client.compensator` and `client.simulated.plant`, without bounds.
"""

import math
from typing import NamedTuple

import numpy as np

from skytether.client.filter import Kalman
from skytether.client.navigation import filters, sensing
from skytether.client.simulated.sensor import Sensor
from skytether.server.control.committed import HOVERS, UNKNOWN
from skytether.server.control.law import advance, lasting, lead_to
from skytether.server.control.law import step as fly
from skytether.server.control.mpc import LATER, MPC, make_mpc, pose
from skytether.server.control.observer import decay_of, learned
from skytether.server.control.predictive import APART_NS
from skytether.server.control.trajectory import follow
from skytether.shared.base.chance import stream
from skytether.shared.base.kernel import B1, F1, F2, F3, I1, inline, making_kernel, making_part
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.law.dead_time import dead_time
from skytether.shared.law.model import Array, Axis, Indices, Model, discretise, white_acceleration
from skytether.shared.law.rule import Held
from skytether.shared.law.spline import Guide
from skytether.shared.scenario import policies
from skytether.shared.scenario.gain import feedback_gain
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.wire.protocol import committed_max

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
    """Gains of the feedback aboard, on position [1/s] and velocity; shape (2,)."""
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


# -- one flight's timing ---------------------------------------------------------------------------


@making_part
def _number(past: Past, made_for: int) -> int:
    """Number of the horizon made for a step, see `server.control.committed`."""
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
def _follow(loop: Loop, past: Past, x: F2, u: F1) -> None:
    """Compute the input along a trajectory that rests at the origin."""
    rests = (0.0, 0.0)
    gain_p, gain_v = loop.back[0], loop.back[1]
    guide = Guide(loop.model, rests, 1, 1.0, 1, 0.0, 0.0, 0.0, np.inf, gain_p, gain_v)
    for c in range(len(u)):
        u[c], _ = follow(guide, 0, 0.0, 0.0, x[0, c], x[1, c], past.filtered[2, c])


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
        _follow(loop, past, x, u)
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
def _respond(
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


# -- a scenario's loops ----------------------------------------------------------------------------


def make_loops(scenario: Scenario, steps: int) -> list[Loop]:
    """Loops on each axis of a scenario, for flights of so many steps."""
    terms, control = scenario.terms(), scenario.control
    dt, tau, gain = control.dt, scenario.true_tau_s, scenario.true_gain
    true_axes = zip(tau, scenario.true_dead_time_s, gain, strict=True)
    late = [dead_time(tau_s, late_s, terms.dt_ns, g) for tau_s, late_s, g in true_axes]
    known_late = terms.dead_times
    nowhere = discretise([1.0], 0.0).axes()[0]
    plans, before = np.zeros((terms.axes, 1, 3)), np.zeros((terms.axes, 0, 0))
    if not terms.splines:
        plans, before = _plans(terms.model, make_mpc(terms, control))
    back = feedback_gain(scenario).astype("f4").astype("f8")
    delay, corrections = _corrections(scenario, steps)
    pushes = white_acceleration(tau, dt)
    return [
        Loop(
            model=model,
            true=axis,
            late=np.array(late[i].late),
            dead_steps=late[i].steps,
            known_late=np.array(known_late[i].late),
            known_dead_steps=known_late[i].steps,
            rest=known_late[i].rest or nowhere,
            push=pushes[i],
            sensor_delay=delay,
            corrections=corrections[i],
            predicts=scenario.sensor.filter == "kalman",
            scheme=SCHEMES.index(terms.scheme),
            plan=plans[i],
            before=before[i] if control.change_weight > 0.0 else np.zeros((0, 0)),
            feeds_back=terms.feedback,
            back=back[i],
            decay=decay_of(terms, control) if terms.commits or terms.indexed else 1.0,
            holds=terms.brake == 0.0,
            age_max=terms.age_max,
            dt_ns=terms.dt_ns,
        )
        for i, (model, axis) in enumerate(
            zip(terms.model.axes(), discretise(tau, dt, gain).axes(), strict=True)
        )
    ]


def _plans(model: Model, mpc: MPC) -> tuple[Array, Array]:
    """Unconstrained plans of eq. (9), U = -𝓗⁻¹ g, as gains from the quantities in g.

    Returns:
        for position and velocity where planning starts and ŵ, shape (axes, H, 3), and for the
        horizon before, shape (axes, H, H).
    """
    H, axes = len(mpc.weights.states), len(model.b0)
    hessian = pose(model, mpc, LATER).hessian
    free = np.zeros((axes, 3, H, 2))
    """States 1 … H without any input, for unit initial values."""
    forced = np.zeros((axes, H, H, 2))
    """States 1 … H for a unit input at each stage."""
    for j, start in enumerate(([1.0, 0.0], [0.0, 1.0], [0.0, 0.0])):
        x = np.tile(start, (axes, 1))
        for i in range(H):
            x = free[:, j, i] = model.step(x, np.full(axes, float(j == 2)))
    for j in range(H):
        x = np.zeros((axes, 2))
        for i in range(j, H):
            x = forced[:, j, i] = model.step(x, np.full(axes, float(i == j)))
    gradient = np.einsum("auip,ip,ajip->auj", forced, mpc.weights.states, free)
    gradient[:, :, 2] += mpc.weights.input
    changes = np.tile(np.diag(mpc.weights.changes[LATER]), (axes, 1, 1))
    return -np.linalg.solve(hessian, gradient), np.linalg.solve(hessian, changes)


def _corrections(scenario: Scenario, steps: int) -> tuple[int, Array]:
    """Delay of the sensor [steps], and `Loop.corrections` of each axis."""
    sensor, axes = Sensor(scenario, stream(scenario.seed, "sensor")), scenario.model.axes
    if sensing(scenario).exact and not filters(scenario):
        return 0, np.zeros((axes, 0, 2, 3))
    found, nothing = np.zeros((axes, steps, 2, 3)), [(0.0, 0.0)] * axes
    kalman = Kalman(scenario, sensor.delay) if filters(scenario) else None
    for step in range(steps):
        measured = sensor.measure(nothing)
        if kalman is None:  # each measurement is reported unfiltered
            for which, values in enumerate(measured[1:]):
                found[:, step, which, which] = values is not None
            continue
        if step == 0:
            kalman.begin(measured)
            continue
        kalman.advance([0.0] * axes)
        kalman.take(measured)
        for which, gains in enumerate(kalman.gains):
            if gains:
                found[:, step, which] = gains
    return sensor.delay, found


def timing_of(flight: Record) -> Timing:
    """Timing of a flight of one vehicle, from its record."""
    client, server = flight.client, flight.server
    assert (np.diff(client["step"]) == 1).all()
    return Timing(
        in_force=client["in_force"].copy(),
        step=server["step"].copy(),
        ahead=server["ahead"].copy(),
        observed=server["observed_step"].copy(),
        event=server["event"].copy(),
    )


def no_packets(steps: int) -> Timing:
    """Timing of a flight without packets."""
    none = np.zeros(0, dtype=np.int64)
    return Timing(np.full(steps, HOVERS), none, none, none, none.astype(np.bool_))


def _periods(scenario: Scenario) -> list[int]:
    """Periods in a loop [steps]; pushes must cover all phases of them."""
    control, sensor = scenario.control, scenario.sensor
    periods = [
        int(each.values[0]) if each.values else control.period
        for each in policies.policies(policies.parse(control.trigger))
        if each.name == "periodic"
    ]
    measured = (sensor.position_every_s, sensor.velocity_every_s)
    times_s = [each for each in measured if isinstance(each, float) and each > 0.0]
    return periods + [-(-seconds_to_ns(each) // scenario.dt_ns) for each in times_s]


def respond(
    scenario: Scenario, loop: Loop, timing: Timing, begin: int, window: int, width: int
) -> tuple[Array, Indices]:
    """Mean squares after pushes, along a flight's timing.

    Args:
        begin: step of the first push.
        window: number of steps simulated after each push.
        width: number of pushes of each source simulated at once.

    Returns:
        p² and u² of each source 0 … window - 1 steps after a push of strength 1, summed over the
        pushes, shape (2, sources, window), and the number of pushes, shape (window,).
    """
    terms = scenario.terms()
    H, most = terms.planned, committed_max(terms)
    sources = WIND + (NOISE if len(loop.corrections) else 0)
    every = -(-window // width)
    while math.gcd(every, math.prod(_periods(scenario))) > 1:
        every += 1
    columns = sources * width
    steps, observed = timing.step, timing.observed
    last = np.concatenate([observed[:1], observed[:-1]])
    known = observed - last <= terms.age_max
    longest = int(max((steps + timing.ahead - observed).max(initial=0), terms.age_max)) + 2
    dead_steps = max(loop.dead_steps, loop.known_dead_steps)
    reach = int((steps - last)[known].max(initial=1)) + dead_steps + loop.sensor_delay + 8
    sent = steps[timing.event]
    needed = [
        np.searchsorted(sent, np.arange(len(timing.in_force)))
        - np.searchsorted(sent, timing.in_force),
        np.searchsorted(sent, steps) - np.searchsorted(sent, timing.in_force[last]),
    ]
    room = int(max(each.max(initial=0) for each in needed)) + 3
    past = Past(
        true=np.zeros((reach, 2, columns)),
        filtered=np.zeros((3, columns)),
        reported=np.zeros((reach, 2, columns)),
        flown=np.zeros((reach, columns)),
        first=np.zeros((reach, columns)),
        made=np.full(room, -1),
        due=np.full(room, -1),
        length=np.ones(room, dtype=np.int64),
        inputs=np.zeros((room, most + H, columns)),
        origins=np.zeros((room, 3, columns)),
        plan=np.zeros((H, columns)),
        scratch=np.zeros((max(H, 3), columns)),
        disturbance=np.zeros(columns),
        led=np.zeros((2, columns)),
        commands=np.zeros((longest, columns)),
        track=np.zeros((longest + 1, 2, columns)),
        marks=np.array([0, -1, 0, -1, 0]),
    )
    squares: Array = np.zeros((2, sources, window))
    counts = np.zeros(window, dtype=np.int64)
    _respond(loop, timing, past, begin, every, squares, counts)
    return squares, counts
