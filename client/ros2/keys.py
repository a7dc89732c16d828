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
    """Whether commands are geometry_msgs/TwistStamped; otherwise Twist. auto: the type that the
    subscriber of `command` expects."""
    drive: OfVehicle[Literal["holonomic", "differential", "fixed"]] = "holonomic"
    """Kind of commands: holonomic: any velocity in the robot's frame; differential: forwards and a
    turn; fixed: any velocity in the fixed frame of its odometry."""
    ahead_m: OfVehicle[Annotated[float, Meta(ge=0.01, le=10)]] = 0.2
    """Distance from the axle forwards to the point that follows a plan (`differential`) [m]."""
    origin: OfVehicle[Literal["start", "odometry"]] = "start"
    """Origin of the scenario: start: the robot's position at the start (on a mission, that position
    is its first goal); odometry: the origin of its odometry."""
    silence_s: OfVehicle[Annotated[float, Meta(ge=0.05, le=5)]] = 0.5
    """Time without odometry after which the robot brakes [s]."""


SECTION = Ros2Config
