"""Clock map: present step of each vehicle, from the server's clock and the vehicle's stamps.

Neither clock is set; the vehicle's is the time since its step 0. Every observation gives
F = t2 - t1 (sent by the vehicle, received here) and tells G = t4 - t3 (sent here, received aboard)
of the newest packet from here. Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2,

vehicle's clock minus server's. Half of any asymmetry of the two smallest delays stays unknown: the
offset is right to within the bound and no better. Step k begins at k Δt of the vehicle.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import I1, I2, I3, inline, kernel, part, record, records
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Indices

BUCKET_NS = SECOND_NS // 2
"""Length of the half seconds for which minima are kept [ns]."""
BUCKETS = 40
"""Half seconds for which minima are kept: 20 s."""
RECENT = 3
"""Half seconds that are recent, where a step of a clock is looked for; more, up to OLD, of a
vehicle that says so little that they would hold fewer than STEP_SAMPLES."""
OLD = 8
"""Half seconds after which minima are old enough to compare the recent ones with."""
STEP_SAMPLES = 5
"""Samples that recent and old minima need each before a clock may be said to have stepped."""
STEP_NS = 40 * MILLISECOND_NS
"""Smallest step of a clock: up in one direction, and down by about as much in the other [ns]."""

ECHOES = 4
"""Number of newest echoes that are kept of a vehicle: how long packets to it take just now."""

# Two of them added stay within an int64, so that sums of minima need no check.
UNSEEN = 2**61
"""Minimum of a half second in which nothing was seen."""


class VehicleClock:
    """Record: the clock of one vehicle."""

    newest: int
    """Half second of its newest sample, since our clock's zero."""
    heard: int
    """`Observation.heard` of its newest observation; -1 before the first."""
    echoes: int
    """Number of packets of ours that it has told G of."""
    adopted: int
    """Offset that is reckoned with, the vehicle's clock minus ours [ns], or UNSEEN."""


VEHICLE_CLOCK = record(VehicleClock)


class Seen(NamedTuple):
    """Clock offsets and delays observed for up to `capacity` vehicles."""

    vehicles: Annotated[NDArray[np.void], records(VEHICLE_CLOCK, 1)]
    """Shape (capacity,)."""
    minimum: I3
    """Smallest F and G of each half second [ns], a ring; shape (capacity, 2, BUCKETS)."""
    samples: I2
    """Number of both in each half second; shape (capacity, BUCKETS)."""
    echoes: I2
    """Newest G, each of another packet of ours [ns], a ring; shape (capacity, ECHOES)."""


class ClockMap:
    """Offsets and steps of up to `capacity` vehicles.

    It follows an estimate of the offset only when that has moved by more than half a step: a step
    index that went back and forth at a boundary would skip and repeat steps for nothing.
    """

    def __init__(self, capacity: int, dt_ns: int) -> None:
        self._dt_ns = dt_ns
        self.seen = Seen(
            vehicles=np.zeros(capacity, dtype=VEHICLE_CLOCK),
            minimum=np.empty((capacity, 2, BUCKETS), dtype=np.int64),
            samples=np.empty((capacity, BUCKETS), dtype=np.int64),
            echoes=np.empty((capacity, ECHOES), dtype=np.int64),
        )
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle, or with a new life of it."""
        self.seen.minimum[row], self.seen.samples[row] = UNSEEN, 0
        self.seen.echoes[row] = -UNSEEN
        self.seen.vehicles[row] = (0, -1, 0, UNSEEN)

    def observe(
        self, row: int, forward_ns: int, backward_ns: int, *, heard: int, now_ns: int
    ) -> None:
        """Take one F and one G of a vehicle, received at `now_ns`.

        Args:
            heard: another number for each packet of ours that G is of.
        """
        _observe(self.seen, row, forward_ns, backward_ns, heard, now_ns // BUCKET_NS)

    def steps(self, rows: Indices, now_ns: int) -> Indices:
        """Step k of each vehicle at a time of the server's clock; shape (n,)."""
        steps = rows.copy()  # room for them: less work than to make an array of a type
        _steps(self.seen, rows, now_ns, self._dt_ns, steps)
        return steps

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus ours, for vehicles observed at least once [ns]; shape (n,)."""
        # Brings `adopted` up to date; the steps themselves are not needed.
        self.steps(rows, 0)
        offsets: Indices = self.seen.vehicles["adopted"][rows]
        return offsets

    def bound_ns(self, row: int) -> int:
        """Bound of the error of a vehicle's clock offset [ns]: `half_trip_ns`."""
        # Not by that part: called from Python, what it calls would be compiled in flight.
        forward, backward = self.seen.minimum[row].min(axis=1).tolist()
        return (forward + backward) // 2


@inline
def least(values: I1) -> int:
    """Least of some numbers."""
    found = values[0]
    for value in values:
        found = min(found, value)
    return found


@part
def half_trip_ns(seen: Seen, row: int) -> int:
    """Half of the smallest round trip of a vehicle [ns]."""
    return (least(seen.minimum[row, 0]) + least(seen.minimum[row, 1])) // 2


@part
def shortest_ns(seen: Seen, row: int) -> int:
    """Shortest of the delays of the newest ECHOES packets to a vehicle, as the map knows it [ns].

    It is negative while there are fewer.
    """
    return least(seen.echoes[row]) - seen.vehicles[row]["adopted"]


@kernel
def _observe(seen: Seen, row: int, forward: int, backward: int, heard: int, bucket: int) -> None:
    """Take F and G [ns] of a vehicle into the half second `bucket`."""
    vehicle = seen.vehicles[row]
    # The same echo told once more is no new sample of the delay.
    if heard != vehicle.heard:
        vehicle.heard = heard
        seen.echoes[row, vehicle.echoes % ECHOES] = backward
        vehicle.echoes += 1
    # At most once round the ring, however long the vehicle was silent.
    for passed in range(max(vehicle.newest + 1, bucket - BUCKETS + 1), bucket + 1):
        slot = passed % BUCKETS
        seen.minimum[row, 0, slot], seen.minimum[row, 1, slot] = UNSEEN, UNSEEN
        seen.samples[row, slot] = 0
    vehicle.newest = max(vehicle.newest, bucket)
    slot = bucket % BUCKETS
    seen.minimum[row, 0, slot] = min(seen.minimum[row, 0, slot], forward)
    seen.minimum[row, 1, slot] = min(seen.minimum[row, 1, slot], backward)
    seen.samples[row, slot] += 1


@part
def _change(minimum: I1, newest: int, recently: int) -> int:
    """Smallest delay of what is recent, less that of what is older than 4 s [ns]."""
    recent, old = UNSEEN, UNSEEN
    for age in range(BUCKETS):
        value = minimum[(newest - age) % BUCKETS]
        if age < recently:
            recent = min(recent, value)
        elif age >= OLD:
            old = min(old, value)
    return recent - old


@part
def _drop_stepped(seen: Seen, row: int) -> None:
    """Forget the minima of before a step of the vehicle's clock or ours, where there was one."""
    recent, old, newest, recently = 0, 0, seen.vehicles[row]["newest"], RECENT
    for age in range(BUCKETS):
        count = seen.samples[row, (newest - age) % BUCKETS]
        if age < RECENT or (age < OLD and recent < STEP_SAMPLES):
            recent, recently = recent + count, age + 1
        elif age >= OLD:
            old += count
    # Of a few samples, one that was delayed would look like a step.
    if min(recent, old) < STEP_SAMPLES:
        return
    forward = _change(seen.minimum[row, 0], newest, recently)
    backward = _change(seen.minimum[row, 1], newest, recently)
    # A clock that steps moves one of the two up and the other down by as much; a network that
    # changes moves both the same way, or one alone.
    large = min(abs(forward), abs(backward)) > STEP_NS
    if large and abs(forward + backward) < max(STEP_NS, 0.2 * abs(forward)):
        for age in range(recently, BUCKETS):
            slot = (newest - age) % BUCKETS
            seen.minimum[row, 0, slot], seen.minimum[row, 1, slot] = UNSEEN, UNSEEN
            seen.samples[row, slot] = 0


@kernel
def _steps(seen: Seen, rows: I1, now: int, dt: int, steps: I1) -> None:
    """Fill in k of each vehicle, see `ClockMap.steps`; forgets what came before a clock stepped."""
    for i in range(len(rows)):
        row = rows[i]
        _drop_stepped(seen, row)
        estimate = (least(seen.minimum[row, 1]) - least(seen.minimum[row, 0])) // 2
        vehicle = seen.vehicles[row]
        if vehicle["adopted"] == UNSEEN or abs(estimate - vehicle["adopted"]) > dt // 2:
            vehicle["adopted"] = estimate
        steps[i] = (now + vehicle["adopted"]) // dt
