"""Measurements from LOCAL_POSITION_NED: in our axes and by our clock, each once, and in order."""

import math
from collections import Counter, deque

import msgspec

from skytether.client.mavlink.clock import BootClock
from skytether.client.navigation import Leaps
from skytether.client.vehicle import Frame, Measurement
from skytether.mavlink.codec import Message
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.scenario.reference import FAR_M

WAITING_MAX = 64
"""Measurements that wait to be taken; the oldest give way."""
AHEAD_NS = 20 * MILLISECOND_NS
"""Time by which a stamp may lie ahead, for the clock is known only so well [ns]; more is
impossible."""
OLD_NS = SECOND_NS
"""Largest age of a measurement that is used, for an autopilot aboard [ns]."""
RECALLED_MAX_NS = 600 * SECOND_NS
"""Longest time for which an origin is good that an earlier life has kept [ns]."""
REBOOT_NS = SECOND_NS
"""Time by which the autopilot's clock may differ from ours since it was kept [ns], beside its
drift."""
DRIFT_PARTS = 40
"""Part of the time since then that its drift may make: 2.5 %."""
SPEED_MAX = 1e3
"""Largest speed on an axis that is believed [m/s]."""

FAULTS = {
    "not_finite": "they are not finite",
    "far": "they are further away, or faster, than can be",
    "unsynchronised": "the autopilot's clock is not known",
    "doubled": "they come twice",
    "impossible": "their stamps lie in the future",
    "old": f"they are older than {OLD_NS / SECOND_NS:g} s",
    "late": "older ones come after newer ones",
}
"""Reasons for which a position is dropped, in words."""

Vector = tuple[float, float, float]


class Positions:
    """Positions and velocities as the autopilot tells them.

    Args:
        axes: number of axes that are flown, 2 or 3.
        clock: the autopilot's clock.
        old_ns: age of a measurement above which it is not taken [ns].
        start: where in our axes it takes off, once `begin` is called [m].
        origin: origin of the scenario's frame in the autopilot's local frame, in our axes [m]; None
            where it is only known once `begin` is called.
        leaps: check of each measurement against the one before; None: none is checked.
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
        self._newest_boot_ms = -1
        self._newest_ns: int | None = None
        """Stamp of the newest measurement."""
        self._leaps = leaps
        self._is_flown = False
        """Whether its measurements are flown by: from then on a leap counts."""
        self.leap_m: Vector | None = None
        """Displacement of its position that nobody has decided about, in our axes [m]; None without
        one. The origin has been displaced by as much, so that the vehicle goes by its old frame."""
        self._jumps = 0
        self.origin: Vector = origin or (0.0, 0.0, 0.0)
        """Origin of the scenario's frame in the autopilot's local frame, in our axes [m]."""
        self.has_origin = origin is not None
        """Whether that is known."""
        self.is_recalled = False
        """Whether it is what an earlier life has kept since this boot of the autopilot."""
        self._recalled: Frame | None = None
        """What an earlier life has kept, until it is known whether it is of this boot."""
        self._boot_ms = 0
        """Time since the autopilot's boot of the newest measurement [ms]."""
        self.position: Vector | None = None
        """Newest position in the autopilot's local frame, in our axes [m]."""
        self.velocity: Vector = (0.0, 0.0, 0.0)
        """Newest velocity, in our axes [m/s]."""
        self.came_ns: int | None = None
        """Time at which the newest measurement came."""
        self.heard_ns: int | None = None
        """Time at which the newest came that was taken or dropped."""
        self.taken = 0
        """Number of measurements taken."""
        self.dropped: Counter[str] = Counter()
        """Number of those that were dropped, by reason."""
        self._fault = ""
        """Reason for which the newest was dropped; empty where it was taken."""

    @property
    def fault(self) -> str:
        """Reason for which the newest was dropped, in words; empty where it was taken."""
        return FAULTS.get(self._fault, "")

    @property
    def altitude(self) -> float:
        """Altitude above our origin [m]; 0 before anything was measured."""
        return self.position[2] - self.origin[2] if self.position else 0.0

    def hear(self, message: Message, *, now_ns: int) -> None:
        """Take a message, or drop and count it."""
        self.heard_ns = now_ns
        self._fault = reason = self._wrong(message, now_ns)
        if reason:
            self.dropped[reason] += 1
            return
        boot_ms = self._boot_ms = message.time_boot_ms
        if self._recalled is not None:
            self._recall(self._recalled, boot_ms, now_ns)
        stamp_ns = min(self._stamp_ns(boot_ms), now_ns)
        if self._newest_ns is not None:  # the map has moved by less than what lies between them
            stamp_ns = max(stamp_ns, self._newest_ns + 1)
        self._newest_boot_ms, self._newest_ns = boot_ms, stamp_ns
        self.position = turned((message.x, message.y, message.z))
        self.velocity = turned((message.vx, message.vy, message.vz))
        self.came_ns = now_ns
        self.taken += 1
        if self._leaps is not None:
            self._watch(self._leaps, Measurement(stamp_ns, [*self.position], [*self.velocity]))
        place = [at - zero for at, zero in zip(self.position, self.origin, strict=True)]
        self._waiting.append(
            Measurement(stamp_ns, place[: self._axes], list(self.velocity[: self._axes]))
        )

    def _watch(self, leaps: Leaps, measured: Measurement) -> None:
        """Displace the origin with a position that has leapt: the vehicle has not moved so far."""
        if leaps.leaps(measured, measured.numbers()) and leaps.off_m and self._is_flown:
            dx, dy, dz = leaps.off_m
            (x, y, z), before = self.origin, self.leap_m or (0.0, 0.0, 0.0)
            self.origin = x + dx, y + dy, z + dz
            self.leap_m = before[0] + dx, before[1] + dy, before[2] + dz

    def decide(self, *, keeps_frame: bool) -> None:
        """Go by the old frame for good, or by the new one from now on."""
        if self.leap_m is not None and not keeps_frame:
            pairs = zip(self.origin, self.leap_m, strict=True)
            x, y, z = (zero - leapt for zero, leapt in pairs)
            self.origin = x, y, z
            self._waiting.clear()
        self.leap_m = None

    def _stamp_ns(self, boot_ms: int) -> int:
        # What was measured in this millisecond was so in the middle of it.
        return self._clock.local_ns(boot_ms * MILLISECOND_NS + MILLISECOND_NS // 2)

    def _wrong(self, message: Message, now_ns: int) -> str:
        """Reason for which a message is dropped; empty of one that is taken."""
        if self._jumps != self._clock.jumps:
            self._jumps = self._clock.jumps
            self._newest_boot_ms, self._newest_ns = -1, None
        numbers = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        if not all(map(math.isfinite, numbers)):
            return "not_finite"
        if max(map(abs, numbers[:3])) > FAR_M or max(map(abs, numbers[3:])) > SPEED_MAX:
            return "far"
        return self._untimely(message.time_boot_ms, now_ns)

    def _untimely(self, boot_ms: int, now_ns: int) -> str:
        """Fault of a stamp; empty where there is none."""
        if not self._clock.is_known:
            return "unsynchronised"
        if boot_ms == self._newest_boot_ms:
            return "doubled"
        stamp_ns = self._stamp_ns(boot_ms)
        if stamp_ns > now_ns + AHEAD_NS:
            return "impossible"
        if stamp_ns < now_ns - self._old_ns:
            return "old"
        return "late" if boot_ms < self._newest_boot_ms else ""

    def begin(self) -> None:
        """Set our origin: the vehicle's place less its start in the scenario."""
        if self.position is not None:
            x, y, z = (at - start for at, start in zip(self.position, self._start, strict=True))
            self.place((x, y, z))

    def place(self, origin: Vector) -> None:
        """Set our origin [m; the autopilot's local frame, in our axes]."""
        self.origin, self.has_origin, self._recalled = origin, True, None
        self._waiting.clear()

    def recall(self, frame: Frame) -> None:
        """Take the origin that an earlier life has kept, once it is known to be of this boot."""
        if not self.has_origin and frame.origin is not None:
            self._recalled = frame

    def _recall(self, frame: Frame, boot_ms: int, now_ns: int) -> None:
        """Take an origin, if both clocks have gone on alike since: a reboot sets its own to 0."""
        self._recalled = None
        passed_ns = now_ns - frame.at_ns
        apart_ns = abs((boot_ms - frame.boot_ms) * MILLISECOND_NS - passed_ns)
        is_same = apart_ns <= REBOOT_NS + passed_ns // DRIFT_PARTS
        if is_same and 0 <= passed_ns <= RECALLED_MAX_NS and frame.origin is not None:
            self.place(frame.origin)
            self.leap_m = frame.leap_m
            self.is_recalled = True

    def frame(self, *, armed: bool) -> Frame:
        """What the next life needs to know of the origin.

        Args:
            armed: see `Frame`.
        """
        if not self.has_origin or self.came_ns is None:
            known = self._recalled or Frame()
            return msgspec.structs.replace(known, armed=armed)
        return Frame(
            armed=armed,
            origin=self.origin,
            leap_m=self.leap_m,
            boot_ms=self._boot_ms,
            at_ns=self.came_ns,
        )

    def take(self, *, now_ns: int) -> list[Measurement]:
        """Measurements of up to now that were not taken before, the oldest first."""
        self._is_flown = True
        told = []
        while self._waiting and self._waiting[0].stamp_ns <= now_ns:
            told.append(self._waiting.popleft())
        return told
