"""ArduCopter 4.5, as measured: without set-points the vehicle stops, and stays in GUIDED."""

from math import hypot

from skytether.autopilot.flavours import FlightMode
from skytether.autopilot.flight import (
    CompanionSetpoint,
    OwnSpeeds,
    PilotedVehicle,
    Result,
    Severity,
)
from skytether.quadrotor.loops import Gains
from skytether.shared.base.units import SECOND_NS

LEAST = 0.1
"""Lower bound of every gain and limit; a smaller parameter is raised to it."""
LANDED_S = 2.0
"""Time on the ground after which a landing counts as finished [s], as measured."""
STATION_ACTIONS = {
    1: FlightMode.RETURN,
    3: FlightMode.RETURN,
    4: FlightMode.RETURN,
    5: FlightMode.LAND,
    7: FlightMode.HOLD,
}
"""Modes by the value of FS_GCS_ENABLE. SmartRTL is simulated as RTL: no return path is stored."""
BATTERY_ACTIONS = {
    1: FlightMode.LAND,
    2: FlightMode.RETURN,
    3: FlightMode.RETURN,
    4: FlightMode.LAND,
}
"""Modes by the value of BATT_FS_LOW_ACT."""
FENCE_ACTIONS = {1: FlightMode.RETURN, 2: FlightMode.LAND, 4: FlightMode.HOLD}
"""Modes by the value of FENCE_ACTION."""


class ArduPilot(PilotedVehicle):
    refusal = Result.FAILED
    arming_word = "Arming"
    lifts_off_by_setpoint = False

    def why_not_armed(self) -> str:
        if self.mode in (FlightMode.LAND, FlightMode.RETURN, FlightMode.HOLD):
            return f"Arm: {self.mode_name} mode not armable"
        if not self.ready and self.parameters["ARMING_CHECK"]:
            return "PreArm: Need Position Estimate"
        if self.quadrotor.battery().charge < self.low and self.parameters["ARMING_CHECK"]:
            return "PreArm: Battery 1 below minimum arming voltage"
        return ""

    def why_not_guided(self) -> str:
        return ""

    def mode_number(self, main: int, sub: int) -> int:  # noqa: ARG002
        """Number of a mode in a heartbeat, equal to the main mode in a command."""
        return main

    def takes_setpoints(self) -> bool:
        return self.mode is FlightMode.GUIDED

    def altitude_of(self, altitude: float) -> float | None:
        """Altitude above home [m]: the commanded altitude, which ArduCopter counts from home."""
        return altitude

    def enter_takeoff(self) -> bool:
        """Enter GUIDED, in which the vehicle climbs."""
        return self.mode is FlightMode.GUIDED

    def limits(self) -> OwnSpeeds:
        p = self.parameters
        return OwnSpeeds(
            speed=p["WPNAV_SPEED"] / 100.0,
            up=p["WPNAV_SPEED_UP"] / 100.0,
            down=p["WPNAV_SPEED_DN"] / 100.0,
            land=p["LAND_SPEED"] / 100.0,
            p=max(p["PSC_POSXY_P"], LEAST),
            p_up=max(p["PSC_POSZ_P"], LEAST),
            acceleration=max(p["WPNAV_ACCEL"] / 100.0, LEAST),
            acceleration_up=max(p["WPNAV_ACCEL_Z"] / 100.0, LEAST),
        )

    def gains(self) -> Gains:
        p = self.parameters
        return self.flavour.gains._replace(
            jerk=max(p["PSC_JERK_XY"], LEAST),
            acceleration=max(p["WPNAV_ACCEL"] / 100.0, LEAST),
            jerk_up=max(p["PSC_JERK_Z"], LEAST),
            acceleration_up=max(p["WPNAV_ACCEL_Z"] / 100.0, LEAST),
            catch_up=max(p["PSC_POSXY_P"], LEAST),
            p=max(p["PSC_VELXY_P"], LEAST),
        )

    def is_station(self, system: int, kind: int) -> bool:  # noqa: ARG002
        return system == self.parameters["SYSID_MYGCS"]

    def return_altitude(self, distance: float) -> float:
        """Altitude of the flight home [m]: RTL_ALT, or lower near home."""
        cone = self.parameters["RTL_CONE_SLOPE"] * distance
        return min(self.parameters["RTL_ALT"] / 100.0, max(cone, 2.0))

    def silence(self, setpoint: CompanionSetpoint) -> bool:
        """Whether the vehicle must brake: no set-point has arrived for GUID_TIMEOUT."""
        past_s = (self.now_ns - setpoint.came_ns) / SECOND_NS
        return past_s > self.parameters["GUID_TIMEOUT"]

    def watch(self) -> None:
        p = self.parameters
        if self.station_ns is not None:
            past_s = (self.now_ns - self.station_ns) / SECOND_NS
            lost = past_s > p["FS_GCS_TIMEOUT"]
            action = STATION_ACTIONS.get(int(p["FS_GCS_ENABLE"]))
            if lost and action and self.mode is not FlightMode.PILOT and self.once("station"):
                self.act(action, "GCS Failsafe")
        if self.quadrotor.battery().charge < self.low and self.once("battery"):
            action = BATTERY_ACTIONS.get(int(p["BATT_FS_LOW_ACT"]))
            self.say("Battery 1 is low", Severity.WARNING)
            if action:
                self.act(action, "Battery Failsafe")
        x, y, z = self.position()
        high = int(p["FENCE_TYPE"]) & 1 and z > p["FENCE_ALT_MAX"]
        far = int(p["FENCE_TYPE"]) & 2 and hypot(x, y) > p["FENCE_RADIUS"]
        if p["FENCE_ENABLE"] and (high or far) and self.once("fence"):
            self.say("Fence Breached", Severity.WARNING)
            action = FENCE_ACTIONS.get(int(p["FENCE_ACTION"]))
            if action:
                self.act(action, f"Fence: {action.name.lower()}")

    def idle_s(self) -> float:
        landed = self.mode in (FlightMode.LAND, FlightMode.RETURN)
        return LANDED_S if landed else self.parameters["DISARM_DELAY"]
