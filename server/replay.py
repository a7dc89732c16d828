"""Committed inputs: what the vehicle has been told, and so where it is, and where it will be.

A horizon reaches the vehicle within d steps or is lost. So what it flies in the next d steps is
settled by what was sent before: these inputs are committed. They roll the newest observation on to
x̂(k+d), where planning starts, and they are the first d inputs of the next horizon: until that
arrives, and whenever within d steps it does, the vehicle flies the same.

Every observation acknowledges the horizon in force at its step. The inputs replayed from there are
those of this horizon; then, for every horizon in flight, its own from its step + d on. One that has
had d steps and was not in force is lost, and left out.

    x(i+1) = A x(i) + B (u(i) + w)        from the observation to k + d

w is what else acts on the vehicle, as an input of its own: constant wind, a wrong gain. Each
observation shows how far the velocity has come away from where the one before it, replayed, says;
the disturbance observer follows that with a time constant of `control.observer_s`. Vehicles report
what they take their velocity for. So the observer has a velocity of its own, which follows what is
reported within FOLLOW_S: else it would learn the noise that a filter aboard has left.

With feedback aboard, a horizon tells the vehicle also where its inputs lead, x̄ from x̂(k) on, and
how to come back to there: it flies u(i) + K (x̄(i) - x(i)). That is replayed in the same way. What
is committed are the inputs that this comes to if nothing else happens, along x̄ from x̂(k): as K is
always the same, it makes no difference when the next horizon replaces the one before.

Both the replay and the observer work in two moves: which horizon is in force from which step on (a
course), and the roll along it by the rule of flight (`shared.rule`).
"""

from collections import Counter
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from server import delay
from server.clock import ClockMap, Seen, half_trip_ns, shortest_ns
from server.delay import DelayBound, acknowledge, at_least, begin, delay_bound
from server.model import (
    AXIS_FIELDS,
    advance,
    bounded,
    entry,
    flown,
    lasting,
    leading,
    led_back,
    remaining,
)
from server.observer import decay_of, learned
from server.scheme import Foresight
from shared.config import ControlConfig
from shared.kernel import B1, F1, F2, I1, R1, R2, S4, kernel, part, record, records
from shared.model import Array, Flags, Indices
from shared.protocol import NO_HORIZON, Observation, committed_max
from shared.terms import Terms

MARGIN = 2
"""Steps on top of half a round trip, until a horizon has been acknowledged."""
FOLLOW_S = 0.25
"""Time constant with which the disturbance observer follows the velocity that is reported [s]."""
LOSS, LEARNED = 0.1, 0.05
"""Share of lost horizons that is assumed at first, and by how much of itself each horizon that has
come into force, or is lost, moves it."""
HOVERS, UNKNOWN = -1, -2
"""In place of the number of a horizon: none, so that it brakes and stands still; one that was sent
in an earlier life of ours."""

RULE = record(*AXIS_FIELDS, ("bound", "f8"), ("gain_p", "f8"), ("gain_v", "f8"))
"""Eq. (4) on one axis, u_max [m/s], and K on position [1/s] and velocity, 0 without feedback."""
SEEN = record(
    ("in_force", "i8"),
    ("since", "i8"),
    ("base_step", "i8"),
    ("base_in_force", "i8"),
    ("acknowledged", "i8"),
    ("judged", "i8"),
    ("sent", "i8"),
    ("takes", "i8"),
    ("base_takes", "i8"),
    ("loss", "f8"),
)
"""What is known of one vehicle: horizon in force, and first step flown with it, of its newest
observation; step and horizon of the one before, or -1; the horizon last seen to have come into
force; the step up to which horizons were seen in force, or lost, or overtaken; the number of
horizons sent so far; whether it flies those that come, at its newest observation and at the one
before; and the share of horizons that were lost lately."""
STATE = record(
    ("p", "f8"),
    ("v", "f8"),
    ("u", "f8"),
    ("base_p", "f8"),
    ("base_v", "f8"),
    ("base_u", "f8"),
    ("w", "f8"),
)
"""On one axis of a vehicle: position [m], velocity [m/s] and input [m/s] of its newest observation
and of the one before, with the velocity that the observer takes it for; and the disturbance
[m/s]."""
SENT = record(("step", "i8"), ("due", "i8"), ("length", "i8"), ("speed", "f8"))
"""A horizon that was sent: the step it was made for; that at which it is in force, or lost; how
many inputs it has; and the magnitude of the last [m/s]."""
LED = record(("stage", "i8"), ("p", "f8"), ("v", "f8"), ("w", "f8"))
"""Where a horizon leads on one axis, x̄: a stage, position [m] and velocity [m/s] there, and the
disturbance [m/s]. It goes on with what is observed, for nothing before is ever replayed again."""


class Settings(NamedTuple):
    """What is the same for all vehicles."""

    rule: Annotated[NDArray[np.void], records(RULE, 1)]
    """Model, bound and gain; shape (axes,)."""
    H: int
    """Steps planned ahead."""
    age_max: int
    """Largest age of an observation that counts [steps]."""
    dt_ns: int
    """Length of a step [ns]."""
    brake: float
    """Speed that braking takes away in a step [m/s]."""
    decay: float
    """Share of the error that the disturbance observer leaves in a step; 1 for no observer."""
    follow: float
    """Share of what is new of the velocity that the observer has not followed after a step."""
    feeds_back: bool
    """Whether horizons bring feedback."""


class Memory(NamedTuple):
    """What is known of every vehicle, and what it was sent."""

    observed: I1
    """Step of the newest observation, or -1; shape (capacity,)."""
    seen: Annotated[NDArray[np.void], records(SEEN, 1)]
    """Shape (capacity,)."""
    state: Annotated[NDArray[np.void], records(STATE, 2)]
    """Shape (capacity, axes)."""
    sent: Annotated[NDArray[np.void], records(SENT, 2)]
    """Horizons that were sent, a ring; shape (capacity, room)."""
    inputs: S4
    """Their inputs [m/s]; shape (capacity, room, axes, most + H), with the largest d."""
    led: Annotated[NDArray[np.void], records(LED, 3)]
    """Where they lead; shape (capacity, room, axes)."""


class Replay:
    """The committed `Scheme`: observations of, and horizons sent to, up to `capacity` vehicles.

    Args:
        terms: the rule of flight.
        control: `observer_s` and `delay_bound`.
        gain: K of feedback aboard, 0 without; shape (axes, 2).
        clock: knows half of the smallest round trip, which is a first guess at the delay bound.
    """

    def __init__(
        self, terms: Terms, control: ControlConfig, gain: Array, capacity: int, clock: ClockMap
    ) -> None:
        axes, H, most = terms.axes, terms.horizon, committed_max(terms)
        self.counts: Counter[str] = Counter()
        rule = np.zeros(axes, dtype=RULE)
        for name, numbers in terms.model._asdict().items():
            rule[name] = numbers
        rule["bound"] = terms.u_max
        rule["gain_p"], rule["gain_v"] = gain.T.astype("f4")  # as the vehicle will be told it
        self._settings = Settings(
            rule=rule,
            H=H,
            age_max=terms.age_max,
            dt_ns=terms.dt_ns,
            brake=terms.brake,
            decay=decay_of(terms, control),
            follow=float(np.exp(-terms.dt_s / FOLLOW_S)),
            feeds_back=terms.feedback,
        )
        room = terms.age_max + H
        self._memory = Memory(
            observed=np.zeros(capacity, dtype=np.int64),
            seen=np.zeros(capacity, dtype=SEEN),
            state=np.zeros((capacity, axes), dtype=STATE),
            sent=np.zeros((capacity, room), dtype=SENT),
            inputs=np.zeros((capacity, room, axes, most + H), dtype=np.float32),
            led=np.zeros((capacity, room, axes), dtype=LED),
        )
        given = control.delay_bound
        fixed_s = None if given == "auto" else given
        self.delay_bound = delay_bound(capacity, terms.dt_s, most, fixed_s)
        self._clock = clock
        self.observed_step: Indices = self._memory.observed
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        memory = self._memory
        memory.observed[row] = -1
        memory.seen[row] = (NO_HORIZON, 0, -1, NO_HORIZON, NO_HORIZON, 0, 0, 1, 1, LOSS)
        memory.state["w"][row] = 0.0
        delay.forget(self.delay_bound, row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        told = observation
        return _keep(
            self._memory,
            row,
            told.step,
            told.in_force,
            told.since,
            told.takes,
            told.state,
            told.input,
        )

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`: planning starts at k + d."""
        lost = _foresee(
            self._settings, self._memory, self.delay_bound, self._clock.seen, rows, step, found
        )
        if lost:
            self.counts["horizons lost"] += lost

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what was sent counts."""
        _remember(self._settings, self._memory, rows, step, found, event)


class Course(NamedTuple):
    """Which horizon is in force from which step on; room for more than can be in flight."""

    begins: I1
    """First step of each leg."""
    numbers: I1
    """Number of the horizon flown on it, HOVERS or UNKNOWN."""


class Track(NamedTuple):
    """What was flown on one axis, step by step, and where that led."""

    commands: F1
    """Inputs [m/s]."""
    states: F2
    """Position [m] and velocity [m/s] at each step and after the last."""


@kernel
def _keep(
    memory: Memory, row: int, step: int, in_force: int, since: int, takes: int, state: R2, flown: R1
) -> bool:
    """Write down an observation, see `Replay.observe`."""
    if step <= memory.observed[row]:
        return False
    memory.observed[row] = step
    seen = memory.seen[row]
    seen.in_force, seen.since, seen.takes = in_force, since, takes
    for axis in range(len(state)):
        memory.state[row, axis].p, memory.state[row, axis].v = state[axis, 0], state[axis, 1]
        memory.state[row, axis].u = flown[axis]
    return True


@part
def _speed(inputs: R1) -> float:
    """Magnitude of an input over all axes [m/s]."""
    squares = 0.0
    for u in inputs:
        squares += u * u
    return np.sqrt(squares)


@part
def _number(memory: Memory, row: int, made_for: int) -> int:
    """Number of the horizon made for a step, counted from 0 in the order of sending."""
    if made_for < 0:
        return HOVERS
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    for number in range(count - 1, max(count - room, 0) - 1, -1):
        step = memory.sent[row, number % room].step
        if step <= made_for:
            return number if step == made_for else UNKNOWN
    return UNKNOWN


@part
def _first_after(memory: Memory, row: int, step: int) -> int:
    """Number of the first horizon made for a later step."""
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    number = count
    while number > max(count - room, 0) and memory.sent[row, (number - 1) % room].step > step:
        number -= 1
    return number


@part
def _first_under_way(memory: Memory, row: int, in_force: int, observed: int) -> int:
    """Number of the first horizon that was made after the one in force, and is not due yet."""
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    number = count
    while number > max(count - room, 0):
        sent = memory.sent[row, (number - 1) % room]
        if sent.step <= in_force or sent.due <= observed:
            break
        number -= 1
    return number


@part
def _chart(
    course: Course, memory: Memory, row: int, begin: int, flown: int, following: range
) -> int:
    """Number of legs of the course from `begin`: `flown`, then each of those following it.

    Args:
        following: numbers of horizons, each in force when it is due.
    """
    room, legs = memory.sent.shape[1], 1
    course.begins[0], course.numbers[0] = begin, flown
    for number in following:
        due = memory.sent[row, number % room].due
        if due <= begin:
            course.numbers[0] = number
            continue
        course.begins[legs], course.numbers[legs] = due, number
        legs += 1
    return legs


@part
def _roll(
    settings: Settings,
    memory: Memory,
    row: int,
    axis: int,
    course: Course,
    legs: int,
    end: int,
    x: tuple[float, float, float, float],
    track: Track,
) -> None:
    """Fly one axis along a course from its begin to step `end`, into `track`.

    Args:
        x: position [m] and velocity [m/s] at the begin, the input flown from there on [m/s], and
            the magnitude of that over all axes [m/s].
    """
    rule, room, begin = settings.rule[axis], memory.sent.shape[1], course.begins[0]
    (p, v, told_first, speed_told), w = x, memory.state[row, axis].w
    for leg in range(legs):
        first = course.begins[leg]
        last = min(end, course.begins[leg + 1] if leg + 1 < legs else end)
        number = course.numbers[leg]
        if first >= last:
            continue
        if number < 0:
            # Of a horizon that is unknown it is as good a guess as any that it flies on.
            brake = settings.brake if number == HOVERS else 0.0
            for step in range(first, last):
                u = remaining(step - begin, 1, speed_told, brake) * told_first
                u = flown(step - begin, u, 0.0, rule.bound)
                track.commands[step - begin] = u
                track.states[step - begin, 0], track.states[step - begin, 1] = p, v
                p, v = advance(rule, p, v, u + w)
            continue
        slot = number % room
        horizon, inputs = memory.sent[row, slot], memory.inputs[row, slot, axis]
        made_for, length, speed = horizon.step, horizon.length, horizon.speed
        led = memory.led[row, slot, axis]
        led_p, led_v, led_w = led.p, led.v, led.w
        if settings.feeds_back:
            for stage in range(led.stage, first - made_for):
                share = remaining(stage, length, speed, settings.brake)
                told = share * bounded(float(inputs[entry(stage, length)]), rule.bound)
                led_p, led_v = advance(rule, led_p, led_v, leading(told, led_w, share))
            if leg == 0 and first - made_for > led.stage:
                led.stage, led.p, led.v = first - made_for, led_p, led_v
        for step in range(first, last):
            stage, back = step - made_for, 0.0
            share = remaining(stage, length, speed, settings.brake)
            told = share * bounded(float(inputs[entry(stage, length)]), rule.bound)
            if settings.feeds_back:
                back = led_back(rule.gain_p, rule.gain_v, led_p - p, led_v - v)
            u = flown(stage, told, back, rule.bound)
            if step == begin:
                u = told_first  # as it says itself, whatever the rule
            if settings.feeds_back and stage >= 0:
                led_p, led_v = advance(rule, led_p, led_v, leading(told, led_w, share))
            track.commands[step - begin] = u
            track.states[step - begin, 0], track.states[step - begin, 1] = p, v
            p, v = advance(rule, p, v, u + w)
    after = max(end - begin, 0)
    track.states[after, 0], track.states[after, 1] = p, v


@part
def _observe_disturbance(
    settings: Settings, memory: Memory, row: int, trip: int, course: Course, track: Track
) -> None:
    """Disturbance observer: from the observation before to the newest, where there is a new one.

    Args:
        trip: steps from that to where planning starts; a long trip makes it slower.
    """
    seen = memory.seen[row]
    begin, end = seen.base_step, memory.observed[row]
    if end == begin:
        return
    before, after = _number(memory, row, seen.base_in_force), _number(memory, row, seen.in_force)
    by_rule = seen.takes == 1 and seen.base_takes == 1 and min(before, after) > UNKNOWN
    follows = by_rule and begin >= 0 and end - begin <= settings.age_max
    m, legs, speed = end - begin, 0, _speed(memory.state[row].base_u)
    if follows:
        first = _first_under_way(memory, row, seen.base_in_force, begin)
        legs = _chart(course, memory, row, begin, before, range(first, after))
        # What came into force, and when, is known.
        while legs > 1 and course.begins[legs - 1] >= seen.since:
            legs -= 1
        if seen.since <= begin:
            course.numbers[0] = after
        elif seen.since < end:
            course.begins[legs], course.numbers[legs] = seen.since, after
            legs += 1
    for axis in range(len(settings.rule)):
        state, rule, lag = memory.state[row, axis], settings.rule[axis], 0.0
        if follows:
            x = (state.base_p, state.base_v, state.base_u, speed)
            _roll(settings, memory, row, axis, course, legs, end, x, track)
            off, left = state.v - track.states[m, 1], settings.follow**m
            memory.state[row, axis].w = learned(
                state.w,
                (1.0 - left) * off,
                m,
                rule.a11,
                settings.decay,
                trip * settings.dt_ns,
                rule.bound,
            )
            lag = left * off
        memory.state[row, axis].base_p, memory.state[row, axis].base_v = state.p, state.v - lag
        memory.state[row, axis].base_u = state.u
    memory.seen[row].base_step, memory.seen[row].base_in_force = end, seen.in_force
    memory.seen[row].base_takes = seen.takes


@part
def _listen(
    settings: Settings, memory: Memory, bound: DelayBound, clock: Seen, row: int, k: int
) -> None:
    """Take what the newest observation says of the delay of horizons.

    A bound so large that no plan could be flown is forgotten: nothing would be sent, and nothing
    that was sent could show that the delay is smaller by now.
    """
    seen, room = memory.seen[row], memory.sent.shape[1]
    age = k - memory.observed[row]
    if bound.steps[row] > age and age + bound.steps[row] > settings.age_max:
        bound.steps[row], bound.seen[row] = 0, 0
    if bound.steps[row] == 0:
        begin(bound, row, -(-half_trip_ns(clock, row) // settings.dt_ns) + MARGIN)
    at_least(bound, row, -(-shortest_ns(clock, row) // settings.dt_ns))
    if seen.in_force == seen.acknowledged or seen.sent == 0:
        return
    memory.seen[row].loss -= LEARNED * seen.loss
    oldest = max(seen.sent - room, 0)
    if memory.sent[row, oldest % room].step <= seen.in_force:
        acknowledge(bound, row, seen.since - seen.in_force)
    memory.seen[row].acknowledged = seen.in_force


@part
def _doubt(
    settings: Settings,
    memory: Memory,
    row: int,
    i: int,
    k: int,
    flying: int,
    under_way: range,
    course: Course,
    track: Track,
    found: Foresight,
) -> None:
    """Fill in what becomes of vehicle `i` of a block where the newest horizons in flight are lost.

    Args:
        flying: number of the horizon in force at its newest observation.
        under_way: numbers of those in flight.
    """
    observed, share, speed = memory.observed[row], 1.0, _speed(memory.state[row].u)
    then, loss = k + found.ahead[i] - observed, memory.seen[row].loss
    for j in range(found.doubt.shape[1]):
        found.doubt[i, j] = 0.0
        left = len(under_way) - j - 1
        if left < 0:
            continue
        share *= loss
        # Where more may be lost than are reckoned with, or none is left, this case stands for all.
        last = left == 0 or j + 1 == found.doubt.shape[1]
        found.doubt[i, j] = share if last else share * (1.0 - loss)
        some = range(under_way.start, under_way.start + left)
        legs = _chart(course, memory, row, observed, flying, some)
        for axis in range(len(settings.rule)):
            state = memory.state[row, axis]
            x = (state.p, state.v, state.u, speed)
            _roll(settings, memory, row, axis, course, legs, observed + then + settings.H, x, track)
            for n in range(2):
                found.doubted_start[i, j, axis, n] = track.states[max(then, 0), n]
            for n in range(settings.H):
                found.doubted[i, j, axis, n] = track.commands[then + n] if then + n >= 0 else 0.0


@kernel
def _foresee(
    settings: Settings,
    memory: Memory,
    bound: DelayBound,
    clock: Seen,
    rows: I1,
    steps: I1,
    found: Foresight,
) -> int:
    """Fill in what is foreseen of vehicles at their steps k; the number of horizons newly lost."""
    axes, H, room = len(settings.rule), settings.H, memory.sent.shape[1]
    course = Course(np.empty(room + 2, dtype=np.int64), np.empty(room + 2, dtype=np.int64))
    longest = settings.age_max + bound.most + H + 1
    track, lost = Track(np.empty(longest), np.empty((longest, 2))), 0
    for i in range(len(rows)):
        row, k = rows[i], steps[i]
        _listen(settings, memory, bound, clock, row, k)
        d = bound.steps[row]
        if settings.decay < 1.0:
            trip = k + d - memory.observed[row]
            _observe_disturbance(settings, memory, row, trip, course, track)
        seen, observed = memory.seen[row], memory.observed[row]
        assert (
            k - observed <= settings.age_max
        )  # the controller's promise; the track has no more room
        # Those that were due and are not in force have been overtaken, or are lost.
        first = _first_under_way(memory, row, seen.in_force, observed)
        for number in range(_first_after(memory, row, seen.in_force), first):
            newly = memory.sent[row, number % room].due > seen.judged
            lost += newly
            if newly:
                memory.seen[row].loss += LEARNED * (1.0 - memory.seen[row].loss)
        memory.seen[row].judged = observed
        flying, under_way = HOVERS, range(0)
        if seen.takes == 1:
            flying, under_way = _number(memory, row, seen.in_force), range(first, seen.sent)
        legs = _chart(course, memory, row, observed, flying, under_way)
        found.ahead[i], speed = d, _speed(memory.state[row].u)
        for axis in range(axes):
            state, rule = memory.state[row, axis], settings.rule[axis]
            x = (state.p, state.v, state.u, speed)
            _roll(settings, memory, row, axis, course, legs, k + d + H, x, track)
            # An observation from ahead of k, where clocks disagree, is taken as it is.
            now, then = k - observed, k + d - observed
            for j in range(2):
                found.estimate[i, axis, j] = track.states[max(now, 0), j]
                found.start[i, axis, j] = track.states[max(then, 0), j]
            for j in range(d):
                found.committed[i, axis, j] = track.commands[now + j] if now + j >= 0 else 0.0
            for j in range(H):
                found.held[i, axis, j] = track.commands[then + j] if then + j >= 0 else 0.0
            found.disturbance[i, axis] = state.w
            if settings.feeds_back:
                found.feedback[i, axis, 0] = found.estimate[i, axis, 0]
                found.feedback[i, axis, 1] = found.estimate[i, axis, 1]
                found.feedback[i, axis, 2] = state.w
                found.feedback[i, axis, 3], found.feedback[i, axis, 4] = rule.gain_p, rule.gain_v
        _doubt(settings, memory, row, i, k, flying, under_way, course, track, found)
    return lost


@kernel
def _remember(
    settings: Settings, memory: Memory, rows: I1, steps: I1, found: Foresight, event: B1
) -> None:
    """Write down the horizons that are sent, see `Replay.remember`."""
    room = memory.sent.shape[1]
    for i in range(len(rows)):
        if not event[i]:
            continue
        row = rows[i]
        slot = memory.seen[row].sent % room
        memory.seen[row].sent += 1
        given, squares = found.ahead[i] + settings.H, 0.0
        length = lasting(given, steps[i], memory.observed[row], settings.age_max)
        for axis in range(len(settings.rule)):
            for stage in range(length):
                memory.inputs[row, slot, axis, stage] = found.horizons[i, axis, stage]
            last = bounded(float(found.horizons[i, axis, length - 1]), settings.rule[axis].bound)
            squares += last * last
            led = memory.led[row, slot, axis]
            led.stage, led.p = 0, found.feedback[i, axis, 0]
            led.v, led.w = found.feedback[i, axis, 1], found.feedback[i, axis, 2]
        sent = memory.sent[row, slot]
        sent.step, sent.due = steps[i], steps[i] + found.ahead[i]
        sent.length, sent.speed = length, np.sqrt(squares)
