"""Messages of the ROS 2 types that Skytether uses, encoded and decoded in CDR by rosbags."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores.ros2_jazzy import FIELDDEFS

from skytether.ros2.graph import Topic
from skytether.shared.base.units import SECOND_NS

ODOMETRY = "nav_msgs/msg/Odometry"
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
POSE_STAMPED, PATH = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"
PARTS = (
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/Header",
    *(f"geometry_msgs/msg/{name}" for name in ("Point", "Quaternion", "Vector3", "Pose")),
    *(f"geometry_msgs/msg/{name}" for name in ("PoseWithCovariance", "TwistWithCovariance")),
)
STORE = Typestore()
# Loading only these types takes a tenth of the time and memory of loading all types of ROS 2.
USED = (*PARTS, TWIST, TWIST_STAMPED, ODOMETRY, POSE_STAMPED, PATH)
STORE.register({kind: FIELDDEFS[kind] for kind in USED})
POSE_PARTS = "Point", "Pose", "PoseStamped"
UNIT = 0.01
"""Largest deviation from 1 of the length of a quaternion."""

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]
"""Rows of the rotation matrix from a robot's axes to its fixed frame's axes; shape (3, 3)."""


class MessageError(ValueError):
    """The bytes are no message of the expected type, or the message has invalid numbers."""


class Odometry(NamedTuple):
    stamp_ns: int
    """Time of measurement on the robot's clock [ns]."""
    frame: str
    """Fixed frame of position and rotation."""
    child: str
    """Frame of the velocities, fixed to the robot."""
    position: Vector
    """Position of the robot in the fixed frame [m]."""
    rotation: Rotation
    velocity: Vector
    """Velocity of the robot in the frame `child` [m/s]."""
    turn: Vector
    """Angular velocity of the robot in the frame `child` [rad/s]."""


class Goal(NamedTuple):
    frame: str
    position: Vector
    """Position in the frame `frame` [m]."""


def topic(name: str, kind: str) -> Topic:
    return Topic(name, kind, STORE.hash_rihs01(kind))


def odometry(payload: bytes) -> Odometry:
    """Decode nav_msgs/Odometry.

    Raises:
        MessageError: the bytes are not such a message, or its orientation is not a rotation.
    """
    message = _decoded(payload, ODOMETRY)
    header, pose, twist = message.header, message.pose.pose, message.twist.twist
    return Odometry(
        header.stamp.sec * SECOND_NS + header.stamp.nanosec,
        header.frame_id,
        message.child_frame_id,
        _vector(pose.position),
        rotation(pose.orientation.w, *_vector(pose.orientation)),
        _vector(twist.linear),
        _vector(twist.angular),
    )


def goal(payload: bytes) -> Goal:
    """Decode geometry_msgs/PoseStamped, without its orientation.

    Raises:
        MessageError: the bytes are not such a message, or its position is not finite.
    """
    message = _decoded(payload, POSE_STAMPED)
    position = _vector(message.pose.position)
    if not all(map(math.isfinite, position)):
        raise MessageError("the position is not finite")
    return Goal(message.header.frame_id, position)


def _decoded(payload: bytes, kind: str) -> Any:
    try:
        return STORE.deserialize_cdr(payload, kind)
    except SerdeError as error:
        raise MessageError(str(error)) from None


def rotation(w: float, x: float, y: float, z: float) -> Rotation:
    """Rotation of a unit quaternion; raises MessageError for other quaternions."""
    if not abs(math.hypot(w, x, y, z) - 1.0) <= UNIT:
        raise MessageError("the orientation is not a unit quaternion")
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def twist(linear: Vector, turn: float) -> bytes:
    """Encode geometry_msgs/Twist, with an angular velocity about the vertical axis [rad/s]."""
    return bytes(STORE.serialize_cdr(_twist(linear, turn), TWIST))


def twist_stamped(stamp_ns: int, frame: str, linear: Vector, turn: float) -> bytes:
    """Encode geometry_msgs/TwistStamped; `stamp_ns` is a time on the robot's clock."""
    types: Any = STORE.types
    message = types[TWIST_STAMPED](_header(stamp_ns, frame), _twist(linear, turn))
    return bytes(STORE.serialize_cdr(message, TWIST_STAMPED))


def path(stamp_ns: int, frame: str, positions: Sequence[Vector]) -> bytes:
    """Encode nav_msgs/Path: positions in a frame [m], one time stamp for all, no rotations."""
    types: Any = STORE.types
    point, pose, stamped = (types[f"geometry_msgs/msg/{name}"] for name in POSE_PARTS)
    level = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    header = _header(stamp_ns, frame)
    poses = [stamped(header, pose(point(*position), level)) for position in positions]
    return bytes(STORE.serialize_cdr(types[PATH](header, poses), PATH))


def _header(stamp_ns: int, frame: str) -> Any:
    types: Any = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(max(stamp_ns, 0), SECOND_NS))
    return types["std_msgs/msg/Header"](stamp, frame)


def _twist(linear: Vector, turn: float) -> Any:
    types: Any = STORE.types
    vector = types["geometry_msgs/msg/Vector3"]
    return types[TWIST](vector(*linear), vector(0.0, 0.0, turn))


def _vector(message: Any) -> Vector:
    return message.x, message.y, message.z
