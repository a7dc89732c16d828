"""Slides: gradual changes of the measured position that the receiver's velocity does not show.

When the receiver's position shifts by some metres, for example after a correction, the autopilot's
estimate slides there within 2 to 5 s, and its velocity changes accordingly. The receiver measures
its velocity g independently, and this velocity does not change:

    o(t) = position(t) - ∫ g dt      slides if |o(t) - o(t - SLIDE_NS)| > SLID_M + LAG_S |Δg|

where Δg is the change of g in that time; LAG_S |Δg| allows for fixes that arrive late. After the
detection the slide is measured for another FOLLOWED_NS, still from its beginning.
"""

import math
from collections import deque
from typing import NamedTuple

from skytether.shared.base.units import SECOND_NS

SLIDE_NS, SLID_M = 5 * SECOND_NS, 1.5
"""Time over which positions are compared, and the smallest displacement that is a slide [m]."""
LAG_S = 0.3
"""Largest delay of a fix of the receiver behind the autopilot's estimate [s]."""
FOLLOWED_NS = 5 * SECOND_NS
"""Time for which a slide is still measured after its detection."""
STEP_NS, STEP_M = SECOND_NS, 0.3
"""Minimum time, and minimum displacement [m], between two reports (`Slide`) of one slide."""
FIX_GAP_NS = SECOND_NS
"""Longest time between two fixes over which the receiver's velocity is integrated."""
OFFSETS_MAX = 128

Plane = tuple[float, float]
"""North and east component."""


class Offset(NamedTuple):
    """Offset o(t) at one fix: position minus integrated velocity of the receiver."""

    stamp_ns: int
    velocity: Plane
    offset_m: Plane


class Slide(NamedTuple):
    by_m: Plane
    """Displacement of the position since the previous `Slide` [m]."""
    begins: bool


class Slides:
    """Detector of the slides of one vehicle."""

    def __init__(self) -> None:
        self._past: deque[Offset] = deque(maxlen=OFFSETS_MAX)
        """Offsets of the last SLIDE_NS, or the offset at which the present slide began."""
        self._travelled: Plane = (0.0, 0.0)
        self._velocity: Plane = (0.0, 0.0)
        self._stamp_ns = -FIX_GAP_NS
        self._until_ns: int | None = None
        """Time until which the present slide is measured [ns]; None without a slide."""
        self._next_ns = 0

    def begin(self) -> None:
        """Start again: the origin has changed, or fixes were missing."""
        self._past.clear()
        self._until_ns = None

    def slid(self, place: Plane, velocity: Plane, stamp_ns: int) -> Slide | None:
        """Slide to be subtracted from the position from now on; None if none was detected.

        Args:
            place: position in the plane, minus all earlier slides [m].
            velocity: velocity of a fix of the receiver [m/s].
            stamp_ns: time of the fix [ns].
        """
        self._travel(velocity, stamp_ns)
        offset = _minus(place, self._travelled)
        if self._until_ns is None:
            while self._past and stamp_ns - self._past[0].stamp_ns > SLIDE_NS:
                self._past.popleft()
            self._past.append(Offset(stamp_ns, velocity, offset))
        before = self._past[0]
        by_m, begins = _minus(offset, before.offset_m), self._until_ns is None
        if self._until_ns is None:
            change = math.hypot(*_minus(velocity, before.velocity))
            if math.hypot(*by_m) <= SLID_M + LAG_S * change:
                return None
            self._until_ns = stamp_ns + FOLLOWED_NS
        elif stamp_ns >= self._until_ns:
            self.begin()
            return None
        elif stamp_ns < self._next_ns or math.hypot(*by_m) < STEP_M:
            return None
        self._next_ns = stamp_ns + STEP_NS
        self._past.clear()
        self._past.append(before)
        return Slide(by_m, begins)

    def _travel(self, velocity: Plane, stamp_ns: int) -> None:
        time_ns = stamp_ns - self._stamp_ns
        if 0 < time_ns <= FIX_GAP_NS:
            half_s = 0.5 * time_ns / SECOND_NS
            (x, y), (vx, vy) = self._travelled, self._velocity
            self._travelled = x + half_s * (vx + velocity[0]), y + half_s * (vy + velocity[1])
        else:
            self.begin()
        self._velocity, self._stamp_ns = velocity, stamp_ns


def _minus(a: Plane, b: Plane) -> Plane:
    return a[0] - b[0], a[1] - b[1]
