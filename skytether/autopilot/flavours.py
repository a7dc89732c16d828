"""Flavours: tables of the differences between ArduCopter and PX4.

Parameters have the names, types and defaults of ArduCopter 4.5 and PX4 1.17. The tables contain the
parameters that `flight.py` uses, and parameters that a companion reads.
"""

from dataclasses import dataclass
from enum import Enum, auto
from typing import Literal

from skytether.mavlink.dialect import dialect
from skytether.quadrotor.loops import ARDUPILOT, PX4, Gains

FlavourName = Literal["ardupilot", "px4"]
Parameters = dict[str, int | float]
"""Values of parameters by name; ints for integer parameters."""


class FlightMode(Enum):
    """Mode of the vehicle, under a name common to both autopilots."""

    PILOT = auto()
    """A pilot flies; with centred sticks the vehicle holds its position."""
    HOLD = auto()
    """The vehicle brakes, then holds its position."""
    GUIDED = auto()
    """The vehicle follows a companion computer: GUIDED of ArduCopter, OFFBOARD of PX4."""
    TAKEOFF = auto()
    """The vehicle climbs to a commanded altitude."""
    RETURN = auto()
    """The vehicle flies home and lands."""
    LAND = auto()
    """The vehicle lands at its present position."""


@dataclass(frozen=True)
class SimulatedFlavour:
    """Constants, modes and parameters of one simulated autopilot."""

    title: str
    version: tuple[int, int, int]
    """Version on which the behaviour was measured."""
    autopilot: int
    bytewise: bool
    """Whether integer parameters are sent as the bits of a float, see `mavlink.parameters`."""
    gains: Gains
    frame: str
    """Airframe of the autopilot's own simulator, or the most similar frame in FRAMES."""
    ready_s: float
    """Time from the start until arming is allowed [s]; the autopilot's filters settle meanwhile."""
    words_for_stations: bool
    """Whether status texts are sent only to ground stations, as PX4 does."""
    fixed_heartbeats: bool
    """Whether the rate of the autopilot's heartbeats cannot be changed."""
    stamps_fixes: bool
    """Whether GPS fixes have a timestamp; PX4 sends 0 while its receiver has no date."""
    forwards: bool
    """Whether the autopilot forwards each peer's heartbeats to the other peers."""
    spool_s: float
    """Time from the take-off command until the vehicle climbs [s]."""
    wander_mps: float
    """Standard deviation of the velocity estimate's error along each axis [m/s]."""
    blind_s: float
    """Time from the last GPS fix until the estimate counts as lost and the vehicle lands [s]."""
    home: tuple[float, float, float]
    """Latitude [°], longitude [°] and altitude above the sea [m] of the start."""
    modes: dict[int, tuple[str, FlightMode]]
    """Name and meaning of each mode, by its number in the heartbeat."""
    first: int
    streams: dict[int, float]
    parameters: Parameters

    def number(self, mode: FlightMode) -> int:
        """Number of the first mode with this meaning."""
        return next(number for number, (_, kind) in self.modes.items() if kind is mode)


def _px4(main: int, sub: int = 0) -> int:
    """Number of a PX4 mode in a heartbeat."""
    return main << 16 | sub << 24


LOCAL_POSITION = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
CURRENT_MODE = 436
"""Message id of CURRENT_MODE. PX4 sends this message, but pymavlink's dialect lacks it."""
FLAVOURS: dict[FlavourName, SimulatedFlavour] = {
    "ardupilot": SimulatedFlavour(
        title="ArduCopter",
        version=(4, 5, 6),
        autopilot=int(dialect.MAV_AUTOPILOT_ARDUPILOTMEGA),
        bytewise=False,
        gains=ARDUPILOT,
        frame="1.5kg",
        ready_s=41.5,
        words_for_stations=False,
        fixed_heartbeats=False,
        stamps_fixes=True,
        forwards=False,
        spool_s=3.4,
        wander_mps=0.0,
        blind_s=7.9,
        home=(-35.363262, 149.165237, 584.0),
        modes={
            5: ("LOITER", FlightMode.PILOT),
            0: ("STABILIZE", FlightMode.PILOT),
            2: ("ALT_HOLD", FlightMode.PILOT),
            16: ("POSHOLD", FlightMode.PILOT),
            4: ("GUIDED", FlightMode.GUIDED),
            6: ("RTL", FlightMode.RETURN),
            9: ("LAND", FlightMode.LAND),
            17: ("BRAKE", FlightMode.HOLD),
        },
        first=0,
        streams={},
        parameters={
            "ANGLE_MAX": 3000,
            "ARMING_CHECK": 1,
            "BATT_FS_CRT_ACT": 0,
            "BATT_FS_LOW_ACT": 0,
            "BATT_LOW_VOLT": 10.5,
            "DISARM_DELAY": 10,
            "FENCE_ACTION": 1,
            "FENCE_ALT_MAX": 100.0,
            "FENCE_ENABLE": 0,
            "FENCE_RADIUS": 300.0,
            "FENCE_TYPE": 7,
            "FS_EKF_ACTION": 1,
            "FS_GCS_ENABLE": 0,
            "FS_GCS_TIMEOUT": 5.0,
            "FS_OPTIONS": 16,
            "FS_THR_ENABLE": 1,
            "GUID_OPTIONS": 0,
            "GUID_TIMEOUT": 3.0,
            "LAND_SPEED": 50,
            "PSC_JERK_XY": 5.0,
            "PSC_JERK_Z": 5.0,
            "PSC_POSXY_P": 1.0,
            "PSC_POSZ_P": 1.0,
            "PSC_VELXY_P": 2.0,
            "RTL_ALT": 1500,
            "RTL_ALT_FINAL": 0,
            "RTL_CONE_SLOPE": 3.0,
            "SYSID_MYGCS": 255,
            "SYSID_THISMAV": 1,
            "WPNAV_ACCEL": 250.0,
            "WPNAV_ACCEL_Z": 100.0,
            "WPNAV_SPEED": 1000.0,
            "WPNAV_SPEED_DN": 150.0,
            "WPNAV_SPEED_UP": 250.0,
        },
    ),
    "px4": SimulatedFlavour(
        title="PX4",
        version=(1, 17, 0),
        autopilot=int(dialect.MAV_AUTOPILOT_PX4),
        bytewise=True,
        gains=PX4,
        frame="sih",
        ready_s=4.6,
        words_for_stations=True,
        fixed_heartbeats=True,
        stamps_fixes=False,
        forwards=True,
        spool_s=1.0,
        wander_mps=0.16,
        blind_s=5.8,
        home=(47.397742, 8.545594, 489.4),
        modes={
            _px4(3): ("POSCTL", FlightMode.PILOT),
            _px4(1): ("MANUAL", FlightMode.PILOT),
            _px4(2): ("ALTCTL", FlightMode.PILOT),
            _px4(6): ("OFFBOARD", FlightMode.GUIDED),
            _px4(4, 3): ("AUTO.LOITER", FlightMode.HOLD),
            _px4(4, 2): ("AUTO.TAKEOFF", FlightMode.TAKEOFF),
            _px4(4, 5): ("AUTO.RTL", FlightMode.RETURN),
            _px4(4, 6): ("AUTO.LAND", FlightMode.LAND),
        },
        first=_px4(4, 3),
        streams={
            int(dialect.MAVLINK_MSG_ID_SYS_STATUS): 1.0,
            int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): 1.0,
            int(dialect.MAVLINK_MSG_ID_ATTITUDE): 15.0,
            LOCAL_POSITION: 30.0,
            int(dialect.MAVLINK_MSG_ID_TIMESYNC): 10.0,
            CURRENT_MODE: 0.5,
        },
        parameters={
            "BAT_CRIT_THR": 0.07,
            "BAT_LOW_THR": 0.15,
            "COM_DISARM_LAND": 2.0,
            "COM_DISARM_PRFLT": 10.0,
            "COM_DL_LOSS_T": 10,
            "COM_LOW_BAT_ACT": 0,
            "COM_OBL_RC_ACT": 0,
            "COM_OF_LOSS_T": 1.0,
            "COM_RC_IN_MODE": 3,
            "GF_ACTION": 2,
            "GF_MAX_HOR_DIST": 0.0,
            "GF_MAX_VER_DIST": 0.0,
            "MAV_SYS_ID": 1,
            "MIS_TAKEOFF_ALT": 2.5,
            "MPC_LAND_SPEED": 0.7,
            "MPC_TILTMAX_AIR": 45.0,
            "MPC_TKO_SPEED": 1.5,
            "MPC_XY_CRUISE": 5.0,
            "MPC_XY_P": 0.95,
            "MPC_XY_VEL_I_ACC": 0.4,
            "MPC_XY_VEL_MAX": 12.0,
            "MPC_XY_VEL_P_ACC": 1.8,
            "MPC_Z_P": 1.0,
            "MPC_Z_VEL_MAX_DN": 1.5,
            "MPC_Z_VEL_MAX_UP": 3.0,
            "NAV_DLL_ACT": 0,
            "NAV_RCL_ACT": 2,
            "RTL_CONE_ANG": 45,
            "RTL_DESCEND_ALT": 30.0,
            "RTL_LAND_DELAY": 0.0,
            "RTL_RETURN_ALT": 60.0,
        },
    ),
}
