"""Vehicle kind "mavlink"."""

from skytether.client.vehicle import Vehicle
from skytether.shared.base import extras
from skytether.shared.scenario.registry import VEHICLES
from skytether.shared.scenario.schema import Scenario


@VEHICLES
def mavlink(scenario: Scenario, number: int) -> Vehicle:
    """ArduCopter or PX4 at `vehicle.address`, flown by velocities over MAVLink."""
    with extras.named():
        from skytether.client.mavlink.vehicle import MavlinkVehicle
    return MavlinkVehicle(scenario, number)
