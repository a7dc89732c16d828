"""Vehicle kind "ros2"."""

from skytether.client.vehicle import Vehicle
from skytether.shared.base import extras
from skytether.shared.scenario.registry import VEHICLES
from skytether.shared.scenario.schema import Scenario


@VEHICLES
def ros2(scenario: Scenario, number: int) -> Vehicle:
    """Robot that speaks ROS 2 over rmw_zenoh at `vehicle.address`, driven by velocities."""
    extras.need("ros2")
    from skytether.client.ros2.vehicle import Ros2Vehicle

    return Ros2Vehicle(scenario, number)
