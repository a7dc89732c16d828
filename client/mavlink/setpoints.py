"""Set-points: when a desired velocity is sent, and repeated; never a position.

pilot's command → sent at once → repeated SETPOINTS_MIN_HZ times a second
→ no new command for UNFLOWN_NS: silence, and the autopilot's own time-out acts
"""

from enum import Enum, auto

from skytether.client.mavlink.positions import Vector
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

UNFLOWN_NS = 500 * MILLISECOND_NS
"""Time after which a silent pilot counts as gone [ns]; then no set-point is sent."""
SETPOINTS_MIN_HZ, SETPOINTS_MAX_HZ = 20, 50.0
"""Least and largest number of set-points in a second."""
CURRENT_NS = 300 * MILLISECOND_NS
"""Time after a pause of set-points from which on a heartbeat counts as current [ns]: earlier ones
may have waited in a queue."""
LATE = 1.1
"""A set-point is repeated after this many intervals, since a step may come late."""
ZERO_NS = 50 * MILLISECOND_NS
"""Interval between zero set-points, if a mode needs a stream of them [ns]."""
VELOCITY_ALONE = 0b110111000111
"""Type mask of a set-point with neither position nor acceleration, nor yaw or yaw rate."""
FRAME = int(dialect.MAV_FRAME_LOCAL_NED)
ZERO = 0.0, 0.0, 0.0


class Sends(Enum):
    """Set-points that are sent at present."""

    NOTHING = auto()
    ZEROS = auto()
    """A stream of zeros, which the next mode needs."""
    COMMANDS = auto()
    """The pilot's commands."""


class Setpoints:
    """Set-points of one vehicle.

    Args:
        step_ns: interval between the pilot's commands [ns].
    """

    def __init__(self, step_ns: int) -> None:
        parts = -(-step_ns * SETPOINTS_MIN_HZ // SECOND_NS)
        self._repeat_ns = round(LATE * step_ns / parts)
        self._velocity = ZERO
        """Desired velocity, in our axes [m/s]."""
        self._flown_ns: int | None = None
        """Time of the pilot's newest command; None before the first."""
        self._sent_ns: int | None = None
        """Time of the newest set-point."""
        self._mode_awaited_ns: int | None = None
        """Time since which, after a pause, set-points wait for a current mode; None if they do
        not."""
        self.count = 0
        """Number of set-points sent."""

    def command(self, velocity: Vector, *, now_ns: int) -> bool:
        """Adopt the pilot's command; returns whether to send it now, since none was just sent."""
        self._velocity, self._flown_ns = velocity, now_ns
        least_ns = SECOND_NS / SETPOINTS_MAX_HZ
        return self._sent_ns is None or now_ns - self._sent_ns >= 0.9 * least_ns

    def due_ns(self, sends: Sends, *, now_ns: int) -> int | None:
        """Time of the next set-point; None if none is to be sent."""
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
        """Velocity to be sent now, in our axes [m/s]; None if none may be sent.

        After a pause in which the autopilot has left its guided mode, which the first set-point
        would bring back, its mode has to be heard first.

        Args:
            sends: which set-points are sent.
            leaves_ns: pause after which the autopilot leaves its guided mode [ns]; None if a
                set-point never brings it back.
            heartbeat_ns: time of the autopilot's newest heartbeat.
            now_ns: time now.
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
        """Whether set-points may continue, as far as the autopilot's mode is known."""
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
    """Set-point message.

    Args:
        target: numbers of the autopilot's system and component.
        velocity: desired velocity, in our axes [m/s].
        now_ns: time now.
    """
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
