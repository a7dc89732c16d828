"""Measurements of an autopilot or a robot on the client's clock, in order and without repeats."""

import math
from collections import Counter, deque

import msgspec

from skytether.client.clock import BootClock
from skytether.client.navigation import Leaps
from skytether.client.vehicle import Measurement, VehicleMemory
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.scenario.reference import FAR_M
from skytether.shared.scenario.schema import Scenario

WAITING_MAX = 64
"""Largest number of measurements that wait to be read; older ones are dropped."""
AHEAD_NS = 20 * MILLISECOND_NS
"""Time by which a stamp may lie in the future because of clock errors; stamps further ahead are
dropped."""
OLD_NS = SECOND_NS
"""Largest age of a measurement that is used, for an autopilot aboard."""
RECALLED_MAX_NS = 600 * SECOND_NS
"""Longest time for which an origin saved by an earlier run stays valid."""
REBOOT_NS = SECOND_NS
"""Allowed difference between the times that have passed on the autopilot's and the host's clock
since the origin was saved, in addition to their drift."""
DRIFT_PARTS = 40
"""Inverse of the allowed drift of these two clocks: 1/40 = 2.5 %."""
SPEED_MAX = 1e3
"""Largest speed on an axis that is accepted [m/s]."""

FAULTS = {
    "not_finite": "they are not finite",
    "far": "they are impossibly far away or fast",
    "unsynchronised": "the autopilot's clock is not known",
    "doubled": "they arrive twice",
    "impossible": "their stamps lie in the future",
    "old": f"they are older than {OLD_NS / SECOND_NS:g} s",
    "late": "older ones arrive after newer ones",
}

Vector = tuple[float, float, float]


def take_off_place(scenario: Scenario, vehicle: int) -> Vector:
    """Position of take-off in the scenario's frame [m]; on a mission, below the vehicle's start."""
    if not scenario.keeps_apart:
        return 0.0, 0.0, 0.0
    x, y = scenario.start_m(vehicle)[:2].tolist()
    return x, y, 0.0


class Positions:
    """Positions and velocities reported by the autopilot.

    Args:
        axes: number of axes that are flown, 2 or 3.
        clock: the autopilot's clock.
        old_ns: age above which a measurement is dropped [ns].
        start: position of take-off in the scenario's frame, used by `begin` [m].
        origin: origin of the scenario's frame in the autopilot's local frame, z up [m]; None if
            `begin` sets it.
        leaps: leap detection; None: leaps are not detected.
    """

    def __init__(
        self,
        axes: int,
        clock: BootClock,
        old_ns: int = OLD_NS,
        start: Vector = (0.0, 0.0, 0.0),
        origin: Vector | None = (0.0, 0.0, 0.0),
        leaps: Leaps | None = None,
    ) -> None:
        self._axes, self._clock, self._old_ns, self._start = axes, clock, old_ns, start
        self._waiting: deque[Measurement] = deque(maxlen=WAITING_MAX)
        self._newest_boot_ns = -1
        self._newest_ns: int | None = None
        """Stamp of the newest measurement [ns; the client's clock]."""
        self._leaps = leaps
        self.is_flown = False
        """Whether the pilot flies by these measurements; otherwise leaps have no effect."""
        self.leap_m: Vector | None = None
        """Displacement of the position about which no operator has decided yet, z up [m]; None
        without a leap. The origin has been displaced by the same vector, so the vehicle keeps its
        old frame."""
        self._jumps = 0
        self.origin: Vector = origin or (0.0, 0.0, 0.0)
        """Origin of the scenario's frame in the autopilot's local frame, z up [m]."""
        self.has_origin = origin is not None
        self.is_recalled = False
        """Whether the origin was saved by an earlier run since this boot of the autopilot."""
        self._recalled: VehicleMemory | None = None
        """Saved state of an earlier run, until it is known whether the autopilot has rebooted."""
        self._boot_ns = 0
        """Time from the autopilot's boot to the newest measurement that was used [ns]."""
        self.position: Vector | None = None
        """Newest position in the autopilot's local frame, z up [m]."""
        self.velocity: Vector = (0.0, 0.0, 0.0)
        """Newest velocity, z up [m/s]."""
        self.came_ns: int | None = None
        """Arrival of the newest measurement that was used [ns]."""
        self.heard_ns: int | None = None
        """Arrival of the newest measurement, used or dropped [ns]."""
        self.taken = 0
        self.dropped: Counter[str] = Counter()
        self._fault = ""
        """Why the newest measurement was dropped; empty if it was used."""

    @property
    def fault(self) -> str:
        """Why the newest measurement was dropped, in words; empty if it was used."""
        return FAULTS.get(self._fault, "")

    @property
    def altitude(self) -> float:
        """Altitude above the scenario's origin [m]; 0 before the first measurement."""
        return self.position[2] - self.origin[2] if self.position else 0.0

    def take_in(self, boot_ns: int, position: Vector, velocity: Vector, *, now_ns: int) -> None:
        """Process a position [m] and a velocity [m/s], z up, measured at a time since boot [ns]."""
        self.heard_ns = now_ns
        self._fault = reason = self._wrong(boot_ns, position, velocity, now_ns)
        if reason:
            self.dropped[reason] += 1
            return
        self._boot_ns = boot_ns
        if self._recalled is not None:
            self._recall(self._recalled, now_ns)
        stamp_ns = min(self._clock.local_ns(boot_ns), now_ns)
        if self._newest_ns is not None:  # keeps the order if the clock was corrected
            stamp_ns = max(stamp_ns, self._newest_ns + 1)
        self._newest_boot_ns, self._newest_ns = boot_ns, stamp_ns
        self.position, self.velocity = position, velocity
        self.came_ns = now_ns
        self.taken += 1
        if self._leaps is not None:
            self._watch(self._leaps, Measurement(stamp_ns, [*position], [*velocity]))
        place = [at - zero for at, zero in zip(position, self.origin, strict=True)]
        self._waiting.append(
            Measurement(stamp_ns, place[: self._axes], list(velocity[: self._axes]))
        )

    def _watch(self, leaps: Leaps, measured: Measurement) -> None:
        """Displace the origin by each leap of the position, because no vehicle can have moved that
        far.
        """
        if leaps.leaps(measured, measured.numbers()) and leaps.off_m and self.is_flown:
            dx, dy, dz = leaps.off_m
            self.displace((dx, dy, dz))

    def displace(self, by_m: Vector, *, asks: bool = True) -> None:
        """Displace the origin by a leap of the position; `asks`: an operator then has to decide."""
        dx, dy, dz = by_m
        (x, y, z), before = self.origin, self.leap_m or (0.0, 0.0, 0.0)
        self.origin = x + dx, y + dy, z + dz
        if asks:
            self.leap_m = before[0] + dx, before[1] + dy, before[2] + dz

    def decide(self, *, keeps_frame: bool) -> None:
        """Keep the old frame for good, or return to the new frame by undoing the displacement."""
        if self.leap_m is not None and not keeps_frame:
            pairs = zip(self.origin, self.leap_m, strict=True)
            x, y, z = (zero - leapt for zero, leapt in pairs)
            self.origin = x, y, z
            self._waiting.clear()
        self.leap_m = None

    def _wrong(self, boot_ns: int, position: Vector, velocity: Vector, now_ns: int) -> str:
        if self._jumps != self._clock.jumps:
            self._jumps = self._clock.jumps
            self._newest_boot_ns, self._newest_ns = -1, None
        if not all(map(math.isfinite, (*position, *velocity))):
            return "not_finite"
        if max(map(abs, position)) > FAR_M or max(map(abs, velocity)) > SPEED_MAX:
            return "far"
        return self._untimely(boot_ns, now_ns)

    def _untimely(self, boot_ns: int, now_ns: int) -> str:
        if not self._clock.is_known:
            return "unsynchronised"
        if boot_ns == self._newest_boot_ns:
            return "doubled"
        stamp_ns = self._clock.local_ns(boot_ns)
        if stamp_ns > now_ns + AHEAD_NS:
            return "impossible"
        if stamp_ns < now_ns - self._old_ns:
            return "old"
        return "late" if boot_ns < self._newest_boot_ns else ""

    def begin(self) -> None:
        """Set the scenario's origin such that the vehicle is now at `start`."""
        if self.position is not None:
            x, y, z = (at - start for at, start in zip(self.position, self._start, strict=True))
            self.place((x, y, z))

    def place(self, origin: Vector) -> None:
        self.origin, self.has_origin, self._recalled = origin, True, None
        self._waiting.clear()

    def recall(self, saved: VehicleMemory) -> None:
        """Restore an earlier run's origin once the autopilot proves not to have rebooted."""
        if not self.has_origin and saved.origin is not None:
            self._recalled = saved

    def _recall(self, saved: VehicleMemory, now_ns: int) -> None:
        """Restore an origin if both clocks have advanced equally: a reboot resets the autopilot's
        clock to 0.
        """
        self._recalled = None
        passed_ns = now_ns - saved.at_ns
        apart_ns = abs((self._boot_ms - saved.boot_ms) * MILLISECOND_NS - passed_ns)
        is_same = apart_ns <= REBOOT_NS + passed_ns // DRIFT_PARTS
        if is_same and 0 <= passed_ns <= RECALLED_MAX_NS and saved.origin is not None:
            self.place(saved.origin)
            self.leap_m = saved.leap_m
            self.is_recalled = True

    @property
    def _boot_ms(self) -> int:
        """Time from boot to the newest measurement used, modulo 2^32 as in MAVLink [ms]."""
        return self._boot_ns // MILLISECOND_NS % 2**32

    def frame(self, *, armed: bool) -> VehicleMemory:
        """State of the origin for the next run of the client; `armed` as in `VehicleMemory`."""
        if not self.has_origin or self.came_ns is None:
            saved = self._recalled or VehicleMemory()
            return msgspec.structs.replace(saved, armed=armed)
        return VehicleMemory(
            armed=armed,
            origin=self.origin,
            leap_m=self.leap_m,
            boot_ms=self._boot_ms,
            at_ns=self.came_ns,
        )

    def take(self, *, now_ns: int) -> list[Measurement]:
        """Measurements up to now that have not been returned before, oldest first."""
        self.is_flown = True
        due = []
        while self._waiting and self._waiting[0].stamp_ns <= now_ns:
            due.append(self._waiting.popleft())
        return due
