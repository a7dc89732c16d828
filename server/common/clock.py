"""Clock map: present step of each vehicle, from the server's clock and the vehicle's stamps.

Neither clock is set; the vehicle's is the time since its step 0. Every observation gives
F = t2 - t1 (sent by the vehicle, received here) and tells G = t4 - t3 (sent here, received aboard)
of the newest packet from here. Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2,

vehicle's clock minus server's. Half of any asymmetry of the two smallest delays stays unknown: the
offset is right to within the bound and no better. Step k begins at k Δt of the vehicle.

Beside this estimate stand two bounds that no delay can make false. A delay is never negative, so
the true offset O is at least -F and at most G at the time of each sample, and until another time
changes by no more than DRIFT of what has passed:

    max (-F - DRIFT age) ≤ O ≤ min (G + DRIFT age)

over all samples, however old. They do not depend on the estimate, nor on what it is made of.

What is known from elsewhere narrows these two: an operator's word that the smallest delays of both
directions differ by no more than so much, and the time of day, where both ends know it. It is held
against them, and against itself over time. What is contradicted is not believed any more.
"""

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F1, I1, I2, I3, inline, kernel, part, record, records
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.core.time_of_day import DRIFT
from skytether.shared.law.heartbeat import SESSION_NS
from skytether.shared.law.model import Array, Indices

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


class Contradiction(IntEnum):
    """What a sample contradicts that was known of a vehicle's clock."""

    NOTHING = 0
    CLOCK = 1
    """The bounds by delays: a clock was set, or runs wrong."""
    ASYMMETRY = 2
    """The operator's bound `link.asymmetry_s` on the difference of the delays each way."""
    TIME_OF_DAY = 3
    """The time of day of one end."""


NOTHING, CLOCK, ASYMMETRY, TIME_OF_DAY = map(int, Contradiction)
"""Members of `Contradiction` as plain numbers, for kernels."""


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
    low: int
    """Least that the true offset can be at `bounded` [ns]; -UNSEEN before the first sample."""
    high: int
    """Most that the true offset can be then [ns]; UNSEEN before the first sample."""
    bounded: int
    """Time of our clock at which these two hold; they widen before and after it [ns]."""
    steps: int
    """Number of times that a sample contradicted the bounds: a clock was set, or runs wrong."""
    other_low: int
    """Least that the true offset can be at `other`, as it is known from elsewhere [ns], or
    -UNSEEN."""
    other_high: int
    """Most that it can be then [ns], or UNSEEN."""
    other: int
    """Time of our clock at which these two hold [ns]."""
    doubted: int
    """1 if the time of day was contradicted; then all counts that anybody says."""
    uneven: int
    """1 if the operator's word on the delays was contradicted; then it does not count."""


FORGOTTEN = ("newest", "heard", "echoes", "adopted")
"""Fields of `VehicleClock` that are forgotten with each session."""


class StepError(NamedTuple):
    """Error of the step that the server counts for a vehicle, as far as its clock is known."""

    early: float
    """Largest number of steps by which the vehicle is ahead of the step that is counted."""
    late: float
    """Largest number of steps by which it is behind that."""


EXACT = StepError(0.0, 0.0)
"""Error of a step that is known."""


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

    The smallest delays of the two directions over 20 s differ by at most `asymmetry_ns`; 0: nobody
    knows.

    It follows an estimate of the offset only when that has moved by more than half a step: a step
    index that went back and forth at a boundary would skip and repeat steps for nothing.
    """

    def __init__(self, capacity: int, dt_ns: int, asymmetry_ns: int = 0) -> None:
        self._dt_ns, self._asymmetry_ns = dt_ns, asymmetry_ns
        self.tick_ns = 0
        """Time of our clock that steps were counted for last [ns]."""
        self._lives: list[tuple[int, int] | None] = [None] * capacity
        """Vehicle in each row, and the boot id of its life."""
        self.seen = Seen(
            vehicles=np.zeros(capacity, dtype=VEHICLE_CLOCK),
            minimum=np.empty((capacity, 2, BUCKETS), dtype=np.int64),
            samples=np.empty((capacity, BUCKETS), dtype=np.int64),
            echoes=np.empty((capacity, ECHOES), dtype=np.int64),
        )
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int, life: tuple[int, int] | None = None) -> None:
        """Begin anew with a vehicle, or with a new session of it.

        Args:
            row: the vehicle.
            life: its number and the boot id of its life, in all of which its step 0 is the same:
                bounds that were found earlier in the same life stay true. None where it is not
                known.
        """
        self.seen.minimum[row], self.seen.samples[row] = UNSEEN, 0
        self.seen.echoes[row] = -UNSEEN
        vehicle = self.seen.vehicles[row]
        for name, value in zip(FORGOTTEN, (0, -1, 0, UNSEEN), strict=True):
            vehicle[name] = value
        if life is None or life != self._lives[row]:
            for name in ("low", "other_low"):
                vehicle[name] = -UNSEEN
            for name in ("high", "other_high"):
                vehicle[name] = UNSEEN
            for name in ("bounded", "other", "doubted", "uneven"):
                vehicle[name] = 0
        self._lives[row] = life

    def observe(
        self,
        row: int,
        forward_ns: int,
        backward_ns: int,
        *,
        heard: int,
        now_ns: int,
        is_newest: bool = True,
    ) -> Contradiction:
        """Take one F and one G of a vehicle, received at `now_ns`; what they contradict.

        Args:
            heard: another number for each packet of ours that G is of.
            is_newest: whether they are of a newer observation than all before: of the echo of an
                older one it is not known when it was had.
        """
        sample = forward_ns, backward_ns, heard, is_newest, self._asymmetry_ns, now_ns
        return Contradiction(_observe(self.seen, row, *sample))

    def tell(self, row: int, offset_ns: int, error_ns: int, *, now_ns: int) -> Contradiction:
        """Take the offset of a vehicle's clock as it is known from elsewhere; what it contradicts.

        Args:
            offset_ns: the vehicle's clock minus ours [ns].
            error_ns: largest error of that [ns].
            now_ns: time of our clock [ns].
        """
        low, high = offset_ns - error_ns, offset_ns + error_ns
        return Contradiction(_tell(self.seen, row, low, high, self._asymmetry_ns > 0, now_ns))

    def steps(self, rows: Indices, now_ns: int) -> Indices:
        """Step k of each vehicle at a time of the server's clock; shape (n,)."""
        steps = rows.copy()  # room for them: less work than to make an array of a type
        self.tick_ns = now_ns
        _steps(self.seen, rows, now_ns, self._dt_ns, steps)
        return steps

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus ours, for vehicles observed at least once [ns]; shape (n,)."""
        # Brings `adopted` up to date; the steps themselves are not needed.
        _steps(self.seen, rows, 0, self._dt_ns, rows.copy())
        offsets: Indices = self.seen.vehicles["adopted"][rows]
        return offsets

    @property
    def counts(self) -> dict[str, int]:
        """Number of times that a clock was found to have been set, if ever."""
        steps = int(self.seen.vehicles["steps"].sum())
        return {"clock_steps": steps} if steps else {}

    def step_errors(self, rows: Indices, steps: Indices, early: Array, late: Array) -> None:
        """Fill in the error of the steps that were counted for vehicles last, see `StepError`.

        Args:
            rows, steps: as given to and by `steps`; shape (n,).
            early, late: written to at the rows; shape (capacity,).
        """
        _step_errors(self.seen, rows, steps, self.tick_ns, self._dt_ns, early, late)

    def bound_ns(self, row: int) -> int:
        """Half of what the true offset of a vehicle's clock can lie apart, now [ns]."""
        return self.middle_ns(row, self.tick_ns)[1]

    def middle_ns(self, row: int, now_ns: int) -> tuple[int, int]:
        """Middle between the bounds of the offset of a vehicle's clock, and half of what is
        between them [ns].
        """
        found = np.empty(2, dtype=np.int64)
        _bounds(self.seen, row, now_ns, found)
        low, high = found.tolist()
        return (high + low) // 2, (high - low) // 2


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


@part
def _by_delays(seen: Seen, row: int, now: int) -> tuple[int, int]:
    """Least and most that the offset of a vehicle's clock can be, by delays alone [ns]."""
    vehicle = seen.vehicles[row]
    apart = abs(now - vehicle.bounded) // DRIFT + 1
    return vehicle.low - apart, vehicle.high + apart


@part
def _by_others(seen: Seen, row: int, now: int) -> tuple[int, int]:
    """Least and most that the offset of a vehicle's clock can be, as known from elsewhere [ns]."""
    vehicle = seen.vehicles[row]
    apart = abs(now - vehicle.other) // DRIFT + 1 if vehicle.other_high < UNSEEN else 0
    return vehicle.other_low - apart, vehicle.other_high + apart


@part
def bounds_ns(seen: Seen, row: int, now: int) -> tuple[int, int]:
    """Least and most that the offset of a vehicle's clock can be at a time of ours [ns]."""
    low, high = _by_delays(seen, row, now)
    other_low, other_high = _by_others(seen, row, now)
    if seen.vehicles[row].doubted or max(low, other_low) > min(high, other_high):
        # One of the two is false, and nobody knows which.
        return min(low, other_low), max(high, other_high)
    return max(low, other_low), min(high, other_high)


@kernel
def _bounds(seen: Seen, row: int, now: int, found: I1) -> None:
    """Write down `bounds_ns`."""
    found[0], found[1] = bounds_ns(seen, row, now)


@part
def _add(seen: Seen, row: int, low: int, high: int, now: int) -> bool:
    """Narrow what is known from elsewhere; whether that is possible. It is forgotten if not."""
    vehicle = seen.vehicles[row]
    other_low, other_high = _by_others(seen, row, now)
    trip_low, trip_high = _by_delays(seen, row, now)
    low, high = max(low, other_low), min(high, other_high)
    possible = low <= high and max(low, trip_low) <= min(high, trip_high)
    if not possible:
        low, high = -UNSEEN, UNSEEN
    vehicle.other_low, vehicle.other_high, vehicle.other = low, high, now
    return possible


@kernel
def _tell(seen: Seen, row: int, low: int, high: int, asymmetric: bool, now: int) -> int:
    """Take what the time of day says, see `ClockMap.tell`."""
    vehicle = seen.vehicles[row]
    if vehicle.doubted:
        other_low, other_high = _by_others(seen, row, now)
        vehicle.other_low, vehicle.other_high = min(low, other_low), max(high, other_high)
        vehicle.other = now
        return NOTHING
    if _add(seen, row, low, high, now):
        return NOTHING
    if asymmetric and not vehicle.uneven:
        vehicle.uneven = 1
        if _add(seen, row, low, high, now):
            return ASYMMETRY
    vehicle.doubted = 1
    vehicle.other_low, vehicle.other_high, vehicle.other = low, high, now
    return TIME_OF_DAY


@part
def _believe_even(seen: Seen, row: int, asymmetry: int, now: int) -> int:
    """Take the operator's word that delays differ by at most `asymmetry` [ns]; see `_observe`."""
    vehicle, samples = seen.vehicles[row], 0
    for slot in range(BUCKETS):
        samples += seen.samples[row, slot]
    if asymmetry == 0 or vehicle.uneven or vehicle.doubted or samples < STEP_SAMPLES:
        return NOTHING
    # The minima are up to 20 s old.
    room = asymmetry // 2 + BUCKETS * BUCKET_NS // DRIFT
    middle = (least(seen.minimum[row, 1]) - least(seen.minimum[row, 0])) // 2
    if _add(seen, row, middle - room, middle + room, now):
        return NOTHING
    vehicle.uneven = 1
    return ASYMMETRY


@part
def _bound(seen: Seen, row: int, forward: int, backward: int, is_new: bool, now: int) -> int:
    """Narrow the bounds of a vehicle's clock offset by F and G [ns]; what these contradict.

    Args:
        is_new: whether G is of an echo that no observation before has told of.
        now: our time [ns].
    """
    vehicle = seen.vehicles[row]
    low, high = _by_delays(seen, row, now)
    # F is as old as the observation, which is no older than the round trip. Of an echo it is known
    # that the observation before did not tell of it yet, and that of the first one the session has
    # not ended since.
    trip = max(forward + backward, 0) // DRIFT + 1
    since = now - vehicle.bounded if vehicle.high < UNSEEN else SESSION_NS
    low = max(low, -forward - trip)
    if is_new:
        high = min(high, backward + trip + max(since, 0) // DRIFT)
    found = CLOCK if low > high else NOTHING
    if found == CLOCK:
        # Nothing earlier holds any more. By the round trip the newest sample may be one of less
        # than nothing, of a clock that was set in between.
        vehicle.steps += 1
        low, high = min(-forward, backward) - trip, max(-forward, backward) + trip
        vehicle.other_low, vehicle.other_high = -UNSEEN, UNSEEN
    vehicle.low, vehicle.high, vehicle.bounded = low, high, now
    return found


@kernel
def _observe(
    seen: Seen,
    row: int,
    forward: int,
    backward: int,
    heard: int,
    is_newest: bool,
    asymmetry: int,
    now: int,
) -> int:
    """Take F and G [ns] of a vehicle, received at a time of our clock [ns]; what they
    contradict.
    """
    vehicle, bucket = seen.vehicles[row], now // BUCKET_NS
    is_new = is_newest and heard != vehicle.heard
    found = _bound(seen, row, forward, backward, is_new, now)
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
    uneven = _believe_even(seen, row, asymmetry, now)
    return found if found != NOTHING else uneven


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
        if not vehicle["doubted"]:
            estimate = min(max(estimate, vehicle["other_low"]), vehicle["other_high"])
        if vehicle["adopted"] == UNSEEN or abs(estimate - vehicle["adopted"]) > dt // 2:
            vehicle["adopted"] = estimate
        steps[i] = (now + vehicle["adopted"]) // dt


@kernel
def _step_errors(seen: Seen, rows: I1, steps: I1, now: int, dt: int, early: F1, late: F1) -> None:
    """Fill in `ClockMap.step_errors`."""
    for i in range(len(rows)):
        low, high = bounds_ns(seen, rows[i], now)
        # Less the whole steps first: two times of years in nanoseconds have no digits left.
        early[rows[i]] = (now + high - steps[i] * dt) / dt
        late[rows[i]] = (steps[i] * dt - now - low) / dt
