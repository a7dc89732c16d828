"""Plausibility check of observations: rejects well-formed observations with impossible values.

Each observation is compared with the vehicle's last accepted observation:

    clock     its delay and that of the other direction must give a round trip of at least 0
    horizon   the horizon in force and its first flown step must not go back, nor be in the future
    jump      position and velocity must change by no more than a vehicle can fly

An observation that fails is dropped and counted. But the last accepted observation may be wrong: so
REPEATS observations in a row that are consistent with each other are accepted, and the vehicle's
data are reset.
"""

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F4, R2, kernel, part, record, records, shared
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.time_of_day import DRIFT
from skytether.shared.law import leap
from skytether.shared.law.leap import NOISE_M, NOISE_MPS
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import NO_HORIZON, Observation

REPEATS = 3
"""Number of consistent rejected observations in a row that replace the accepted observation."""
SLACK_NS = 50 * MILLISECOND_NS
"""Tolerance for a measured round trip that is too short [ns], in addition to the drift of the
clocks between two observations."""


class Statement:
    """Numpy record: an observation without its state."""

    step: int
    """Step of the observation, or -1 if there is none."""
    in_force: int
    """Step that the horizon in force was made for, or NO_HORIZON."""
    since: int
    """First step flown with the horizon in force."""
    forward: int
    """Time difference F, see `server.planning.clock` [ns]."""
    backward: int
    """Time difference G, see `server.planning.clock` [ns]."""
    count: int
    """Number of consistent observations rejected in a row up to this one; 0 if accepted."""


STATEMENT = record(Statement)
position_leaps, velocity_leaps = shared(leap.position_leaps), shared(leap.velocity_leaps)


class Belief(IntEnum):
    ANEW = -1
    """Verdict: the observation is accepted, and earlier observations are discarded."""
    BELIEVED = 0
    CLOCK = 1
    HORIZON = 2
    JUMP = 3


LAST, DOUBTED, NEW = 0, 1, 2
"""Indices of a vehicle's three observations: last accepted, last rejected, and new."""


class HeardNumbers(NamedTuple):
    numbers: Annotated[NDArray[np.void], records(STATEMENT, 2)]
    """Last accepted, last rejected and new observation of each vehicle; shape (3, capacity)."""
    states: F4
    """Positions [m] and velocities [m/s] in the observations; shape (3, capacity, axes, 2)."""


class Plausibility:
    def __init__(self, terms: Terms, capacity: int) -> None:
        self._observed = HeardNumbers(
            numbers=np.zeros((3, capacity), dtype=STATEMENT),
            states=np.zeros((3, capacity, terms.axes, 2)),
        )
        self._dt_s, self._H = terms.dt_s, terms.horizon
        self._noise_m = NOISE_M + NOISE_MPS * max(terms.dead_time_s)
        """Largest change of an observed position by noise, predicted over the dead time [m]."""
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        self._observed.numbers["step"][:, row] = -1

    def judge(self, row: int, observation: Observation, F: int, G: int) -> int:
        """Check an observation with its F and G [ns], see `clock`; returns a `Belief`."""
        message = observation
        return _judge(
            self._observed,
            row,
            message.state,
            message.step,
            message.in_force,
            message.since,
            F,
            G,
            self._H,
            self._dt_s,
            self._noise_m,
        )


ANEW, BELIEVED, CLOCK, HORIZON, JUMP = map(int, Belief)


@part
def _against(
    observed: HeardNumbers, row: int, which: int, H: int, dt: float, noise_m: float
) -> int:
    """Reason why the new observation contradicts another; BELIEVED if it does not."""
    before, new = observed.numbers[which, row], observed.numbers[NEW, row]
    verdict = BELIEVED
    if new.in_force > new.since + H or new.since > new.step:
        verdict = HORIZON
    elif before.step >= 0:
        # F of one observation plus G of another is also a round trip, which cannot be negative.
        trip = min(new.forward + before.backward, new.backward + before.forward)
        drift = int(abs(new.step - before.step) * dt * SECOND_NS) // DRIFT
        if min(trip, new.forward + new.backward) < -SLACK_NS - drift:
            verdict = CLOCK
        elif new.step > before.step:  # otherwise only the clocks are compared
            back = new.in_force < before.in_force or new.since < before.since
            if new.in_force != NO_HORIZON and back:
                verdict = HORIZON
            elif _jumps(observed, row, which, (new.step - before.step) * dt, noise_m):
                verdict = JUMP
    return verdict


@part
def _jumps(observed: HeardNumbers, row: int, which: int, time: float, noise_m: float) -> bool:
    """Whether a vehicle cannot fly from another observed state to the new one in a time [s]."""
    jumps = False
    for axis in range(observed.states.shape[2]):
        p, v = observed.states[which, row, axis, 0], observed.states[which, row, axis, 1]
        after_p, after_v = observed.states[NEW, row, axis, 0], observed.states[NEW, row, axis, 1]
        jumps |= velocity_leaps(v, after_v, time, NOISE_MPS)
        jumps |= position_leaps(p, v, after_p, after_v, time, noise_m)
    return jumps


@kernel
def _judge(
    observed: HeardNumbers,
    row: int,
    state: R2,
    step: int,
    in_force: int,
    since: int,
    F: int,
    G: int,
    H: int,
    dt: float,
    noise_m: float,
) -> int:
    numbers, place = observed.numbers, LAST
    new = numbers[NEW, row]
    new.step, new.in_force, new.since = step, in_force, since
    new.forward, new.backward, new.count = F, G, 0
    for axis in range(len(state)):
        for n in range(2):
            observed.states[NEW, row, axis, n] = state[axis, n]
    verdict = _against(observed, row, LAST, H, dt, noise_m)
    if verdict != BELIEVED:
        place = DOUBTED
        # Three consistent observations are accepted: the vehicle may have been moved, or its clock
        # set.
        agrees = numbers[DOUBTED, row].step >= 0 and (
            _against(observed, row, DOUBTED, H, dt, noise_m) == BELIEVED
        )
        numbers[NEW, row].count = numbers[DOUBTED, row].count + 1 if agrees else 1
        if numbers[NEW, row].count == REPEATS:
            place, verdict = LAST, ANEW
    if verdict == BELIEVED and numbers[NEW, row].step <= numbers[LAST, row].step:
        return BELIEVED
    if place == LAST:
        numbers[DOUBTED, row].step = -1
    numbers[place, row] = numbers[NEW, row]
    for axis in range(len(state)):
        for n in range(2):
            observed.states[place, row, axis, n] = observed.states[NEW, row, axis, n]
    return verdict
