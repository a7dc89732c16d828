"""PX4 1.17, as measured: when set-points stop, PX4 leaves OFFBOARD and flies home.

A failsafe replaces the requested mode only temporarily: when set-points come again, PX4 returns to
OFFBOARD by itself. After disarming, PX4 is in the newest requested mode that allows arming, such as
OFFBOARD after a landing.
"""

from math import hypot, isfinite, radians, tan

import numpy as np

from skytether.autopilot.flavours import FlightMode, SimulatedFlavour
from skytether.autopilot.flight import (
    CompanionSetpoint,
    OwnSpeeds,
    PilotedVehicle,
    Result,
    Severity,
    Vector,
)
from skytether.mavlink.dialect import dialect
from skytether.quadrotor.loops import Gains
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.base.units import SECOND_NS

LEAST = 0.1
"""Lower bound of every gain; a smaller parameter is raised to it."""
SILENCE_LAG_S = 0.2
"""Time from the end of COM_OF_LOSS_T until PX4 acts [s], as measured."""
OFFBOARD_ACTIONS = {4: FlightMode.LAND, 5: FlightMode.HOLD}
"""Modes by the value of COM_OBL_RC_ACT; without a remote control, other values mean RETURN."""
STATION_ACTIONS = {1: FlightMode.HOLD, 2: FlightMode.RETURN, 3: FlightMode.LAND}
"""Modes by the value of NAV_DLL_ACT."""
BATTERY_ACTIONS = {2: FlightMode.LAND, 3: FlightMode.RETURN}
"""Modes by the value of COM_LOW_BAT_ACT."""
UNARMABLE = (FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN)
"""Modes that PX4 leaves after disarming."""
FENCE_ACTIONS = {2: FlightMode.HOLD, 3: FlightMode.RETURN, 5: FlightMode.LAND}
"""Modes by the value of GF_ACTION."""


class PX4(PilotedVehicle):
    refusal = Result.REJECTED
    arming_word = ""
    lifts_off_by_setpoint = True

    def __init__(
        self,
        flavour: SimulatedFlavour,
        quadrotor: Quadrotor,
        ready_s: float,
        noise: np.random.Generator,
    ) -> None:
        super().__init__(flavour, quadrotor, ready_s, noise)
        self._covered = False
        """Whether a failsafe replaces OFFBOARD until set-points come again."""
        self._after_disarming = flavour.first

    def switch(self, number: int) -> Result:
        result = super().switch(number)
        if result is Result.ACCEPTED:
            self._covered = False
            if self.flavour.modes[number][1] not in UNARMABLE:
                self._after_disarming = number
        return result

    def disarm(self, *, force: bool = False) -> Result:
        result = super().disarm(force=force)
        if result is Result.ACCEPTED:
            self._covered = False
            self.enter(self._after_disarming)
        return result

    def want(self, velocity: Vector, position: Vector | None) -> None:
        super().want(velocity, position)
        if self._covered:
            self._covered = False
            self.enter(self.flavour.number(FlightMode.GUIDED))

    def why_not_armed(self) -> str:
        """Reason why arming is refused, in PX4's words; some texts end with a tab."""
        unguided = self.mode is FlightMode.GUIDED and self.why_not_guided()
        if unguided or not self.ready:
            return "Arming denied: Resolve system health failures first\t"
        if self.quadrotor.battery().charge < self.parameters["BAT_LOW_THR"]:
            return "Arming denied: low battery"
        if self.mode is FlightMode.PILOT:
            return "Arming denied: manual control signal lost"
        return ""

    def why_not_guided(self) -> str:
        """Reason why OFFBOARD is refused: set-points must already be arriving."""
        setpoint = self._setpoint
        if setpoint is None or self._past_s(setpoint) > self.parameters["COM_OF_LOSS_T"]:
            return "Switching to mode 'Offboard' is currently not possible"
        return ""

    def forget(self) -> None:
        """Do nothing, because PX4 keeps the set-points that arrived before it entered OFFBOARD."""

    def mode_number(self, main: int, sub: int) -> int:
        return main << 16 | max(sub, 0) << 24

    def takes_setpoints(self) -> bool:
        return True

    def altitude_of(self, altitude: float) -> float | None:
        """Altitude above home [m], from an altitude above the sea; for NaN, MIS_TAKEOFF_ALT."""
        if isfinite(altitude):
            return altitude - self.flavour.home[2]
        return self.parameters["MIS_TAKEOFF_ALT"]

    def enter_takeoff(self) -> bool:
        if not self.ready:
            return False
        self.enter(self.flavour.number(FlightMode.TAKEOFF))
        return True

    def limits(self) -> OwnSpeeds:
        p, climbs = self.parameters, self.mode is FlightMode.TAKEOFF
        guided = self.mode is FlightMode.GUIDED
        return OwnSpeeds(
            speed=p["MPC_XY_VEL_MAX"] if guided else p["MPC_XY_CRUISE"],
            up=p["MPC_TKO_SPEED"] if climbs else p["MPC_Z_VEL_MAX_UP"],
            down=p["MPC_Z_VEL_MAX_DN"],
            land=p["MPC_LAND_SPEED"],
            p=max(p["MPC_XY_P"], LEAST),
            p_up=max(p["MPC_Z_P"], LEAST),
            acceleration=3.0,
            acceleration_up=3.0,
        )

    def gains(self) -> Gains:
        p = self.parameters
        return self.flavour.gains._replace(
            p=max(p["MPC_XY_VEL_P_ACC"], LEAST),
            i=p["MPC_XY_VEL_I_ACC"],
            tilt_max=radians(p["MPC_TILTMAX_AIR"]),
        )

    def is_station(self, system: int, kind: int) -> bool:  # noqa: ARG002
        return kind == dialect.MAV_TYPE_GCS

    def return_altitude(self, distance: float) -> float:
        """Altitude of the flight home [m]: RTL_RETURN_ALT, or lower near home."""
        cone = distance * tan(radians(self.parameters["RTL_CONE_ANG"]))
        return min(self.parameters["RTL_RETURN_ALT"], cone)

    def _past_s(self, setpoint: CompanionSetpoint) -> float:
        return (self.now_ns - setpoint.came_ns) / SECOND_NS

    def silence(self, setpoint: CompanionSetpoint) -> bool:
        """Leave OFFBOARD after COM_OF_LOSS_T without set-points; return whether PX4 has left it."""
        if self._past_s(setpoint) <= self.parameters["COM_OF_LOSS_T"] + SILENCE_LAG_S:
            return False
        value = int(self.parameters["COM_OBL_RC_ACT"])
        mode = OFFBOARD_ACTIONS.get(value, FlightMode.RETURN)
        self.act(mode, "Failsafe activated: no offboard signal")
        self._covered = True
        return True

    def watch(self) -> None:
        p = self.parameters
        if self.station_ns is not None:
            past_s = (self.now_ns - self.station_ns) / SECOND_NS
            action = STATION_ACTIONS.get(int(p["NAV_DLL_ACT"]))
            if past_s > p["COM_DL_LOSS_T"] and action and self.once("station"):
                self.act(action, "Failsafe activated: no connection to ground station")
        charge = self.quadrotor.battery().charge
        if charge < p["BAT_LOW_THR"] and self.once("battery"):
            self.say("Low battery level", Severity.WARNING)
        action = BATTERY_ACTIONS.get(int(p["COM_LOW_BAT_ACT"]))
        if charge < p["BAT_CRIT_THR"] and action and self.once("battery critical"):
            self.act(action, "Failsafe activated: critical battery level")
        x, y, z = self.position()
        far = 0.0 < p["GF_MAX_HOR_DIST"] < hypot(x, y)
        high = 0.0 < p["GF_MAX_VER_DIST"] < z
        if (far or high) and self.once("fence"):
            self.say("Geofence exceeded", Severity.WARNING)
            action = FENCE_ACTIONS.get(int(p["GF_ACTION"]))
            if action:
                self.act(action, f"Failsafe activated: geofence, {action.name.lower()}")

    def idle_s(self) -> float:
        landed = self.mode in (FlightMode.LAND, FlightMode.RETURN)
        return self.parameters["COM_DISARM_LAND" if landed else "COM_DISARM_PRFLT"]
