"""Set-points: times at which a desired velocity, never a position, is sent and repeated.

pilot's command → sent at once → repeated SETPOINTS_MIN_HZ times a second → no new command for
UNFLOWN_NS: silence, and the autopilot's own time-out acts
"""

from enum import Enum, auto

from skytether.client.positions import Vector
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

UNFLOWN_NS = 500 * MILLISECOND_NS
"""Time without a command of the pilot (`client.pilot`) after which no set-point is sent [ns]."""
SETPOINTS_MIN_HZ, SETPOINTS_MAX_HZ = 20, 50.0
CURRENT_NS = 300 * MILLISECOND_NS
"""Time after a pause of set-points from which on a heartbeat counts as current [ns]; an earlier
heartbeat may have waited in a queue."""
LATE = 1.1
"""Time after which a set-point is repeated, in nominal intervals; above 1, as steps may be late."""
ZERO_NS = 50 * MILLISECOND_NS
"""Interval between zero set-points, if a mode needs a stream of them."""
VELOCITY_ALONE = 0b110111000111
"""Type mask of a set-point with a velocity only."""
FRAME = int(dialect.MAV_FRAME_LOCAL_NED)
ZERO = 0.0, 0.0, 0.0


class Sends(Enum):
    NOTHING = auto()
    ZEROS = auto()
    """Send zeros, because the next mode needs a stream of set-points first."""
    COMMANDS = auto()


class Setpoints:
    """Set-points of one vehicle; `step_ns` is the interval between the pilot's commands."""

    def __init__(self, step_ns: int) -> None:
        parts = -(-step_ns * SETPOINTS_MIN_HZ // SECOND_NS)
        self._repeat_ns = round(LATE * step_ns / parts)
        self._velocity = ZERO
        """Desired velocity north, east and up [m/s]."""
        self._flown_ns: int | None = None
        self._sent_ns: int | None = None
        self._mode_awaited_ns: int | None = None
        """Start of the wait for a heartbeat after a pause [ns]; None without a wait."""
        self.count = 0

    def command(self, velocity: Vector, *, now_ns: int) -> bool:
        """Adopt the pilot's command; return whether SETPOINTS_MAX_HZ allows sending it now."""
        self._velocity, self._flown_ns = velocity, now_ns
        least_ns = SECOND_NS / SETPOINTS_MAX_HZ
        return self._sent_ns is None or now_ns - self._sent_ns >= 0.9 * least_ns

    def due_ns(self, sends: Sends, *, now_ns: int) -> int | None:
        sent_ns, flown_ns = self._sent_ns, self._flown_ns
        if sends is Sends.ZEROS:
            return now_ns if sent_ns is None else sent_ns + ZERO_NS
        if sends is Sends.NOTHING or flown_ns is None or self._mode_awaited_ns is not None:
            return None
        due_ns = flown_ns if sent_ns is None else sent_ns + self._repeat_ns
        return due_ns if due_ns - flown_ns <= UNFLOWN_NS else None

    def take(
        self, sends: Sends, *, leaves_ns: int | None, heartbeat_ns: int | None, now_ns: int
    ) -> Vector | None:
        """Velocity to be sent now, north, east and up [m/s]; None if none may be sent.

        After a pause the autopilot may have left its guided mode, and a set-point would switch it
        back to this mode. So a heartbeat has to show the present mode before the next set-point.

        Args:
            leaves_ns: pause after which the autopilot leaves its guided mode [ns]; None if a
                set-point never switches it back to this mode.
            heartbeat_ns: time of the autopilot's newest heartbeat.
        """
        if sends is Sends.NOTHING:
            return None
        if sends is Sends.COMMANDS and (
            self._flown_ns is None or not self._may_go_on(leaves_ns, heartbeat_ns, now_ns)
        ):
            return None
        self._sent_ns = now_ns
        self.count += 1
        return ZERO if sends is Sends.ZEROS else self._velocity

    def _may_go_on(self, leaves_ns: int | None, heartbeat_ns: int | None, now_ns: int) -> bool:
        if leaves_ns is None or self._sent_ns is None:
            return True
        if self._mode_awaited_ns is None and now_ns - self._sent_ns > leaves_ns:
            self._mode_awaited_ns = now_ns
        if self._mode_awaited_ns is None:
            return True
        if heartbeat_ns is not None and heartbeat_ns - self._mode_awaited_ns >= CURRENT_NS:
            self._mode_awaited_ns = None
        return self._mode_awaited_ns is None


def message(target: tuple[int, int], velocity: Vector, *, now_ns: int) -> Message:
    """Set-point for system and component `target`, with a velocity north, east and up [m/s]."""
    return dialect.MAVLink_set_position_target_local_ned_message(
        now_ns // MILLISECOND_NS % 2**32,
        *target,
        FRAME,
        VELOCITY_ALONE,
        *ZERO,
        *turned(velocity),
        *ZERO,
        0.0,
        0.0,
    )
