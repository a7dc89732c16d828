"""Clock map: present step of each vehicle, from the server's clock and the vehicle's time stamps.

Neither clock is adjusted; the vehicle's clock counts from its step 0. Every observation gives F,
its reception time (server) minus its sending time (vehicle), and contains G, the reception time
(vehicle) minus the sending time (server) of the server's newest packet. Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2

where the offset is the vehicle's clock minus the server's, and the bound is the largest error of
this estimate, because the two smallest delays may differ. Step k begins at k Δt of the vehicle's
clock.

Independently of this estimate there are two bounds that hold for any delays. A delay is never
negative, so the true offset O is at least -F and at most G at the time of each sample, and changes
by at most DRIFT of the elapsed time:

    max (-F - DRIFT age) ≤ O ≤ min (G + DRIFT age)

over all samples of any age.

The bounds are narrowed by `link.asymmetry_s`, the operator's bound on the difference of the
smallest delays of the two directions, and by the time of day if both ends know it. Each new value
is checked against the bounds from delays and against all earlier values of the two. After a
contradiction `link.asymmetry_s` is no longer used. If the time of day contradicts the bounds even
without `link.asymmetry_s`, the bounds become wider: from then on they include both the bounds from
delays and the bounds from the time of day.
"""

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F1, I1, I2, I3, inline, kernel, part, record, records
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.time_of_day import DRIFT
from skytether.shared.law.heartbeat import SESSION_NS
from skytether.shared.law.model import Array, Indices

BUCKET_NS = SECOND_NS // 2
"""Length of the intervals whose smallest F and G are stored [ns]."""
BUCKETS = 40
RECENT = 3
"""Number of newest intervals that count as recent when looking for a step of a clock. If they hold
fewer than STEP_SAMPLES samples, since the vehicle reports rarely, up to OLD intervals count."""
OLD = 8
"""A recent minimum of F or G is compared only with minima at least this old [intervals]."""
STEP_SAMPLES = 5
"""Number of samples needed in both recent and old minima to detect a step of a clock."""
STEP_NS = 40 * MILLISECOND_NS
"""Smallest step of a clock that is detected [ns]. A step raises the estimated delay of one
direction and lowers that of the other direction by as much."""

ECHOES = 4
"""Number of newest G stored for each vehicle, to estimate the present uplink delay."""

# 2 * UNSEEN fits in an int64, so sums of two minima need no check.
UNSEEN = 2**61
"""Minimum of an interval without samples."""


class Contradiction(IntEnum):
    """Earlier bound of a clock offset that a new sample contradicts, by the bound's source."""

    NOTHING = 0
    CLOCK = 1
    """The sample contradicts the bounds from delays: a clock was set, or runs at a wrong rate."""
    ASYMMETRY = 2
    """The sample contradicts `link.asymmetry_s`, the operator's bound on delay differences."""
    TIME_OF_DAY = 3
    """The time of day of one end contradicts the clock offset."""


NOTHING, CLOCK, ASYMMETRY, TIME_OF_DAY = map(int, Contradiction)


class VehicleClock:
    """Numpy record: clock of one vehicle."""

    newest: int
    """Interval of the newest sample, counted from zero of the server's clock."""
    heard: int
    """Number of the server's packets that had arrived aboard at the newest observation
    (`Observation.heard`); -1 before the first."""
    echoes: int
    """Number of the server's packets for which the vehicle has reported G."""
    adopted: int
    """Offset in use, the vehicle's clock minus the server's [ns], or UNSEEN."""
    low: int
    """Lower bound of the true offset at `bounded` [ns]; -UNSEEN before the first sample."""
    high: int
    """Upper bound of the true offset at `bounded` [ns]; UNSEEN before the first sample."""
    bounded: int
    """Server's time at which `low` and `high` hold [ns]; the bounds at other times are wider."""
    sent: int
    """Earliest time at which the newest observation can have been sent, by the server's clock [ns];
    UNSEEN before the first."""
    echo: int
    """Value of `heard` at the newest observation that arrived in order; -1 before the first."""
    echoed: int
    """Earliest possible arrival aboard of packet number `echo`, by the server's clock [ns]."""
    steps: int
    """Number of times that a sample contradicted the bounds from delays."""
    other_low: int
    """Lower bound of the true offset at the time `other` [ns], from `link.asymmetry_s` and the time
    of day; -UNSEEN if there is none."""
    other_high: int
    """Upper bound of the true offset at the time `other` [ns], from `link.asymmetry_s` and the time
    of day; UNSEEN if there is none."""
    other: int
    """Server's time at which `other_low` and `other_high` hold [ns]."""
    doubted: int
    """1 once the time of day has contradicted the bounds from delays, or its own earlier values.
    From then on the offset's bounds are the wider ones that include both."""
    uneven: int
    """1 if the operator's bound on the delays was contradicted, and is no longer used."""


FORGOTTEN = ("newest", "heard", "echoes", "adopted", "sent", "echo")
"""Fields of `VehicleClock` that are reset with each session."""


class StepError(NamedTuple):
    early: float
    """Number of steps by which the vehicle may be ahead of its step by the server's count."""
    late: float
    """Number of steps by which the vehicle may be behind its step by the server's count."""


EXACT = StepError(0.0, 0.0)


VEHICLE_CLOCK = record(VehicleClock)


class Seen(NamedTuple):
    """Clock samples of up to `capacity` vehicles."""

    vehicles: Annotated[NDArray[np.void], records(VEHICLE_CLOCK, 1)]
    """Clock of each vehicle; shape (capacity,)."""
    minimum: I3
    """Smallest F and G of each interval [ns], as a ring; shape (capacity, 2, BUCKETS)."""
    samples: I2
    """Number of samples in each interval; shape (capacity, BUCKETS)."""
    echoes: I2
    """Newest G, one per packet of the server [ns], as a ring; shape (capacity, ECHOES)."""


class ClockMap:
    """Clock offsets and present steps of up to `capacity` vehicles.

    The offset in use is set to the estimate only when the two differ by more than half a step.
    Otherwise the step number could alternate at a boundary, and steps would be skipped or repeated.

    Args:
        asymmetry_ns: bound on the difference of the smallest delays of the two directions over 20 s
            [ns]; 0: unknown.
    """

    def __init__(self, capacity: int, dt_ns: int, asymmetry_ns: int = 0) -> None:
        self._dt_ns, self._asymmetry_ns = dt_ns, asymmetry_ns
        self.tick_ns = 0
        """Server's time at which steps were last counted [ns]."""
        self._lives: list[tuple[int, int] | None] = [None] * capacity
        """Number of the vehicle in each row, and the boot id of the vehicle's client."""
        self.seen = Seen(
            vehicles=np.zeros(capacity, dtype=VEHICLE_CLOCK),
            minimum=np.empty((capacity, 2, BUCKETS), dtype=np.int64),
            samples=np.empty((capacity, BUCKETS), dtype=np.int64),
            echoes=np.empty((capacity, ECHOES), dtype=np.int64),
        )
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int, life: tuple[int, int] | None = None) -> None:
        """Reset the row for another vehicle, or for a new session.

        Args:
            life: the vehicle's number and its client's boot id, or None if unknown. If both are
                unchanged, so is the vehicle's step 0, and bounds found earlier remain valid.
        """
        self.seen.minimum[row], self.seen.samples[row] = UNSEEN, 0
        self.seen.echoes[row] = -UNSEEN
        vehicle = self.seen.vehicles[row]
        for name, value in zip(FORGOTTEN, (0, -1, 0, UNSEEN, UNSEEN, -1), strict=True):
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
        """Add one F and one G of a vehicle; returns the bound that they contradict.

        Args:
            forward_ns: F [ns].
            backward_ns: G [ns].
            heard: number of the server's packets that have arrived aboard, including that of G.
            now_ns: server's time of reception [ns].
            is_newest: whether the observation is the vehicle's newest; the age of the G in an older
                observation is unknown.
        """
        sample = forward_ns, backward_ns, heard, is_newest, self._asymmetry_ns, now_ns
        return Contradiction(_observe(self.seen, row, *sample))

    def tell(self, row: int, offset_ns: int, error_ns: int, *, now_ns: int) -> Contradiction:
        """Narrow the bounds of a vehicle's clock offset by its time of day; returns the
        contradiction.

        Args:
            offset_ns: the vehicle's clock minus the server's [ns].
            error_ns: largest error of the offset [ns].
            now_ns: server's time [ns].
        """
        low, high = offset_ns - error_ns, offset_ns + error_ns
        return Contradiction(
            _narrow_by_time(self.seen, row, low, high, self._asymmetry_ns > 0, now_ns)
        )

    def steps(self, rows: Indices, now_ns: int) -> Indices:
        """Step k of each vehicle at a time of the server's clock; shape (n,)."""
        steps = rows.copy()  # overwritten below: a copy is cheaper than a new array
        self.tick_ns = now_ns
        _steps(self.seen, rows, now_ns, self._dt_ns, steps)
        return steps

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus the server's, for observed vehicles [ns]; shape (n,)."""
        # The call updates `adopted`; its result is not needed.
        _steps(self.seen, rows, 0, self._dt_ns, rows.copy())
        offsets: Indices = self.seen.vehicles["adopted"][rows]
        return offsets

    @property
    def counts(self) -> dict[str, int]:
        steps = int(self.seen.vehicles["steps"].sum())
        return {"clock_steps": steps} if steps else {}

    def step_errors(self, rows: Indices, steps: Indices, early: Array, late: Array) -> None:
        """Fill in the `StepError` of the latest step numbers, at `rows` of `early` and `late`."""
        _step_errors(self.seen, rows, steps, self.tick_ns, self._dt_ns, early, late)

    def bound_ns(self, row: int) -> int:
        """Half of the width of the bounds of a vehicle's clock offset at the last tick [ns]."""
        return self.middle_ns(row, self.tick_ns)[1]

    def middle_ns(self, row: int, now_ns: int) -> tuple[int, int]:
        """Midpoint of the bounds of a vehicle's clock offset, and half of their width [ns]."""
        bounds = np.empty(2, dtype=np.int64)
        _bounds(self.seen, row, now_ns, bounds)
        low, high = bounds.tolist()
        return (high + low) // 2, (high - low) // 2


@inline
def least(values: I1) -> int:
    smallest = values[0]
    for value in values:
        smallest = min(smallest, value)
    return smallest


@part
def half_trip_ns(seen: Seen, row: int) -> int:
    """Half of the smallest round trip of a vehicle [ns]."""
    return (least(seen.minimum[row, 0]) + least(seen.minimum[row, 1])) // 2


@part
def shortest_ns(seen: Seen, row: int) -> int:
    """Shortest estimated uplink delay of the last ECHOES packets [ns]; negative if fewer came."""
    return least(seen.echoes[row]) - seen.vehicles[row]["adopted"]


@part
def _by_delays(seen: Seen, row: int, now: int) -> tuple[int, int]:
    vehicle = seen.vehicles[row]
    drift = abs(now - vehicle.bounded) // DRIFT + 1
    return vehicle.low - drift, vehicle.high + drift


@part
def _by_others(seen: Seen, row: int, now: int) -> tuple[int, int]:
    """Bounds of a vehicle's clock offset from `link.asymmetry_s` and the time of day [ns]."""
    vehicle = seen.vehicles[row]
    drift = abs(now - vehicle.other) // DRIFT + 1 if vehicle.other_high < UNSEEN else 0
    return vehicle.other_low - drift, vehicle.other_high + drift


@part
def bounds_ns(seen: Seen, row: int, now: int) -> tuple[int, int]:
    """Bounds of a vehicle's clock offset at a time of the server's clock [ns]."""
    low, high = _by_delays(seen, row, now)
    other_low, other_high = _by_others(seen, row, now)
    if seen.vehicles[row].doubted or max(low, other_low) > min(high, other_high):
        # One of the two bounds is wrong, and it is unknown which one.
        return min(low, other_low), max(high, other_high)
    return max(low, other_low), min(high, other_high)


@kernel
def _bounds(seen: Seen, row: int, now: int, bounds: I1) -> None:
    bounds[0], bounds[1] = bounds_ns(seen, row, now)


@part
def _narrow(seen: Seen, row: int, low: int, high: int, now: int) -> bool:
    """Narrow `other_low` and `other_high` [ns]; on a contradiction reset both and return False."""
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
def _narrow_by_time(seen: Seen, row: int, low: int, high: int, asymmetric: bool, now: int) -> int:
    vehicle = seen.vehicles[row]
    if vehicle.doubted:
        other_low, other_high = _by_others(seen, row, now)
        vehicle.other_low, vehicle.other_high = min(low, other_low), max(high, other_high)
        vehicle.other = now
        return NOTHING
    if _narrow(seen, row, low, high, now):
        return NOTHING
    if asymmetric and not vehicle.uneven:
        vehicle.uneven = 1
        if _narrow(seen, row, low, high, now):
            return ASYMMETRY
    vehicle.doubted = 1
    vehicle.other_low, vehicle.other_high, vehicle.other = low, high, now
    return TIME_OF_DAY


@part
def _narrow_by_asymmetry(seen: Seen, row: int, asymmetry: int, now: int) -> int:
    vehicle, samples = seen.vehicles[row], 0
    for slot in range(BUCKETS):
        samples += seen.samples[row, slot]
    if asymmetry == 0 or vehicle.uneven or vehicle.doubted or samples < STEP_SAMPLES:
        return NOTHING
    # The clocks may have drifted since the minima, which are up to 20 s old.
    margin = asymmetry // 2 + BUCKETS * BUCKET_NS // DRIFT
    middle = (least(seen.minimum[row, 1]) - least(seen.minimum[row, 0])) // 2
    if _narrow(seen, row, middle - margin, middle + margin, now):
        return NOTHING
    vehicle.uneven = 1
    return ASYMMETRY


@part
def _bound(
    seen: Seen, row: int, forward: int, backward: int, heard: int, is_newest: bool, now: int
) -> int:
    """Narrow the bounds of a clock offset by F and G [ns]; returns a `Contradiction`."""
    vehicle = seen.vehicles[row]
    low, high = _by_delays(seen, row, now)
    # A newly reported packet arrived aboard after the previous observation was sent. If the time of
    # sending is unknown, or the observation was overtaken, the packet is at most SESSION_NS old.
    is_new = is_newest and heard != vehicle.echo
    if is_new:
        vehicle.echoed = vehicle.sent if vehicle.sent < UNSEEN else now - SESSION_NS
        vehicle.echo = heard
    age = max(now - vehicle.echoed, 0) if heard == vehicle.echo else SESSION_NS
    # The age of F is the observation's delay: at most the round trip, plus the drift of the clocks
    # that measure the round trip.
    trip = max(forward + backward, 0) + age // DRIFT + 1
    low = max(low, -forward - trip // DRIFT - 1)
    if is_new:
        high = min(high, backward + age // DRIFT + 1)
    if is_newest:
        vehicle.sent = now - trip
    contradiction = CLOCK if low > high else NOTHING
    if contradiction == CLOCK:
        # All earlier bounds are void. If a clock was set since the earlier samples, the round trip
        # of the newest sample may be negative.
        vehicle.steps += 1
        drift = max(age, trip) // DRIFT + 1
        low, high = min(-forward, backward) - drift, max(-forward, backward) + drift
        vehicle.other_low, vehicle.other_high = -UNSEEN, UNSEEN
    vehicle.low, vehicle.high, vehicle.bounded = low, high, now
    return contradiction


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
    vehicle, bucket = seen.vehicles[row], now // BUCKET_NS
    contradiction = _bound(seen, row, forward, backward, heard, is_newest, now)
    # A packet reported again is no new sample of the delay.
    if heard != vehicle.heard:
        vehicle.heard = heard
        seen.echoes[row, vehicle.echoes % ECHOES] = backward
        vehicle.echoes += 1
    # The loop goes around the ring once at most, even after a long time without observations.
    for passed in range(max(vehicle.newest + 1, bucket - BUCKETS + 1), bucket + 1):
        slot = passed % BUCKETS
        seen.minimum[row, 0, slot], seen.minimum[row, 1, slot] = UNSEEN, UNSEEN
        seen.samples[row, slot] = 0
    vehicle.newest = max(vehicle.newest, bucket)
    slot = bucket % BUCKETS
    seen.minimum[row, 0, slot] = min(seen.minimum[row, 0, slot], forward)
    seen.minimum[row, 1, slot] = min(seen.minimum[row, 1, slot], backward)
    seen.samples[row, slot] += 1
    uneven = _narrow_by_asymmetry(seen, row, asymmetry, now)
    return contradiction if contradiction != NOTHING else uneven


@part
def _change(minimum: I1, newest: int, recently: int) -> int:
    """Smallest recent delay minus the smallest delay older than OLD intervals [ns]."""
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
    """Drop minima from before a step of the vehicle's clock or the server's, if there was one."""
    recent, old, newest, recently = 0, 0, seen.vehicles[row]["newest"], RECENT
    for age in range(BUCKETS):
        count = seen.samples[row, (newest - age) % BUCKETS]
        if age < RECENT or (age < OLD and recent < STEP_SAMPLES):
            recent, recently = recent + count, age + 1
        elif age >= OLD:
            old += count
    # With few samples, a single late sample would look like a step.
    if min(recent, old) < STEP_SAMPLES:
        return
    forward = _change(seen.minimum[row, 0], newest, recently)
    backward = _change(seen.minimum[row, 1], newest, recently)
    # A step of a clock raises the estimated delay of one direction and lowers the other by as much;
    # a change of the network affects one direction, or both alike.
    large = min(abs(forward), abs(backward)) > STEP_NS
    if large and abs(forward + backward) < max(STEP_NS, 0.2 * abs(forward)):
        for age in range(recently, BUCKETS):
            slot = (newest - age) % BUCKETS
            seen.minimum[row, 0, slot], seen.minimum[row, 1, slot] = UNSEEN, UNSEEN
            seen.samples[row, slot] = 0


@kernel
def _steps(seen: Seen, rows: I1, now: int, dt: int, steps: I1) -> None:
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
    for i in range(len(rows)):
        low, high = bounds_ns(seen, rows[i], now)
        # Subtract whole steps first: floats are too imprecise for years in nanoseconds.
        early[rows[i]] = (now + high - steps[i] * dt) / dt
        late[rows[i]] = (steps[i] * dt - now - low) / dt
