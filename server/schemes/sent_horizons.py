"""Memory of committed inputs: newest observations of each vehicle, and the horizons sent to it.

Horizons lie in a ring, one for each number counted from 0 in the order of sending. An observation
names the horizon in force by the step that it was made for; here that becomes its number again.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.compiled import Laws, bounded, lasting
from skytether.server.common.scheme import Foresight
from skytether.shared.base.kernel import B1, I1, R1, R2, S4, kernel, part, record, records
from skytether.shared.wire.protocol import DISTURBANCE, LED_P, LED_V

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


@kernel
def keep(
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


@kernel
def remember(
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


@part
def speed_of(inputs: R1) -> float:
    """Magnitude of an input over all axes [m/s]."""
    squares = 0.0
    for u in inputs:
        squares += u * u
    return np.sqrt(squares)


@part
def number_of(memory: ReplayMemory, row: int, made_for: int) -> int:
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
def first_after(memory: ReplayMemory, row: int, step: int) -> int:
    """Number of the first horizon made for a later step."""
    room = memory.sent.shape[1]
    count = memory.seen[row].sent
    number = count
    while number > max(count - room, 0) and memory.sent[row, (number - 1) % room].step > step:
        number -= 1
    return number


@part
def first_under_way(memory: ReplayMemory, row: int, in_force: int, observed: int) -> int:
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
