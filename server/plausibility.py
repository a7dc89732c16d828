"""Plausibility of observations: one may be well formed, in a session, and still be impossible.

Each is held against the one of its vehicle that was believed last:

    clock     with the delay of the other direction it makes no round trip of less than nothing
    horizon   the horizon in force, and since when, go on with time and not beyond it
    jump      position and velocity have changed by no more than a vehicle can fly

One that fails is dropped and counted. It may be the others that are wrong: REPEATS in a row that
agree with each other are believed, and the vehicle is begun with anew.
"""

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F4, R2, kernel, part, record, records, shared
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.law import leap
from skytether.shared.law.leap import NOISE_M, NOISE_MPS
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import NO_HORIZON, Observation

REPEATS = 3
"""Observations in a row, each possible after the one before, that are believed in the end."""
SLACK_NS = 50 * MILLISECOND_NS
"""Time by which drifting clocks may shorten a measured round trip [ns]."""


class Statement:
    """Record: an observation, but for its state."""

    step: int
    """Step of that observation, or -1 where there is none."""
    in_force: int
    """Step that the horizon in force was made for, or NO_HORIZON."""
    since: int
    """First step flown with that horizon."""
    forward: int
    """F of `server.common.clock` [ns]."""
    backward: int
    """G of `server.common.clock` [ns]."""
    count: int
    """Number of doubted ones in a row that agree, itself included; 0 unless it is doubted."""


STATEMENT = record(Statement)
position_leaps, velocity_leaps = shared(leap.position_leaps), shared(leap.velocity_leaps)


class Belief(IntEnum):
    """Verdict on an observation."""

    ANEW = -1
    """Believed, unlike all that was believed before."""
    BELIEVED = 0
    CLOCK = 1
    HORIZON = 2
    JUMP = 3


LAST, DOUBTED, NEW = 0, 1, 2
"""Places of a vehicle's observations: believed last, doubted last, and to be judged."""


class HeardNumbers(NamedTuple):
    """Newest observations of the vehicles."""

    numbers: Annotated[NDArray[np.void], records(STATEMENT, 2)]
    """Observations at their three places; shape (3, capacity)."""
    states: F4
    """Positions [m] and velocities [m/s]; shape (3, capacity, axes, 2)."""


class Plausibility:
    """Judge of the observations of up to `capacity` vehicles."""

    def __init__(self, terms: Terms, capacity: int) -> None:
        self._said = HeardNumbers(
            numbers=np.zeros((3, capacity), dtype=STATEMENT),
            states=np.zeros((3, capacity, terms.axes, 2)),
        )
        self._dt_s, self._H = terms.dt_s, terms.horizon
        self._noise_m = NOISE_M + NOISE_MPS * max(terms.dead_time_s)
        """Largest change of position by noise, predicted over the dead time [m]."""
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle, or with a new life of it."""
        self._said.numbers["step"][:, row] = -1

    def judge(self, row: int, observation: Observation, F: int, G: int) -> int:
        """Verdict on an observation of a vehicle.

        Args:
            row: the vehicle.
            observation: what it says.
            F, G: of the observation and its echo, see `server.common.clock` [ns].

        Returns:
            a `Belief`.
        """
        told = observation
        return _judge(
            self._said,
            row,
            told.state,
            told.step,
            told.in_force,
            told.since,
            F,
            G,
            self._H,
            self._dt_s,
            self._noise_m,
        )


ANEW, BELIEVED, CLOCK, HORIZON, JUMP = map(int, Belief)
"""Members of `Belief` as plain numbers, for kernels."""


@part
def _against(said: HeardNumbers, row: int, which: int, H: int, dt: float, noise_m: float) -> int:
    """Reason against the new observation after another; BELIEVED where nothing does."""
    before, new = said.numbers[which, row], said.numbers[NEW, row]
    verdict = BELIEVED
    if new.in_force > new.since + H or new.since > new.step:
        verdict = HORIZON
    elif before.step >= 0:
        # F of one observation and G of another make a round trip as well, which cannot be shorter
        # than nothing.
        trip = min(new.forward + before.backward, new.backward + before.forward)
        if min(trip, new.forward + new.backward) < -SLACK_NS:
            verdict = CLOCK
        elif new.step > before.step:  # an older one tells of the clocks alone
            back = new.in_force < before.in_force or new.since < before.since
            if new.in_force != NO_HORIZON and back:
                verdict = HORIZON
            elif _jumps(said, row, which, (new.step - before.step) * dt, noise_m):
                verdict = JUMP
    return verdict


@part
def _jumps(said: HeardNumbers, row: int, which: int, time: float, noise_m: float) -> bool:
    """Whether no vehicle can come from the state of another observation to the new one's in time.

    Args:
        time: between the two [s].
        noise_m: what noise may add to a change of position [m].
    """
    jumps = False
    for axis in range(said.states.shape[2]):
        p, v = said.states[which, row, axis, 0], said.states[which, row, axis, 1]
        after_p, after_v = said.states[NEW, row, axis, 0], said.states[NEW, row, axis, 1]
        jumps |= velocity_leaps(v, after_v, time, NOISE_MPS)
        jumps |= position_leaps(p, v, after_p, after_v, time, noise_m)
    return jumps


@kernel
def _judge(
    said: HeardNumbers,
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
    """The verdict on a new observation, which takes its place among those of its vehicle."""
    numbers, place = said.numbers, LAST
    new = numbers[NEW, row]
    new.step, new.in_force, new.since = step, in_force, since
    new.forward, new.backward, new.count = F, G, 0
    for axis in range(len(state)):
        for n in range(2):
            said.states[NEW, row, axis, n] = state[axis, n]
    verdict = _against(said, row, LAST, H, dt, noise_m)
    if verdict != BELIEVED:
        place = DOUBTED
        # Three observations that agree with each other are believed after all: the vehicle may have
        # been carried away, or have a new clock.
        agrees = numbers[DOUBTED, row].step >= 0 and (
            _against(said, row, DOUBTED, H, dt, noise_m) == BELIEVED
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
            said.states[place, row, axis, n] = said.states[NEW, row, axis, n]
    return verdict
