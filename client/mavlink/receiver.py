"""Position receiver of an autopilot, from GPS_RAW_INT: whether it has a fix, and its velocity.

After the last fix an autopilot flies on by its accelerometers for seconds before its flags report
the loss of the fix. If there has been no usable fix since the client's start, the vehicle is
assumed to have another position source, and no loss is reported.
"""

import math

from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

LOST_NS = 1500 * MILLISECOND_NS
"""Time without a usable fix after which the fix counts as lost [ns], unless fixes are rare."""
FEWEST = 3
"""Number of usual intervals for which no fix may arrive before the fix counts as lost."""
INTERVAL_MAX_NS = 2 * SECOND_NS
"""Largest time between two fixes that counts as a usual interval."""
UNHEARD_NS = SECOND_NS // 2
"""Pause of all messages after which the time without a fix is counted from 0."""
ACCURACY_MM = 5000
"""Largest horizontal error of a usable fix [mm], as in both autopilots' own checks."""
UNKNOWN = 65535
US_NS = 1000


class Receiver:
    def __init__(self) -> None:
        self.stamp_ns = -1
        """Time of the newest usable fix on the autopilot's clock, or its arrival if it has no time
        stamp [ns]; -1 before the first fix."""
        self.velocity: tuple[float, float] | None = None
        """Velocity of the newest usable fix, north and east [m/s]; None if not measured."""
        self._fix_ns: int | None = None
        """Start of the time without a fix [ns]: the newest fix, or the end of a later pause."""
        self._interval_ns = 0

    def hear(self, message: Message, *, now_ns: int) -> bool:
        """Process a GPS_RAW_INT; returns whether it has a new and usable fix."""
        stamp_ns = message.time_usec * US_NS or now_ns  # PX4 sends 0 until it knows the date
        if not _is_usable(message) or stamp_ns == self.stamp_ns:
            return False
        if self._fix_ns is not None and now_ns - self._fix_ns <= INTERVAL_MAX_NS:
            self._interval_ns = now_ns - self._fix_ns
        self.stamp_ns, self._fix_ns = stamp_ns, now_ns
        self.velocity = None
        if UNKNOWN not in (message.vel, message.cog):
            speed, course = message.vel / 100.0, math.radians(message.cog / 100.0)
            self.velocity = speed * math.cos(course), speed * math.sin(course)
        return True

    def unheard(self, *, now_ns: int) -> None:
        """Note a pause of all messages: the time without a fix is counted from now on."""
        if self._fix_ns is not None:
            self._fix_ns = now_ns

    def is_lost(self, *, now_ns: int) -> bool:
        if self._fix_ns is None:
            return False
        return now_ns - self._fix_ns > max(LOST_NS, FEWEST * self._interval_ns)


def _is_usable(message: Message) -> bool:
    return bool(message.fix_type >= dialect.GPS_FIX_TYPE_3D_FIX and message.h_acc <= ACCURACY_MM)
