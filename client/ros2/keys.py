"""Keys of a robot that speaks ROS 2."""

from typing import Annotated, Literal

from msgspec import Meta

from skytether.shared.scenario.owners import OfVehicle
from skytether.shared.scenario.schema import Section, TopicName


class Ros2Config(Section, frozen=True):
    """Robot of a vehicle of the kind `ros2`, see docs/ros2.md."""

    domain: OfVehicle[Annotated[int, Meta(ge=0, le=232)]] = 0
    """Domain of the robot's nodes (ROS_DOMAIN_ID)."""
    odometry: OfVehicle[TopicName] = "/odom"
    """Topic of nav_msgs/Odometry."""
    command: OfVehicle[TopicName] = "/cmd_vel"
    """Topic on which velocities are commanded."""
    stamped: OfVehicle[bool | Literal["auto"]] = "auto"
    """Type of commands: true: geometry_msgs/TwistStamped; false: Twist; auto: the type that the
    subscriber of `command` expects."""
    drive: OfVehicle[Literal["holonomic", "differential", "fixed"]] = "holonomic"
    """Kind of commands: holonomic: any velocity in the robot's frame; differential: forward speed
    and turn rate; fixed: any velocity in the fixed frame of the robot's odometry."""
    ahead_m: OfVehicle[Annotated[float, Meta(ge=0.01, le=10)]] = 0.2
    """Distance from the axle to the point ahead that follows a plan [m]; `differential` only."""
    origin: OfVehicle[Literal["start", "odometry"]] = "start"
    """Origin of the scenario: start: the robot's position at the start (on a mission, this position
    is its first goal); odometry: the origin of its odometry."""
    silence_s: OfVehicle[Annotated[float, Meta(ge=0.05, le=5)]] = 0.5
    """Time without odometry after which the robot brakes [s]."""


SECTION = Ros2Config
