"""Measurements from nav_msgs/Odometry, in one frame, on the client's clock, in order.

A robot answers no questions about its clock, so only the arrivals of messages show its time:

    the fastest message of an interval, stamped b, arrives at t, after at most ROUND_TRIP_NS:
    offset = t - ROUND_TRIP_NS / 2 - b

This sample is used like the answer of an autopilot (`client.clock`). A delay common to all messages
cannot be detected: measurements then seem younger by this delay.
"""

from skytether.client.clock import BootClock
from skytether.client.navigation import Leaps
from skytether.client.positions import Positions, take_off_place
from skytether.client.ros2 import drive
from skytether.client.ros2.keys import Ros2Config
from skytether.ros2 import messages
from skytether.ros2.messages import MessageError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.scenario.schema import Scenario

ROUND_TRIP_NS = 4 * MILLISECOND_NS
"""Assumed largest delay of an interval's fastest message [ns]; small, as the client is aboard."""
BEGIN_NS, INTERVAL_NS = 100 * MILLISECOND_NS, SECOND_NS
"""Interval between two clock samples before the clock is known, and afterwards."""


class OdometryFilter:
    """Conversion of one robot's odometry to positions and velocities of its controlled point."""

    def __init__(self, scenario: Scenario, vehicle: int) -> None:
        keys = scenario.section(Ros2Config)
        self._ahead = keys.ahead_m if keys.drive == "differential" else 0.0
        self.clock = BootClock(SECOND_NS)
        self.positions = Positions(
            scenario.model.axes,
            self.clock,
            start=take_off_place(scenario, vehicle),
            origin=(0.0, 0.0, 0.0) if keys.origin == "odometry" else None,
            leaps=Leaps(scenario),
        )
        self.newest: messages.Odometry | None = None
        """Newest message that was used."""
        self.heard = 0
        self._frames: tuple[str, str] | None = None
        self._fastest: tuple[int, int] | None = None
        """Arrival and stamp of the fastest message of the present interval [ns]."""
        self._sampled_ns: int | None = None
        self._fault = ""
        """Fault in the content of the newest message, in words; empty without a fault."""

    @property
    def fault(self) -> str:
        """Why the newest message was not used, in words; empty if it was used."""
        return self._fault or self.positions.fault

    def hear(self, payload: bytes, *, now_ns: int) -> None:
        self.heard += 1
        positions = self.positions
        positions.heard_ns = now_ns
        try:
            message = messages.odometry(payload)
        except MessageError as error:
            self._drop("garbage", f"they are no odometry: {error}")
            return
        frames = message.frame, message.child
        self._frames = self._frames or (frames if all(frames) else None)
        if frames != self._frames:
            expected = f"expected {self._frames}" if self._frames else "expected two names"
            self._drop("frame", f"their frames are {frames}, {expected}")
            return
        self._fault = ""
        self._time(message.stamp_ns, now_ns)
        taken = positions.taken
        positions.take_in(message.stamp_ns, *drive.point(message, self._ahead), now_ns=now_ns)
        if positions.taken > taken:
            self.newest = message

    def _drop(self, reason: str, fault: str) -> None:
        self.positions.dropped[reason] += 1
        self._fault = fault

    def _time(self, stamp_ns: int, now_ns: int) -> None:
        """Take a sample of the robot's clock from the fastest message of each interval."""
        if self._sampled_ns is None:
            self._sampled_ns = now_ns
        if self._fastest is None or now_ns - stamp_ns < self._fastest[0] - self._fastest[1]:
            self._fastest = now_ns, stamp_ns
        interval_ns = INTERVAL_NS if self.clock.is_known else BEGIN_NS
        if now_ns - self._sampled_ns >= interval_ns:
            came_ns, fastest_ns = self._fastest
            asked_ns = self.clock.ask(now_ns=came_ns - ROUND_TRIP_NS)
            self.clock.hear(fastest_ns, asked_ns, now_ns=came_ns)
            self._sampled_ns, self._fastest = now_ns, None
