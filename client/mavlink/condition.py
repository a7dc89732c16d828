"""Condition of the vehicle, as last reported by its autopilot."""

from math import isfinite

from skytether.client.mavlink.receiver import UNHEARD_NS, Receiver
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

ASTRAY_NS = 500 * MILLISECOND_NS
"""Time for which the estimate must be bad before the failsafe is told [ns], because its flags
flicker when satellites change."""
LOW_NS = 2 * SECOND_NS
"""Time for which the battery must be low before the failsafe is told [ns], because its voltage sags
briefly under thrust."""
FRESH_NS = 2500 * MILLISECOND_NS
"""Age up to which a heartbeat counts as current [ns]; so long that one heartbeat may be lost."""
NUMBERS = 256
"""Number of different sequence numbers of frames; after the last one they begin again at 0."""
OVERTAKEN_NS = SECOND_NS
"""Longest time for which a frame with a lower number counts as overtaken; after a longer pause its
sender may have restarted."""
KNOWS = dialect.ESTIMATOR_VELOCITY_HORIZ
"""Flag of an estimate with a valid velocity."""
PLACED = dialect.ESTIMATOR_POS_HORIZ_ABS | dialect.ESTIMATOR_POS_HORIZ_REL
"""Flags of an estimate with a valid position; one is enough."""
STANDS_IN = dialect.ESTIMATOR_CONST_POS_MODE
"""Flag of an estimate that, for lack of data, assumes that the vehicle is at rest."""
UNKNOWN_MV, UNKNOWN_PERCENT = 65535, -1
BATTERY_BAD = range(
    int(dialect.MAV_BATTERY_CHARGE_STATE_LOW), int(dialect.MAV_BATTERY_CHARGE_STATE_UNHEALTHY) + 1
)
"""Charge states in which the autopilot itself reports a low battery, or worse."""


class Condition:
    """Condition of the autopilot and its vehicle, as far as the autopilot reports it.

    Args:
        battery_min: charge below which the battery is low, from 0 to 1.
        battery_min_v: voltage below which the battery is low [V]; 0: not checked.
    """

    def __init__(self, battery_min: float, battery_min_v: float) -> None:
        self._battery_min, self._battery_min_v = battery_min, battery_min_v
        self.heard_ns: int | None = None
        self.heartbeat_ns: int | None = None
        self._number = 0
        self._number_ns: int | None = None
        self.mode = -1
        """Number of the autopilot's flight mode; -1 if unknown."""
        self.armed = False
        self.landed = int(dialect.MAV_LANDED_STATE_UNDEFINED)
        self.charge: float | None = None
        """Charge of the battery, from 0 to 1; None if unknown."""
        self.voltage: float | None = None
        self.home: tuple[float, float, float] | None = None
        """Latitude and longitude of home [°], and altitude of home above the sea [m]."""
        self.home_up = 0.0
        """Altitude of home in the autopilot's local frame [m]."""
        self._is_bad: dict[str, bool] = {}
        """Whether the estimate is bad according to each type of message that reports on it."""
        self._astray_ns: int | None = None
        self._is_low: dict[str, bool] = {}
        """Whether the battery is low according to each type of message that reports on it."""
        self._low_ns: int | None = None
        self.receiver = Receiver()
        self.has_new_fix = False
        """Whether the newest message has a new and usable fix of the receiver."""

    def hear(self, message: Message, *, now_ns: int) -> None:
        """Process a message of the autopilot, unless a newer one arrived before it.

        These messages have no time stamps. So the sequence number is checked: otherwise a heartbeat
        that was overtaken would hide the mode that a pilot has just chosen.
        """
        if self.heard_ns is not None and now_ns - self.heard_ns > UNHEARD_NS:
            self.receiver.unheard(now_ns=now_ns)
        self.heard_ns, self.has_new_fix = now_ns, False
        if self._is_overtaken(message.get_seq(), now_ns):
            return
        self._number, self._number_ns = message.get_seq(), now_ns
        match message.get_type():
            case "HEARTBEAT":
                self.heartbeat_ns = now_ns
                self.mode = message.custom_mode
                self.armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            case "EXTENDED_SYS_STATE":
                self.landed = message.landed_state
            case "SYS_STATUS":
                self._hear_status(message, now_ns)
            case "BATTERY_STATUS" if message.id == 0:
                self._low("BATTERY_STATUS", message.charge_state in BATTERY_BAD, now_ns)
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                flags = message.flags
                knows = flags & KNOWS and flags & PLACED and not flags & STANDS_IN
                self._bad("ESTIMATE", not knows, now_ns)
            case "GPS_RAW_INT":
                self.has_new_fix = self.receiver.hear(message, now_ns=now_ns)
            case "HOME_POSITION":
                self.home = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
                self.home_up = -message.z if isfinite(message.z) else 0.0

    def _is_overtaken(self, number: int, now_ns: int) -> bool:
        if self._number_ns is None or now_ns - self._number_ns > OVERTAKEN_NS:
            return False
        return 0 < (self._number - number) % NUMBERS < NUMBERS // 2

    def _hear_status(self, message: Message, now_ns: int) -> None:
        percent, millivolts = message.battery_remaining, message.voltage_battery
        self.charge = None if percent == UNKNOWN_PERCENT else percent / 100.0
        self.voltage = None if millivolts in (0, UNKNOWN_MV) else millivolts / 1000.0
        low = self.charge is not None and self.charge < self._battery_min
        weak = self.voltage is not None and self.voltage < self._battery_min_v
        self._low("SYS_STATUS", low or weak, now_ns)
        used = message.onboard_control_sensors_present & message.onboard_control_sensors_enabled
        sick = used & ~message.onboard_control_sensors_health
        self._bad("SYS_STATUS", bool(sick & dialect.MAV_SYS_STATUS_AHRS), now_ns)

    def _low(self, source: str, low: bool, now_ns: int) -> None:
        self._is_low[source] = low
        self._low_ns = _since(self._low_ns, any(self._is_low.values()), now_ns)

    def _bad(self, source: str, bad: bool, now_ns: int) -> None:
        self._is_bad[source] = bad
        self._astray_ns = _since(self._astray_ns, any(self._is_bad.values()), now_ns)

    @property
    def battery_is_weak(self) -> bool:
        return self._low_ns is not None

    def battery_is_low(self, *, now_ns: int) -> bool:
        return self._low_ns is not None and now_ns - self._low_ns >= LOW_NS

    def is_astray(self, *, now_ns: int) -> bool:
        """Whether the estimate is bad, or soon will be because the receiver has lost its fix."""
        if self.heard_ns is not None and self.receiver.is_lost(now_ns=self.heard_ns):
            return True
        return self._astray_ns is not None and now_ns - self._astray_ns >= ASTRAY_NS

    def is_fresh(self, *, now_ns: int) -> bool:
        """Whether mode and arming are current: a heartbeat arrived within FRESH_NS."""
        return self.heartbeat_ns is not None and now_ns - self.heartbeat_ns <= FRESH_NS

    @property
    def is_airborne(self) -> bool:
        return self.landed in (
            dialect.MAV_LANDED_STATE_IN_AIR,
            dialect.MAV_LANDED_STATE_TAKEOFF,
            dialect.MAV_LANDED_STATE_LANDING,
        )

    @property
    def is_on_ground(self) -> bool:
        return self.landed == dialect.MAV_LANDED_STATE_ON_GROUND

    @property
    def is_flying(self) -> bool:
        return self.armed and self.landed == dialect.MAV_LANDED_STATE_IN_AIR


def _since(before_ns: int | None, now_so: bool, now_ns: int) -> int | None:
    """Time since which a condition has held; None if it does not hold now (`now_so`)."""
    if not now_so:
        return None
    return now_ns if before_ns is None else before_ns
