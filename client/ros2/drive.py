"""The controlled point of a robot, and the command that gives this point a velocity.

A holonomic robot moves in every direction, and its controlled point is the origin p of its child
frame. A differential robot can only drive forwards or backwards, and turn: its point is `ahead`
metres in front of the axle, where every velocity is possible (feedback linearisation). With the
rotation R, velocity v and turn rate ω of the robot:

    position = p + R (ahead, 0, 0)      velocity = R (v + (0, ahead ω, 0))
    command: linear x = (Rᵀ u)₁, and turn = (Rᵀ u)₂ / ahead

The heading then follows the motion, and is stable while the robot drives forward.
"""

from collections.abc import Sequence
from typing import NamedTuple

from skytether.ros2.messages import Odometry, Rotation, Vector


class Command(NamedTuple):
    frame: str
    linear: Vector
    """Linear velocity in the frame of the command [m/s]."""
    turn: float
    """Turn rate about the vertical axis [rad/s]."""


def point(odometry: Odometry, ahead: float) -> tuple[Vector, Vector]:
    """Position [m] and velocity [m/s], in the fixed frame, of the point `ahead` metres in front."""
    x, y, z = odometry.velocity
    if odometry.child != odometry.frame:
        velocity = from_robot(odometry.rotation, (x, y + ahead * odometry.turn[2], z))
    else:  # the velocity is already in the fixed frame
        dx, dy, dz = from_robot(odometry.rotation, (0.0, ahead * odometry.turn[2], 0.0))
        velocity = x + dx, y + dy, z + dz
    px, py, pz = odometry.position
    dx, dy, dz = from_robot(odometry.rotation, (ahead, 0.0, 0.0))
    return (px + dx, py + dy, pz + dz), velocity


def command(velocity: Vector, odometry: Odometry, drive: str, ahead: float) -> Command:
    """Command that gives the controlled point a velocity, in the fixed frame [m/s]."""
    if drive == "fixed":
        return Command(odometry.frame, velocity, 0.0)
    forward, left, up = to_robot(odometry.rotation, velocity)
    if drive == "differential":
        return Command(odometry.child, (forward, 0.0, 0.0), left / ahead)
    return Command(odometry.child, (forward, left, up), 0.0)


def from_robot(rotation: Rotation, vector: Sequence[float]) -> Vector:
    x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in rotation)
    return x, y, z


def to_robot(rotation: Rotation, vector: Sequence[float]) -> Vector:
    x, y, z = zip(*rotation, strict=True)
    return from_robot((x, y, z), vector)
