"""Which step it is aboard each vehicle: the server's clock mapped to the vehicle's.

Neither clock is set. Every observation gives F = t2 - t1 (sent by the vehicle, received here) and,
by its echo of our own stamp, G = t4 - t3 (sent here, received aboard). Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2,

vehicle's clock minus server's. Half of any asymmetry of the two smallest delays stays unknown: the
offset is right to within the bound and no better. Step k begins at epoch + k Δt of the vehicle.
"""

import numpy as np

from shared.endpoint import MILLISECOND_NS, SECOND_NS
from shared.kernel import I1, I2, I3, kernel, part, plain
from shared.model import Indices

BUCKET_NS = SECOND_NS // 2
"""Minima are kept for each half second [ns]."""
BUCKETS = 40
"""Half seconds for which minima are kept: 20 s."""
RECENT = 3
"""Half seconds that are recent, where a step of a clock is looked for."""
OLD = 8
"""Half seconds after which minima are old enough to compare the recent ones with."""
STEP_SAMPLES = 5
"""Samples that recent and old minima need each before a clock may be said to have stepped."""
STEP_NS = 40 * MILLISECOND_NS
"""Smallest step of a clock: up in one direction, and down by about as much in the other [ns]."""

UNSEEN = 2**61
"""In place of a minimum where nothing was seen."""


class ClockMap:
    """Offsets and steps of up to `capacity` vehicles.

    It follows an estimate of the offset only when that has moved by more than half a step: a step
    index that went back and forth at a boundary would skip and repeat steps for nothing.
    """

    def __init__(self, capacity: int, dt_ns: int) -> None:
        self._dt_ns = dt_ns
        self.minimum = np.full((capacity, 2, BUCKETS), UNSEEN, dtype=np.int64)
        """Smallest F and G of each half second [ns], a ring; shape (capacity, 2, BUCKETS)."""
        self._samples = np.zeros((capacity, BUCKETS), dtype=np.int64)
        self._newest = np.zeros(capacity, dtype=np.int64)
        """Half second of the newest sample; shape (capacity,)."""
        self._adopted = np.full(capacity, UNSEEN, dtype=np.int64)
        """Offset that is reckoned with [ns]; shape (capacity,)."""
        self.epoch_ns = np.zeros(capacity, dtype=np.int64)
        """Begin of step 0 [vehicle's clock]; shape (capacity,)."""

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle, or with a new life of it."""
        self.minimum[row] = UNSEEN
        self._samples[row] = 0
        self._adopted[row] = UNSEEN

    def observe(self, row: int, forward_ns: int, backward_ns: int, *, now_ns: int) -> None:
        """Take one F and one G of a vehicle, received at `now_ns`."""
        _observe(
            self.minimum,
            self._samples,
            self._newest,
            row,
            forward_ns,
            backward_ns,
            now_ns // BUCKET_NS,
        )

    def steps(self, rows: Indices, now_ns: int) -> Indices:
        """Step k of each vehicle at a time of the server's clock; shape (n,)."""
        steps = np.empty(len(rows), dtype=np.int64)
        _steps(
            self.minimum,
            self._samples,
            self._newest,
            self._adopted,
            self.epoch_ns,
            rows,
            now_ns,
            self._dt_ns,
            steps,
        )
        return steps

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus ours, for vehicles observed at least once [ns]; shape (n,)."""
        self.steps(rows, 0)
        return self._adopted[rows]

    def bound_ns(self, row: int) -> int:
        """How far the offset of a vehicle may be off [ns]."""
        return int(plain(half_trip_ns)(self.minimum, row))


@part
def half_trip_ns(minimum: I3, row: int) -> int:
    """Half of the smallest round trip of a vehicle [ns]."""
    return (minimum[row, 0].min() + minimum[row, 1].min()) // 2


@kernel
def _observe(
    minimum: I3, samples: I2, newest: I1, row: int, forward: int, backward: int, bucket: int
) -> None:
    """Take F and G [ns] of a vehicle into the half second `bucket`; changes the arrays in place."""
    for passed in range(max(newest[row] + 1, bucket - BUCKETS + 1), bucket + 1):
        slot = passed % BUCKETS
        minimum[row, 0, slot], minimum[row, 1, slot] = UNSEEN, UNSEEN
        samples[row, slot] = 0
    newest[row] = max(newest[row], bucket)
    slot = bucket % BUCKETS
    minimum[row, 0, slot] = min(minimum[row, 0, slot], forward)
    minimum[row, 1, slot] = min(minimum[row, 1, slot], backward)
    samples[row, slot] += 1


@part
def _change(minimum: I1, newest: int) -> int:
    """Smallest delay of the last 1.5 s, less that of what is older than 4 s [ns]."""
    recent, old = UNSEEN, UNSEEN
    for age in range(BUCKETS):
        value = minimum[(newest - age) % BUCKETS]
        if age < RECENT:
            recent = min(recent, value)
        elif age >= OLD:
            old = min(old, value)
    return recent - old


@part
def _drop_stepped(minimum: I3, samples: I2, newest: I1, row: int) -> None:
    """Keep only what came since, where one of a vehicle's two clocks has stepped."""
    recent, old = 0, 0
    for age in range(BUCKETS):
        count = samples[row, (newest[row] - age) % BUCKETS]
        if age < RECENT:
            recent += count
        elif age >= OLD:
            old += count
    if min(recent, old) < STEP_SAMPLES:
        return
    forward = _change(minimum[row, 0], newest[row])
    backward = _change(minimum[row, 1], newest[row])
    large = min(abs(forward), abs(backward)) > STEP_NS
    if large and abs(forward + backward) < max(STEP_NS, 0.2 * abs(forward)):
        for age in range(RECENT, BUCKETS):
            slot = (newest[row] - age) % BUCKETS
            minimum[row, 0, slot], minimum[row, 1, slot] = UNSEEN, UNSEEN
            samples[row, slot] = 0


@kernel
def _steps(
    minimum: I3,
    samples: I2,
    newest: I1,
    adopted: I1,
    epoch: I1,
    rows: I1,
    now: int,
    dt: int,
    steps: I1,
) -> None:
    """Fill in k of each vehicle, see `ClockMap.steps`; forgets what came before a clock stepped."""
    for i in range(len(rows)):
        row = rows[i]
        _drop_stepped(minimum, samples, newest, row)
        estimate = (minimum[row, 1].min() - minimum[row, 0].min()) // 2
        if adopted[row] == UNSEEN or abs(estimate - adopted[row]) > dt // 2:
            adopted[row] = estimate
        steps[i] = (now + adopted[row] - epoch[row]) // dt
