"""Differences between ArduCopter and PX4: numbers and names of modes, and the take-off sequence."""

from dataclasses import dataclass
from enum import Enum, auto

from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect

CUSTOM = float(dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
AIRBORNE = frozenset(
    {
        int(dialect.MAV_TYPE_QUADROTOR),
        int(dialect.MAV_TYPE_COAXIAL),
        int(dialect.MAV_TYPE_HELICOPTER),
        int(dialect.MAV_TYPE_HEXAROTOR),
        int(dialect.MAV_TYPE_OCTOROTOR),
        int(dialect.MAV_TYPE_TRICOPTER),
        int(dialect.MAV_TYPE_DODECAROTOR),
        int(dialect.MAV_TYPE_DECAROTOR),
    }
)
"""Types of vehicles that can hover; other types are not flown."""


class LaunchStep(Enum):
    HOLD = auto()
    """Wait for a mode of the autopilot that needs no pilot, such as holding the position."""
    GUIDE = auto()
    """Wait for the mode that follows set-points."""
    ARM = auto()
    LIFT = auto()
    CLIMB = auto()


@dataclass(frozen=True)
class Flavour:
    name: str
    guided: int
    """Number of the mode that follows set-points."""
    land: int
    back: int
    """Number of the mode that returns home and lands."""
    hold: int
    lift: int
    """Number of the mode during a commanded take-off."""
    steps: tuple[LaunchStep, ...]
    streams_first: bool
    """Whether the autopilot needs set-points before it enters its guided mode. Later set-points
    also switch the autopilot back to this mode."""
    words_for_stations: bool
    """Whether the autopilot sends status texts to ground stations only."""
    fixed_heartbeats: bool
    """Whether the rate of heartbeats cannot be set, so that each heartbeat is requested."""
    time_out: str
    """Name of the parameter of the set-point time-out [s]."""
    above_sea: bool
    """Whether the take-off altitude is commanded above the sea, not above home."""
    bytewise: bool
    """Whether parameters are sent bytewise, see `mavlink.parameters`."""
    submodes: bool
    """Whether a mode's number has two parts: main mode and sub-mode."""
    modes: dict[int, str]

    def mode_name(self, mode: int) -> str:
        return self.modes.get(mode, f"mode {mode}")

    def mode_parts(self, mode: int) -> tuple[float, float, float]:
        if self.submodes:
            return CUSTOM, float(mode >> 16 & 0xFF), float(mode >> 24)
        return CUSTOM, float(mode), 0.0


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


ARDUPILOT = Flavour(
    name="ArduCopter",
    guided=4,
    land=9,
    back=6,
    hold=17,
    lift=4,
    steps=(LaunchStep.GUIDE, LaunchStep.ARM, LaunchStep.LIFT, LaunchStep.CLIMB),
    streams_first=False,
    words_for_stations=False,
    fixed_heartbeats=False,
    time_out="GUID_TIMEOUT",
    above_sea=False,
    bytewise=False,
    submodes=False,
    modes={
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        5: "LOITER",
        6: "RTL",
        7: "CIRCLE",
        9: "LAND",
        11: "DRIFT",
        13: "SPORT",
        15: "AUTOTUNE",
        16: "POSHOLD",
        17: "BRAKE",
        18: "THROW",
        20: "GUIDED_NOGPS",
        21: "SMART_RTL",
    },
)
PX4 = Flavour(
    name="PX4",
    guided=_px4(6),
    land=_px4(4, 6),
    back=_px4(4, 5),
    hold=_px4(4, 3),
    lift=_px4(4, 2),
    steps=(LaunchStep.HOLD, LaunchStep.ARM, LaunchStep.LIFT, LaunchStep.CLIMB, LaunchStep.GUIDE),
    streams_first=True,
    words_for_stations=True,
    fixed_heartbeats=True,
    time_out="COM_OF_LOSS_T",
    above_sea=True,
    bytewise=True,
    submodes=True,
    modes={
        _px4(1): "MANUAL",
        _px4(2): "ALTCTL",
        _px4(3): "POSCTL",
        _px4(4, 1): "AUTO.READY",
        _px4(4, 2): "AUTO.TAKEOFF",
        _px4(4, 3): "AUTO.LOITER",
        _px4(4, 4): "AUTO.MISSION",
        _px4(4, 5): "AUTO.RTL",
        _px4(4, 6): "AUTO.LAND",
        _px4(5): "ACRO",
        _px4(6): "OFFBOARD",
        _px4(7): "STABILIZED",
    },
)
FLAVOURS = {
    int(dialect.MAV_AUTOPILOT_ARDUPILOTMEGA): ARDUPILOT,
    int(dialect.MAV_AUTOPILOT_PX4): PX4,
}


def unfit(heartbeat: Message) -> str:
    """Why the vehicle that sent a heartbeat cannot be flown; empty if it can be flown."""
    if heartbeat.autopilot not in FLAVOURS:
        return f"its autopilot is number {heartbeat.autopilot}, expected ArduPilot (3) or PX4 (12)"
    if heartbeat.type not in AIRBORNE:
        return f"it is of MAV_TYPE {heartbeat.type}, expected one that hovers, e.g. a quadrotor (2)"
    return ""
