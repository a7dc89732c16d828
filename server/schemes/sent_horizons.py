"""Memory of committed inputs: newest observations of each vehicle, and the horizons sent to it.

Which of these are in force, in flight or lost is kept by `schemes.sent`.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.compiled import Laws, bounded, lasting
from skytether.server.common.scheme import Foresight
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.sent import Sent
from skytether.shared.base.kernel import B1, I1, R1, R2, S4, kernel, part, record, records
from skytether.shared.wire.protocol import DISTURBANCE, LED_P, LED_V


class Observations:
    """Record: the two newest observations of a vehicle."""

    base_step: int
    """Step of the observation before, or -1."""
    base_in_force: int
    """Step that the horizon in force there was made for, or NO_HORIZON."""
    takes: int
    """1 if horizons that come are flown at its newest observation, else 0."""
    base_takes: int
    """1 if horizons that come were flown at the observation before, else 0."""


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
    """Record: how a horizon that was sent is flown."""

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


OBSERVATIONS, AXIS_STATE = record(Observations), record(ObservedAxis)
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

    sent: Sent
    """Which horizons are in force, in flight or lost; as many as the ring has room for."""
    seen: Annotated[NDArray[np.void], records(OBSERVATIONS, 1)]
    """Shape (capacity,)."""
    state: Annotated[NDArray[np.void], records(AXIS_STATE, 2)]
    """Shape (capacity, axes)."""
    horizons: Annotated[NDArray[np.void], records(SENT_HORIZON, 2)]
    """Horizons in the ring; shape (capacity, ring)."""
    inputs: S4
    """Inputs of these horizons [m/s]; shape (capacity, ring, axes, largest d + H)."""
    led: Annotated[NDArray[np.void], records(LEAD, 3)]
    """States that the horizons lead to; shape (capacity, ring, axes)."""


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
    sent = memory.sent
    if step <= sent.observed[row]:
        return False
    sent.observed[row] = step
    sent.heard[row].in_force, sent.heard[row].since = in_force, since
    memory.seen[row].takes = takes
    for axis in range(len(state)):
        memory.state[row, axis].p, memory.state[row, axis].v = state[axis, 0], state[axis, 1]
        memory.state[row, axis].u = flown[axis]
    return True


@kernel
def remember(
    settings: ReplaySettings, memory: ReplayMemory, rows: I1, steps: I1, found: Foresight, event: B1
) -> None:
    """Write down the horizons that are sent, see `Replay.remember`."""
    for i in range(len(rows)):
        if not event[i]:
            continue
        row, squares = rows[i], 0.0
        slot = tracker.note(memory.sent, row, steps[i], found.ahead[i])
        stages = found.ahead[i] + settings.H
        length = lasting(stages, steps[i], memory.sent.observed[row], settings.age_max)
        for axis in range(len(settings.laws)):
            for stage in range(length):
                memory.inputs[row, slot, axis, stage] = found.horizons[i, axis, stage]
            # Just as `HorizonFollower` does it aboard: both ends have to brake from the same
            # speed.
            last = bounded(float(found.horizons[i, axis, length - 1]), settings.laws[axis].bound)
            squares += last * last
            led = memory.led[row, slot, axis]
            feedback = found.feedback[i, axis]
            led.stage, led.w = 0, feedback[DISTURBANCE]
            led.p, led.v = feedback[LED_P], feedback[LED_V]
        horizon = memory.horizons[row, slot]
        horizon.length, horizon.speed = length, np.sqrt(squares)


@part
def speed_of(inputs: R1) -> float:
    """Magnitude of an input over all axes [m/s]."""
    squares = 0.0
    for u in inputs:
        squares += u * u
    return np.sqrt(squares)
