"""Measurements from LOCAL_POSITION_NED, as north, east and up."""

from typing import Any

from skytether.client import positions
from skytether.client.mavlink.keys import MavlinkConfig
from skytether.client.positions import Vector
from skytether.client.slides import Plane, Slides
from skytether.mavlink.codec import Message
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.scenario.schema import Scenario

FRESH_NS = 200 * MILLISECOND_NS
"""Largest age of a position that is compared with a fix of the receiver."""


def given_origin(scenario: Scenario) -> Vector | None:
    """Origin given by a scenario: north, east and up [m]; None if it is the place of take-off."""
    match scenario.section(MavlinkConfig).origin:
        case "takeoff":
            return None
        case "autopilot":
            return 0.0, 0.0, 0.0
        case (x, y, *up):
            return float(x), float(y), float(up[0]) if up else 0.0
    raise AssertionError  # `MavlinkConfig.contradictions` refuses other values


class Positions(positions.Positions):
    _origin_before: Vector | None = None
    """Origin at the newest fix of the receiver."""

    def __init__(self, *args: Any, **keys: Any) -> None:
        super().__init__(*args, **keys)
        self._slides = Slides()

    def hear(self, message: Message, *, now_ns: int) -> None:
        # The stamp is in whole milliseconds; the middle of the millisecond is the best guess.
        boot_ns = message.time_boot_ms * MILLISECOND_NS + MILLISECOND_NS // 2
        position = turned((message.x, message.y, message.z))
        velocity = turned((message.vx, message.vy, message.vz))
        self.take_in(boot_ns, position, velocity, now_ns=now_ns)

    def hear_fix(self, velocity: Plane | None, stamp_ns: int, *, now_ns: int) -> None:
        """Compare the position with a fix of the receiver.

        Args:
            velocity: the receiver's velocity, north and east [m/s]; None if not measured.
            stamp_ns: time of the fix, by the autopilot's clock [ns].
        """
        if velocity is None or self.position is None or self.came_ns is None or not self.is_flown:
            return
        is_old = now_ns - self.came_ns > FRESH_NS
        if is_old or self.origin != self._origin_before:
            self._slides.begin()
        if is_old:  # newer positions were dropped, so `position` is much older than the fix
            return
        (north, east, _), (x, y, _) = self.position, self.origin
        slide = self._slides.slid((north - x, east - y), velocity, stamp_ns)
        if slide is not None:
            # The operator is asked when a slide begins, and not again while the slide grows.
            self.displace((*slide.by_m, 0.0), asks=slide.begins or self.leap_m is not None)
        self._origin_before = self.origin
