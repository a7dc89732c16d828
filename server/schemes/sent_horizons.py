"""Memory of the scheme "committed": newest observations of each vehicle, and its sent horizons.

`schemes.sent` tracks the delivery of the horizons.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.planning.compiled import Laws, bounded, lasting
from skytether.server.planning.scheme import Foresight
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.sent import Sent
from skytether.shared.base.kernel import B1, I1, R1, R2, S4, kernel, part, record, records
from skytether.shared.wire.protocol import DISTURBANCE, REFERENCE_P, REFERENCE_V


class Observations:
    """Numpy record: the two newest observations of a vehicle."""

    base_step: int
    """Step of the previous observation, or -1."""
    base_in_force: int
    """Step that the horizon in force in the previous observation was made for, or NO_HORIZON."""
    takes: int
    """1 if the vehicle accepts horizons in its newest observation, else 0."""
    base_takes: int
    """1 if the vehicle accepted horizons in the previous observation, else 0."""


class ObservedAxis:
    """Numpy record: the two newest observations of a vehicle on one axis."""

    p: float
    v: float
    u: float
    """Input flown at the step of the newest observation [m/s]."""
    base_p: float
    base_v: float
    """Velocity in the previous observation, low-pass filtered by the observer [m/s]."""
    base_u: float
    """Input flown at the step of the previous observation [m/s]."""
    w: float


class SentHorizon:
    """Numpy record: a horizon that was sent, without its inputs."""

    length: int
    """Number of inputs that may be flown before they are too old."""
    speed: float
    """Magnitude of the last input that may be flown, over all axes [m/s]."""


class ReferenceState:
    """Numpy record: reference state x̄ of a horizon on one axis at the newest observation."""

    stage: int
    """Stage of the horizon that x̄ belongs to."""
    p: float
    v: float
    w: float
    """Disturbance ŵ that the horizon compensates [m/s]."""


OBSERVATIONS, AXIS_STATE = record(Observations), record(ObservedAxis)
SENT_HORIZON, REFERENCE_STATE = record(SentHorizon), record(ReferenceState)


class ReplaySettings(NamedTuple):
    """Constants shared by all vehicles."""

    laws: Laws
    H: int
    age_max: int
    """Largest age of an observation that is used [steps]."""
    dt_ns: int
    brake: float
    """Reduction of the speed in a step of braking [m/s]."""
    decay: float
    """Share of the observer's error that remains after a step, see `observer.decay_of`."""
    follow: float
    """Share of a velocity jump that the observer's low-pass filter has not followed after a step.
    """
    feeds_back: bool


class ReplayMemory(NamedTuple):
    """Newest observations of every vehicle, and the horizons sent to it."""

    sent: Sent
    seen: Annotated[NDArray[np.void], records(OBSERVATIONS, 1)]
    """Newest two observations of each vehicle; shape (capacity,)."""
    state: Annotated[NDArray[np.void], records(AXIS_STATE, 2)]
    """Newest two observations of each vehicle on each axis; shape (capacity, axes)."""
    horizons: Annotated[NDArray[np.void], records(SENT_HORIZON, 2)]
    """Horizons in the ring; shape (capacity, ring)."""
    inputs: S4
    """Inputs of the stored horizons [m/s]; shape (capacity, ring, axes, largest d + H)."""
    reference: Annotated[NDArray[np.void], records(REFERENCE_STATE, 3)]
    """Reference states of the stored horizons; shape (capacity, ring, axes)."""


@kernel
def store_observation(
    memory: ReplayMemory,
    row: int,
    step: int,
    in_force: int,
    since: int,
    takes: int,
    state: R2,
    flown: R1,
) -> bool:
    sent = memory.sent
    if step <= sent.observed[row]:
        return False
    sent.observed[row] = step
    sent.delivery[row].in_force, sent.delivery[row].since = in_force, since
    memory.seen[row].takes = takes
    for axis in range(len(state)):
        memory.state[row, axis].p, memory.state[row, axis].v = state[axis, 0], state[axis, 1]
        memory.state[row, axis].u = flown[axis]
    return True


@kernel
def store_sent(
    settings: ReplaySettings,
    memory: ReplayMemory,
    rows: I1,
    steps: I1,
    foresight: Foresight,
    event: B1,
) -> None:
    for i in range(len(rows)):
        if not event[i]:
            continue
        row, squares = rows[i], 0.0
        slot = tracker.add_plan(memory.sent, row, steps[i], foresight.ahead[i])
        stages = foresight.ahead[i] + settings.H
        length = lasting(stages, steps[i], memory.sent.observed[row], settings.age_max)
        for axis in range(len(settings.laws)):
            for stage in range(length):
                memory.inputs[row, slot, axis, stage] = foresight.horizons[i, axis, stage]
            # The speed is computed as in `HorizonFollower` aboard: both ends brake from this speed.
            last = bounded(
                float(foresight.horizons[i, axis, length - 1]), settings.laws[axis].bound
            )
            squares += last * last
            reference = memory.reference[row, slot, axis]
            feedback = foresight.feedback[i, axis]
            reference.stage, reference.w = 0, feedback[DISTURBANCE]
            reference.p, reference.v = feedback[REFERENCE_P], feedback[REFERENCE_V]
        horizon = memory.horizons[row, slot]
        horizon.length, horizon.speed = length, np.sqrt(squares)


@part
def speed_of(inputs: R1) -> float:
    """Magnitude of an input over all axes [m/s]."""
    squares = 0.0
    for u in inputs:
        squares += u * u
    return np.sqrt(squares)
