"""Second commanders: other systems on the network that command the client's autopilot.

An autopilot obeys the latest command of any sender. This module detects commanders whose messages a
router or radio passes on to the client; `obedience` detects the others by their effect.
"""

from collections import deque

from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import SECOND_NS

WINDOW_NS = SECOND_NS
"""Window in which set-points are counted."""
LEAST = 2
"""Number of set-points in the window that reveal a second commander; one may be an error."""
QUIET_NS = 3 * SECOND_NS
"""Silence after which a second commander counts as gone."""
STREAMS = frozenset(
    {
        "SET_POSITION_TARGET_LOCAL_NED",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_ATTITUDE_TARGET",
        "SET_ACTUATOR_CONTROL_TARGET",
    }
)
"""Set-points that are sent as a stream."""
GOTO = frozenset(
    {
        int(dialect.MAV_CMD_DO_REPOSITION),
        int(dialect.MAV_CMD_DO_ORBIT),
        int(dialect.MAV_CMD_DO_CHANGE_SPEED),
        int(dialect.MAV_CMD_OVERRIDE_GOTO),
    }
)
"""Commands that move a vehicle in its present mode; they are sent once. Changes of mode are
detected from heartbeats."""
GUIDED_ITEM = (2, 3)
"""Values of `current` that mark a mission item as a goal or an altitude to fly to at once."""
STICK = 50
"""Stick deflection above which a pilot commands; full deflection: 1000 units, or 500 µs."""
CENTRE_US = 1500
UNUSED_US = (0, 65535)
"""Pulse widths of a channel that is not overridden [µs]."""


class Rivals:
    """Other systems that command the client's autopilot, as far as their messages arrive here."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque(maxlen=LEAST)
        self._active_ns: int | None = None
        """Time of the newest set-point of a second commander; None without one."""
        self.newest: tuple[int, int, str] = (0, 0, "")
        """System and component of the newest second commander, and the type of its newest
        message."""

    def hear(self, message: Message, system: int, *, now_ns: int) -> None:
        """Process a message of another sender; `system`: number of the autopilot's system."""
        weight = _weight(message, system)
        for _ in range(weight):
            self._times_ns.append(now_ns)
        if weight and len(self._times_ns) == LEAST and now_ns - self._times_ns[0] <= WINDOW_NS:
            self._active_ns = now_ns
            sender = message.get_srcSystem(), message.get_srcComponent()
            self.newest = *sender, message.get_type()

    def are_there(self, *, now_ns: int) -> bool:
        return self._active_ns is not None and now_ns - self._active_ns <= QUIET_NS


def _weight(message: Message, system: int) -> int:
    kind = message.get_type()
    named = message.target if kind == "MANUAL_CONTROL" else getattr(message, "target_system", None)
    if named not in (0, system):
        return 0
    match kind:
        case "MANUAL_CONTROL":
            return int(max(abs(message.x), abs(message.y), abs(message.r)) > STICK)
        case "RC_CHANNELS_OVERRIDE":
            sticks = (message.chan1_raw, message.chan2_raw, message.chan4_raw)
            return int(any(_is_moved(pulse_us) for pulse_us in sticks))
        case "COMMAND_LONG" | "COMMAND_INT":
            return LEAST if message.command in GOTO else 0
        case "MISSION_ITEM" | "MISSION_ITEM_INT":
            return LEAST if message.current in GUIDED_ITEM else 0
        case _:
            return int(kind in STREAMS)


def _is_moved(pulse_us: int) -> bool:
    return pulse_us not in UNUSED_US and abs(pulse_us - CENTRE_US) > STICK
