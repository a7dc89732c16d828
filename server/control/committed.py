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
course), and the roll along it by the rule of flight (`shared.law.rule`).
"""

from collections import Counter
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.control import delay
from skytether.server.control.clock import ClockMap, Seen, half_trip_ns, shortest_ns
from skytether.server.control.delay import DelayBound, acknowledge, at_least, begin, delay_bound
from skytether.server.control.law import (
    Laws,
    advance,
    axis_of,
    bounded,
    lasting,
    laws_of,
    lead_to,
    step,
)
from skytether.server.control.observer import decay_of, learned
from skytether.server.control.scheme import Foresight
from skytether.shared.base.kernel import (
    B1,
    F1,
    F2,
    I1,
    R1,
    R2,
    S4,
    inline,
    kernel,
    part,
    record,
    records,
)
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.rule import Held
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    GAIN_P,
    GAIN_V,
    LED_P,
    LED_V,
    NO_HORIZON,
    Observation,
    committed_max,
)

MARGIN = 2
"""Steps on top of half a round trip, until a horizon has been acknowledged."""
FOLLOW_S = 0.25
"""Time constant with which the disturbance observer follows the velocity that is reported [s]."""
LOSS, LEARNED = 0.1, 0.05
"""Share of lost horizons that is assumed at first, and by how much of itself each horizon that has
come into force, or is lost, moves it."""
HOVERS, UNKNOWN = -1, -2
"""Number of a horizon where there is none (the vehicle brakes and stands still), and where it was
sent in an earlier life of the server."""


class Latest:
    """Record: what is known of one vehicle."""

    in_force: int
    """Step that the horizon in force at its newest observation was made for, or NO_HORIZON."""
    since: int
    """First step flown with that horizon."""
    base_step: int
    """Step of the observation before, or -1."""
    base_in_force: int
    """Step that the horizon in force there was made for, or NO_HORIZON."""
    acknowledged: int
    """Step that the horizon last seen to have come into force was made for, or NO_HORIZON."""
    judged: int
    """Step up to which horizons were seen in force, lost or overtaken."""
    sent: int
    """Number of horizons sent so far."""
    takes: int
    """1 if horizons that come are flown at its newest observation, else 0."""
    base_takes: int
    """1 if horizons that come were flown at the observation before, else 0."""
    loss: float
    """Share of horizons that were lost lately."""


class ObservedAxis:
    """Record: the two newest observations of a vehicle on one axis."""

    p: float
    """Position in the newest observation [m]."""
    v: float
    """Velocity in it [m/s]."""
    u: float
    """Input flown at its step [m/s]."""
    base_p: float
    """Position in the observation before [m]."""
    base_v: float
    """Velocity in it, as the disturbance observer follows it [m/s]."""
    base_u: float
    """Input flown at that step [m/s]."""
    w: float
    """Disturbance ŵ [m/s]."""


class SentHorizon:
    """Record: a horizon that was sent."""

    step: int
    """Step that it was made for."""
    due: int
    """Step at which it is in force, or lost."""
    length: int
    """Number of its inputs that are flown."""
    speed: float
    """Magnitude of the last of these over all axes [m/s]."""


class Lead:
    """Record: where a horizon leads on one axis, x̄.

    It goes on with what is observed, for nothing before is ever replayed again.
    """

    stage: int
    """Stage that x̄ belongs to."""
    p: float
    """Position there [m]."""
    v: float
    """Velocity there [m/s]."""
    w: float
    """Disturbance ŵ that the horizon reckons with [m/s]."""


LATEST, AXIS_STATE = record(Latest), record(ObservedAxis)
SENT_HORIZON, LEAD = record(SentHorizon), record(Lead)


class ReplaySettings(NamedTuple):
    """Constants shared by all vehicles."""

    laws: Laws
    """Model, bound and gain of each axis; shape (axes,)."""
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
    """Share of a velocity's jump that the observer has not followed after a step."""
    feeds_back: bool
    """Whether horizons bring feedback."""


class ReplayMemory(NamedTuple):
    """State of every vehicle, and the horizons sent to it."""

    observed: I1
    """Step of the newest observation, or -1; shape (capacity,)."""
    seen: Annotated[NDArray[np.void], records(LATEST, 1)]
    """Shape (capacity,)."""
    state: Annotated[NDArray[np.void], records(AXIS_STATE, 2)]
    """Shape (capacity, axes)."""
    sent: Annotated[NDArray[np.void], records(SENT_HORIZON, 2)]
    """Horizons that were sent, a ring; shape (capacity, room)."""
    inputs: S4
    """Inputs of these horizons [m/s]; shape (capacity, room, axes, largest d + H)."""
    led: Annotated[NDArray[np.void], records(LEAD, 3)]
    """States that the horizons lead to; shape (capacity, room, axes)."""


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
        self._settings = ReplaySettings(
            laws=laws_of(terms, gain),
            H=H,
            age_max=terms.age_max,
            dt_ns=terms.dt_ns,
            brake=terms.brake,
            decay=decay_of(terms, control),
            follow=float(np.exp(-terms.dt_s / FOLLOW_S)),
            feeds_back=terms.feedback,
        )
        # One horizon a step at most, and none is flown for longer than `age_max`.
        room = terms.age_max + H
        self._memory = ReplayMemory(
            observed=np.zeros(capacity, dtype=np.int64),
            seen=np.zeros(capacity, dtype=LATEST),
            state=np.zeros((capacity, axes), dtype=AXIS_STATE),
            sent=np.zeros((capacity, room), dtype=SENT_HORIZON),
            inputs=np.zeros((capacity, room, axes, most + H), dtype=np.float32),
            led=np.zeros((capacity, room, axes), dtype=LEAD),
        )
        # From the oldest observation that counts to the end of a plan that is made from it.
        longest = terms.age_max + most + H + 1
        self._course = HorizonsInForce(
            np.empty(room + 2, dtype=np.int64), np.empty(room + 2, dtype=np.int64)
        )
        self._track = FlownTrack(np.empty(longest), np.empty((longest, 2)))
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
            self._settings,
            self._memory,
            self.delay_bound,
            self._clock.seen,
            self._course,
            self._track,
            rows,
            step,
            found,
        )
        if lost:
            self.counts["horizons_lost"] += lost

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what was sent counts."""
        _remember(self._settings, self._memory, rows, step, found, event)


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


@kernel
def _keep(
    memory: ReplayMemory,
    row: int,
    step: int,
    in_force: int,
    since: int,
    takes: int,
    state: R2,
    flown: R1,
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
def _number(memory: ReplayMemory, row: int, made_for: int) -> int:
    """Number of the horizon made for a step, counted from 0 in the order of sending."""
    if made_for < 0:
        return HOVERS
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    # From the newest down: the horizon in force is mostly one of the last few.
    for number in range(count - 1, max(count - room, 0) - 1, -1):
        step = memory.sent[row, number % room].step
        if step <= made_for:
            return number if step == made_for else UNKNOWN
    return UNKNOWN


@part
def _first_after(memory: ReplayMemory, row: int, step: int) -> int:
    """Number of the first horizon made for a later step."""
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    number = count
    while number > max(count - room, 0) and memory.sent[row, (number - 1) % room].step > step:
        number -= 1
    return number


@part
def _first_under_way(memory: ReplayMemory, row: int, in_force: int, observed: int) -> int:
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
    course: HorizonsInForce,
    memory: ReplayMemory,
    row: int,
    begin: int,
    flown: int,
    following: range,
) -> int:
    """Number of legs of the course from `begin`: `flown`, then each of those following it.

    Args:
        following: numbers of horizons, each in force when it is due.
    """
    room, legs = memory.sent.shape[1], 1
    course.begins[0], course.numbers[0] = begin, flown
    for number in following:
        due = memory.sent[row, number % room].due
        # In force already when the course begins: the newest such horizon counts.
        if due <= begin:
            course.numbers[0] = number
            continue
        course.begins[legs], course.numbers[legs] = due, number
        legs += 1
    return legs


@part
def _roll(
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
    law, room, begin = settings.laws[axis], memory.sent.shape[1], course.begins[0]
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
            stands = Held(
                model, (told_first,), 1, True, speed_told, brake, bound, False, 0.0, 0.0, 0.0
            )
            p, v = _fly(stands, begin, 0.0, 0.0, p, v, w, first, last, begin, told_first, track)
            continue
        slot = number % room
        horizon, led = memory.sent[row, slot], memory.led[row, slot, axis]
        made_for, led_p, led_v = horizon.step, led.p, led.v
        held = Held(
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
            led_p, led_v = lead_to(held, led.stage, first - made_for, led_p, led_v)
            if leg == 0 and first - made_for > led.stage:
                led.stage, led.p, led.v = first - made_for, led_p, led_v
        p, v = _fly(held, made_for, led_p, led_v, p, v, w, first, last, begin, told_first, track)
    after = max(end - begin, 0)
    track.states[after, 0], track.states[after, 1] = p, v


@inline
def _fly(
    held: Held,
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


@part
def _observe_disturbance(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    trip: int,
    course: HorizonsInForce,
    track: FlownTrack,
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
    # A vehicle that takes no horizon brakes by its failsafe: what it does then says nothing of
    # wind.
    by_rule = seen.takes == 1 and seen.base_takes == 1 and min(before, after) > UNKNOWN
    # Further back than `age_max` the horizons of that time may be gone from the ring.
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
    for axis in range(len(settings.laws)):
        state, law, lag = memory.state[row, axis], settings.laws[axis], 0.0
        if follows:
            x = (state.base_p, state.base_v, state.base_u, speed)
            _roll(settings, memory, row, axis, course, legs, end, x, track)
            # A jump of the velocity may be noise: the observer follows it with FOLLOW_S, and
            # carries the rest on as `lag`.
            off, left = state.v - track.states[m, 1], settings.follow**m
            memory.state[row, axis].w = learned(
                state.w,
                (1.0 - left) * off,
                m,
                law.a11,
                settings.decay,
                trip * settings.dt_ns,
                law.bound,
            )
            lag = left * off
        memory.state[row, axis].base_p, memory.state[row, axis].base_v = state.p, state.v - lag
        memory.state[row, axis].base_u = state.u
    memory.seen[row].base_step, memory.seen[row].base_in_force = end, seen.in_force
    memory.seen[row].base_takes = seen.takes


@part
def _listen(
    settings: ReplaySettings, memory: ReplayMemory, bound: DelayBound, clock: Seen, row: int, k: int
) -> None:
    """Take what the newest observation says of the delay of horizons.

    A bound so large that no plan could be flown is forgotten: nothing would be sent, and nothing
    that was sent could show that the delay is smaller by now.
    """
    seen, room = memory.seen[row], memory.sent.shape[1]
    age = k - memory.observed[row]
    if bound.steps[row] > age and age + bound.steps[row] > settings.age_max:
        bound.steps[row], bound.seen[row] = 0, 0
    # No sample yet: half a round trip, rounded up, and a margin.
    if bound.steps[row] == 0:
        begin(bound, row, -(-half_trip_ns(clock, row) // settings.dt_ns) + MARGIN)
    at_least(bound, row, -(-shortest_ns(clock, row) // settings.dt_ns))
    if seen.in_force == seen.acknowledged or seen.sent == 0:
        return
    memory.seen[row].loss -= LEARNED * seen.loss
    oldest = max(seen.sent - room, 0)
    # One that is older than all in the ring was sent too long ago to be a sample.
    if memory.sent[row, oldest % room].step <= seen.in_force:
        acknowledge(bound, row, seen.since - seen.in_force)
    memory.seen[row].acknowledged = seen.in_force


@part
def _doubt(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    i: int,
    k: int,
    flying: int,
    under_way: range,
    course: HorizonsInForce,
    track: FlownTrack,
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
        for axis in range(len(settings.laws)):
            state = memory.state[row, axis]
            x = (state.p, state.v, state.u, speed)
            _roll(settings, memory, row, axis, course, legs, observed + then + settings.H, x, track)
            for n in range(2):
                found.doubted_start[i, j, axis, n] = track.states[max(then, 0), n]
            for n in range(settings.H):
                found.doubted[i, j, axis, n] = track.commands[then + n] if then + n >= 0 else 0.0


@kernel
def _foresee(
    settings: ReplaySettings,
    memory: ReplayMemory,
    bound: DelayBound,
    clock: Seen,
    course: HorizonsInForce,
    track: FlownTrack,
    rows: I1,
    steps: I1,
    found: Foresight,
) -> int:
    """Fill in what is foreseen of vehicles at their steps k; the number of horizons newly lost.

    Both `course` and `track` are scratch.
    """
    axes, H, room = len(settings.laws), settings.H, memory.sent.shape[1]
    lost = 0
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
            # A lost horizon stays in the ring, and is counted once.
            newly = memory.sent[row, number % room].due > seen.judged
            lost += newly
            if newly:
                memory.seen[row].loss += LEARNED * (1.0 - memory.seen[row].loss)
        memory.seen[row].judged = observed
        # A vehicle that takes no horizons stands still, whatever is under way to it.
        flying, under_way = HOVERS, range(0)
        if seen.takes == 1:
            flying, under_way = _number(memory, row, seen.in_force), range(first, seen.sent)
        legs = _chart(course, memory, row, observed, flying, under_way)
        found.ahead[i], speed = d, _speed(memory.state[row].u)
        found.flown[i] = max(0, lasting(d + H, k, observed, settings.age_max) - d)
        for axis in range(axes):
            state, law = memory.state[row, axis], settings.laws[axis]
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
                feedback = found.feedback[i, axis]
                feedback[LED_P] = found.estimate[i, axis, 0]
                feedback[LED_V] = found.estimate[i, axis, 1]
                feedback[DISTURBANCE] = state.w
                feedback[GAIN_P], feedback[GAIN_V] = law.gain_p, law.gain_v
        _doubt(settings, memory, row, i, k, flying, under_way, course, track, found)
    return lost


@kernel
def _remember(
    settings: ReplaySettings, memory: ReplayMemory, rows: I1, steps: I1, found: Foresight, event: B1
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
        for axis in range(len(settings.laws)):
            for stage in range(length):
                memory.inputs[row, slot, axis, stage] = found.horizons[i, axis, stage]
            # Just as `Compensator._hold` does it aboard: both ends have to brake from the same
            # speed.
            last = bounded(float(found.horizons[i, axis, length - 1]), settings.laws[axis].bound)
            squares += last * last
            led = memory.led[row, slot, axis]
            feedback = found.feedback[i, axis]
            led.stage, led.w = 0, feedback[DISTURBANCE]
            led.p, led.v = feedback[LED_P], feedback[LED_V]
        sent = memory.sent[row, slot]
        sent.step, sent.due = steps[i], steps[i] + found.ahead[i]
        sent.length, sent.speed = length, np.sqrt(squares)
