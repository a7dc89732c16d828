"""A vehicle with a MAVLink autopilot: velocities in, measurements out."""

from collections.abc import Sequence

import numpy as np

from skytether.client.mavlink import keys
from skytether.client.mavlink.keys import MavlinkConfig
from skytether.client.mavlink.port import Port
from skytether.client.mavlink.positions import given_origin
from skytether.client.vehicle import Measurement, Vehicle, VehicleMemory
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.line import parse_line
from skytether.shared.events.flight import Failure
from skytether.shared.law.model import Array
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

PLANE_ALTITUDE_M = 3.0
"""Altitude of the flight of a vehicle with two axes [m]."""
ORIGIN = keys_of(keys.ORIGIN)
ALTITUDE_MIN_M = 0.5


class MavlinkVehicle(Vehicle):
    """A vehicle flown by an autopilot.

    Raises:
        ConfigError: the address of the autopilot is invalid, or the flight begins on the ground.
    """

    returns = True
    drifts = True
    changeable = keys_of(InFlight.ARMED, keys.ORIGIN)

    def __init__(self, scenario: Scenario, number: int) -> None:
        line = parse_line("vehicle.address", scenario.vehicle.address)
        self._may_arm = scenario.armed
        self._port = self.port = Port(scenario, number, line, altitude(scenario, number))
        self._autopilot = self._port.autopilot

    @property
    def failure(self) -> Failure | None:  # type: ignore[override] # set in flight
        return self._autopilot.failure

    def set_parameters(self) -> bool:
        self._autopilot.sets_parameters = True
        return True

    def fly(self, velocity: Array) -> None:
        """Fly with a velocity [m/s]; with two axes the vehicle keeps its altitude."""
        x, y, *up = velocity.tolist()
        self._port.fly((x, y, up[0] if up else 0.0))

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        return self._autopilot.positions.take(now_ns=now_ns)

    @property
    def is_ready(self) -> bool:
        return self._autopilot.is_ready

    @property
    def waits_for(self) -> str:
        return self._autopilot.waits_for

    def take_off(self, *, now_ns: int) -> bool:
        """Take off; the client arms a vehicle on the ground only if the key `armed` is true."""
        return self._port.take_off(may_arm=self._may_arm, now_ns=now_ns)

    def is_up(self, *, now_ns: int) -> bool:
        return self._port.take_off(may_arm=False, now_ns=now_ns)

    @property
    def took_off(self) -> bool:
        return self._autopilot.took_off

    @property
    def frame(self) -> VehicleMemory:
        return self._autopilot.frame

    def recall(self, frame: VehicleMemory) -> None:
        self._autopilot.recall(frame)

    def arm(self) -> None:
        self._autopilot.arm()

    def hindrance(self, *, now_ns: int) -> Reason | None:
        return self._port.hindrance(now_ns=now_ns)

    @property
    def leap_m(self) -> tuple[float, ...] | None:  # type: ignore[override] # set in flight
        return self._autopilot.positions.leap_m

    def decide(self, *, keeps_frame: bool) -> None:
        self._autopilot.positions.decide(keeps_frame=keeps_frame)

    def land(self) -> bool:
        self._port.land()
        return True

    def return_home(self) -> None:
        self._port.return_home()

    @property
    def is_down(self) -> bool:
        return self._port.is_down

    def change(self, scenario: Scenario) -> None:
        """Apply changed keys; setting `armed` lets the vehicle take off."""
        self._may_arm = scenario.armed
        origin, positions = given_origin(scenario), self._autopilot.positions
        if origin is not None and not positions.has_origin:
            positions.place(origin)

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        """Refuse to change a known origin, because a change would move the fence in flight."""
        if keys & ORIGIN and self._autopilot.positions.has_origin:
            x, y, z = self._autopilot.positions.origin
            origin_text = f"the origin is known: [{x:.2f}, {y:.2f}, {z:.2f}]"
            return (
                f"mavlink.origin: got {scenario.section(MavlinkConfig).origin}, but {origin_text}"
            )
        return ""


def altitude(scenario: Scenario, number: int = 1) -> float:
    """Take-off altitude of a vehicle [m]; ConfigError if the flight would begin on the ground."""
    takeoff_m = scenario.section(MavlinkConfig).takeoff_m
    if takeoff_m != "auto":
        return float(takeoff_m)
    if scenario.model.axes == 2:
        return PLANE_ALTITUDE_M
    start = float(scenario.unallocated_reference(number)(np.zeros(()))[2, 0])
    if start < ALTITUDE_MIN_M:
        expected = (
            f"a desired trajectory that begins {ALTITUDE_MIN_M:g} m or more above the ground, or "
            f"the altitude of take-off: --mavlink.takeoff-m {PLANE_ALTITUDE_M:g}"
        )
        raise ConfigError(f"mavlink.takeoff_m: got 'auto' at altitude {start:g} m, {expected}")
    return start
