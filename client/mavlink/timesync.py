"""TIMESYNC requests for the autopilot's clock, and reports of a clock that
restarts or is silent.
"""

from skytether.client.clock import BootClock
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import ClockSilent

BEGIN_NS, INTERVAL_NS = 100 * MILLISECOND_NS, SECOND_NS
"""Interval between two questions before the clock is known, and afterwards."""
SILENT_NS = 10 * SECOND_NS
"""Time without an answer after which the missing answers are reported."""


class Timesync:
    """Requests the time of one autopilot; the answers set the `BootClock`."""

    def __init__(self, clock: BootClock, vehicle: int, events: Events) -> None:
        self._clock, self._vehicle, self._events = clock, vehicle, events
        self._next_ns = 0
        self._jumps = 0
        """Number of the clock's jumps for which `hear` has already reported a restart."""
        self._reported_silent = False
        self.untimely = 0

    @property
    def fault(self) -> str:
        if fault := self._clock.rate_fault:
            return f"a clock of its autopilot that can be followed: its speed is {fault}"
        return "an answer of its autopilot to TIMESYNC"

    def hear(self, message: Message, *, now_ns: int) -> bool:
        """Process an answer; returns whether it shows that the autopilot has restarted."""
        if message.tc1 == 0:  # PX4 also sends requests of its own, ten a second
            return False
        clock = self._clock
        self.untimely += not clock.hear(message.tc1, message.ts1, now_ns=now_ns)
        if clock.jumps == self._jumps or clock.rate_fault:
            return False
        self._jumps = clock.jumps
        return True

    def ask(self, *, is_heard: bool, now_ns: int) -> list[Message]:
        """Request for the time, if due. Reports an autopilot that answers no such request."""
        clock, was_reported = self._clock, self._reported_silent
        silent_ns = now_ns - clock.heard_ns if clock.is_known and is_heard else 0
        self._reported_silent = silent_ns > SILENT_NS
        if self._reported_silent and not was_reported:
            silent_s = silent_ns / SECOND_NS
            self._events.append(ClockSilent(vehicle=self._vehicle, silent_s=silent_s))
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + (INTERVAL_NS if clock.is_known else BEGIN_NS)
        return [dialect.MAVLink_timesync_message(0, clock.ask(now_ns=now_ns))]
