"""A robot that speaks ROS 2: velocities in, measurements out."""

from collections.abc import Sequence

from skytether.client.ros2.keys import Ros2Config
from skytether.client.ros2.port import Port
from skytether.client.vehicle import Measurement, Vehicle, VehicleMemory
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.line import parse_line
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason


class Ros2Vehicle(Vehicle):
    """A robot that follows commanded velocities.

    Raises:
        ConfigError: the address is not that of a Zenoh router or peer, or the scenario of a
            differential robot has three axes.
    """

    def __init__(self, scenario: Scenario, number: int) -> None:
        address = scenario.vehicle.address
        line = parse_line("vehicle.address", address)
        if line.kind != "tcp":
            expected = "tcp:HOST:PORT of a Zenoh router with vehicle.kind = 'ros2'"
            raise ConfigError(f"vehicle.address: got {address!r}, expected {expected}")
        if scenario.section(Ros2Config).drive == "differential" and scenario.model.axes != 2:
            expected = "expected 'holonomic' or 'fixed' with model.axes = 3"
            raise ConfigError(f"ros2.drive: got 'differential', {expected}")
        self._port = self.port = Port(scenario, number, line)
        self.node = self._port.node
        self._positions = self._port.odometry.positions
        self._placed = 0
        """Number of measurements before the origin was set; a flight begins after a later one."""

    def fly(self, velocity: Array) -> None:
        x, y, *up = velocity.tolist()
        self._port.fly((x, y, up[0] if up else 0.0))

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        return self._positions.take(now_ns=now_ns)

    @property
    def is_ready(self) -> bool:
        return self._port.is_ready

    @property
    def waits_for(self) -> str:
        return self._port.waits_for

    def take_off(self, *, now_ns: int) -> bool:
        """Set the origin to the robot's position, unless it is known. A robot needs no take-off."""
        self._port.now_ns = now_ns
        if self._port.is_ready and not self._positions.has_origin:
            self._positions.begin()
            self._placed = self._positions.taken
        return self.is_up(now_ns=now_ns)

    def is_up(self, *, now_ns: int) -> bool:
        self._port.now_ns = now_ns
        positions = self._positions
        return self._port.is_ready and positions.has_origin and positions.taken > self._placed

    @property
    def frame(self) -> VehicleMemory:
        return self._positions.frame(armed=False)

    def recall(self, frame: VehicleMemory) -> None:
        self._positions.recall(frame)

    def hindrance(self, *, now_ns: int) -> Reason | None:
        return self._port.hindrance(now_ns=now_ns)

    @property
    def leap_m(self) -> tuple[float, ...] | None:  # type: ignore[override] # set in flight
        return self._positions.leap_m

    def decide(self, *, keeps_frame: bool) -> None:
        self._positions.decide(keeps_frame=keeps_frame)

    def land(self) -> bool:
        """Stop: send zero velocities for a while, then nothing."""
        self._port.land()
        return True

    @property
    def is_down(self) -> bool:
        return self._port.is_down
